"""Signals by the names that people know: SIGKILL, or `signal 35` where Python has no name for it."""

from __future__ import annotations

import signal


def signal_name(number: int) -> str:
    """Return the name of a signal; of a real-time one its number in words, for Python names but the first and the last of them."""
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"
