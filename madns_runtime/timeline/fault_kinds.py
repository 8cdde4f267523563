"""The kinds of faults: the words of a timeline for them, and their parameters."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Final, Literal

from annotated_types import Ge, Gt, Le

from madns_runtime.plain_values import FORBID_EXTRA
from madns_runtime.timeline.action import ActionKind, TimelineAction

KILL: Final = "kill"
RESTART: Final = "restart"
HANG: Final = "hang"
SLOW: Final = "slow"
LOSE: Final = "lose_messages"
DELAY: Final = "delay_messages"
REORDER: Final = "reorder_messages"
DUPLICATE: Final = "duplicate_messages"
LINK_DOWN: Final = "link_down"
PARTITION: Final = "partition"

LOSSES: Final = (KILL, RESTART)

Traffic = Literal["all", "with_host", "between_agents"]
Probability = Annotated[float, Gt(0), Le(1)]
DELAY_S_MAX: Final = 3600
Delay = Annotated[float, Gt(0), Le(DELAY_S_MAX)]
MUST_CONTINUE: Final = "expected on_agent_loss: continue, got abort: the loss would end the run"


@dataclass(frozen=True, slots=True, kw_only=True)
class SlowSteps:
    """Parameters of slow."""

    __pydantic_config__ = FORBID_EXTRA

    factor: Annotated[float, Gt(1), Le(1000)]
    """How many times as long a step takes; in lockstep, where steps take no time, a step is taken in one of so many ticks."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LostMessages:
    """Parameters of lose_messages."""

    __pydantic_config__ = FORBID_EXTRA

    probability: Probability = 1.0
    traffic: Traffic = "all"
    """Which messages: those with the host's half, those between agents, or all."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DelayedMessages:
    """Parameters of delay_messages."""

    __pydantic_config__ = FORBID_EXTRA

    delay_s: Delay
    jitter_s: Annotated[float, Ge(0), Le(DELAY_S_MAX)] = 0.0
    """Up to so much is added, by chance."""
    traffic: Traffic = "all"


@dataclass(frozen=True, slots=True, kw_only=True)
class ReorderedMessages:
    """Parameters of reorder_messages."""

    __pydantic_config__ = FORBID_EXTRA

    probability: Probability = 0.5
    within_s: Delay = 1.0
    """A message that is chosen is late by up to this, by chance, so that later ones overtake it."""
    traffic: Traffic = "all"


@dataclass(frozen=True, slots=True, kw_only=True)
class DuplicatedMessages:
    """Parameters of duplicate_messages."""

    __pydantic_config__ = FORBID_EXTRA

    probability: Probability = 1.0
    traffic: Traffic = "all"


@dataclass(frozen=True, slots=True, kw_only=True)
class DownLink:
    """Parameters of link_down."""

    __pydantic_config__ = FORBID_EXTRA

    traffic: Traffic = "all"


_OF_AGENTS: Final[tuple[ActionKind, ...]] = (
    ActionKind(
        carried_out_by="framework",
        word=KILL,
        summary="Ends the agents without a word; with for_s they return after it.",
        lasting="may",
    ),
    ActionKind(
        carried_out_by="framework",
        word=RESTART,
        summary="Ends the agents without a word, and starts them anew.",
    ),
    ActionKind(
        carried_out_by="framework", word=HANG, summary="Withholds the agents' steps.", lasting="may"
    ),
    ActionKind(
        carried_out_by="framework",
        word=SLOW,
        summary="Makes the agents' steps take longer by a factor.",
        parameters=SlowSteps,
        lasting="may",
    ),
)
_OF_MESSAGES: Final[tuple[ActionKind, ...]] = (
    ActionKind(
        carried_out_by="framework",
        word=LOSE,
        summary="Loses messages of the agents by chance.",
        parameters=LostMessages,
        lasting="may",
    ),
    ActionKind(
        carried_out_by="framework",
        word=DELAY,
        summary="Delivers messages of the agents later.",
        parameters=DelayedMessages,
        lasting="may",
    ),
    ActionKind(
        carried_out_by="framework",
        word=REORDER,
        summary="Lets messages of the agents overtake each other.",
        parameters=ReorderedMessages,
        lasting="may",
    ),
    ActionKind(
        carried_out_by="framework",
        word=DUPLICATE,
        summary="Delivers messages of the agents twice.",
        parameters=DuplicatedMessages,
        lasting="may",
    ),
    ActionKind(
        carried_out_by="framework",
        word=LINK_DOWN,
        summary="Cuts the agents off from the host's half and from each other.",
        parameters=DownLink,
        lasting="may",
    ),
    ActionKind(
        carried_out_by="framework",
        word=PARTITION,
        summary="Parts the agents from all others: neither side hears the other.",
        lasting="may",
    ),
)
FAULT_KINDS: Final = (*_OF_AGENTS, *_OF_MESSAGES)
"""Every fault of agents and of their messages, by which `timeline:` and `cosmos inject` know it."""
FAULT_WORDS: Final = tuple(kind.word for kind in FAULT_KINDS)
MESSAGE_FAULTS: Final = tuple(kind.word for kind in _OF_MESSAGES)
STEP_FAULTS: Final = tuple(kind.word for kind in _OF_AGENTS if kind.word not in LOSSES)


def killed_words(action: TimelineAction) -> str:
    """Return why the agents of a kill or a restart are lost, in words."""
    did = "restarted" if action.word == RESTART else "killed"
    until = "" if action.for_s is None else f" for {action.for_s:g} s"
    return f"{did} on purpose at t = {action.t_s:g} s{until}"


def nobody_words(action: TimelineAction) -> str:
    """Return why an action is refused of which no agent is there."""
    return f"{', '.join(action.agents)}: not running, so there is nothing to {action.word}"


def factor_of(action: TimelineAction) -> float:
    """Return the factor of a fault of steps; 1 of one that has none."""
    return float(action.parameters.get("factor", 1.0))
