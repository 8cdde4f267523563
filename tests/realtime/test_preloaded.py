"""What each agent would import for itself in its set-up is there before agents are forked."""

import subprocess
import sys

import pytest

pytestmark = pytest.mark.process

PROGRAM = """
import sys
import madns_runtime.realtime.supervisor

print(sorted({"encodings.idna", "numpy.random"} - set(sys.modules)))
"""


def test_what_every_agent_needs_is_imported_once_for_all():
    told = subprocess.run([sys.executable, "-c", PROGRAM], check=True, stdout=subprocess.PIPE)

    assert told.stdout == b"[]\n"
