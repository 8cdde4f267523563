"""A CAN bus as the driver of `can` sees it, by whatever library it is reached."""

from __future__ import annotations

import errno
from typing import Final, Protocol

from madns_runtime.errors import MachineError

FULL: Final = (errno.ENOBUFS, errno.EAGAIN)
"""The kernel's words for a queue without room."""


class BusIsFullError(MachineError):
    """The bus takes no more frames now."""

    def __init__(self, interface: str) -> None:
        super().__init__(
            f"{interface}: its queue is full: the bus is slower than what is sent, or nobody is there to acknowledge;"
            f" see `ip -details link show {interface}`"
        )


class CanBus(Protocol):
    """A bus, opened."""

    frames_lost: int
    """Frames that came faster than they were read."""
    frames_left_out: int
    """Requests, reports of errors, and frames of CAN FD."""

    def fileno(self) -> int | None:
        """Return a descriptor that becomes readable when a frame has come; None if it has none."""

    def receive(self) -> tuple[int, bytes] | None:
        """Return the next frame that has come (identifier with bit 31 for 29 bits, data), or None."""

    def send(self, identifier: int, data: bytes) -> None:
        """
        Send a frame.

        Raises:
            BusIsFullError: It takes none now.
            MachineError: It takes none any more.
        """

    def close(self) -> None:
        """Let go of the bus."""
