"""
Waiting for a stream with a deadline; where it is watched, a machine's silence is looked into.

A machine that is merely slow is waited for, a dead one is not: TCP notices neither a pulled cable nor a
frozen machine for many minutes, and a deadline that spares a board with a slow card is long.
"""

from __future__ import annotations

import time
from collections.abc import Callable

from cosmos_cli.fleet.connection import Connection, Stream, StreamEnd
from cosmos_cli.fleet.failure import FailureKind, MachineFailure
from cosmos_cli.fleet.transfer_limits import Patience, duration_words, too_slow

SILENCE_S = 1.0
"""After so long without a byte the machine is asked for a sign of life."""
NAMED_S = 2.0
"""After so long without a byte and a sign its silence is told: as soon as in a run."""
SIGN_S = 8.0
"""For the sign to come: a board that is busy to the brim must not be taken for a dead one."""
STATUS_WAIT_S = 1.0
"""For the exit status of a program whose output has ended: it comes right after, if it comes."""


class SilentMachine(MachineFailure):
    """A machine that gave no sign of life; its kind is LOST."""

    def __init__(self) -> None:
        super().__init__(FailureKind.LOST, "the machine stopped answering")


class SilenceWatch:
    """
    Asks a silent machine for a sign of life.

    Args:
        connection: To the machine.
        on_silence: Called with how long the machine has been silent, s, while it is still waited for.
    """

    def __init__(
        self,
        connection: Connection,
        on_silence: Callable[[float], None] = lambda silent_s: None,
    ) -> None:
        self._connection = connection
        self._on_silence = on_silence

    def gives_sign(self) -> bool:
        """Wait for a sign of life, long enough for a busy machine."""
        if self._connection.is_alive(timeout_s=NAMED_S - SILENCE_S):
            return True
        self._on_silence(NAMED_S)
        return self._connection.is_alive(timeout_s=SIGN_S - (NAMED_S - SILENCE_S))


class BlockingStream:
    """
    A stream for a thread that waits.

    Args:
        stream: To a program; stays its owner's.
        watch: Looks into silence; None leaves all to the deadlines.
    """

    def __init__(self, stream: Stream, watch: SilenceWatch | None = None) -> None:
        self._stream = stream
        self._watch = watch

    def read_some(self, count: int, *, timeout_s: float) -> bytes:
        """
        Wait for bytes, at most *timeout_s*; empty at the end.

        Raises:
            MachineFailure: TIMEOUT, or the connection is lost, or the machine gives no sign of life.
        """
        until_s = time.monotonic() + timeout_s
        while True:
            try:
                return self._stream.read(count, timeout_s=self._wait_s(until_s - time.monotonic()))
            except BlockingIOError:
                pass
            if self._is_silent():
                try:  # what came meanwhile, or that the link broke
                    return self._stream.read(count)
                except BlockingIOError:
                    raise SilentMachine from None
            if time.monotonic() >= until_s:
                raise MachineFailure(
                    FailureKind.TIMEOUT, f"no answer in {duration_words(timeout_s)}"
                )

    def write_all(self, data: bytes, *, timeout_s: float) -> None:
        """
        Hand over everything, waiting for room; *timeout_s* is for all of it, and more as `Patience` grants.

        Raises:
            MachineFailure: TIMEOUT, or the connection is lost, or the machine gives no sign of life.
        """
        view = memoryview(data)
        patience = Patience(timeout_s)
        while view:
            try:
                count = self._stream.write(view, timeout_s=self._wait_s(patience.left_s))
            except BlockingIOError:
                count = 0
            else:
                patience.moved(count)
            view = view[count:]
            if view and patience.left_s <= 0:
                raise too_slow(patience, len(data))
            if not count and self._is_silent():
                raise SilentMachine

    def ending(self) -> StreamEnd:
        """Return how the program ended, waiting a moment for its status."""
        return self._stream.ending(timeout_s=STATUS_WAIT_S)

    def _wait_s(self, left_s: float) -> float:
        return max(0.0, left_s if self._watch is None else min(SILENCE_S, left_s))

    def _is_silent(self) -> bool:
        return self._watch is not None and not self._watch.gives_sign()
