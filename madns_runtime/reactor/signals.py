"""Signals as bytes on a descriptor, so that their callbacks run in the loop and nowhere else."""

from __future__ import annotations

import contextlib
import os
import signal
from collections.abc import Callable
from types import FrameType
from typing import Any


class SignalPipe:
    """
    Turns signals into readable bytes; only for the main thread.

    Closing gives back the handlers and the wake-up descriptor found at first. A forked process
    shares the pipe until it closes its copy of the reactor, and must do so before anything else.
    """

    def __init__(self) -> None:
        self._read_fd, self._write_fd = os.pipe()
        os.set_blocking(self._read_fd, False)
        os.set_blocking(self._write_fd, False)
        self._callbacks: dict[int, Callable[[], None]] = {}
        self._handlers_before: dict[int, Any] = {}
        self._wakeup_before = signal.set_wakeup_fd(self._write_fd, warn_on_full_buffer=False)

    @property
    def fd(self) -> int:
        """Readable when signals came."""
        return self._read_fd

    def on_signal(self, signum: int, callback: Callable[[], None]) -> None:
        """Call *callback* from `dispatch` when the signal comes; the last one set counts."""
        if signum not in self._handlers_before:
            self._handlers_before[signum] = signal.signal(signum, _take_note)
        self._callbacks[signum] = callback

    def dispatch(self) -> None:
        """Call the callbacks of all signals that came."""
        try:
            data = os.read(self._read_fd, 256)
        except BlockingIOError:
            return
        # Once a kind: the kernel, too, merges signals that come faster than they are handled.
        left = list(dict.fromkeys(data))
        try:
            while left:
                callback = self._callbacks.get(left.pop(0))
                if callback is not None:
                    callback()
        finally:
            # A callback that raises does not swallow the signals behind it.
            if left:
                os.write(self._write_fd, bytes(left))

    def close(self) -> None:
        """Give back the handlers as they were."""
        for signum, handler in self._handlers_before.items():
            # A handler that was not set from Python reads as None and cannot be given back.
            signal.signal(signum, signal.SIG_DFL if handler is None else handler)
        self._handlers_before.clear()
        with contextlib.suppress(ValueError):
            signal.set_wakeup_fd(self._wakeup_before)
        os.close(self._read_fd)
        os.close(self._write_fd)


def _take_note(signum: int, frame: FrameType | None) -> None:
    """Do nothing here: the byte on the wake-up descriptor is the message."""
