"""
A connection whose silence is looked into: a machine that is merely slow is waited for, a dead one is not.

TCP notices neither a pulled cable nor a frozen machine for many minutes, and a deadline that spares a
board with a slow card is long.
"""

from __future__ import annotations

import time

from cosmos_cli.fleet.connection import Connection, Stream
from cosmos_cli.fleet.failure import FailureKind, MachineFailure

FULL_S_MIN, FULL_S_MAX = 0.0005, 0.02
"""Between looks whether there is room again for what is sent; each wait is twice the one before."""
SILENCE_S = 4.0
"""After so long without a byte the machine is asked for a sign of life."""
SIGN_S = 5.0
"""For the sign to come: a board that is busy to the brim must not be taken for a dead one."""


class WatchedStream:
    """
    A stream for a thread that waits with `read_some` and `write_all`; all else is the stream's own.

    Args:
        stream: To a program.
        connection: To its machine.
    """

    def __init__(self, stream: Stream, connection: Connection) -> None:
        self._connection = connection
        self.fileno = stream.fileno
        self.read = stream.read
        self.write = stream.write
        self.close_writing = stream.close_writing
        self.exit_status = stream.exit_status
        self.errors = stream.errors
        self.close = stream.close
        self._read_some = stream.read_some

    def read_some(self, count: int, *, timeout_s: float) -> bytes:
        """
        Wait for bytes; empty at the end.

        Raises:
            MachineFailure: TIMEOUT, or the machine gives no sign of life.
        """
        until_s = time.monotonic() + timeout_s
        while True:
            wait_s = min(SILENCE_S, max(0.0, until_s - time.monotonic()))
            try:
                return self._read_some(count, timeout_s=wait_s)
            except MachineFailure as failure:
                if failure.kind is not FailureKind.TIMEOUT:
                    raise
            self._see_that_it_lives()
            if time.monotonic() >= until_s:
                raise MachineFailure(FailureKind.TIMEOUT, f"no answer in {timeout_s:g} s")

    def write_all(self, data: bytes, *, timeout_s: float) -> None:
        """
        Hand over everything, waiting for room; *timeout_s* is for each piece that is taken.

        Raises:
            MachineFailure: TIMEOUT, or the machine gives no sign of life.
        """
        view = memoryview(data)
        taken_s = asked_s = time.monotonic()
        wait_s = FULL_S_MIN
        while view:
            try:
                view = view[self.write(view) :]  # type: ignore[arg-type]
                taken_s, wait_s = time.monotonic(), FULL_S_MIN
                asked_s = taken_s
                continue
            except BlockingIOError:
                now_s = time.monotonic()
            if now_s - taken_s > timeout_s:
                raise MachineFailure(FailureKind.TIMEOUT, f"took no more input for {timeout_s:g} s")
            if now_s - asked_s > SILENCE_S:
                self._see_that_it_lives()
                asked_s = now_s
            time.sleep(wait_s)
            wait_s = min(2 * wait_s, FULL_S_MAX)

    def _see_that_it_lives(self) -> None:
        if not self._connection.is_alive(timeout_s=SIGN_S):
            raise MachineFailure(FailureKind.LOST, "the machine stopped answering")


class WatchedConnection:
    """
    A connection whose streams are watched.

    Args:
        connection: Open; stays its owner's.
    """

    def __init__(self, connection: Connection) -> None:
        self._connection = connection
        self.target = connection.target
        self.own_address = connection.own_address
        self.peer_address = connection.peer_address
        self.opening_s = connection.opening_s
        self.run = connection.run
        self.is_alive = connection.is_alive
        self.close = connection.close

    def open(self, command: str) -> WatchedStream:
        """Start a shell command there."""
        return WatchedStream(self._connection.open(command), self._connection)
