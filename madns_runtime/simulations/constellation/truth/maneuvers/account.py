"""Account of all vehicles' commands, and the times of one. Pure."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, field


@dataclass(slots=True)
class ManeuverAccount:
    """Account of all commands, for the summary."""

    commanded: int = 0
    executed: int = 0
    postponed: int = 0
    refused: int = 0
    inequality_broken: int = 0
    """Commands for which it does not hold, and those that came too late by what the scenario allows."""
    inequality_broken_by: Counter[int] = field(default_factory=Counter)
    """The same by vehicle."""
    slack_s_min: float = math.inf
    propagation_s_max: float = 0.0
    network_s_max: float = 0.0
    delta_v_m_s: float = 0.0
    """Sum of the magnitudes given by burns that are over."""
    propellant_kg: float = 0.0
    """Burnt by them."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Times:
    """The synchronous inequality of one command, T_p + 2 T_n <= T_m - T_s."""

    propagation_s: float | None
    """T_p, measured: from hearing the command to handing out the truth that holds it; None if there is none."""
    network_s: float
    """T_n, measured: from the tick that commanded to hearing of it."""
    slack_s: float
    """(T_m - T_s) - (T_p + 2 T_n); T_m as commanded, of a burn its beginning; T_p as allowed if none was measured."""
