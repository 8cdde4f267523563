"""Actions that a timeline may name in a constellation: failures of sensors, actuators and ground stations. Pure."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Final, Literal

from annotated_types import Ge, Le, MinLen

from madns_runtime.timeline.action import ActionKind

SensorName = Literal[
    "gnss", "gyro", "accelerometer", "star_tracker", "sun_sensor", "clock", "magnetometer"
]
BIAS_MAX: Final = 1e9


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorFault:
    """Parameters of sensor_fault."""

    sensor: SensorName
    """The sensor; it must be one that the vehicle models, not a device's."""
    fault: Literal["stuck", "biased", "dead"]
    """stuck: its measurements repeat the last one; biased: `bias` is added to them; dead: none come."""
    bias: tuple[Annotated[float, Ge(-BIAS_MAX), Le(BIAS_MAX)], ...] = ()
    """Of biased: added to the first values of each measurement, in the unit of its stream."""


@dataclass(frozen=True, slots=True, kw_only=True)
class WeakThruster:
    """Parameters of weaken_thruster."""

    factor: Annotated[float, Ge(0), Le(1)]
    """Share of each commanded change of velocity that is given, and of its propellant."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DarkStation:
    """Parameters of darken_station."""

    station: Annotated[str, MinLen(1)]
    """Name of the ground station."""


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
ACTIONS: Final = (SENSOR_FAULT, WEAKEN_THRUSTER, FAIL_WHEELS, DARKEN_STATION)
