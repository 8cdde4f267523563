"""
Agents of one process that tick together: one wake-up of the loop for all of them.

A wake-up from sleep costs several times a tick that follows another at once, so that agents that share a process
share deadlines too. Packs are spread over the period as agents by themselves are; every agent's lateness counts from
the shared deadline.
"""

from __future__ import annotations

import math
from time import monotonic
from typing import Protocol

from madns_runtime.reactor.reactor import Reactor
from madns_runtime.realtime.process_port import ProcessPort
from madns_runtime.realtime.wake_lead import WAIT_S_MAX, WakeLead


class PackMember(Protocol):
    """An agent's ticks as its pack knows them."""

    def next_deadline_s(self) -> float:
        """Return the simulated time at which its next tick is due, s; infinite while it has none."""

    def local_s(self, t_s: float) -> float:
        """Return when simulated time *t_s* is on this machine's monotonic clock, s."""

    def tick(self) -> None:
        """Run the tick that is due, if one is."""

    def report_if_due(self, now_s: float) -> None:
        """Ping the host, if that is due by *now_s* of the local clock: this wake-up then serves for both."""


class Pack:
    """
    Some agents of a process.

    Args:
        phase_s: Offset of their deadlines within the period, s.
        reactor: The loop.
        process: The socket that they share.
    """

    def __init__(self, phase_s: float, *, reactor: Reactor, process: ProcessPort) -> None:
        self.phase_s = phase_s
        self._reactor = reactor
        self._process = process
        self._members: list[PackMember] = []
        self._lead = WakeLead()
        self._is_answered = False
        """Whether the host has sent something since the last ticks, to an agent by itself."""
        if process.agents == 1:
            process.after_packet = self._answered
        self._next: tuple[PackMember, float] | None = None
        """The member whose tick it wakes for, and when that is due, s of simulated time."""
        self._due_s = math.inf
        """When that is on the local clock, s, as the clock was after so many changes."""
        self._clock_changes = 0
        # Infinite is never: the timer is made once and moved.
        self._timer = reactor.call_at(math.inf, self._due)

    def add(self, member: PackMember) -> None:
        """Take an agent in."""
        self._members.append(member)

    def leave_out(self, member: PackMember) -> None:
        """Tick without an agent that has ended."""
        self._members = [other for other in self._members if other is not member]

    def arm(self) -> None:
        """Wake up for the earliest tick of any member."""
        earliest_s, first = math.inf, None
        for member in self._members:
            deadline_s = member.next_deadline_s()
            if deadline_s < earliest_s:
                earliest_s, first = deadline_s, member
        if first is None:
            self._next = None
            self._timer.reschedule(math.inf)
        else:
            self._next = first, earliest_s
            self._clock_changes = self._process.clock.changes
            self._due_s = due_s = first.local_s(earliest_s)
            self._timer.reschedule(due_s - self._lead.lead_s)

    def _due(self) -> None:
        members, process = self._members, self._process
        is_shared = len(members) > 1
        if is_shared:
            process.begin()
        process.account.begin_ticks(monotonic())
        try:
            self._wait_for_deadline()
            for member in members:
                member.tick()
            # What a pack says leaves in one packet with its ticks' messages. Of an agent by itself it would hold up the
            # answer to its tick: where answers come, it is said behind them.
            if not self._is_answered:
                self._report_if_due()
            self._is_answered = False
        finally:
            if is_shared:
                process.end()
        self.arm()

    def _answered(self) -> None:
        self._is_answered = True
        self._report_if_due()

    def _report_if_due(self) -> None:
        now_s = monotonic()
        for member in self._members:
            member.report_if_due(now_s)

    def _wait_for_deadline(self) -> None:
        """Wait for what is left until the deadline, WAIT_S_MAX at most, and learn from a wake-up out of sleep."""
        ordered_s, now_s = self._timer.when_s, monotonic()
        slept_from_s, slept_to_s = self._reactor.sleeps[-1]
        if slept_from_s <= ordered_s <= slept_to_s:
            self._lead.learn(now_s - ordered_s)
        if self._next is None:
            return
        if self._process.clock.changes != self._clock_changes:
            # By the clock as it is estimated now: a tick that is a little early would cost another wake-up.
            member, deadline_s = self._next
            self._due_s = member.local_s(deadline_s)
        until_s = min(self._due_s, ordered_s + WAIT_S_MAX)
        while now_s < until_s:
            now_s = monotonic()
