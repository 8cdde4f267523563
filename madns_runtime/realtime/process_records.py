"""The framework's records of one agent in real time, beside those of the plug-in."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from madns_runtime.health.probe import ProcessUsage
from madns_runtime.recording.records import CLOCK, LATE_TICKS, PROCESS, TICKS
from madns_runtime.recording.run_journal import RunJournal
from madns_runtime.timing.clocksync import ClockEstimate

CLOCK_INTERVAL_S = 1.0
"""The clock's estimate is recorded this often, though it changes with every exchange."""
PROBLEM_CHARACTERS_MAX = 200
"""Characters of the disk's trouble in a report, which must fit a datagram."""


class ProcessRecords:
    """
    The streams ticks, late_ticks, clock and process of one agent.

    Args:
        journal: Of the agent; these streams lie beside its own.
        period_s: How often to record what the process uses, s.

    Raises:
        MachineError: The directory takes no new file.
    """

    def __init__(self, journal: RunJournal, period_s: float) -> None:
        self._journal = journal
        self._recorder = journal.recorder
        self._t_s = journal.t_s
        for schema in (TICKS, LATE_TICKS, CLOCK, PROCESS):
            self._recorder.open_stream(schema)
        self._clock_recorded_s = 0.0
        self._usage = ProcessUsage()
        self._usage_period_s = period_s
        self.usage_due_s = math.inf
        """When to record next what the process uses, s of the local clock: in a wake-up that is for a tick anyway."""
        self.device_account: dict[str, Any] = {}
        """Counts for the host of losses between devices and the agent."""

    def scheduling(self, grant: Mapping[str, Any]) -> None:
        """Record what the kernel granted to the loop."""
        self._journal.event("scheduling", **grant)
        if grant.get("warning"):
            self._journal.say("warning", str(grant["warning"]))

    def clock(self, clock: ClockEstimate, now_s: float) -> None:
        """Record the estimate of the host's clock at local time *now_s*, now and then."""
        t_s = self._t_s()
        if t_s is None or now_s - self._clock_recorded_s < CLOCK_INTERVAL_S:
            return
        self._clock_recorded_s = now_s
        self._recorder.record(
            CLOCK.name,
            (
                round(t_s, 3),
                round(clock.offset_s(now_s) * 1e6, 1),
                round(clock.drift_ppm, 3),
                round(clock.uncertainty_s(now_s) * 1e6, 1),
                round(clock.round_trip_s_min * 1e6, 1),
            ),
        )

    def begin_usage(self, now_s: float, share: float) -> None:
        """
        Count what this process uses from now on.

        Args:
            now_s: Local time, s.
            share: Of the period by which the first record comes earlier, 0 to 1: those of a machine's processes at one
                time would keep each other's ticks waiting.
        """
        self._usage = ProcessUsage()
        self.usage_due_s = now_s + self._usage_period_s * (1.0 - share)

    def usage(self, now_s: float) -> None:
        """Record what this process has used since the last time."""
        self.usage_due_s = now_s + self._usage_period_s
        t_s = self._t_s()
        self._recorder.record(
            PROCESS.name, self._usage.read(None if t_s is None else round(t_s, 3))
        )

    def device_losses(self, losses: Mapping[str, Mapping[str, int]]) -> None:
        """Tell what devices, by name, and the agent had no room for, by kind."""
        self.device_account = self._journal.device_losses(losses)

    def report(self) -> dict[str, Any]:
        """Return what a ping tells of the records: how many were dropped, and the disk's trouble."""
        report: dict[str, Any] = {"dropped": self._recorder.counts().dropped}
        if (problem := self._recorder.problem) is not None:
            report["problem"] = problem[:PROBLEM_CHARACTERS_MAX]
        return report
