"""A process that cannot be watched, as where descriptors have run out, is not taken for one that has ended."""

import errno
import os
import signal
import subprocess
import sys
import time

import pytest

from madns_runtime.hardware.child_process import wait_for
from madns_runtime.hardware.guardian import Guardian

pytestmark = pytest.mark.process

PATIENCE_S = 60.0


class Calls:
    """A reactor that calls at once, a bounded number of times, and watches nothing."""

    def __init__(self):
        self.made = []
        self.readers = []

    def call_at(self, when_s, then):
        self.made.append(then)

    def add_reader(self, fd, then):
        self.readers.append(fd)


@pytest.fixture
def child():
    with subprocess.Popen([sys.executable, "-c", "import sys; sys.stdin.read()"], stdin=-1) as one:
        yield one
        one.kill()


@pytest.fixture
def no_descriptors(monkeypatch):
    def fail(_pid):
        raise OSError(errno.EMFILE, os.strerror(errno.EMFILE))

    monkeypatch.setattr(os, "pidfd_open", fail)


def guardian():
    made = object.__new__(Guardian)
    made._reactor = Calls()
    return made


def test_the_guardian_goes_on_looking_at_one_that_lives(child, no_descriptors, monkeypatch):
    ended = []
    one = guardian()
    one._watch(child.pid, lambda: ended.append(True))
    one._reactor.made.pop()()
    assert ended == []
    monkeypatch.undo()

    one._reactor.made.pop()()
    assert (ended, len(one._reactor.readers)) == ([], 1)
    os.close(one._reactor.readers[0])


def test_the_guardian_sees_the_end_without_a_descriptor(child, no_descriptors):
    ended = []
    one = guardian()
    one._watch(child.pid, lambda: ended.append(True))
    child.kill()
    child.wait()
    one._reactor.made.pop()()

    one._reactor.made.pop()()
    assert ended == [True]


def test_a_child_is_waited_for_without_a_descriptor(child, no_descriptors):
    assert wait_for(child.pid, time.monotonic()) is None
    child.stdin.close()

    assert wait_for(child.pid, time.monotonic() + PATIENCE_S) == 0
    assert wait_for(child.pid, time.monotonic() + PATIENCE_S) == 0  # let go of before


def test_a_child_that_was_killed_is_told_from_one_that_ended(child):
    child.kill()

    assert wait_for(child.pid, time.monotonic() + PATIENCE_S) == -signal.SIGKILL
