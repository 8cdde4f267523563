"""
Progress of `cosmos up`: one live line per machine on a terminal, one plain line per machine elsewhere.

The plain line comes when the machine is done; now and then another tells who is still at work.

The pool's threads tell; whoever tells draws, at most a few times a second. Nothing is drawn, and Rich is
not imported, for what is over in a moment: the second `up` of an unchanged tower.
"""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable, Sequence
from typing import Any

from cosmos_cli.system.import_turn import IMPORT_TURN
from cosmos_cli.ui.console import Console, is_terminal
from cosmos_cli.ui.foreign_text import clean_line
from cosmos_cli.ui.name_ranges import compact, names_by
from cosmos_cli.ui.plural import counted
from cosmos_cli.ui.step_times import is_on

QUIET_S = 1.0
REDRAW_INTERVAL_S = 0.2
TEXT_CHARACTERS_MAX = 100
STILL_INTERVAL_S = 15.0
"""Time between lines about machines still at work, where nobody looks at a terminal."""
STILL_SHOWN_MAX = 4
"""Tasks that such a line shows."""


class MachineTeller:
    """
    Tells a view what is done on one machine.

    Args:
        view: Shows it.
        machine: Its name.
    """

    def __init__(self, view: UpView, machine: str) -> None:
        self._view = view
        self._machine = machine
        self._step = ""

    def step(self, title: str) -> None:
        """Say that a step begins."""
        self._step = title
        self._view.tell(self._machine, title)

    def detail(self, text: str) -> None:
        """Say how far it is."""
        self._view.tell(self._machine, f"{self._step}: {text}" if self._step else text)


class UpView:
    """
    The view; use it as a context manager.

    Args:
        console: Says nothing when it is quiet.
        machines: Their names, in the order in which they are shown.
        now_s: A monotonic clock.
    """

    def __init__(
        self,
        console: Console,
        machines: Sequence[str],
        *,
        now_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self._console = console
        self._is_live = not (console.quiet or is_on()) and is_terminal(sys.stderr)
        self._now_s = now_s
        self._start_s = self._drawn_s = now_s()
        self._lines = dict.fromkeys(machines, "waiting for its answer")
        self._done: set[str] = set()
        self._said_s = self._start_s
        self._lock = threading.Lock()
        self._live: Any = None

    def teller(self, machine: str) -> MachineTeller:
        """Return who tells of one machine."""
        return MachineTeller(self, machine)

    def tell(self, machine: str, text: str) -> None:
        """Show what is done on a machine; for any thread."""
        with self._lock:
            self._lines[machine] = clean_line(text, length_max=TEXT_CHARACTERS_MAX)
            if self._is_live:
                self._draw_if_due()

    def done(self, machine: str, text: str) -> None:
        """Show what became of a machine; a failure is told when it happens, not in the table at the end."""
        with self._lock:
            self._done.add(machine)
            self._lines[machine] = clean_line(text, length_max=TEXT_CHARACTERS_MAX)
            if self._is_live:
                self._draw_if_due()
            else:
                self._console.say(f"{machine}: {text}")

    def say(self, text: str) -> None:
        """Say what is done on this computer, above what is shown of machines."""
        with self._lock:
            (self._live or self._console).say(text)

    def look(self) -> None:
        """Say elsewhere than on a terminal who is still at work, when nothing has been said of it for long."""
        with self._lock:
            now_s = self._now_s()
            if self._is_live or now_s - self._said_s < STILL_INTERVAL_S:
                return
            self._said_s = now_s
            if still := _still(self._lines, self._done):
                self._console.say(f"after {now_s - self._start_s:.0f} s: {still}")

    def close(self) -> None:
        """Give the terminal back; what was shown goes, for the table follows."""
        with self._lock:
            if self._live is not None:
                self._live.stop()
                self._live = None
            self._is_live = False

    def __enter__(self) -> UpView:
        return self

    def __exit__(self, kind: type[BaseException] | None, *rest: object) -> None:
        self.close()
        if kind is KeyboardInterrupt:
            self._tell_interrupted()

    def _tell_interrupted(self) -> None:
        """Say how far it came, and that nothing is lost."""
        with self._lock:
            done = f"{len(self._done)} of {counted(len(self._lines), 'machine')} done"
            still = _still(self._lines, self._done)
            self._console.say(f"{done}; {still}" if still else done)
            self._console.say("the same command goes on from there: what is done is not done again")

    def _draw_if_due(self) -> None:
        now_s = self._now_s()
        if now_s - self._start_s < QUIET_S or now_s - self._drawn_s < REDRAW_INTERVAL_S:
            return
        self._drawn_s = now_s
        if self._live is None:
            with IMPORT_TURN:
                from cosmos_cli.ui.rich_console import LiveRows  # a tenth of a second to import

            self._live = LiveRows()
        self._live.show(self._lines)


def _still(lines: dict[str, str], done: set[str]) -> str:
    """Return who is at what, machines at the same thing together."""
    at = names_by((text, machine) for machine, text in lines.items() if machine not in done)
    shown = [f"{compact(names)}: {text}" for text, names in list(at.items())[:STILL_SHOWN_MAX]]
    rest = sum(len(names) for names in list(at.values())[STILL_SHOWN_MAX:])
    return "; ".join([*shown, *([f"{counted(rest, 'machine')} more at work"] if rest else [])])
