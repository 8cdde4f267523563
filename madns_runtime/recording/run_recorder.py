"""The records of the host, or of one agent: a recorder that knows the simulated time and what the framework itself tells."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from madns_runtime.config import RunConfig
from madns_runtime.recording.counts import RecordCounts
from madns_runtime.recording.records import EVENTS, LOG
from madns_runtime.recording.writer import CLOSE_TIMEOUT_S, Recorder

T_S_DIGITS = 6


class RunRecorder(Recorder):
    """
    The record streams of the host or of one agent, events and log among them.

    Args:
        directory: Where the files go.
        config: The run.
        source: host, or the agent's name.
        t_s: Returns the simulated time, s; None before it runs.
        life: Which life of its process this is; files are numbered from it.

    Raises:
        MachineError: The directory cannot be made, or takes no new file.
    """

    def __init__(
        self,
        directory: Path,
        config: RunConfig,
        *,
        source: str,
        t_s: Callable[[], float | None],
        life: int = 1,
    ) -> None:
        settings = config.recording
        super().__init__(directory, run=config.run, source=source, settings=settings, life=life)
        self._t_s = t_s
        self._is_ended = False
        self.open_stream(EVENTS)
        self.open_stream(LOG)

    def event(self, event: str, **values: Any) -> None:
        """Record that something happened now; nothing once the records are closed."""
        if not self._is_ended:
            when = {"t_s": self._now_s(), "utc": self._utc(), "event": event}
            self.record(EVENTS.name, {**when, **values})

    def say(self, level: str, text: str) -> None:
        """Log a sentence of the framework's own, now."""
        self.log(level, text, self._now_s())

    def close(self, timeout_s: float = CLOSE_TIMEOUT_S) -> RecordCounts:
        """Record the end, and close; see `Recorder.close`."""
        self.event("end")
        self._is_ended = True
        return super().close(timeout_s)

    def _now_s(self) -> float | None:
        t_s = self._t_s()
        return None if t_s is None else round(t_s, T_S_DIGITS)
