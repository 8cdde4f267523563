"""Progress of long work: a bar on a terminal, a plain line a step elsewhere."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from cosmos_cli.console import Console, is_terminal

STEP = 0.25
"""Elsewhere than on a terminal a line is printed when this much more is done."""


@contextmanager
def told_progress(console: Console, title: str) -> Iterator[Callable[[str, float], None]]:
    """
    Give a function that takes what is being done and how far it is, and show it on stderr.

    Args:
        console: Says nothing when it is quiet.
        title: What all of it is for, such as a run's name.
    """
    if console.quiet:
        yield lambda _what, _share: None
    elif is_terminal(sys.stderr):
        yield from _bar(title)
    else:
        yield _plain_lines(console, title)


def _bar(title: str) -> Iterator[Callable[[str, float], None]]:
    from rich.console import Console as RichConsole
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (
        TextColumn(title),
        BarColumn(),
        TextColumn("{task.description}"),
        TimeElapsedColumn(),
    )
    with Progress(*columns, console=RichConsole(stderr=True), transient=True) as bar:
        task = bar.add_task("", total=1.0)
        yield lambda what, share: bar.update(task, description=what, completed=share)


def _plain_lines(console: Console, title: str) -> Callable[[str, float], None]:
    told: dict[str, float] = {}

    def tell(what: str, share: float) -> None:
        step = what.split(" ", 1)[0]
        if step not in told or share - told[step] >= STEP:
            told[step] = share
            how_far = f" ({share:.0%})" if share else ""  # of some steps nobody knows
            console.say(f"{title}: {what}{how_far}")

    return tell
