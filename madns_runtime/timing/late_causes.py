"""
Why a tick began late, or not at all: one cause each, by what was measured between its deadline and its begin.

Pure. In that window the loop slept, computed, or was kept from computing, and whatever it did was timed. The first of
CAUSES, in their order, that filled at least half of the window is the cause; where none did, the one that filled most
of it, if all of them together filled half. A window that is empty but for what nobody timed is UNEXPLAINED.
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import StrEnum
from typing import Final


class Cause(StrEnum):
    """The causes, in the order of their precedence."""

    CLOCK = "clock"
    """The agent's estimate of the host's time leapt ahead: its clock was put wrong, or its estimate was far off."""
    START = "start"
    """It is the agent's first tick, and the order to start, or what set-up left to do, came after its deadline."""
    STOLEN = "stolen"
    """The loop had nothing else to do or was kept from it by nothing in the guest, and the hypervisor gave processors to other guests."""
    GARBAGE = "garbage"
    """Python's collector was at work."""
    RECORDING = "recording"
    """The loop was to wake up, and the thread that writes the records was computing."""
    WAKE_UP = "wake_up"
    """The kernel woke the loop late, or gave its processor to another."""
    STEP = "step"
    """The agent's own step before took longer than its period."""
    TICK_BEFORE = "tick_before"
    """The agent's tick before, itself late, was still under way, though its step was short enough."""
    OTHER_AGENT = "other_agent"
    """Ticks of other agents in the same process."""
    RECEIVING = "receiving"
    """Messages from the host were taken in, the plug-in's `receive` among them."""
    HOUSEKEEPING = "housekeeping"
    """The session's own work: pings, resends, the account of resources used."""
    UNEXPLAINED = "unexplained"


CAUSES: Final = tuple(Cause)
HALF: Final = 0.5


def name_cause(
    window_s: float, filled_s: Mapping[Cause, float], *, together_s: float | None = None
) -> Cause:
    """
    Return the cause of a late tick.

    Args:
        window_s: From the deadline, of the first tick missed or else of this one, to its begin, s.
        filled_s: The part of the window that each cause filled, s; parts may overlap.
        together_s: The part that all of them filled, s; None for their sum, where they do not overlap.
    """
    limit_s = HALF * window_s
    for cause in CAUSES:
        if filled_s.get(cause, 0.0) >= limit_s > 0:
            return cause
    if together_s is None:
        together_s = sum(filled_s.values())
    if together_s >= limit_s > 0:
        return max(CAUSES, key=lambda cause: filled_s.get(cause, 0.0))
    return Cause.UNEXPLAINED


def overlap_s(begin_s: float, end_s: float, window: tuple[float, float]) -> float:
    """Return how long a span of time lies within a window, s."""
    return max(0.0, min(end_s, window[1]) - max(begin_s, window[0]))
