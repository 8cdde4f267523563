"""Chooses how a run is shown."""

from __future__ import annotations

import sys
import time

from cosmos_cli.launch.events import Progress
from cosmos_cli.launch.request import View
from cosmos_cli.models.agent_labels import NO_LABELS, AgentLabels
from cosmos_cli.system.import_turn import IMPORT_TURN
from cosmos_cli.ui import step_times
from cosmos_cli.ui.console import is_terminal
from cosmos_cli.ui.progress import work_words
from cosmos_cli.ui.step_times import Phases
from cosmos_cli.view.plain import PlainView, SilentView
from cosmos_cli.view.words import state_words


def make_view(
    title: str, duration_s: float, labels: AgentLabels = NO_LABELS, *, quiet: bool
) -> View:
    """Return the view that fits standard error: live on a terminal, lines elsewhere, errors only if *quiet*."""
    if step_times.is_on():
        return TimedView(_plain_view(duration_s, quiet=quiet), title)
    if quiet:
        return _plain_view(duration_s, quiet=True)
    if is_terminal(sys.stderr):
        with IMPORT_TURN:
            from cosmos_cli.view.live import LiveView  # rich costs a tenth of a second to import

        return LiveView(sys.stderr, title, duration_s=duration_s, labels=labels)
    return _plain_view(duration_s, quiet=False)


def _plain_view(duration_s: float, *, quiet: bool) -> View:
    kind = SilentView if quiet else PlainView
    return kind(sys.stderr, duration_s, now_s=time.monotonic)


class TimedView:
    """
    A view that also tells how long each phase of the run took.

    Args:
        view: Shows the run.
        title: The run's name.
    """

    def __init__(self, view: View, title: str) -> None:
        self._view = view
        self._phases = Phases(title)

    def say(self, text: str, level: str = "info") -> None:
        """Pass a sentence on."""
        self._view.say(text, level)

    def state(self, state: str) -> None:
        """Pass a state on; its predecessor has ended."""
        self._view.state(state)
        self._phases.begin(state_words(state) or state.replace("_", " ").lower())

    def progress(self, progress: Progress) -> None:
        """Pass it on."""
        self._view.progress(progress)

    def work(self, what: str, share: float) -> None:
        """Pass it on; another stage ends the one before."""
        self._view.work(what, share)
        self._phases.begin(work_words(what))

    def close(self) -> None:
        """End the last phase."""
        self._view.close()
        self._phases.begin("")
