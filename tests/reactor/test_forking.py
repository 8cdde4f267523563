"""What a forked child gets from its parent, and does not take for its own."""

import gc
import os
import signal
import socket
import subprocess
import sys

import pytest

from madns_runtime.reactor.forking import ForkedCopies, leave_parent

pytestmark = pytest.mark.process


def test_garbage_of_the_parent_closes_no_descriptor_of_the_child():
    gc.disable()
    try:
        one, other = socket.socketpair()
        number = one.fileno()
        cycle = [one, other]
        cycle.append(cycle)
        del one, other, cycle
        read_fd, write_fd = os.pipe()
        pid = os.fork()
        if not pid:
            _tell_whether_it_stays_open(number, write_fd)
    finally:
        gc.enable()
    os.close(write_fd)
    os.waitpid(pid, 0)
    told = os.read(read_fd, 10)
    os.close(read_fd)

    assert told == b"open"


def _tell_whether_it_stays_open(number: int, write_fd: int) -> None:
    """Take the number of a socket of the parent's, and collect garbage, as any process does sooner or later."""
    try:
        leave_parent(keep={write_fd})
        os.dup2(0, number)
        gc.collect()
        os.fstat(number)
        os.write(write_fd, b"open")
    finally:
        os._exit(0)


STRAY = """
import os, sys, time
from madns_runtime.reactor.reactor import Reactor
reactor = Reactor()
own, wait = os.getpid(), reactor._poller.wait
def told_wait(until_s):
    if os.getpid() != own:
        print("took a wake-up", flush=True)
    return wait(until_s)
reactor._poller.wait = told_wait
def fork():
    if os.fork():
        os.wait()
reactor.call_at(reactor.now_s(), fork)
reactor.call_at(reactor.now_s() + 0.1, reactor.stop)
reactor.run()
print("ran to its end", flush=True)
"""


def test_a_process_that_comes_back_from_a_callback_does_not_run_the_loop_on():
    done = subprocess.run(
        [sys.executable, "-c", STRAY], capture_output=True, text=True, timeout=60, check=True
    )

    assert done.stdout.splitlines() == ["ran to its end"]
    assert "forked a process that came back from the call" in done.stderr


FROZEN = """
import time
from madns_runtime.reactor.reactor import Reactor
reactor = Reactor()
time.monotonic = lambda: 0.0
reactor.call_at(reactor.now_s() + 0.05, reactor.stop)
reactor.run()
"""


def test_a_loop_goes_on_whatever_clock_a_plugin_puts_in_the_place_of_time():
    subprocess.run([sys.executable, "-c", FROZEN], timeout=60, check=True)


def test_copies_are_gone_once_they_have_ended_or_are_another_program():
    copies = ForkedCopies()
    assert copies.wait_until_gone(0.0)

    children = [_fork_that(_becomes_sleep), _fork_that(_ends)]
    assert copies.wait_until_gone(60.0)
    os.kill(children[0], signal.SIGKILL)

    children.append(_fork_that(_stays))
    assert not copies.wait_until_gone(0.01)
    os.kill(children[2], signal.SIGKILL)
    for child in children:
        os.waitpid(child, 0)


def _fork_that(goes_on):
    child = os.fork()
    if not child:
        try:
            goes_on()
        finally:
            os._exit(1)
    return child


def _becomes_sleep():
    os.execvp("sleep", ["sleep", "600"])  # noqa: S606, S607 - whichever there is


def _ends():
    os._exit(0)


def _stays():
    signal.pause()
