"""Descriptors beyond what `select` takes, and as many of them as a process needs."""

import fcntl
import os
import resource
import socket

import pytest

from madns_runtime.config import DeviceLaunch
from madns_runtime.errors import MachineError
from madns_runtime.hardware import messages
from madns_runtime.hardware.driven import DeviceProcess, allow_descriptors_of
from madns_runtime.reactor.descriptors import allow_descriptors, ready

HIGH = 1100
"""Beyond the 1023 of `select`."""


@pytest.fixture(autouse=True)
def limits():
    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    if before[1] < 4 * HIGH:
        pytest.skip(f"needs {4 * HIGH} open files (ulimit -Hn)")
    yield before
    resource.setrlimit(resource.RLIMIT_NOFILE, before)


@pytest.fixture
def pair():
    """Two sockets, the first of a high number."""
    allow_descriptors(2 * HIGH)
    low, other = messages.make_pair()
    with low, other, socket.socket(fileno=fcntl.fcntl(low.fileno(), fcntl.F_DUPFD, HIGH)) as high:
        yield high, other


def test_descriptors_of_high_numbers_are_waited_for(pair):
    high, other = pair
    assert high.fileno() >= HIGH
    process = DeviceProcess([], control=high)

    assert ready([high.fileno()], [high.fileno()], 0.0) == (set(), {high.fileno()})
    assert not process.has_words()
    other.send(b"x")
    assert ready([high.fileno()], [], 60.0) == ({high.fileno()}, set())
    assert process.has_words()


def test_one_that_was_hung_up_is_ready():
    read_fd, write_fd = os.pipe()
    os.close(write_fd)

    assert ready([read_fd], [], 60.0) == ({read_fd}, set())
    os.close(read_fd)


def test_as_many_are_allowed_as_devices_need_and_never_fewer(limits):
    _, hard = limits
    resource.setrlimit(resource.RLIMIT_NOFILE, (512, hard))
    users = tuple(f"agent-{number:03d}" for number in range(1, 801))
    device = DeviceLaunch(
        name="null", place="here", kind="null", base_directory="", rate_hz=1.0, users=users
    )
    allow_descriptors_of([device])
    soft = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
    allow_descriptors_of([])

    assert soft >= 3 * len(users)
    assert resource.getrlimit(resource.RLIMIT_NOFILE) == (soft, hard)


def test_no_room_for_a_device_is_told_with_its_cure(limits):
    _, hard = limits
    resource.setrlimit(resource.RLIMIT_NOFILE, (3, hard))
    with pytest.raises(
        MachineError, match="no socket for a device: Too many open files; `ulimit -Hn`"
    ):
        messages.make_pair()
