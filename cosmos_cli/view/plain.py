"""Progress as plain lines, for pipes, logs and CI; and the silent view, which shows errors only."""

from __future__ import annotations

from collections.abc import Callable
from typing import TextIO

from cosmos_cli.launch.events import Progress
from cosmos_cli.ui.console import tell
from cosmos_cli.ui.progress import work_words
from cosmos_cli.view.words import progress_line, state_words

PROGRESS_INTERVAL_S = 10.0
LOUD_LEVELS = frozenset({"error", "critical", "manual"})
"""Levels that even --quiet shows: without the command line of a hand-started agent nobody could start it."""
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
        word = "error" if level == "critical" else level
        self._write(text, word=word if level in COLOURS else "", colour=COLOURS.get(level, ""))

    def state(self, state: str) -> None:
        """Write what the run is doing now."""
        words = state_words(state)
        if words is not None:
            self._write(words)
        self._shown_s = self._now_s()

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

    def _write(self, text: str, *, word: str = "", colour: str = "") -> None:
        if self._is_broken:
            return
        try:
            tell(self._stream, text, word=word, colour=colour)
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
