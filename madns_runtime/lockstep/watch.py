"""
Ends a host whose own half of the simulation hangs, and says in which call.

The loop stands still then, so a thread of its own looks now and then. Who hangs in a call that never
lets other threads run is ended by the operator, which hears nothing more.
"""

from __future__ import annotations

import faulthandler
import sys
import threading
from collections.abc import Callable
from time import monotonic

LOOK_INTERVAL_S = 0.25


class CallWatch:
    """
    Watches the calls of the host's half.

    Args:
        on_hang: Called, in a thread of its own, with the call and the seconds it was given.
    """

    def __init__(self, on_hang: Callable[[str, float], None]) -> None:
        self._on_hang = on_hang
        self._call: tuple[str, float, float] | None = None
        threading.Thread(target=self._look, name="call-watch", daemon=True).start()

    def began(self, call: str, limit_s: float) -> None:
        """Note that *call* begins, and may take *limit_s*."""
        self._call = (call, monotonic(), limit_s)

    def ended(self) -> None:
        """Note that it has returned."""
        self._call = None

    def _look(self) -> None:
        while True:
            threading.Event().wait(LOOK_INTERVAL_S)
            present = self._call
            if present is not None and monotonic() - present[1] > present[2]:
                faulthandler.dump_traceback(file=sys.__stderr__ or 2)
                self._on_hang(present[0], present[2])
                return
