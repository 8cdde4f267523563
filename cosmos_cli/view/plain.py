"""Progress as plain lines, for pipes, logs and CI; and the silent view, which shows errors only."""

from __future__ import annotations

from collections.abc import Callable
from typing import TextIO

from cosmos_cli.console import paint
from cosmos_cli.launch.events import AgentChanged, Progress
from cosmos_cli.view.words import progress_line, state_words, work_words

PROGRESS_INTERVAL_S = 10.0
LOUD_LEVELS = frozenset({"error", "critical", "manual"})
"""What even --quiet shows: without the command line of a hand-started agent nobody could start it."""
COLOURS = {"critical": "red", "error": "red", "warning": "yellow"}


class PlainView:
    """
    Writes a line at each change of state and every ten seconds.

    Args:
        stream: Where to; one that breaks is given up in silence, for the run matters more.
        duration_s: Simulated time of the run.
        now_s: A monotonic clock.
    """

    def __init__(self, stream: TextIO, duration_s: float, *, now_s: Callable[[], float]) -> None:
        self._stream = stream
        self._duration_s = duration_s
        self._now_s = now_s
        self._shown_s: float | None = None
        self._work: str | None = None
        self._is_broken = False

    def say(self, text: str, level: str = "info") -> None:
        """Write a sentence; warnings and worse are named so."""
        if level in COLOURS:
            word = "error" if level == "critical" else level
            text = f"{paint(word, COLOURS[level], self._stream)}: {text}"
        self._write(text)

    def state(self, state: str) -> None:
        """Write what the run is doing now."""
        words = state_words(state)
        if words is not None:
            self._write(words)
        self._shown_s = self._now_s()

    def agent(self, change: AgentChanged) -> None:
        """A lost agent is told by the host's log, with the reason; the rest shows in the counts."""

    def progress(self, progress: Progress) -> None:
        """Write how the run fares, if ten seconds have gone."""
        now_s = self._now_s()
        if progress.t_s is None or progress.t_s <= 0:
            return
        if self._shown_s is None or now_s - self._shown_s >= PROGRESS_INTERVAL_S:
            self._shown_s = now_s
            self._write(progress_line(progress, self._duration_s))

    def work(self, what: str, share: float) -> None:
        """Write each stage of the work once."""
        stage = work_words(what)
        if stage != self._work:
            self._work = stage
            self._write(stage)

    def close(self) -> None:
        """Leave nothing behind; there is nothing."""

    def _write(self, text: str) -> None:
        if self._is_broken:
            return
        try:
            self._stream.write(text + "\n")
            self._stream.flush()
        except (OSError, ValueError):
            self._is_broken = True


class SilentView(PlainView):
    """Shows errors, and what a person must do."""

    def say(self, text: str, level: str = "info") -> None:
        """Write the sentence if it is an error or asks for something."""
        if level in LOUD_LEVELS:
            super().say(text, level)

    def state(self, state: str) -> None:
        """Say nothing."""

    def progress(self, progress: Progress) -> None:
        """Say nothing."""

    def work(self, what: str, share: float) -> None:
        """Say nothing."""
