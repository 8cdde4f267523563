"""Progress of long work: a bar on a terminal, one plain line per step elsewhere."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from cosmos_cli.system.import_turn import IMPORT_TURN
from cosmos_cli.ui import step_times
from cosmos_cli.ui.console import Console, is_terminal

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
    if step_times.is_on():
        phases = step_times.Phases(title)
        yield lambda what, _share: phases.begin(work_words(what))
        phases.begin("")
    elif console.quiet:
        yield lambda _what, _share: None
    elif is_terminal(sys.stderr):
        with IMPORT_TURN:
            from cosmos_cli.ui.rich_console import progress_bar  # a tenth of a second to import

        yield from progress_bar(title)
    else:
        yield _plain_lines(console, title)


def _plain_lines(console: Console, title: str) -> Callable[[str, float], None]:
    told: dict[str, float] = {}

    def tell(what: str, share: float) -> None:
        step = what.split(" ", 1)[0]
        if step not in told or share - told[step] >= STEP:
            told[step] = share
            how_far = f" ({share:.0%})" if share else ""  # of some steps nobody knows
            console.say(f"{title}: {what}{how_far}")

    return tell


def work_words(what: str) -> str:
    """Return the stage of the work after a run, without the file that it is at."""
    return "reading the records" if what.startswith("reading ") else what
