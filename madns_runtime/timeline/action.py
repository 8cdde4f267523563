"""An action of a timeline as a value, the kinds of actions that there are, and who carries one out. Pure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, Protocol

from madns_runtime.errors import MadnsError
from madns_runtime.plain_values import FORBID_EXTRA

Lasting = Literal["never", "given", "may", "must"]
TimeMode = Literal["realtime", "lockstep"]
CarriedOutBy = Literal["framework", "host", "agent"]


@dataclass(frozen=True, slots=True, kw_only=True)
class NoParameters:
    """Parameters of an action that has none."""

    __pydantic_config__ = FORBID_EXTRA


@dataclass(frozen=True, slots=True, kw_only=True)
class ActionKind:
    """A kind of action: the word that a timeline names it by, and what may stand beside the word."""

    word: str
    """Such as lose_messages: lower case, imperative."""
    summary: str
    """Effect, in one sentence."""
    parameters: type = NoParameters
    """A frozen stdlib dataclass; bounds are annotated_types, units stand in field names."""
    takes_agents: bool = True
    """Whether it acts on agents, which must then be named."""
    lasting: Lasting = "never"
    """Whether it has an end: never (no for_s), given (for as long as for_s says, without it over at once), may (without
    for_s until the end of the run), must (for_s is needed)."""
    modes: tuple[TimeMode, ...] = ("realtime", "lockstep")
    """The values of time.mode in which it exists."""
    carried_out_by: CarriedOutBy = "host"
    """Of a simulation's action: the half that is called. The framework's own are framework."""
    loses_agents: bool = False
    """Of a simulation's action: whether its agents are as good as lost by it, and told as lost on purpose."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TimelineAction:
    """One action that takes place."""

    number: int
    """Its own among all actions of the run, in the order in which they begin."""
    word: str
    agents: tuple[str, ...]
    """Names of the agents that it acts on, in order; empty for a kind that takes none."""
    parameters: Mapping[str, Any]
    """As the scenario gives them, validated, with defaults filled in."""
    t_s: float
    """Simulated time at which it was due, s."""
    for_s: float | None
    """How long it lasts, s; None for one that has no end, or none before the run's."""
    chance: int = 0
    """Number that its chance is drawn for, beside the seed; see `runner.chance_of`."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PlannedAction:
    """An entry of a scenario's timeline before the run, for a simulation that is asked what is wrong with it."""

    place: str
    """Where it stands, such as timeline[3]."""
    word: str
    agents: tuple[str, ...]
    """Names of the agents that it acts on, in order."""
    parameters: Any
    """An instance of its kind's class."""


class ActionRefused(MadnsError):
    """An action cannot take place now; the text says why. The run goes on, and records it."""


class ActionHandler(Protocol):
    """Carries out the actions of some words, at the host."""

    def begin(self, action: TimelineAction) -> Sequence[str] | None:
        """
        Let the action take place.

        Called at its simulated time; in lockstep before the first tick at or after that.

        Returns:
            Those of its agents that are not there, where it takes place at the others alone.

        Raises:
            ActionRefused: It cannot.
        """

    def end(self, action: TimelineAction) -> Sequence[str] | None:
        """
        Let what *action* did be over; called for those that last, once, unless the run ends before.

        Returns:
            Those of its agents that are not there, and are told when they return.

        Raises:
            ActionRefused: It cannot.
        """
