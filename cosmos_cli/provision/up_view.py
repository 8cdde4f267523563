"""
Progress of `cosmos up`: one live line a machine on a terminal, a plain line a step elsewhere.

The pool's threads tell; whoever tells draws, at most a few times a second. Nothing is drawn, and Rich is
not imported, for what is over in a moment: the second `up` of an unchanged tower.
"""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable, Sequence
from typing import Any

from cosmos_cli.console import Console, is_terminal

QUIET_S = 1.0
REDRAW_INTERVAL_S = 0.2
TEXT_CHARACTERS_MAX = 100


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
        self._view.tell(self._machine, title, is_step=True)

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
        self._is_live = not console.quiet and is_terminal(sys.stderr)
        self._now_s = now_s
        self._start_s = self._drawn_s = now_s()
        self._lines = dict.fromkeys(machines, "waiting")
        self._lock = threading.Lock()
        self._live: Any = None

    def teller(self, machine: str) -> MachineTeller:
        """Return who tells of one machine."""
        return MachineTeller(self, machine)

    def tell(self, machine: str, text: str, *, is_step: bool = False) -> None:
        """Show what is done on a machine; for any thread."""
        with self._lock:
            self._lines[machine] = text[:TEXT_CHARACTERS_MAX]
            if self._is_live:
                self._draw_if_due()
            elif is_step:
                self._console.say(f"{machine}: {text}")

    def done(self, machine: str) -> None:
        """Show that a machine is done with; the table will tell how."""
        self.tell(machine, "done")

    def close(self) -> None:
        """Give the terminal back; what was shown goes, for the table follows."""
        with self._lock:
            if self._live is not None:
                self._live.stop()
                self._live = None
            self._is_live = False

    def __enter__(self) -> UpView:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _draw_if_due(self) -> None:
        now_s = self._now_s()
        if now_s - self._start_s < QUIET_S or now_s - self._drawn_s < REDRAW_INTERVAL_S:
            return
        self._drawn_s = now_s
        if self._live is None:
            self._live = _start_live()
        self._live.update(_picture(self._lines), refresh=True)


def _start_live() -> Any:
    from rich.console import Console as RichConsole
    from rich.live import Live

    live = Live(
        console=RichConsole(stderr=True),
        auto_refresh=False,
        transient=True,
        redirect_stdout=False,
        redirect_stderr=False,
    )
    live.start()
    return live


def _picture(lines: dict[str, str]) -> Any:
    from rich.table import Table
    from rich.text import Text

    table = Table.grid(padding=(0, 2))
    for machine, text in lines.items():
        table.add_row(Text(machine, "bold"), Text(text, no_wrap=True, overflow="ellipsis"))
    return table
