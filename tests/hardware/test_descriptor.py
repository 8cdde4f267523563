"""A driver's descriptor that is readable for nothing, and one that its driver closes meanwhile."""

from __future__ import annotations

import os

import pytest

from madns_runtime.hardware import descriptor
from madns_runtime.hardware.descriptor import DriverDescriptor
from madns_runtime.reactor.reactor import Reactor

READS_MAX = 10
PATIENCE_S = 30.0


@pytest.fixture
def reactor(monkeypatch):
    monkeypatch.setattr(descriptor, "EMPTY_READS_MAX", READS_MAX)
    loop = Reactor()
    loop.call_at(loop.now_s() + PATIENCE_S, loop.stop)
    yield loop
    loop.close()


class Driver:
    """Reads nothing from a pipe whose other end is closed, and closes its own after so many reads."""

    def __init__(self, reactor, closes_after):
        self.fd, other_fd = os.pipe()
        os.close(other_fd)
        self.reactor, self.closes_after = reactor, closes_after
        self.reads, self.told = 0, []
        self.descriptor = DriverDescriptor(self.fd, reactor, self.readable, self.tell)

    def readable(self):
        self.reads += 1
        if self.reads == self.closes_after:
            os.close(self.fd)
        self.descriptor.note_read(has_samples=False)

    def tell(self, event, now_s, *, why):
        self.told.append((event, why))
        if event == "error":
            self.reactor.stop()


def test_a_descriptor_that_its_driver_closes_in_a_pause_is_told_and_ends_no_loop(reactor):
    driver = Driver(reactor, READS_MAX + 5)
    reactor.run()
    driver.descriptor.close()

    assert driver.reads == READS_MAX + 5
    assert [event for event, _ in driver.told] == ["empty_reads", "error"]
    told = f"its descriptor {driver.fd} cannot be waited for: Bad file descriptor"
    assert driver.told[1][1] == told
