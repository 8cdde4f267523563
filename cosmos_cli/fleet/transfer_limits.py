"""
Limits of a transfer: its time as a whole, and the bytes of a program's output.

Nobody who sends a byte now and then holds others up for ever; of what is too much to keep, the first and the last
bytes are, and the count of those between.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

from cosmos_cli.fleet.failure import FailureKind, MachineFailure

RATE_BYTES_S_MIN = 16 * 1024
"""Time granted beyond the deadline for each byte that moved, as a rate: slower than any usable link."""


class Patience:
    """
    The deadline of one transfer: a time for all of it, and as much more as the bytes that moved are worth.

    No standstill may last longer than the time for all of it either.

    Args:
        timeout_s: For all of it, were there no bytes.
        now_s: A monotonic clock.
    """

    def __init__(self, timeout_s: float, *, now_s: Callable[[], float] = time.monotonic) -> None:
        self._now_s = now_s
        self._start_s = self._moved_s = now_s()
        self._timeout_s = timeout_s
        self.moved_bytes = 0
        """Number of bytes that have moved."""

    def moved(self, count: int) -> None:
        """Take note of bytes that moved."""
        self.moved_bytes += count
        self._moved_s = self._now_s()

    @property
    def spent_s(self) -> float:
        """Duration until now, s."""
        return self._now_s() - self._start_s

    @property
    def left_s(self) -> float:
        """Time that is left, s; not positive when it is over."""
        whole_s = self._timeout_s + self.moved_bytes / RATE_BYTES_S_MIN - self.spent_s
        still_s = self._timeout_s - (self._now_s() - self._moved_s)
        return min(whole_s, still_s)


def too_slow(patience: Patience, size_bytes: int) -> MachineFailure:
    """Say of a machine that it takes what it is sent too slowly, or not at all."""
    return MachineFailure(
        FailureKind.TIMEOUT,
        f"took only {patience.moved_bytes} of {size_bytes} bytes of input in {duration_words(patience.spent_s)}",
        "is its link or its processor overloaded?",
    )


def not_ended(timeout_s: float) -> MachineFailure:
    """Say of a command that its time is over."""
    return MachineFailure(
        FailureKind.TIMEOUT, f"the command did not end in {duration_words(timeout_s)}"
    )


def duration_words(seconds: float) -> str:
    """Return a duration that is never rounded to nothing, such as 0.04 s, 1.5 s, 30 s or 180 s."""
    for below_s, digits in ((0.1, 3), (1.0, 2), (10.0, 1)):
        if seconds < below_s:
            text = f"{seconds:.{digits}f}".rstrip("0").rstrip(".")
            return f"{text} s" if text != "0" else "less than 1 ms"
    return f"{seconds:.0f} s"


class BoundedOutput:
    """
    Bytes within bounds.

    Args:
        first_bytes: How many of the first are kept.
        last_bytes: How many of the last are kept.
    """

    def __init__(self, first_bytes: int, last_bytes: int) -> None:
        self._first_bytes = first_bytes
        self._last_bytes = last_bytes
        self._first = bytearray()
        self._last = bytearray()
        self.cut_bytes = 0
        """Number of bytes left out between the first and the last."""
        self.said_bytes = 0
        """Number of bytes that came."""

    def add(self, data: bytes) -> None:
        """Take more."""
        self.said_bytes += len(data)
        room = self._first_bytes - len(self._first)
        if room > 0:
            self._first += data[:room]
            data = data[room:]
        self._last += data
        over = len(self._last) - self._last_bytes
        if over > 0:
            del self._last[:over]
            self.cut_bytes += over

    @property
    def data(self) -> bytes:
        """Return what is kept, with a line in its midst that says what is not."""
        if not self.cut_bytes:
            return bytes(self._first + self._last)
        note = f"\n[... {self.cut_bytes} bytes left out ...]\n".encode()
        return bytes(self._first + note + self._last) if self._first else bytes(self._last)

    def text(self) -> str:
        """Return what is kept as text."""
        return self.data.decode(errors="replace")


@dataclass(frozen=True, slots=True, kw_only=True)
class OutputLimits:
    """Limits of a command: its time and its output."""

    timeout_s: float
    said_bytes_max: int

    def check(self, remaining_s: float, outputs: tuple[BoundedOutput, BoundedOutput]) -> None:
        """
        See that a command is within both.

        Args:
            remaining_s: Of its time.
            outputs: What it has said.

        Raises:
            MachineFailure: It is not.
        """
        if remaining_s <= 0:
            raise not_ended(self.timeout_s)
        if sum(output.said_bytes for output in outputs) > self.said_bytes_max:
            raise MachineFailure(
                FailureKind.DATA,
                f"the command said more than {self.said_bytes_max} bytes, and was ended",
                "let it write to a file there; a start-up file of its shell must be silent",
            )
