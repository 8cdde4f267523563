"""Parameters that a scenario may set."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from annotated_types import Ge, Gt


@dataclass(frozen=True, slots=True, kw_only=True)
class RoverParameters:
    """The parameters section of a scenario; `cosmos validate` checks types and bounds."""

    distance_m: Annotated[float, Gt(0)] = 5.0
    """From the start to the mark of the first rover; each next rover has one metre more."""
    speed_max_m_s: Annotated[float, Gt(0)] = 2.0
    """A motor turns no faster."""
    noise_m: Annotated[float, Ge(0)] = 0.01
    """Standard deviation of the position sensor."""
    error_max_m: Annotated[float, Gt(0)] = 0.1
    """How far from its mark a rover may stand in the end."""
