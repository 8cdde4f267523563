"""
SIGINT, SIGTERM and SIGHUP as something that a selector can wait for, and SIGCHLD as its wake-up.

Nothing is done in a handler, so that no signal can cut a write in half. Only from the main thread.
"""

from __future__ import annotations

import contextlib
import signal
import socket
from types import FrameType, TracebackType

from cosmos_cli.system.stop_signals import STOP_SIGNALS

_RAISING = frozenset((signal.SIGINT, signal.SIGTERM))


class OperatorSignals:
    """Takes over the signals of a run for as long as it is entered."""

    def __init__(self) -> None:
        self._reader, self._writer = socket.socketpair()
        self._reader.setblocking(False)
        self._writer.setblocking(False)
        self._before: dict[int, object] = {}
        self._wakeup_before = -1
        self._is_raising = False

    def __enter__(self) -> OperatorSignals:
        for number in (*STOP_SIGNALS, signal.SIGCHLD):
            self._before[number] = signal.signal(number, self._noted)
        self._wakeup_before = signal.set_wakeup_fd(self._writer.fileno(), warn_on_full_buffer=False)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        signal.set_wakeup_fd(self._wakeup_before)
        for number, handler in self._before.items():
            signal.signal(number, handler)  # type: ignore[arg-type]  # what signal.signal gave us
        self._reader.close()
        self._writer.close()

    def fileno(self) -> int:
        """Return the descriptor that is readable after a signal."""
        return self._reader.fileno()

    def take(self) -> list[signal.Signals]:
        """Return the stop signals that came since the last call; others only wake."""
        with contextlib.suppress(BlockingIOError):
            return [signal.Signals(n) for n in self._reader.recv(4096) if n in STOP_SIGNALS]
        return []

    def raise_from_now(self) -> None:
        """
        After the loop: let a Ctrl-C or SIGTERM raise KeyboardInterrupt where the program is.

        Raises:
            KeyboardInterrupt: One has come since the loop took the last.
        """
        self._is_raising = True
        if not _RAISING.isdisjoint(self.take()):
            raise KeyboardInterrupt

    def _noted(self, number: int, frame: FrameType | None) -> None:
        if self._is_raising and number in _RAISING:
            raise KeyboardInterrupt
