"""The framework's own records of a run: events and logged sentences, with the simulated time of each."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable, Mapping
from typing import Any

from madns_runtime.errors import MachineError, PluginError
from madns_runtime.recording.record_files import RecordCounts
from madns_runtime.recording.recorder import CLOSE_TIMEOUT_S, Recorder
from madns_runtime.recording.records import DEVICE_LOSSES, EVENTS, LOG, LOG_LEVELS
from madns_runtime.timing.clock import utc_now_iso

T_S_DIGITS = 6
LOG_CHARACTERS_MAX = 65_536
"""Of one sentence: whoever reads a log takes no longer ones at a time than this may become in a file."""
VERBOSITY_LEVELS = (logging.CRITICAL + 1, 50, 40, 30, 20, 10)
"""The least level that recording.verbosity 0 to 5 lets through, as logging numbers them."""


class RunJournal:
    """
    Events and log of the host or of one agent.

    No full disk holds up what it tells, such as a run's end, even where a recorder raises: what is recorded
    next, or flushed, says it.

    Args:
        recorder: Where they go; its other streams are its owner's.
        verbosity: recording.verbosity.
        t_s: Returns the simulated time, s; None before it runs.
        utc: Returns the time that events and sentences carry, ISO 8601.

    Raises:
        MachineError: The directory takes no new file.
    """

    def __init__(
        self,
        recorder: Recorder,
        verbosity: int,
        *,
        t_s: Callable[[], float | None],
        utc: Callable[[], str] = utc_now_iso,
    ) -> None:
        self.recorder = recorder
        self.t_s = t_s
        self._utc = utc
        self._level = VERBOSITY_LEVELS[verbosity]
        self._is_ended = False
        recorder.open_stream(EVENTS)
        recorder.open_stream(LOG)

    def event(self, event: str, **values: Any) -> None:
        """Record that something happened now; nothing once the records are closed."""
        if not self._is_ended:
            when = {"t_s": self._now_s(), "utc": self._utc(), "event": event}
            with contextlib.suppress(MachineError):
                self.recorder.record(EVENTS.name, {**when, **values})

    def emergency(self, reason: str) -> None:
        """Record that whoever records here ends before the run does, and why; also in the log."""
        self.event("emergency", reason=reason)
        self.say("critical", f"emergency shutdown: {reason}")

    def device_losses(self, losses: Mapping[str, Mapping[str, int]]) -> dict[str, Any]:
        """Tell what devices, by name, and an agent had no room for, by kind; also in the log. Return it for the host."""
        for device, counts in losses.items():
            self.event("device_losses", device=device, **counts)
            told = ", ".join(f"{name} {count}" for name, count in counts.items())
            self.say("warning", f"device {device}: there was no room for all: {told}")
        return {DEVICE_LOSSES: losses} if losses else {}

    def say(self, level: str, text: str) -> None:
        """Log a sentence of the framework's own, now."""
        self.log(level, text, self._now_s())

    def log(self, level: object, text: object, t_s: float | None = None) -> None:
        """
        Log a sentence, if it is loud enough for recording.verbosity.

        Args:
            level: critical, error, warning, info or debug.
            text: The sentence; what is beyond LOG_CHARACTERS_MAX is left out, and counted at its end.
            t_s: Simulated time, s; None where it does not run.

        Raises:
            PluginError: The level is none of these, or the sentence is no text.
        """
        if not isinstance(text, str):
            raise PluginError(f"log: expected a text, got {type(text).__name__}; str() it")
        if level not in tuple(LOG_LEVELS):  # compared, not looked up: it may be anything
            raise PluginError(
                f"unknown log level {level!r:.80}; expected one of {', '.join(LOG_LEVELS)}"
            )
        if LOG_LEVELS[level] < self._level:
            return
        if (rest := len(text) - LOG_CHARACTERS_MAX) > 0:
            text = f"{text[:LOG_CHARACTERS_MAX]}... ({rest} more characters)"
        # A lone surrogate, as in a file name that is no UTF-8, has no place in JSON.
        text = text.encode("utf-8", "backslashreplace").decode("utf-8")
        with contextlib.suppress(MachineError):
            self.recorder.record(LOG.name, (t_s, self._utc(), level, text))

    def close(self, timeout_s: float = CLOSE_TIMEOUT_S) -> RecordCounts:
        """Record the end, and close; see `Recorder.close`."""
        self.event("end")
        self._is_ended = True
        return self.recorder.close(timeout_s)

    def _now_s(self) -> float | None:
        t_s = self.t_s()
        return None if t_s is None else round(t_s, T_S_DIGITS)
