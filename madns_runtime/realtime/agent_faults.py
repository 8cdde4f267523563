"""Faults that befall one agent in real time, as its own process carries them out."""

from __future__ import annotations

from collections.abc import Callable

from madns_runtime.protocol.messages import AgentFault
from madns_runtime.realtime.ticks import PacedTicks
from madns_runtime.recording.run_journal import RunJournal
from madns_runtime.timeline.fault_kinds import LOSSES


class AgentFaults:
    """
    The faults of one agent.

    Args:
        ticks: Its ticks.
        journal: Its own.
        killed: Called when it is to end, with why, and the time until its return, s; None for never.
    """

    def __init__(
        self,
        ticks: PacedTicks,
        journal: RunJournal,
        *,
        killed: Callable[[str, float | None], None],
    ) -> None:
        self._ticks = ticks
        self._journal = journal
        self._killed = killed
        self.has_killed = False
        """Whether one of them has ended the agent."""

    def take(self, order: AgentFault) -> None:
        """Begin or end a fault."""
        if order.word in LOSSES:
            self._journal.event("killed", **order.loss)
            self.has_killed = True
            self._killed(order.reason, order.loss["returns_after_s"])
            return
        faults = self._ticks.hinder(order)
        if faults is None:
            return
        name = f"{order.word}_{'begins' if order.begins else 'ends'}"
        told = {} if order.begins else {"ticks_withheld": faults.withheld}
        self._journal.event(name, factor=order.value, **told)
