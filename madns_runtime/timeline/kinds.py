"""The actions that the framework itself carries out: words, parameters, bounds. Pure; handlers are the time modes'."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Final, Literal, get_args

from annotated_types import Ge, Le, MaxLen, MinLen

from madns_runtime.plain_values import FORBID_EXTRA, is_line, shown
from madns_runtime.timeline.action import ActionKind, CarriedOutBy, Lasting, TimeMode
from madns_runtime.timeline.fault_kinds import FAULT_KINDS

DeviceFaultWord = Literal["freeze", "bias", "noise", "drop", "delay", "disconnect", "clear"]
TEXT_CHARACTERS_MAX: Final = 200
STEP_MS_MAX: Final = 10_000
DRIFT_PPM_MAX: Final = 500
"""The most that an estimate of the host's clock follows: two crystals differ by less, and a time service slews by so much."""
ENTRY_KEYS: Final = ("action", "agents", "at_s", "every_s", "when", "rate_per_h", "from_s", "to_s", "for_s")  # fmt: skip
"""Keys of a timeline's entry itself, beside which the action's parameters stand."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Annotate:
    """Parameters of annotate."""

    __pydantic_config__ = FORBID_EXTRA

    text: Annotated[str, MinLen(1), MaxLen(TEXT_CHARACTERS_MAX)]
    """Words beside the band."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Stress:
    """Parameters of stress."""

    __pydantic_config__ = FORBID_EXTRA

    workers: Annotated[int, Ge(1), Le(64)] = 1
    """Processes that factorise primes on the agent's machine."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ClockStep:
    """Parameters of step_clock."""

    __pydantic_config__ = FORBID_EXTRA

    by_ms: Annotated[float, Ge(-STEP_MS_MAX), Le(STEP_MS_MAX)]
    """By how much the clock is put forward, ms; below 0 back."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ClockDrift:
    """Parameters of drift_clock."""

    __pydantic_config__ = FORBID_EXTRA

    ppm: Annotated[float, Ge(-DRIFT_PPM_MAX), Le(DRIFT_PPM_MAX)]
    """By how much the clock runs faster, 1e-6; below 0 slower."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DeviceFault:
    """Parameters of device_fault."""

    __pydantic_config__ = FORBID_EXTRA

    device: Annotated[str, MinLen(1)]
    """The device, by the name that its agents know."""
    fault: DeviceFaultWord
    """Kind of the fault of its samples."""
    value: Annotated[float, Ge(-1e12), Le(1e12)] | None = None
    """Of bias and noise, in the channel's unit; of drop the share of samples, 0 to 1; of delay seconds."""


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
STEP_CLOCK: Final = ActionKind(
    word="step_clock",
    summary="Puts the clock that an agent's process reads forward or back; its estimate of the host's has to find it.",
    parameters=ClockStep,
    modes=("realtime",),
    carried_out_by="framework",
)
DRIFT_CLOCK: Final = ActionKind(
    word="drift_clock",
    summary="Lets the clock that an agent's process reads run faster or slower; its estimate of the host's has to follow.",
    parameters=ClockDrift,
    lasting="may",
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
FRAMEWORK_ACTIONS: Final = (
    ANNOTATE,
    STOP,
    STRESS,
    STEP_CLOCK,
    DRIFT_CLOCK,
    DEVICE_FAULT,
    *FAULT_KINDS,
)


def kinds_by_word(declared: Iterable[ActionKind]) -> Mapping[str, ActionKind]:
    """Return all kinds of a run by their words: the framework's, and those that its simulation declares."""
    return {kind.word: kind for kind in (*FRAMEWORK_ACTIONS, *declared)}


def _field_fault(kind: ActionKind) -> str:
    """Return the first field of an action that is not of its kind; empty if there is none."""
    modes: Any = kind.modes
    known = get_args(TimeMode)
    for name, is_fit, wanted in (
        ("word", is_line(kind.word), "a text"),
        ("summary", isinstance(kind.summary, str), "a text"),
        ("takes_agents", isinstance(kind.takes_agents, bool), "True or False"),
        ("loses_agents", isinstance(kind.loses_agents, bool), "True or False"),
        ("lasting", _is_one_of(kind.lasting, get_args(Lasting)), _told(get_args(Lasting))),
        (
            "carried_out_by",
            _is_one_of(kind.carried_out_by, get_args(CarriedOutBy)),
            "host or agent",
        ),
        (
            "modes",
            isinstance(modes, tuple | list) and all(_is_one_of(mode, known) for mode in modes),
            f"a tuple of {_told(known)}",
        ),
    ):
        if not is_fit:
            got = shown(getattr(kind, name))
            return f"{shown(kind.word)}: {name}: expected {wanted}, got {got}"
    return ""


def _is_one_of(value: object, known: tuple[str, ...]) -> bool:
    return isinstance(value, str) and value in known


def _told(known: tuple[str, ...]) -> str:
    return ", ".join(known)


def kind_texts(kinds: Iterable[Any]) -> list[str]:
    """Return what is wrong with the actions that a simulation declares."""
    own = {kind.word for kind in FRAMEWORK_ACTIONS}
    faults = []
    seen: set[str] = set()
    for kind in kinds:
        if not isinstance(kind, ActionKind):
            faults.append(f"expected an ActionKind, got {shown(kind)}")
        elif fault := _field_fault(kind):
            faults.append(fault)
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
