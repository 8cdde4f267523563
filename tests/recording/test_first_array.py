"""The first array that is sent or recorded costs no import: it would hold up the tick in which that happens."""

import subprocess
import sys

import pytest

pytestmark = pytest.mark.process

PROGRAM = """
import sys
import numpy as np
from madns_runtime.protocol.codec import pack, unpack
from madns_runtime.recording.encoding import count_not_finite

before = set(sys.modules)
assert unpack(pack(np.zeros(3))).tolist() == [0.0, 0.0, 0.0]
assert count_not_finite(np.array([np.nan, 1.0])) == 1
print(sorted(set(sys.modules) - before))
"""


def test_the_first_array_imports_nothing():
    told = subprocess.run([sys.executable, "-c", PROGRAM], check=True, stdout=subprocess.PIPE)

    assert told.stdout == b"[]\n"
