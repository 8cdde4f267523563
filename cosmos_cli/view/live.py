"""
Progress as three lines that stay at the foot of a terminal, with talk scrolling above.

Drawn only when something new has come and at most four times a second: on two processors every
redraw is time that agents could need. No thread draws.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TextIO

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from cosmos_cli.launch.events import AgentChanged, Progress
from cosmos_cli.view import words

REDRAW_INTERVAL_S = 0.25
WAITING_LINES_MAX = 200
BAR_WIDTH = 20
STYLES = {"critical": "bold red", "error": "red", "warning": "yellow", "debug": "dim"}
URGENT_LEVELS = frozenset({"critical", "error", "warning", "manual"})


class LiveView:
    """
    The view of a terminal.

    Args:
        stream: The terminal.
        title: Name of the run.
        duration_s: Simulated time of the run.
        now_s: A monotonic clock.
    """

    def __init__(
        self,
        stream: TextIO,
        title: str,
        *,
        duration_s: float,
        now_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self._console = Console(file=stream)
        self._title = title
        self._duration_s = duration_s
        self._now_s = now_s
        self._state = "starting"
        self._progress = Progress()
        self._drawn_s = float("-inf")
        self._waiting: list[tuple[str, str]] = []
        self._dropped = 0
        self._is_broken = False
        self._live = Live(
            console=self._console, auto_refresh=False, redirect_stdout=False, redirect_stderr=False
        )
        self._safely(self._live.start)

    def say(self, text: str, level: str = "info") -> None:
        """Show a sentence above: at once if it is urgent, else with the next redraw."""
        if len(self._waiting) < WAITING_LINES_MAX:
            self._waiting.append((text, level))
        else:
            self._dropped += 1
        if level in URGENT_LEVELS or self._is_due():
            self._draw()

    def state(self, state: str) -> None:
        """Show what the run is doing now."""
        self._state = words.state_words(state) or self._state
        if self._is_due():
            self._draw()

    def agent(self, change: AgentChanged) -> None:
        """The counts show it."""

    def progress(self, progress: Progress) -> None:
        """Show how the run fares."""
        self._progress = progress
        if self._is_due():
            self._draw()

    def work(self, what: str, share: float) -> None:
        """Show what is done with the records, and how far it is."""
        how_far = f" {share:.0%}" if share else ""  # of some steps nobody knows
        self._state = f"{words.work_words(what)}{how_far}"
        if self._is_due():
            self._draw()

    def close(self) -> None:
        """Leave the last picture and give the terminal back."""
        if self._live.is_started:
            self._draw()
            self._safely(self._live.stop)

    def _is_due(self) -> bool:
        return self._now_s() - self._drawn_s >= REDRAW_INTERVAL_S

    def _draw(self) -> None:
        self._drawn_s = self._now_s()
        self._safely(self._redraw)

    def _redraw(self) -> None:
        lines = self._above()
        self._live.update(self._picture())
        if lines is None:
            self._live.refresh()
        else:  # printing redraws what stands below
            self._console.print(lines, soft_wrap=True)

    def _above(self) -> Text | None:
        if self._dropped:
            self._waiting.append((f"{self._dropped} lines were too many to show", "warning"))
            self._dropped = 0
        waiting, self._waiting = self._waiting, []
        if not waiting:
            return None
        return Text("\n").join(Text(text, STYLES.get(level, "")) for text, level in waiting)

    def _picture(self) -> RenderableType:
        progress = self._progress
        head = Table.grid(padding=(0, 2))
        head.add_row(
            Text(self._title, "bold"),
            Text(self._state),
            ProgressBar(self._duration_s, words.simulated_s(progress), width=BAR_WIDTH),
            Text(words.clock_words(progress, self._duration_s)),
        )
        style = "yellow" if words.has_trouble(progress) else ""
        agents = (words.agent_words(progress), words.loss_words(progress))
        timing = words.timing_words(progress)
        return Group(
            head,
            Text("  ".join(agents), style, no_wrap=True, overflow="ellipsis"),
            Text("  ".join(timing), no_wrap=True, overflow="ellipsis"),
        )

    def _safely(self, action: Callable[[], object]) -> None:
        """Do something to the terminal; one that was closed must not end the run."""
        if self._is_broken:
            return
        try:
            action()
        except (OSError, ValueError):
            self._is_broken = True
