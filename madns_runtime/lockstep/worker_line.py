"""A worker's line to its host: orders in, frames out, and what ends it while it waits."""

from __future__ import annotations

import signal
import socket
from typing import Any

from madns_runtime.lockstep import frames
from madns_runtime.lockstep.frames import FrameReader

READ_BYTES = 1 << 18


class HostGone(Exception):
    """The other end of the line is closed."""


class _Terminated(BaseException):
    """SIGTERM came while nothing was under way."""


class WorkerLine:
    """
    One worker's end.

    Args:
        line: The socket.
    """

    def __init__(self, line: socket.socket) -> None:
        self._line = line
        self._reader = FrameReader()
        self._is_waiting = False
        self.is_terminated = False
        """Whether SIGTERM has come."""

    def heed_sigterm(self) -> None:
        """Take note of SIGTERM from now on; one that comes while an order is awaited ends the wait."""
        signal.signal(signal.SIGTERM, self._on_sigterm)

    def say(self, frame: bytes) -> None:
        """
        Send a frame.

        Raises:
            HostGone: Nobody reads it.
        """
        try:
            self._line.sendall(frame)
        except OSError as error:
            raise HostGone from error

    def next_order(self) -> list[Any]:
        """
        Wait for an order.

        Raises:
            HostGone: None will come.
        """
        data = b""
        try:
            self._is_waiting = True
            while True:
                for order in self._reader.feed(data):
                    return order
                data = self._line.recv(READ_BYTES)
                if not data:
                    raise HostGone
        except _Terminated:
            return [frames.DRAIN, 0.0, []]  # whose answer tells it
        except OSError as error:
            raise HostGone from error
        finally:
            self._is_waiting = False

    def _on_sigterm(self, number: int, frame: object) -> None:
        self.is_terminated = True
        if self._is_waiting:
            self._is_waiting = False
            raise _Terminated
