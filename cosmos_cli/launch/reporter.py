"""The operator's reports on a run, and those of them that the verdict will hear."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from cosmos_cli.evidence.run_documents import Problem
from cosmos_cli.launch.events import Logged, Noise, Progress, StateChanged
from cosmos_cli.launch.request import View
from cosmos_cli.ui.plural import counted

NOISE_LINES_MAX = 20
"""Lines of a child that are no events are shown this often, then only counted."""
PROBLEMS_MAX = 200
FAILED = ("failed", "aborted")
"""Status of a run that did not come to its end."""

Shown = StateChanged | Progress | Logged | Noise


class Reporter:
    """
    Passes sentences on to the view, and keeps the problems among them.

    Args:
        view: Where talk goes.
    """

    def __init__(self, view: View) -> None:
        self._view = view
        self._problems: list[Problem] = []
        self._not_kept = 0
        self._stall = ""
        self._noise: dict[str, int] = {}

    def problems(self, result: Mapping[str, Any] | None) -> tuple[Problem, ...]:
        """
        Return the problems of the run, the first PROBLEMS_MAX and how many more there were.

        By the host's *result*, what may have ended it is one.
        """
        problems = list(self._problems)
        if self._not_kept:
            were = "was" if self._not_kept == 1 else "were"
            further = counted(self._not_kept, "further problem")
            text = f"{further} {were} shown while the run lasted, and not kept"
            problems.append(Problem(text=text))
        if self._stall and (result is None or result.get("status") in FAILED):
            problems.append(Problem(text=self._stall))
        return tuple(problems)

    def stood_still(self, text: str) -> None:
        """Say that the operator stood still; a run that fails may have failed of that."""
        self._stall = text
        self._view.say(text, "warning")

    def problem(self, text: str, machine: str | None = None) -> None:
        """Say what did not go as it should, and keep it."""
        if len(self._problems) < PROBLEMS_MAX:
            self._problems.append(Problem(text=text, machine=machine))
        else:
            self._not_kept += 1
        self._view.say(text, "error")

    def show(self, name: str, event: Shown) -> None:
        """Pass on what a child said."""
        if isinstance(event, StateChanged):
            self._view.state(event.state)
        elif isinstance(event, Progress):
            self._view.progress(event)
        elif isinstance(event, Logged):
            self._view.say(f"{event.source or name}: {event.text}", event.level)
        else:
            self._noise_heard(name, event)

    def noise_in_all(self) -> None:
        """Say how many lines were too many to show."""
        for name, count in self._noise.items():
            if count > NOISE_LINES_MAX:
                self._view.say(f"{name}: {count} lines in all that are no events", "warning")

    def _noise_heard(self, name: str, event: Noise) -> None:
        """Show what a plug-in printed, a few times."""
        self._noise[name] = self._noise.get(name, 0) + 1
        if self._noise[name] <= NOISE_LINES_MAX:
            self._view.say(f"{name}: {event.text}", "info")
