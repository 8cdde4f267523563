"""
Transports: bytes to and from flight software. None waits, each is bounded, and none knows what bytes mean.

A transport is opened, becomes ready when the software is there, and is closed. What is written before it is ready
waits, up to a bound. In real time a thread may take what comes, so that its time of arrival is known
(`arrivals`).
"""

from __future__ import annotations

import contextlib
import os
from abc import ABC, abstractmethod
from collections.abc import Sequence
from time import monotonic
from typing import ClassVar, NamedTuple

WAITING_BYTES_MAX = 1_048_576
"""Written, but not taken by the software yet."""
READ_BYTES = 65_536
"""Read at once, and in one tick of real time: of software that floods the kernel keeps the rest, and holds it up."""
RETRY_S = 0.05
"""Between two attempts to reach software that is not there yet."""


class Arrival(NamedTuple):
    """Bytes, and when they came by this computer's monotonic clock, s."""

    data: bytes
    came_s: float


class Transport(ABC):
    """
    A way of bytes.

    Args:
        name: For people, such as tcp 127.0.0.1:4000.
    """

    keeps_all: ClassVar[bool] = False
    """Whether what is sent before the software listens is there when it does."""
    may_lose: ClassVar[bool] = False
    """Whether what is sent may not arrive, and nobody tell: later packets do all the same."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.address = ""
        """For a program that is to find it: a pty's name, host:port, a path; empty for none."""
        self.is_closed = False
        """Whether nothing more can come: the other side is gone."""
        self.counts = {"bytes_sent": 0, "bytes_received": 0, "floods": 0}
        """floods: in how many ticks as much came as is read in one, READ_BYTES: the rest waits."""

    @property
    @abstractmethod
    def is_ready(self) -> bool:
        """Whether the software is there."""

    @property
    def awaited(self) -> str:
        """Return what shows that the software is there, in words."""
        return "its first word"

    @abstractmethod
    def open(self) -> None:
        """
        Begin to look for the software, or to be found by it.

        Raises:
            BlamedError: It can never be: no such port, an address in use.
        """

    @abstractmethod
    def write(self, packets: Sequence[bytes]) -> bool:
        """Send all of them, as soon as they are taken; False, and none of them, if too much waits already."""

    def may_take(self, packets: Sequence[bytes]) -> bool:
        """Tell whether all of them have room at once, if nothing else waits."""
        return True

    @abstractmethod
    def receive(self) -> bytes | None:
        """
        Return what has come, at most READ_BYTES of it; None for nothing yet, nothing for no more.

        Of datagrams, which come whole, the last may go beyond that.
        """

    def push(self) -> None:  # noqa: B027 - most have nothing that waits
        """Go on with what could not be done at once."""

    def fds(self) -> tuple[int, ...]:
        """Return descriptors that become readable when something comes; none of a transport that must be asked."""
        return ()

    def arrivals(self) -> list[Arrival]:
        """Return what has come by now; never waits."""
        self.push()
        if not self.is_ready or self.is_closed:
            return []
        data = self.receive()
        return [] if data is None else self.taken(data, monotonic())

    def taken(self, data: bytes, came_s: float) -> list[Arrival]:
        """Count what was received; nothing means that no more can come."""
        if not data:
            self.is_closed = True
            return []
        self.counts["bytes_received"] += len(data)
        return [Arrival(data, came_s)]

    def close_input(self) -> None:
        """Tell the software that nothing more will come, where the way can tell that."""
        self.close()

    @abstractmethod
    def close(self) -> None:
        """Close it; more than once is fine."""


class StreamTransport(Transport):
    """A way of bytes through two descriptors, or one for both directions."""

    def __init__(self, name: str) -> None:
        super().__init__(name)
        self._in = self._out = -1
        self._waiting = bytearray()
        self._is_over = False

    @property
    def is_ready(self) -> bool:
        """Whether the software is there."""
        return self._in >= 0

    def use(self, read_fd: int, write_fd: int) -> None:
        """Go on with these."""
        for fd in (read_fd, write_fd):
            os.set_blocking(fd, False)
        self._in, self._out = read_fd, write_fd

    def connect(self) -> None:  # noqa: B027 - some are there from the beginning
        """Look for the software once; called until it is there."""

    def fds(self) -> tuple[int, ...]:
        """Return the descriptor to read from."""
        return (self._in,) if self.is_ready and not self.is_closed else ()

    def write(self, packets: Sequence[bytes]) -> bool:
        """Send all of them in one piece."""
        size = sum(map(len, packets))
        if self._is_over or len(self._waiting) + size > WAITING_BYTES_MAX:
            return False
        self.counts["bytes_sent"] += size
        for packet in packets:
            self._waiting += packet
        self.push()
        return True

    def may_take(self, packets: Sequence[bytes]) -> bool:
        """Tell whether they are not too long in all."""
        return sum(map(len, packets)) <= WAITING_BYTES_MAX

    def push(self) -> None:
        """Connect, and send what waits."""
        if not self.is_ready and not self._is_over:
            self.connect()
        while self._waiting and self.is_ready:
            try:
                written = os.write(self._out, memoryview(self._waiting)[:READ_BYTES])
            except BlockingIOError:
                return
            except OSError:  # it is gone, which reading tells
                self._waiting.clear()
                return
            del self._waiting[:written]

    def receive(self) -> bytes | None:
        """Read what is there."""
        try:
            return os.read(self._in, READ_BYTES)
        except BlockingIOError:
            return None
        except OSError:
            return b""

    def close(self) -> None:
        """Close both descriptors."""
        self._is_over = True
        self._waiting.clear()
        for fd in {self._in, self._out} - {-1}:
            with contextlib.suppress(OSError):
                os.close(fd)
        self._in = self._out = -1
