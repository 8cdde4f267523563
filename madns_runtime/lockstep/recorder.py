"""
Records of a run that does not wait for the disk by itself: here the disk holds up the run, and nothing is dropped.

No thread, and no byte that depends on the wall clock: a run recorded twice is recorded the same.
"""

from __future__ import annotations

import contextlib
from dataclasses import replace
from pathlib import Path
from typing import Any

from madns_runtime.config import RunConfig
from madns_runtime.errors import MachineError
from madns_runtime.lockstep.clock import T0_UTC, SimulatedClock
from madns_runtime.recording.counts import RecordCounts
from madns_runtime.recording.run_recorder import RunRecorder
from madns_runtime.recording.writer import CLOSE_TIMEOUT_S


class LockstepRecorder(RunRecorder):
    """
    The record streams of the host or of one agent, written by whoever records.

    The schema lines name the scenario where those of other runs name the run: its number would
    differ from one run to the next.

    Args:
        directory: Where the files go.
        config: The run.
        source: host, or the agent's name.
        clock: What events and logged sentences carry the time of.

    Raises:
        MachineError: The directory cannot be made.
    """

    def __init__(
        self, directory: Path, config: RunConfig, *, source: str, clock: SimulatedClock
    ) -> None:
        self._clock = clock
        named = replace(config, run=config.scenario)
        super().__init__(directory, named, source=source, t_s=clock.now_s)
        self.set_t0(T0_UTC)

    def start(self) -> None:
        """Do nothing: there is no thread."""

    def event(self, event: str, **values: Any) -> None:
        """Record that something happened, as a run's end, which no full disk may hold up."""
        with contextlib.suppress(MachineError):  # what is recorded next, or flushed, says it
            super().event(event, **values)

    def log(self, level: str, text: str, t_s: float | None = None) -> None:
        """Log a sentence, as of a run's end, which no full disk may hold up."""
        with contextlib.suppress(MachineError):
            super().log(level, text, t_s)

    def flush(self) -> None:
        """
        Write what waits.

        Raises:
            MachineError: The disk refuses: a run that goes on would only lose records.
        """
        if not self._flush():
            raise MachineError(f"records cannot be written: {self.problem}")

    def close(self, timeout_s: float = CLOSE_TIMEOUT_S) -> RecordCounts:
        """Write what waits and the end lines, make it durable, and return the last counts."""
        del timeout_s  # the host waits, not this process
        if not self._is_ended:
            self.event("end")
            self._is_ended = self._is_closing = True
            self._flush()
            self._finish_files()
        return self.counts()

    def _hurry(self) -> None:
        self.flush()

    def _utc(self) -> str:
        return self._clock.utc()
