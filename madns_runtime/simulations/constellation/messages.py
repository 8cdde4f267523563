"""
Messages between the two halves of the constellation, as dataclasses that become mappings.

Pure. A mapping has the fields and "kind", the kind of message; a command's own kind is under "command".

    agent -> host    Command (SYNC, deadline: its time)
    host -> agent    Initial, Segment, CommandResult, TankGauge, GroundText, SatelliteLoss

What vehicles say to each other and to the ground travels as the framework's messages between agents do.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, fields
from typing import Any, ClassVar, Literal, NamedTuple, Self, cast, get_args

import numpy as np
from numpy.typing import NDArray

from madns_runtime.errors import PluginError
from madns_runtime.protocol.messages import Delivery, TransmissionRefusal
from madns_runtime.simulations.constellation.parameters import KNOTS_MAX
from madns_runtime.simulations.constellation.thrust import Thrust, Vector

__all__ = [
    "GROUND",
    "Command",
    "CommandFrame",
    "CommandKind",
    "CommandResult",
    "CommandStatus",
    "Delivery",
    "GroundText",
    "Initial",
    "Message",
    "SatelliteLoss",
    "Segment",
    "TankGauge",
    "TransmissionRefusal",
    "is_for_ground",
    "knot_runs",
]

GROUND = "ground"
"""Receiver of what is for any ground station; ground:NAME for one of them."""

CommandKind = Literal["delta_v", "torque", "ballistic", "dipole"]
CommandFrame = Literal["inertial", "rtn", "body"]
LEAD_TICKS = 1
"""So much ahead of its time the host of a rerun tells that a command is over; the agent holds that back."""
TOO_LATE = "s too late"
"""Of a command that was not heard in time: ends the first part of its result's reason, how late it came."""
CommandStatus = Literal["accepted", "executed", "postponed", "refused"]


class Message:
    """Base of all messages between the halves: a dataclass that becomes a mapping and is read back by its fields' types."""

    __slots__ = ()
    KIND: ClassVar[str]

    def to_message(self) -> dict[str, Any]:
        """Return the mapping that travels."""
        message: dict[str, Any] = {"kind": self.KIND}
        for field in _fields(type(self)):
            message[field.key] = field.write(getattr(self, field.name))
        return message

    @classmethod
    def from_message(cls, message: Mapping[str, Any]) -> Self:
        """
        Read a message back.

        Raises:
            PluginError: It is not as `to_message` writes it; says which field is not.
        """
        values = {}
        for field in _fields(cls):
            try:
                values[field.name] = field.read(message[field.key])
            except (KeyError, TypeError, ValueError) as error:
                raise PluginError(
                    f"constellation: {cls.KIND}: expected {field.name}: {field.type}, "
                    f"got {message.get(field.key)!r:.200}"
                ) from error
        return cls(**values)


@dataclass(frozen=True, slots=True, kw_only=True)
class Segment(Message):
    """A stretch of one vehicle's future truth."""

    KIND = "segment"

    revision: int
    """Grows with every maneuver; a newer one replaces the future from its first knot on."""
    t0_s: float
    """Simulated time of the first knot, s."""
    knot_s: float
    """Time between knots, s."""
    states: NDArray[np.float64]
    """Shape (K, 6), m and m/s, K >= 2."""
    attitude: NDArray[np.float64] | None = None
    """Shape (K, 7): quaternion, scalar last, inertial to body; body rates, rad/s. None for a point mass."""
    thrust: Thrust | None = None
    """Acceleration other than gravity and drag all through the segment: a thrust arc, or a part of one."""
    ballistic_m2_kg: float | None = None
    """Ballistic coefficient that drag acts on all through the segment, m^2/kg, for an accelerometer; None for
    no drag, or nobody who feels it."""

    def __post_init__(self) -> None:
        """Refuse what nobody could fly along."""
        rows = len(self.states)
        finite = math.isfinite(self.t0_s + self.knot_s) and bool(np.isfinite(self.states).all())
        if self.attitude is not None:
            finite &= self.attitude.shape == (rows, 7) and bool(np.isfinite(self.attitude).all())
        fits = self.states.shape == (rows, 6) and 2 <= rows <= KNOTS_MAX and self.knot_s > 0.0
        if not (finite and fits):
            raise PluginError(
                f"constellation: expected a segment of 2 to {KNOTS_MAX} finite knots, got "
                f"{rows} every {self.knot_s} s"
            )

    @property
    def end_s(self) -> float:
        """Simulated time of the last knot."""
        return self.t0_s + (len(self.states) - 1) * self.knot_s


@dataclass(frozen=True, slots=True, kw_only=True)
class Initial(Message):
    """First message to an agent, at the start or when it rejoins."""

    KIND = "initial_data"

    satellite: str
    frame: str
    epoch_utc: str
    """UTC of simulated time zero, ISO 8601."""
    segment: Segment | None
    """Truth from now on; None if the host itself has none yet."""
    more: tuple[Segment, ...] = ()
    """Further segments, where maneuvers have cut truth into pieces."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Command(Message):
    """Wish of flight software to change its own vehicle."""

    KIND = "command"

    number: int
    """The agent's own, from 0 on."""
    kind: CommandKind
    """delta_v: vector in m/s; torque: vector in N m, body axes; ballistic: its first component is Cd A / m, m^2/kg;
    dipole: vector in A m^2, body axes."""
    commanded_s: float
    """T_s: simulated time of the tick that commanded it."""
    at_s: float
    """T_m: simulated time of execution; the middle of a finite burn."""
    frame: CommandFrame
    """rtn: radial, along-track, normal at the time of execution."""
    vector: Vector
    duration_s: float = 0.0
    """Of a torque or a dipole, s."""
    phase_s: float = 0.0
    """By how much this agent's ticks lie behind their nominal time, s: its T_m comes that much later, too."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CommandResult(Message):
    """Result of a command."""

    KIND = "command_result"

    number: int
    status: CommandStatus
    """accepted: truth holds it; postponed: the same, at a later time than wanted; executed: its time is over
    and nothing can take it back; refused: not executed, see reason."""
    at_s: float
    """Time at which it is, or would have been, executed, s."""
    revision: int
    """Of the truth that holds it; the one before if it was refused."""
    reason: str = ""
    delta_v_m_s: float = 0.0
    """Magnitude really given."""
    propellant_kg: float = 0.0
    """Propellant left after the command and all accepted before it, kg; of one that was executed what the tank holds then."""
    wheels_n_m_s: Vector | None = None
    """Momentum of the wheels about body x, y, z after a torque that was executed, N m s; None for any other result."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TankGauge(Message):
    """Reading of a tank's gauge that no command has caused: its vehicle's thruster is stuck open."""

    KIND = "tank_gauge"

    t_s: float
    propellant_kg: float
    """Left, kg."""


@dataclass(frozen=True, slots=True, kw_only=True)
class GroundText(Message):
    """Text for flight software that comes at once, by no radio."""

    KIND = "ground_text"

    t_s: float
    text: str


@dataclass(frozen=True, slots=True, kw_only=True)
class SatelliteLoss(Message):
    """Whether a satellite is lost from now on: it neither flies software nor measures, sends or hears."""

    KIND = "satellite_loss"

    is_lost: bool


def knot_runs(first: int, last: int) -> Iterator[tuple[int, int]]:
    """
    Yield first and last knot of the segments in which the knots from *first* to *last* travel.

    One, unless they are more than a segment may have. Several share a knot, and have half as many as they might: an agent
    forgets a segment as a whole.
    """
    intervals = last - first
    step = max(1, intervals) if intervals < KNOTS_MAX else KNOTS_MAX // 2
    for start in range(first, last, step):
        yield start, min(start + step, last)


def is_for_ground(to: str) -> bool:
    """Return whether a message's receiver is any station, or one of them."""
    return to == GROUND or to.startswith(f"{GROUND}:")


class _Field(NamedTuple):
    name: str
    key: str
    """In the mapping."""
    type: str
    read: Callable[[Any], Any]
    write: Callable[[Any], Any]


_FIELDS: dict[type[Message], tuple[_Field, ...]] = {}
"""Of the classes that were asked for."""


def _fields(cls: type[Message]) -> tuple[_Field, ...]:
    """Return how each field of a message travels."""
    if cls not in _FIELDS:
        _FIELDS[cls] = tuple(
            _Field(
                field.name,
                cls.KIND if field.name == "kind" else field.name,
                str(field.type),
                *_WAYS[str(field.type)],
            )
            for field in fields(cast("Any", cls))
        )
    return _FIELDS[cls]


def _as_it_is(value: Any) -> Any:
    return value


def _exactly(kind: type) -> Callable[[Any], Any]:
    def read(value: Any) -> Any:
        if type(value) is not kind:
            raise TypeError(kind)
        return value

    return read


def _number(value: Any) -> float:
    if type(value) not in (float, int):
        raise TypeError(value)
    return float(value)


def _vector(values: Any) -> Vector:
    x, y, z = map(_number, values)
    return x, y, z


def _one_of(literal: Any) -> Callable[[Any], Any]:
    words = get_args(literal)

    def read(value: Any) -> Any:
        if value not in words:
            raise ValueError(value)
        return value

    return read


def _or_none(function: Callable[[Any], Any]) -> Callable[[Any], Any]:
    return lambda value: None if value is None else function(value)


def _thrust(values: Any) -> Thrust:
    start_s, x, y, z, burnt_1_s = map(_number, values)
    return Thrust(start_s=start_s, acceleration_m_s2=(x, y, z), burnt_1_s=burnt_1_s)


def _thrust_numbers(thrust: Thrust) -> list[float]:
    return [thrust.start_s, *thrust.acceleration_m_s2, thrust.burnt_1_s]


_array = _exactly(np.ndarray)
_WAYS: dict[str, tuple[Callable[[Any], Any], Callable[[Any], Any]]] = {
    "Any": (_as_it_is, _as_it_is),
    "bool": (_exactly(bool), _as_it_is),
    "int": (_exactly(int), _as_it_is),
    "float": (_number, _as_it_is),
    "float | None": (_or_none(_number), _as_it_is),
    "str": (_exactly(str), _as_it_is),
    "Vector": (_vector, list),
    "Vector | None": (_or_none(_vector), _or_none(list)),
    "CommandKind": (_one_of(CommandKind), _as_it_is),
    "CommandFrame": (_one_of(CommandFrame), _as_it_is),
    "CommandStatus": (_one_of(CommandStatus), _as_it_is),
    "NDArray[np.float64]": (_array, _as_it_is),
    "NDArray[np.float64] | None": (_or_none(_array), _as_it_is),
    "Thrust | None": (_or_none(_thrust), _or_none(_thrust_numbers)),
    "Segment | None": (_or_none(Segment.from_message), _or_none(Segment.to_message)),
    "tuple[Segment, ...]": (
        lambda parts: tuple(map(Segment.from_message, parts)),
        lambda parts: [part.to_message() for part in parts],
    ),
}
"""By a field's type as it is written: how it is read, which raises TypeError or ValueError, and how written."""
