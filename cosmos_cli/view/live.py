"""
Progress as lines that stay at the foot of a terminal, with talk scrolling above.

Three of the run, and a table of the values that its simulation wants shown, a line per agent.

Drawn only when something new has come and at most four times a second: on two processors every
redraw is time that agents could need. No thread draws.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TextIO

from rich.console import Group, RenderableType
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table

from cosmos_cli.launch.events import Progress
from cosmos_cli.models.agent_labels import NO_LABELS, AgentLabels
from cosmos_cli.ui.plural import counted
from cosmos_cli.ui.progress import work_words
from cosmos_cli.ui.rich_console import CleanConsole, clean_rich_text
from cosmos_cli.view import words

REDRAW_INTERVAL_S = 0.25
WAITING_LINES_MAX = 200
BAR_WIDTH = 20
AGENTS_SHOWN_MAX = 16
LINES_BESIDE_VALUES = 8
"""Of the terminal: progress, headings, and some of the talk above."""
STYLES = {"critical": "bold red", "error": "red", "warning": "yellow", "debug": "dim"}
URGENT_LEVELS = frozenset({"critical", "error", "warning", "manual"})


class LiveView:
    """
    The view of a terminal.

    Args:
        stream: The terminal.
        title: Name of the run.
        duration_s: Simulated time of the run.
        labels: Second names of agents.
        now_s: A monotonic clock.
    """

    def __init__(
        self,
        stream: TextIO,
        title: str,
        *,
        duration_s: float,
        labels: AgentLabels = NO_LABELS,
        now_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self._console = CleanConsole(file=stream)
        self._title = title
        self._duration_s = duration_s
        self._labels = labels
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
        self._draw(at_once=level in URGENT_LEVELS)

    def state(self, state: str) -> None:
        """Show what the run is doing now."""
        self._state = words.state_words(state) or self._state
        self._draw()

    def progress(self, progress: Progress) -> None:
        """Show how the run fares."""
        self._progress = progress
        self._draw()

    def work(self, what: str, share: float) -> None:
        """Show what is done with the records, and how far it is."""
        how_far = f" {share:.0%}" if share else ""  # of some steps nobody knows
        self._state = f"{work_words(what)}{how_far}"
        self._draw()

    def close(self) -> None:
        """Leave the last picture and give the terminal back."""
        if self._live.is_started:
            self._draw(at_once=True)
            self._safely(self._live.stop)

    def _draw(self, *, at_once: bool = False) -> None:
        """Draw what is new, unless that was just done."""
        now_s = self._now_s()
        if at_once or now_s - self._drawn_s >= REDRAW_INTERVAL_S:
            self._drawn_s = now_s
            self._safely(self._redraw)

    def _redraw(self) -> None:
        lines = self._above()
        self._live.update(self._picture())
        if lines is None:
            self._live.refresh()
        else:  # printing redraws what stands below
            self._console.print(lines, soft_wrap=True)

    def _above(self) -> RenderableType | None:
        if self._dropped:
            self._waiting.append((f"{self._dropped} lines were too many to show", "warning"))
            self._dropped = 0
        waiting, self._waiting = self._waiting, []
        if not waiting:
            return None
        return clean_rich_text("\n").join(
            clean_rich_text(text, STYLES.get(level, "")) for text, level in waiting
        )

    def _picture(self) -> RenderableType:
        progress = self._progress
        head = Table.grid(padding=(0, 2))
        head.add_row(
            clean_rich_text(self._title, "bold"),
            clean_rich_text(self._state),
            ProgressBar(self._duration_s, words.simulated_s(progress), width=BAR_WIDTH),
            clean_rich_text(words.clock_words(progress, self._duration_s)),
        )
        style = "yellow" if words.has_trouble(progress) else ""
        agents = (words.agent_words(progress), words.loss_words(progress))
        timing = words.timing_words(progress)
        values = [self._values()] if progress.values else []
        return Group(
            head,
            clean_rich_text("  ".join(agents), style, no_wrap=True, overflow="ellipsis"),
            clean_rich_text("  ".join(timing), no_wrap=True, overflow="ellipsis"),
            *values,
        )

    def _values(self) -> RenderableType:
        """Return the newest values of the simulation's columns, a row per agent: as many as fit the terminal."""
        progress, labels = self._progress, self._labels.names
        rows_max = min(AGENTS_SHOWN_MAX, self._console.size.height - LINES_BESIDE_VALUES)
        shown = list(progress.values.items())[: max(0, rows_max)]
        left_out = len(progress.values) - len(shown) + progress.values_left_out
        grid = Table.grid(padding=(0, 2))
        headings = ("agent", *([self._labels.column] if labels else []), *progress.columns)
        grid.add_row(*(clean_rich_text(heading, "dim", no_wrap=True) for heading in headings))
        for agent, values in shown:
            own = [labels.get(agent, "")] if labels else []
            cells = (agent, *own, *map(words.value_words, values))
            grid.add_row(*(clean_rich_text(cell, no_wrap=True) for cell in cells))
        more = (
            [clean_rich_text(f"and {counted(left_out, 'more agent')}", "dim")] if left_out else []
        )
        return Group(grid, *more)

    def _safely(self, action: Callable[[], object]) -> None:
        """Do something to the terminal; one that was closed must not end the run."""
        if self._is_broken:
            return
        try:
            action()
        except (OSError, ValueError):
            self._is_broken = True
