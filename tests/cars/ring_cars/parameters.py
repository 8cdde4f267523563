"""What a scenario may set. Defaults are those of a city in table 11.2 of Treiber and Kesting (2013)."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

from annotated_types import Ge, Gt, Le


@dataclass(frozen=True, slots=True, kw_only=True)
class Driver:
    """Parameters of the Intelligent Driver Model."""

    desired_speed_m_s: Annotated[float, Gt(0)] = 15.0
    time_gap_s: Annotated[float, Gt(0)] = 1.0
    gap_min_m: Annotated[float, Gt(0)] = 2.0
    acceleration_m_s2: Annotated[float, Gt(0)] = 1.0
    deceleration_m_s2: Annotated[float, Gt(0)] = 1.5


@dataclass(frozen=True, slots=True, kw_only=True)
class RingParameters:
    """The parameters section of a scenario."""

    ring_m: Annotated[float, Gt(0)] = 230.0
    """Length of the road."""
    spaces_m: tuple[Annotated[float, Gt(0)], ...] = ()
    """From each car to the next behind it at the start, over and over; empty for as much as there is, evenly."""
    car_m: Annotated[float, Gt(0)] = 5.0
    """Length of a car."""
    speed_m_s: Annotated[float, Ge(0)] = 5.0
    """Of all cars at the start but the first, which stands."""
    radio_delay_s: Annotated[float, Gt(0)] = 0.005
    """From the end of what a car says until another hears it."""
    reach_m: Annotated[float, Gt(0)] = 150.0
    """How far the radio reaches."""
    rate_byte_s: Annotated[float, Gt(0)] = 750e3
    """Of a car's radio: 6 Mbit/s, as IEEE 802.11p has it by default."""
    loss: Annotated[float, Ge(0), Le(1)] = 0.01
    """Share of messages that are lost."""
    driver: Driver = field(default_factory=Driver)
