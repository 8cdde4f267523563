"""The actions that the framework itself carries out: words, parameters, bounds. Pure; handlers are the time modes'."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Final, Literal

from annotated_types import Ge, Le, MaxLen, MinLen

from madns_runtime.timeline.action import ActionKind
from madns_runtime.timeline.fault_kinds import FAULT_KINDS

DeviceFaultWord = Literal["freeze", "bias", "noise", "drop", "delay", "disconnect", "clear"]
TEXT_CHARACTERS_MAX: Final = 200
FORBID_EXTRA: Final = {"extra": "forbid"}


@dataclass(frozen=True, slots=True, kw_only=True)
class Annotate:
    """Parameters of annotate."""

    __pydantic_config__ = FORBID_EXTRA

    text: Annotated[str, MinLen(1), MaxLen(TEXT_CHARACTERS_MAX)]
    """What is written beside the band."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Stress:
    """Parameters of stress."""

    __pydantic_config__ = FORBID_EXTRA

    workers: Annotated[int, Ge(1), Le(64)] = 1
    """Processes that factorise primes on the agent's machine."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DeviceFault:
    """Parameters of device_fault."""

    __pydantic_config__ = FORBID_EXTRA

    device: Annotated[str, MinLen(1)]
    """The device, by the name that its agents know."""
    fault: DeviceFaultWord
    """What happens to its samples."""
    value: Annotated[float, Ge(-1e12), Le(1e12)] | None = None
    """Of bias and noise, in the channel's unit; of drop the share of samples, 0 to 1; of delay seconds."""

    @property
    def value_or_nan(self) -> float:
        """The value; not a number where there is none."""
        return math.nan if self.value is None else self.value


ANNOTATE: Final = ActionKind(
    word="annotate",
    summary="Writes a remark into the events, and draws it into the report's figures.",
    parameters=Annotate,
    takes_agents=False,
    lasting="given",
    carried_out_by="framework",
)
STOP: Final = ActionKind(
    word="stop",
    summary="Ends the run here as if this were its duration: complete, and judged.",
    takes_agents=False,
    carried_out_by="framework",
)
STRESS: Final = ActionKind(
    word="stress",
    summary="Runs processes that use all they get of a processor on the agents' machines.",
    parameters=Stress,
    lasting="must",
    modes=("realtime",),
    carried_out_by="framework",
)
DEVICE_FAULT: Final = ActionKind(
    word="device_fault",
    summary="Inserts a fault around a device of each agent, as `cosmos inject` does; when it ends, all of the device's are cleared.",
    parameters=DeviceFault,
    lasting="may",
    carried_out_by="framework",
)
FRAMEWORK_ACTIONS: Final = (ANNOTATE, STOP, STRESS, DEVICE_FAULT, *FAULT_KINDS)


def kinds_by_word(declared: Iterable[ActionKind] = ()) -> Mapping[str, ActionKind]:
    """Return all kinds of a run by their words: the framework's, and those that its simulation declares."""
    return {kind.word: kind for kind in (*FRAMEWORK_ACTIONS, *declared)}


def kind_texts(kinds: Iterable[Any]) -> list[str]:
    """Return what is wrong with the actions that a simulation declares."""
    own = {kind.word for kind in FRAMEWORK_ACTIONS}
    faults = []
    seen: set[str] = set()
    for kind in kinds:
        if not isinstance(kind, ActionKind):
            faults.append(f"expected an ActionKind, got {kind!r}")
        elif not (kind.word.isidentifier() and kind.word == kind.word.lower()):
            faults.append(f"{kind.word!r}: expected a word of lower-case letters, digits and _")
        elif kind.word in own or kind.word in seen:
            faults.append(f"{kind.word}: is taken; give the action another word")
        elif kind.carried_out_by == "framework":
            faults.append(f"{kind.word}: expected carried_out_by host or agent")
        elif kind.carried_out_by == "agent" and not kind.takes_agents:
            faults.append(f"{kind.word}: what an agent's half carries out takes agents")
        else:
            seen.add(kind.word)
    return faults
