"""What `cosmos` sees to before its program is imported."""

import os
import subprocess
import sys

import pytest

pytestmark = pytest.mark.process

STARTED = """
import sys
sys.argv = ["cosmos", "--version"]
from cosmos_cli import start
try:
    start.main()
except SystemExit:
    import numpy, os
    print(len(os.listdir("/proc/self/task")))
"""


def threads(variable):
    """Return how many threads a command has once numpy is imported, if the user's environment says *variable* of them."""
    others = {key: each for key, each in os.environ.items() if not key.endswith("_NUM_THREADS")}
    done = subprocess.run(
        [sys.executable, "-P", "-c", STARTED],
        env=others | variable,
        capture_output=True,
        text=True,
        check=True,
        timeout=60,
    )
    return int(done.stdout.splitlines()[-1])


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="counts threads in /proc")
def test_numpy_has_no_threads_of_its_own():
    assert threads({}) == 1


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="counts threads in /proc")
@pytest.mark.skipif((os.cpu_count() or 1) < 2, reason="one processor")
def test_whoever_asks_for_threads_has_them():
    assert threads({"OPENBLAS_NUM_THREADS": "2"}) == 2
