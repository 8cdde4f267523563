"""A process that hangs ends when the other end of its line has closed, and only then."""

from __future__ import annotations

import socket
import subprocess
import sys

import pytest

pytestmark = pytest.mark.process

PATIENCE_S = 60.0
HANGING = """
import sys, time
from madns_runtime.reactor.watchdog import end_after_hang_up

end_after_hang_up(0, float(sys.argv[1]))
print("ready", flush=True) or sys.argv[2] == "hang" and time.sleep(600)
print(sys.stdin.readline(), end="", flush=True)
sys.stdin.read()
"""


def start(stdin, grace_s: float, what: str) -> subprocess.Popen[str]:
    process = subprocess.Popen(
        [sys.executable, "-c", HANGING, str(grace_s), what],
        stdin=stdin,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "ready\n"
    return process


def test_hanging_process_ends_after_the_grace_and_leaves_its_stack():
    with start(subprocess.PIPE, 0.5, "hang") as process:
        process.stdin.close()

        assert process.wait(PATIENCE_S) == 1
        assert 'File "<string>", line 6 in <module>' in process.stderr.read()


def test_socket_that_closes_counts_as_well():
    ours, theirs = socket.socketpair()
    with ours, theirs, start(theirs.fileno(), 0.1, "hang") as process:
        theirs.close()
        ours.close()

        assert process.wait(PATIENCE_S) == 1


def test_what_comes_on_the_line_is_left_for_its_reader():
    with start(subprocess.PIPE, 600.0, "read") as process:
        process.stdin.write("a word\n")
        process.stdin.flush()

        assert process.stdout.readline() == "a word\n"
        assert process.poll() is None
        # A process that ends by itself is not kept by the count-down.
        process.stdin.close()
        assert process.wait(PATIENCE_S) == 0
        assert process.stderr.read() == ""


MENDED = """
import faulthandler, os, time
from madns_runtime.reactor.watchdog import end_after_hang_up

noted = []
begin, cancel = faulthandler.dump_traceback_later, faulthandler.cancel_dump_traceback_later
faulthandler.dump_traceback_later = lambda s, **rest: (begin(s, **rest), noted.append(s))
faulthandler.cancel_dump_traceback_later = lambda: (cancel(), noted.append("cancelled"))
ours, theirs = os.pipe()
end_after_hang_up(0, 600.0)
print("ready", flush=True)
while 600.0 not in noted:
    time.sleep(0.01)
os.dup2(ours, 0)  # a new line under the same number
end_after_hang_up(0, 0.1)
print(*noted, flush=True)
os.close(theirs)
time.sleep(600)
"""


def test_line_that_takes_the_place_of_one_that_ended_is_watched_in_its_stead():
    process = subprocess.Popen(
        [sys.executable, "-c", MENDED],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    with process:
        assert process.stdout.readline() == "ready\n"
        process.stdin.close()

        assert process.stdout.readline() == "cancelled 600.0 cancelled\n"
        assert process.wait(PATIENCE_S) == 1
