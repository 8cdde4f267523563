"""Ends of a recorded run that lockstep does not have: agents that ended before others, and a host that went on. Pure."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from cosmos_cli.diff.stream import SAME_TIME_S, TICK_TOLERANCE, Alone, StreamDifference
from cosmos_cli.rerun.recorded_run import RecordedAgent
from cosmos_cli.ui.plural import counted

HOST = "host"
AGENTS_NAMED_MAX = 5
"""In one remark each; of more it is told how many."""


def early_ends(agents: Mapping[str, RecordedAgent]) -> dict[str, float]:
    """Return the agents that ended before the last one did, each with the time of its last tick, s."""
    last_s = max(agent.last_s for agent in agents.values())
    return {name: agent.last_s for name, agent in agents.items() if agent.last_s < last_s}


def leave_out_after_ends(
    streams: Iterable[StreamDifference], ends: Mapping[str, float], tick_hz: float
) -> tuple[str, ...]:
    """
    Leave out of a comparison what the rerun alone has of agents after their last ticks on record; return remarks.

    A run that is cut off ends between two agents' ticks, or some ticks apart on several machines; a run in lockstep
    ends with the same tick for all.

    Args:
        streams: Altered: one per stream and source.
        ends: Of agents, simulated time of the last tick on record, s.
        tick_hz: Of both runs.
    """
    left_out = dict.fromkeys(ends, 0)
    for one in streams:
        first = one.only_b.first
        if one.source not in ends or one.by == "order" or first is None:
            continue
        ticks = first.key if one.by == "tick" else first.key * tick_hz
        if ticks > ends[one.source] * tick_hz + TICK_TOLERANCE:
            left_out[one.source] += one.only_b.count
            one.rows_b -= one.only_b.count
            one.only_b = Alone()
    found = [name for name, count in left_out.items() if count]
    remarks = [
        f"{name} ended with the tick of {ends[name]:g} s: {counted(left_out[name], 'record')} of the rerun"
        " after that are not compared"
        for name in found[:AGENTS_NAMED_MAX]
    ]
    if rest := len(found) - len(remarks):
        remarks.append(f"{counted(rest, 'more agent')} ended before the last one did, likewise")
    return tuple(remarks)


def leave_out_after_simulated_time(
    streams: Iterable[StreamDifference], end_s: float
) -> tuple[str, ...]:
    """
    Leave out of a comparison what the host recorded, on record alone, when simulated time was over; return remarks.

    In real time its half's timer is called on while agents listen for what is still under way; in lockstep nothing is.

    Args:
        streams: Altered: one per stream and source.
        end_s: Of simulated time, s.
    """
    remarks = []
    for one in streams:
        first = one.only_a.first
        if one.source != HOST or one.by != "time" or first is None:
            continue
        # Of a timer that is due at the end itself rounding decides whether lockstep calls it.
        if first.key > end_s - SAME_TIME_S:
            remarks.append(
                f"{one.table}: {counted(one.only_a.count, 'record')} of the host from the end of simulated time on,"
                f" {end_s:g} s, are not compared"
            )
            one.rows_a -= one.only_a.count
            one.only_a = Alone()
    return tuple(remarks)
