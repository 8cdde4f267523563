"""What a forked child gets from its parent, and does not take for its own."""

import gc
import os
import socket

import pytest

from madns_runtime.reactor.forking import leave_parent

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
