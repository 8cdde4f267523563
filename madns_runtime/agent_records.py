"""What the framework records of one agent, beside what the plug-in does."""

from __future__ import annotations

import traceback
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from madns_runtime.config import RunConfig
from madns_runtime.health.probe import process_usage
from madns_runtime.recording.records import CLOCK, EVENTS, LOG, PROCESS, TICKS
from madns_runtime.recording.writer import Recorder
from madns_runtime.timing.clock import utc_now_iso
from madns_runtime.timing.clocksync import ClockEstimate

CLOCK_INTERVAL_S = 1.0
"""The clock's estimate is recorded this often, though it changes with every exchange."""
PROBLEM_CHARACTERS_MAX = 200
"""Of the disk's trouble in a report, which must fit a datagram."""


class AgentRecords:
    """
    The record streams of one agent.

    Args:
        directory: Where the files go.
        config: The run.
        source: The agent's name.
        t_s: Returns the simulated time, s; None before it runs.
        incarnation: Which process of this agent this is, from 1.
    """

    def __init__(
        self,
        directory: Path,
        config: RunConfig,
        *,
        source: str,
        t_s: Callable[[], float | None],
        incarnation: int = 1,
    ) -> None:
        self.recorder = Recorder(
            directory, run=config.run, source=source, settings=config.recording, life=incarnation
        )
        for schema in (TICKS, CLOCK, EVENTS, LOG, PROCESS):
            self.recorder.open_stream(schema)
        self._t_s = t_s
        self._clock_recorded_s = 0.0
        self._is_open = True

    def event(self, event: str, **values: Any) -> None:
        """Record that something happened; nothing once the records are closed."""
        if not self._is_open:
            return
        t_s = self._t_s()
        self.recorder.record(
            "events",
            {
                "t_s": None if t_s is None else round(t_s, 6),
                "utc": utc_now_iso(),
                "event": event,
                **values,
            },
        )

    def log(self, level: str, text: str) -> None:
        """Log a sentence."""
        self.recorder.log(level, text, self._t_s())

    def failure(self, error: BaseException) -> None:
        """Log the traceback of what a plug-in raised."""
        self.log("critical", "".join(traceback.format_exception(error)))

    def clock(self, clock: ClockEstimate, now_s: float) -> None:
        """Record the estimate of the host's clock at local time *now_s*, now and then."""
        t_s = self._t_s()
        if t_s is None or now_s - self._clock_recorded_s < CLOCK_INTERVAL_S:
            return
        self._clock_recorded_s = now_s
        self.recorder.record(
            "clock",
            (
                round(t_s, 3),
                round(clock.offset_s(now_s) * 1e6, 1),
                round(clock.drift_ppm, 3),
                round(clock.uncertainty_s(now_s) * 1e6, 1),
                round(clock.round_trip_s_min * 1e6, 1),
            ),
        )

    def usage(self) -> None:
        """Record what this process uses."""
        t_s = self._t_s()
        self.recorder.record("process", process_usage(None if t_s is None else round(t_s, 3)))

    def report(self) -> dict[str, Any]:
        """Return what a ping tells of the records: how many were dropped, and the disk's trouble."""
        report: dict[str, Any] = {"dropped": self.recorder.counts().dropped}
        if (problem := self.recorder.problem) is not None:
            report["problem"] = problem[:PROBLEM_CHARACTERS_MAX]
        return report

    def close(self, timeout_s: float) -> Mapping[str, Any]:
        """Put the records on the disk, and return their counts."""
        self.event("end")
        self._is_open = False
        return self.recorder.close(timeout_s).to_mapping()
