"""
What the two halves of the constellation say to each other, as dataclasses that become mappings.

Pure. Segments carry their knots as one flat float64 array: six numbers a knot, m and m/s, and for a rigid
body a second one of seven: quaternion (scalar last, inertial to body) and body rates, rad/s.

    agent -> host    Command (SYNC, deadline: its time), Transmission
    host -> agent    Initial, Segment, CommandResult, Delivery, Refusal
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from madns_runtime.config import from_mapping
from madns_runtime.errors import PluginError
from madns_runtime.simulations.constellation.parameters import KNOTS_MAX
from madns_runtime.simulations.constellation.thrust import Thrust

SEGMENT = "segment"
COMMAND = "command"
RESULT = "command_result"
TRANSMISSION = "transmission"
DELIVERY = "delivery"
REFUSAL = "refusal"
EVERYBODY = "*"
"""Receiver of a broadcast."""
GROUND = "ground"
"""Receiver of what is for any ground station; ground:NAME for one of them."""

CommandKind = Literal["delta_v", "torque", "ballistic"]
CommandFrame = Literal["inertial", "rtn", "body"]
CommandStatus = Literal["accepted", "executed", "postponed", "refused"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Segment:
    """A stretch of one vehicle's future truth."""

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

    @property
    def end_s(self) -> float:
        """Simulated time of the last knot."""
        return self.t0_s + (len(self.states) - 1) * self.knot_s

    def to_message(self) -> dict[str, Any]:
        """Return the mapping that travels."""
        message: dict[str, Any] = {
            "kind": SEGMENT,
            "revision": self.revision,
            "t0_s": self.t0_s,
            "knot_s": self.knot_s,
            "states": np.ascontiguousarray(self.states, dtype=np.float64).ravel(),
        }
        if self.attitude is not None:
            message["attitude"] = np.ascontiguousarray(self.attitude, dtype=np.float64).ravel()
        if self.thrust is not None:
            message["thrust"] = asdict(self.thrust)
        if self.ballistic_m2_kg is not None:
            message["ballistic_m2_kg"] = self.ballistic_m2_kg
        return message

    @classmethod
    def from_message(cls, message: Mapping[str, Any]) -> Segment:
        """
        Read a segment back.

        Raises:
            PluginError: It is not a segment as `to_message` writes it.
        """
        try:
            flat = np.asarray(message["states"], dtype=np.float64).ravel()
            attitude, thrust = message.get("attitude"), message.get("thrust")
            ballistic = message.get("ballistic_m2_kg")
            if attitude is not None:
                attitude = np.asarray(attitude, dtype=np.float64).reshape(-1, 7)
            segment = cls(
                revision=int(message["revision"]),
                t0_s=float(message["t0_s"]),
                knot_s=float(message["knot_s"]),
                states=flat.reshape(-1, 6),
                attitude=attitude,
                thrust=None if thrust is None else from_mapping(Thrust, thrust),
                ballistic_m2_kg=None if ballistic is None else float(ballistic),
            )
        except (KeyError, TypeError, ValueError) as error:
            raise PluginError(f"constellation: expected a segment, got {message!r:.200}") from error
        finite = np.isfinite(flat).all() and np.isfinite((segment.t0_s, segment.knot_s)).all()
        if segment.attitude is not None:
            finite &= len(segment.attitude) == len(segment.states)
            finite &= bool(np.isfinite(segment.attitude).all())
        if not finite or segment.knot_s <= 0.0 or not 2 <= len(segment.states) <= KNOTS_MAX:
            raise PluginError(
                f"constellation: expected a segment of 2 to {KNOTS_MAX} finite knots, got "
                f"{len(segment.states)} every {segment.knot_s} s"
            )
        return segment


@dataclass(frozen=True, slots=True, kw_only=True)
class Initial:
    """What an agent sets itself up from, at the start or when it rejoins."""

    satellite: str
    frame: str
    epoch_utc: str
    """UTC of simulated time zero, ISO 8601."""
    segment: Segment | None
    """Truth from now on; None if the host itself has none yet."""
    more: tuple[Segment, ...] = ()
    """What follows it, where maneuvers have cut truth into pieces."""

    def to_message(self) -> dict[str, Any]:
        """Return the mapping that travels."""
        return {
            "satellite": self.satellite,
            "frame": self.frame,
            "epoch_utc": self.epoch_utc,
            "segment": None if self.segment is None else self.segment.to_message(),
            "more": [segment.to_message() for segment in self.more],
        }

    @classmethod
    def from_message(cls, message: Mapping[str, Any]) -> Initial:
        """
        Read initial data back.

        Raises:
            PluginError: They are not as `to_message` writes them.
        """
        try:
            segment = message["segment"]
            return cls(
                satellite=str(message["satellite"]),
                frame=str(message["frame"]),
                epoch_utc=str(message["epoch_utc"]),
                segment=None if segment is None else Segment.from_message(segment),
                more=tuple(Segment.from_message(part) for part in message.get("more", ())),
            )
        except (KeyError, TypeError) as error:
            raise PluginError(
                f"constellation: expected initial data, got {message!r:.200}"
            ) from error


@dataclass(frozen=True, slots=True, kw_only=True)
class Command:
    """What flight software wants done to its own vehicle."""

    number: int
    """The agent's own, from 0 on."""
    kind: CommandKind
    """delta_v: vector in m/s; torque: vector in N m, body axes; ballistic: its first component is Cd A / m, m^2/kg."""
    commanded_s: float
    """T_s: simulated time of the tick that commanded it."""
    at_s: float
    """T_m: simulated time of execution; the middle of a finite burn."""
    frame: CommandFrame
    """rtn: radial, along-track, normal at the time of execution."""
    vector: tuple[float, float, float]
    duration_s: float = 0.0
    """Of a torque, s."""
    phase_s: float = 0.0
    """By how much this agent's ticks lie behind their nominal time, s: its T_m comes that much later, too."""

    def to_message(self) -> dict[str, Any]:
        """Return the mapping that travels."""
        return {
            "kind": COMMAND,
            "number": self.number,
            "command": self.kind,
            "commanded_s": self.commanded_s,
            "at_s": self.at_s,
            "frame": self.frame,
            "vector": list(self.vector),
            "duration_s": self.duration_s,
            "phase_s": self.phase_s,
        }

    @classmethod
    def from_message(cls, message: Mapping[str, Any]) -> Command:
        """
        Read a command back; its numbers need not be finite: what is not is refused, and said so.

        Raises:
            PluginError: It is not a command as `to_message` writes it.
        """
        try:
            x, y, z = (float(value) for value in message["vector"])
            command = cls(
                number=int(message["number"]),
                kind=message["command"],
                commanded_s=float(message["commanded_s"]),
                at_s=float(message["at_s"]),
                frame=message["frame"],
                vector=(x, y, z),
                duration_s=float(message["duration_s"]),
                phase_s=float(message.get("phase_s", 0.0)),
            )
        except (KeyError, TypeError, ValueError) as error:
            raise PluginError(f"constellation: expected a command, got {message!r:.200}") from error
        if command.kind not in get_args(CommandKind):
            raise PluginError(f"constellation: expected a command, got {message!r:.200}")
        if command.frame not in get_args(CommandFrame):
            raise PluginError(f"constellation: no frame {command.frame!r}")
        return command


@dataclass(frozen=True, slots=True, kw_only=True)
class CommandResult:
    """What became of a command."""

    number: int
    status: CommandStatus
    """accepted: truth holds it; postponed: the same, at a later time than wanted; executed: its time is over
    and nothing can take it back; refused: not executed, see reason."""
    at_s: float
    """When it is, or would have been, executed."""
    revision: int
    """Of the truth that holds it; the one before if it was refused."""
    reason: str = ""
    delta_v_m_s: float = 0.0
    """Magnitude really given."""
    propellant_kg: float = 0.0
    """Left afterwards."""

    def to_message(self) -> dict[str, Any]:
        """Return the mapping that travels."""
        return {"kind": RESULT, **asdict(self)}

    @classmethod
    def from_message(cls, message: Mapping[str, Any]) -> CommandResult:
        """
        Read a result back.

        Raises:
            PluginError: It is not a result as `to_message` writes it.
        """
        try:
            return cls(
                number=int(message["number"]),
                status=message["status"],
                at_s=float(message["at_s"]),
                revision=int(message["revision"]),
                reason=str(message["reason"]),
                delta_v_m_s=float(message["delta_v_m_s"]),
                propellant_kg=float(message["propellant_kg"]),
            )
        except (KeyError, TypeError, ValueError) as error:
            raise PluginError(
                f"constellation: expected a command's result, got {message!r:.200}"
            ) from error


@dataclass(frozen=True, slots=True, kw_only=True)
class Transmission:
    """A message that a vehicle hands to its radio."""

    to: str
    """An agent's or satellite's name, * for all in view, ground or ground:NAME."""
    sent_s: float
    """Simulated time of the tick that sent it."""
    number: int
    """The agent's own, from 0 on."""
    payload: Any
    """As any message between the halves."""

    def to_message(self) -> dict[str, Any]:
        """Return the mapping that travels."""
        return {
            "kind": TRANSMISSION,
            "to": self.to,
            "sent_s": self.sent_s,
            "number": self.number,
            "payload": self.payload,
        }

    @classmethod
    def from_message(cls, message: Mapping[str, Any]) -> Transmission:
        """
        Read a transmission back.

        Raises:
            PluginError: It is not one as `to_message` writes it.
        """
        try:
            return cls(
                to=str(message["to"]),
                sent_s=float(message["sent_s"]),
                number=int(message["number"]),
                payload=message["payload"],
            )
        except (KeyError, TypeError, ValueError) as error:
            raise PluginError(
                f"constellation: expected a transmission, got {message!r:.200}"
            ) from error


@dataclass(frozen=True, slots=True, kw_only=True)
class Delivery:
    """A message that a vehicle's radio hears."""

    sender: str
    """An agent's name, or ground:NAME."""
    sent_s: float
    arrives_s: float
    """Simulated time at which it is heard: flight software gets it in the first tick at or after it."""
    payload: Any

    def to_message(self) -> dict[str, Any]:
        """Return the mapping that travels."""
        return {
            "kind": DELIVERY,
            "sender": self.sender,
            "sent_s": self.sent_s,
            "arrives_s": self.arrives_s,
            "payload": self.payload,
        }

    @classmethod
    def from_message(cls, message: Mapping[str, Any]) -> Delivery:
        """
        Read a delivery back.

        Raises:
            PluginError: It is not one as `to_message` writes it.
        """
        try:
            return cls(
                sender=str(message["sender"]),
                sent_s=float(message["sent_s"]),
                arrives_s=float(message["arrives_s"]),
                payload=message["payload"],
            )
        except (KeyError, TypeError, ValueError) as error:
            raise PluginError(
                f"constellation: expected a delivery, got {message!r:.200}"
            ) from error


@dataclass(frozen=True, slots=True, kw_only=True)
class Refusal:
    """A message that a vehicle handed to its radio and that never left it, or met nobody."""

    number: int
    """The message's."""
    to: str
    """As it was sent."""
    sent_s: float
    reason: str
    """no_radio or too_long, found on board; or what the host found, see `truth.medium.REFUSED`."""

    def to_message(self) -> dict[str, Any]:
        """Return the mapping that travels."""
        return {"kind": REFUSAL, **asdict(self)}

    @classmethod
    def from_message(cls, message: Mapping[str, Any]) -> Refusal:
        """
        Read a refusal back.

        Raises:
            PluginError: It is not one as `to_message` writes it.
        """
        try:
            return cls(
                number=int(message["number"]),
                to=str(message["to"]),
                sent_s=float(message["sent_s"]),
                reason=str(message["reason"]),
            )
        except (KeyError, TypeError, ValueError) as error:
            raise PluginError(f"constellation: expected a refusal, got {message!r:.200}") from error


def is_for_ground(to: str) -> bool:
    """Return whether a message's receiver is any station, or one of them."""
    return to == GROUND or to.startswith(f"{GROUND}:")


def _vector(values: Any) -> tuple[float, float, float]:
    """Return three finite numbers, or raise ValueError."""
    x, y, z = (float(value) for value in values)
    if not np.isfinite((x, y, z)).all():
        raise ValueError("expected finite numbers")
    return x, y, z
