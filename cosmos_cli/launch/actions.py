"""
Actions that the supervision of a run asks for, and its agenda: actions for now, decisions for later. Pure.

The operator's loop carries the actions out, and has the clock.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from cosmos_cli.launch import events
from cosmos_cli.launch.request import FIRST_START, SupervisorStart


@dataclass(frozen=True, slots=True)
class StartHost:
    """Start the host; answered by ChildStarted or StartFailed."""


@dataclass(frozen=True, slots=True)
class StartAgents:
    """Start a machine's supervisor; answered by ChildStarted or StartFailed."""

    machine: str
    agents: tuple[str, ...]
    listening: events.Listening
    start: SupervisorStart = FIRST_START

    @property
    def name(self) -> str:
        """The supervisor's name; of a machine that has returned, with the number of its incarnation."""
        return f"agents@{self.machine}" + (
            f" ({self.start.incarnation})" if self.start.incarnation > 1 else ""
        )


@dataclass(frozen=True, slots=True)
class StepBack:
    """Give way to the children on this computer's processors."""

    nice: int


@dataclass(frozen=True, slots=True)
class Send:
    """Send a child a command."""

    name: str
    command: Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class Terminate:
    """Close a child's standard input and send its group SIGTERM."""

    name: str


@dataclass(frozen=True, slots=True)
class Kill:
    """Send a child's group SIGKILL; answered by GroupKilled."""

    name: str
    why: str


@dataclass(frozen=True, slots=True)
class LookAtGroup:
    """See who of a child's group lives; answered by GroupSeen."""

    name: str


@dataclass(frozen=True, slots=True)
class CloseChild:
    """Let go of a child on a lost machine."""

    name: str


@dataclass(frozen=True, slots=True)
class Reattach:
    """Make a new line to a child; answered by Reattached, ReattachFailed or ChildExited."""

    name: str


@dataclass(frozen=True, slots=True)
class QuoteLastWords:
    """Show the end of a child's standard error."""

    name: str


@dataclass(frozen=True, slots=True)
class FindLastCall:
    """Find the plug-in's call in which a host has ended, or stands; answered by LastCallFound."""

    name: str
    how: str = ""
    """End of the host; empty while it lives."""


@dataclass(frozen=True, slots=True)
class AskMachine:
    """Ask a connection for a sign of life; answered by MachineAsked."""

    machine: str


@dataclass(frozen=True, slots=True)
class ReachMachine:
    """Reach a lost machine and end what lives there of the run; answered by MachineReached."""

    machine: str


@dataclass(frozen=True, slots=True)
class OpenManualLine:
    """Wait for an agent that is started by hand, and tell how."""

    agent: str
    machine: str
    listening: events.Listening


@dataclass(frozen=True, slots=True)
class SendOnManualLine:
    """Send a command to an agent that was started by hand."""

    agent: str
    command: Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class StopListening:
    """Let no agent that is started by hand connect any more."""

    agent: str


@dataclass(frozen=True, slots=True)
class CloseManualLine:
    """Close the line; an agent that is still connected sees its life line end."""

    agent: str


@dataclass(frozen=True, slots=True)
class AnswerOrder:
    """Tell who ordered a fault why it is refused; empty if it is in force."""

    number: int
    refusal: str


@dataclass(frozen=True, slots=True)
class Say:
    """Show a sentence."""

    text: str
    level: str = "info"


@dataclass(frozen=True, slots=True)
class ReportProblem:
    """Show what did not go as it should, and keep it for the verdict."""

    text: str
    machine: str | None = None


@dataclass(frozen=True, slots=True)
class Show:
    """Show what a child said."""

    name: str
    event: events.StateChanged | events.Progress | events.Logged | events.Noise


Action = (
    StartHost
    | StartAgents
    | StepBack
    | Send
    | Terminate
    | Kill
    | LookAtGroup
    | CloseChild
    | Reattach
    | QuoteLastWords
    | FindLastCall
    | AskMachine
    | ReachMachine
    | OpenManualLine
    | SendOnManualLine
    | StopListening
    | CloseManualLine
    | AnswerOrder
    | Say
    | ReportProblem
    | Show
)


class Agenda:
    """
    Actions that wait to be carried out, and named moments at which something is decided.

    Every method that sets a moment counts from `now_s`, which the owner moves.
    """

    def __init__(self) -> None:
        self.now_s = 0.0
        self._actions: list[Action] = []
        self._due: dict[str, tuple[float, Callable[[], None]]] = {}

    def do(self, *actions: Action) -> None:
        """Ask for actions, in this order."""
        self._actions += actions

    def say(self, text: str, level: str = "info") -> None:
        """Ask for a sentence to be shown."""
        self.do(Say(text, level))

    def problem(self, text: str, machine: str | None = None) -> None:
        """Ask for a problem to be shown and kept."""
        self.do(ReportProblem(text, machine))

    def take(self) -> list[Action]:
        """Return the actions that were asked for since the last call."""
        actions, self._actions = self._actions, []
        return actions

    def after(self, name: str, wait_s: float, decide: Callable[[], None]) -> None:
        """Let *decide* be called when *wait_s* have passed; replaces what was set by this name."""
        self._due[name] = (self.now_s + wait_s, decide)

    def cancel(self, *names: str) -> None:
        """Forget moments; unknown ones do no harm."""
        for name in names:
            self._due.pop(name, None)

    def postpone(self, by_s: float) -> None:
        """Move all moments: for time in which the operator itself was stopped and could not look."""
        self._due = {name: (at_s + by_s, decide) for name, (at_s, decide) in self._due.items()}

    def wait_s(self, now_s: float) -> float | None:
        """Return the time until the next moment, 0 if it has come, None if there is none."""
        if not self._due:
            return None
        return max(0.0, min(at_s for at_s, _ in self._due.values()) - now_s)

    def due(self, now_s: float) -> Iterator[Callable[[], None]]:
        """Yield what is due by *now_s*, each once; what an earlier one cancels does not come."""
        for name in [name for name, (at_s, _) in self._due.items() if at_s <= now_s]:
            entry = self._due.get(name)
            if entry is not None and entry[0] <= now_s:
                del self._due[name]
                yield entry[1]
