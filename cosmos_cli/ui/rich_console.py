"""
Rich's console for live pictures and framed tables, cleaned as all output is; the only home of Rich's writers.

Rich takes a tenth of a second to import: whoever draws imports this module when there is something to draw.
Text is cleaned where it is made, for an escape that is shown takes more columns than the character that it
shows; what was not made here is cleaned on its way out all the same.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any

from rich.console import Console
from rich.live import Live
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.segment import Segment
from rich.table import Table
from rich.text import Text

from cosmos_cli.ui.foreign_text import clean_line, clean_text


class CleanConsole(Console):
    """Writes to a terminal what its own styles and cursor need, and no other control character."""

    def render(self, renderable: Any, options: Any = None) -> Iterable[Segment]:
        """Return the segments of anything that can be drawn, each cleaned."""
        for segment in super().render(renderable, options):
            if segment.control or segment.text.isprintable():
                yield segment
            else:
                yield Segment(clean_text(segment.text), segment.style)


def clean_rich_text(text: str, style: str = "", **options: Any) -> Text:
    """
    Return text without a meaning of its own: no markup, no format, no control character.

    Args:
        text: What a person or a machine wrote.
        style: Rich's name of a style.
        options: Of `rich.text.Text`, such as no_wrap.
    """
    return Text(clean_text(text), style, **options)


def print_table(headings: Iterable[tuple[str, bool]], rows: Sequence[Sequence[str]]) -> None:
    """Print a framed table to stdout; *headings* tell of each column whether it holds numbers."""
    table = Table()
    for heading, is_number in headings:
        table.add_column(clean_rich_text(heading), justify="right" if is_number else "left")
    for row in rows:
        table.add_row(*map(clean_rich_text, row))
    CleanConsole().print(table)


def progress_bar(title: str) -> Iterator[Callable[[str, float], None]]:
    """Yield a function that moves a bar on stderr: the work's stage, and the share that is done."""
    columns = (
        # Neither a title nor a file's name is a format or markup.
        TextColumn("{task.fields[title]}", markup=False),
        BarColumn(),
        TextColumn("{task.description}", markup=False),
        TimeElapsedColumn(),
    )
    with Progress(*columns, console=CleanConsole(stderr=True), transient=True) as bar:
        task = bar.add_task("", total=1.0, title=clean_line(title))
        yield lambda what, share: bar.update(task, description=clean_line(what), completed=share)


class LiveRows:
    """Rows at the foot of stderr's terminal, a name and a text each; drawn when they are shown, gone at the end."""

    def __init__(self) -> None:
        self._live = Live(
            console=CleanConsole(stderr=True),
            auto_refresh=False,
            transient=True,
            redirect_stdout=False,
            redirect_stderr=False,
        )
        self._live.start()

    def show(self, rows: Mapping[str, str]) -> None:
        """Draw the rows."""
        table = Table.grid(padding=(0, 2))
        for name, text in rows.items():
            shown = clean_rich_text(text, no_wrap=True, overflow="ellipsis")
            table.add_row(clean_rich_text(name, "bold"), shown)
        self._live.update(table, refresh=True)

    def say(self, text: str) -> None:
        """Print a line above the rows."""
        self._live.console.print(clean_rich_text(text))

    def stop(self) -> None:
        """Take the rows away."""
        self._live.stop()
