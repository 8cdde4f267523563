"""Ends of a recorded run that lockstep does not have: agents that ended before others, and a host that went on. Pure."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping

from cosmos_cli.diff.recorded import Key
from cosmos_cli.diff.stream import SAME_TIME_S, TICK_TOLERANCE, Alone, StreamDifference
from cosmos_cli.rerun.recorded_run import RecordedAgent
from cosmos_cli.ui.name_ranges import names_by
from cosmos_cli.ui.plural import counted
from madns_runtime.conditions.condition import HOST

AGENTS_NAMED_MAX = 5
"""In one remark each; of more it is told how many."""


def early_ends(agents: Mapping[str, RecordedAgent]) -> dict[str, float]:
    """Return the agents that ended before the last one did, each with the time of its last tick, s."""
    last_s = max(agent.last_s for agent in agents.values())
    return {name: agent.last_s for name, agent in agents.items() if agent.last_s < last_s}


def leave_out_after_ends(
    streams: Iterable[StreamDifference],
    ends: Mapping[str, float],
    tick_hz: float,
    killed: Collection[str] = (),
) -> tuple[str, ...]:
    """
    Leave out of a comparison what the rerun alone has of agents after their last ticks on record; return remarks.

    A run that is cut off ends between two agents' ticks, or some ticks apart on several machines; a run in lockstep
    ends with the same tick for all. Of an agent that was killed not even all of its last tick need have been written.

    Args:
        streams: Altered: one per stream and source.
        ends: Of agents, simulated time of the last tick on record, s; negative where there is none.
        tick_hz: Of both runs.
        killed: Those of them that a fault killed.
    """
    left_out = dict.fromkeys(ends, 0)
    for one in streams:
        first = one.only_b.first
        if one.source not in ends or one.by == "order" or first is None:
            continue
        ticks = first.key if one.by == "tick" else first.key * tick_hz
        last = ends[one.source] * tick_hz - (1.0 if one.source in killed else 0.0)
        if ticks > last + TICK_TOLERANCE:
            left_out[one.source] += one.only_b.count
            one.rows_b -= one.only_b.count
            one.only_b = Alone()
    found = [name for name, count in left_out.items() if count]
    remarks = [
        _remark(name, ends[name], left_out[name], is_killed=name in killed)
        for name in found[:AGENTS_NAMED_MAX]
    ]
    if rest := len(found) - len(remarks):
        remarks.append(f"{counted(rest, 'more agent')} ended before the last one did, likewise")
    return tuple(remarks)


def _remark(name: str, end_s: float, count: int, *, is_killed: bool) -> str:
    records = f"{counted(count, 'record')} of the rerun"
    if end_s < 0.0:
        return f"{name} was killed before any of its ticks was written: {records} are not compared"
    when = "from then on" if is_killed else "after that"
    return f"{name} ended with the tick of {end_s:g} s: {records} {when} are not compared"


def leave_out_unwritten(streams: list[Key], ends: Mapping[str, float]) -> tuple[str, ...]:
    """
    Leave out the streams of agents that were killed before they wrote a tick; return remarks.

    Args:
        streams: Altered: those that the rerun alone has.
        ends: As of `leave_out_after_ends`.
    """
    left_out = [key for key in streams if ends.get(key[1], 0.0) < 0.0]
    streams[:] = [key for key in streams if key not in left_out]
    return tuple(
        f"{name} was killed before any of its ticks was written: {', '.join(tables)} of the rerun are not compared"
        for name, tables in names_by((source, table) for table, source in left_out).items()
    )


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
