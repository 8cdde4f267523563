"""Signals that ask this process to stop, noted as they come in place of ending it."""

from __future__ import annotations

import contextlib
import signal
from collections.abc import Callable, Iterator
from types import FrameType
from typing import Final

STOP_SIGNALS: Final = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


@contextlib.contextmanager
def stop_signals_noted(tell: Callable[[int], None] | None = None) -> Iterator[list[int]]:
    """
    Note stop signals meanwhile; yields those that came. Only from the main thread.

    Args:
        tell: Told of each when it comes.
    """
    came: list[int] = []

    def note(number: int, frame: FrameType | None) -> None:
        came.append(number)
        if tell is not None:
            tell(number)

    before = {number: signal.signal(number, note) for number in STOP_SIGNALS}
    try:
        yield came
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
