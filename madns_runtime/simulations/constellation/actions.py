"""Actions that a timeline may name in a constellation: failures of sensors, actuators and ground stations. Pure."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Final, Literal

from annotated_types import Ge, Gt, Le, MaxLen, MinLen

from madns_runtime.timeline.action import ActionKind

SensorName = Literal[
    "gnss", "gyro", "accelerometer", "star_tracker", "sun_sensor", "clock", "magnetometer"
]
BIAS_MAX: Final = 1e9
THRUST_N_MAX: Final = 1e6
TEXT_CHARACTERS_MAX: Final = 4000
Component = Annotated[float, Ge(-1e6), Le(1e6)]


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorFault:
    """Parameters of sensor_fault."""

    sensor: SensorName
    """The sensor; it must be one that the vehicle models, not a device's."""
    fault: Literal["stuck", "biased", "dead"]
    """stuck: its measurements repeat the first one since then; biased: `bias` is added to them; dead: none come."""
    bias: tuple[Annotated[float, Ge(-BIAS_MAX), Le(BIAS_MAX)], ...] = ()
    """Of biased: added to the first values of each measurement, in the unit of its stream; a direction or a quaternion is
    brought back to length 1."""


@dataclass(frozen=True, slots=True, kw_only=True)
class WeakThruster:
    """Parameters of weaken_thruster."""

    factor: Annotated[float, Ge(0), Le(1)]
    """Share of each commanded change of velocity that is given, and of its propellant."""


@dataclass(frozen=True, slots=True, kw_only=True)
class StuckThruster:
    """Parameters of stick_thruster_open."""

    direction: tuple[Component, Component, Component] = (0.0, 1.0, 0.0)
    """Direction of the push, in `frame`; its length does not matter."""
    frame: Literal["inertial", "rtn", "body"] = "rtn"
    """Frame of the direction: inertial, radial, along-track and normal, or of a vehicle with attitude body axes."""
    thrust_n: Annotated[float, Gt(0), Le(THRUST_N_MAX)] | None = None
    """Thrust, N; none for the thruster's own, which then must have one."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DarkStation:
    """Parameters of darken_station."""

    station: Annotated[str, MinLen(1)]
    """Name of the ground station."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Telecommand:
    """Parameters of telecommand."""

    text: Annotated[str, MinLen(1), MaxLen(TEXT_CHARACTERS_MAX)]
    """Text that flight software receives."""
    station: Annotated[str, MinLen(1)] | None = None
    """Ground station that sends it, in its next contact with the vehicle; none for at once, whatever is in view."""


SENSOR_FAULT: Final = ActionKind(
    word="sensor_fault",
    summary="Has a sensor of each agent stuck, biased or dead; truth is as it was.",
    parameters=SensorFault,
    lasting="may",
    carried_out_by="agent",
)
WEAKEN_THRUSTER: Final = ActionKind(
    word="weaken_thruster",
    summary="Lets burns that are commanded meanwhile give a share of their change of velocity.",
    parameters=WeakThruster,
    lasting="may",
)
STICK_THRUSTER_OPEN: Final = ActionKind(
    word="stick_thruster_open",
    summary="Lets a thruster burn until flight software closes it off, its propellant is gone, or the action ends.",
    parameters=StuckThruster,
    lasting="may",
)
FAIL_WHEELS: Final = ActionKind(
    word="fail_wheels",
    summary="Has torques refused that are commanded meanwhile.",
    lasting="may",
)
DARKEN_STATION: Final = ActionKind(
    word="darken_station",
    summary="Has a ground station neither heard nor hear meanwhile.",
    parameters=DarkStation,
    takes_agents=False,
    lasting="may",
)
LOSE_SATELLITE: Final = ActionKind(
    word="lose_satellite",
    summary="Has a satellite dead meanwhile: it neither flies software nor measures, sends or hears; its truth goes on.",
    lasting="may",
    loses_agents=True,
)
TELECOMMAND: Final = ActionKind(
    word="telecommand",
    summary="Sends flight software a text from the ground, at once or in the next contact with a station.",
    parameters=Telecommand,
)
ACTIONS: Final = (
    SENSOR_FAULT,
    WEAKEN_THRUSTER,
    STICK_THRUSTER_OPEN,
    FAIL_WHEELS,
    DARKEN_STATION,
    LOSE_SATELLITE,
    TELECOMMAND,
)
