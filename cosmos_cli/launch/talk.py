"""What the operator says of a run, and what of it the verdict will hear."""

from __future__ import annotations

from cosmos_cli.launch.children import Child
from cosmos_cli.launch.events import Logged, Noise
from cosmos_cli.launch.outcome import View
from cosmos_cli.problem import Problem

NOISE_LINES_MAX = 20
"""Lines of a child that are no events are shown this often, then only counted."""
PROBLEMS_MAX = 200


class Talk:
    """
    Passes sentences on to the view, and keeps the problems among them.

    Args:
        view: Where talk goes.
    """

    def __init__(self, view: View) -> None:
        self._view = view
        self._problems: list[Problem] = []
        self._noise: dict[str, int] = {}

    @property
    def problems(self) -> tuple[Problem, ...]:
        """What did not go as it should, the first PROBLEMS_MAX."""
        return tuple(self._problems)

    def say(self, text: str, level: str = "info") -> None:
        """Say a sentence."""
        self._view.say(text, level)

    def problem(self, text: str, machine: str | None = None) -> None:
        """Say what did not go as it should, and keep it."""
        if len(self._problems) < PROBLEMS_MAX:
            self._problems.append(Problem(text=text, machine=machine))
        self._view.say(text, "error")

    def logged(self, name: str, event: Logged) -> None:
        """Pass on what a child found worth showing."""
        self._view.say(f"{event.source or name}: {event.text}", event.level)

    def noise(self, name: str, event: Noise) -> None:
        """Show what a plug-in printed, a few times."""
        self._noise[name] = self._noise.get(name, 0) + 1
        if self._noise[name] <= NOISE_LINES_MAX:
            self._view.say(f"{name}: {event.text}", "info")

    def noise_in_all(self) -> None:
        """Say how many lines were too many to show."""
        for name, count in self._noise.items():
            if count > NOISE_LINES_MAX:
                self._view.say(f"{name}: {count} lines in all that are no events", "warning")

    def last_words(self, child: Child) -> None:
        """Show the end of a child's standard error, when it is there."""

        def show(lines: list[str]) -> None:
            if lines:
                shown = "\n".join(f"  | {line}" for line in lines)
                self._view.say(f"the last lines of {child.stderr}:\n{shown}", "error")

        child.tell_last_words(show)
