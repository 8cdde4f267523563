"""
Commands of flight software, checked before they leave the vehicle. Pure.

What no vehicle could do is a mistake of the program and raises; what this one cannot do just now, such
as a delta-v without propellant, is for the host to refuse.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, get_args

from madns_runtime.errors import PluginError
from madns_runtime.simulations.constellation.equipment import Vehicle
from madns_runtime.simulations.constellation.messages import Command, CommandFrame, CommandKind

COMMANDS_PER_TICK_MAX = 16
"""More in one tick is a loop gone wild, not a plan."""


class CommandDesk:
    """
    Numbers and checks one vehicle's commands.

    Args:
        vehicle: What it is like.
        first_number: Of its first command.
    """

    def __init__(self, vehicle: Vehicle, first_number: int = 0) -> None:
        self._vehicle = vehicle
        self._first_number = first_number
        self._tick_s = -math.inf
        self._in_tick = 0
        self.count = 0
        """Commands given."""

    def delta_v(self, t_s: float, delta_v_m_s: Any, *, at_s: float, frame: str) -> Command:
        """
        Return the command for a change of velocity.

        Raises:
            PluginError: It is none that a vehicle of this kind could carry out.
        """
        if frame not in get_args(CommandFrame):
            expected = ", ".join(get_args(CommandFrame))
            raise PluginError(f"delta_v: expected frame to be one of {expected}, got {frame!r}")
        if frame == "body" and self._vehicle.attitude is None:
            raise PluginError("delta_v: frame body needs a vehicle with vehicles.attitude")
        return self._command(
            "delta_v", t_s, at_s=at_s, vector=_vector("delta_v", delta_v_m_s, "m/s"), frame=frame
        )

    def torque(self, t_s: float, torque_n_m: Any, *, at_s: float, duration_s: float) -> Command:
        """
        Return the command for a torque about the body axes.

        Raises:
            PluginError: It is none that a vehicle of this kind could carry out.
        """
        if self._vehicle.attitude is None:
            raise PluginError("torque: needs a vehicle with vehicles.attitude")
        duration_s = _number("torque", "duration_s", duration_s)
        if duration_s <= 0.0:
            raise PluginError(f"torque: expected duration_s > 0, got {duration_s}")
        vector = _vector("torque", torque_n_m, "N m")
        return self._command("torque", t_s, at_s=at_s, vector=vector, duration_s=duration_s)

    def ballistic(self, t_s: float, ballistic_m2_kg: Any, *, at_s: float) -> Command:
        """
        Return the command for another ballistic coefficient.

        Raises:
            PluginError: The vehicle cannot have it.
        """
        value = _number("ballistic", "ballistic_m2_kg", ballistic_m2_kg)
        limits = self._vehicle.ballistic_m2_kg_range
        if limits is None:
            raise PluginError("ballistic: needs a vehicle with vehicles.ballistic_m2_kg_range")
        if not limits[0] <= value <= limits[1]:
            raise PluginError(
                f"ballistic: expected {limits[0]:g} to {limits[1]:g} m^2/kg, got {value:g}"
            )
        return self._command("ballistic", t_s, at_s=at_s, vector=(value, 0.0, 0.0))

    def _command(  # noqa: PLR0913 - the fields of a command, all keyword-only
        self,
        kind: CommandKind,
        t_s: float,
        *,
        at_s: float,
        vector: tuple[float, float, float],
        frame: Any = "body",
        duration_s: float = 0.0,
    ) -> Command:
        at_s = _number(kind, "at_s", at_s)
        if t_s != self._tick_s:
            self._tick_s, self._in_tick = t_s, 0
        if self._in_tick >= COMMANDS_PER_TICK_MAX:
            raise PluginError(
                f"{kind}: expected at most {COMMANDS_PER_TICK_MAX} commands in one tick; "
                f"the tick at {t_s:g} s wants more"
            )
        self._in_tick += 1
        self.count += 1
        return Command(
            number=self._first_number + self.count - 1,
            kind=kind,
            commanded_s=t_s,
            at_s=at_s,
            frame=frame,
            vector=vector,
            duration_s=duration_s,
        )


def _vector(kind: str, values: Any, unit: str) -> tuple[float, float, float]:
    is_vector = isinstance(values, Sequence) or getattr(values, "ndim", 0) == 1
    if not is_vector or isinstance(values, str) or len(values) != 3:
        raise PluginError(f"{kind}: expected three numbers in {unit}, got {values!r:.80}")
    x, y, z = (_number(kind, "component", value) for value in values)
    return x, y, z


def _number(kind: str, name: str, value: Any) -> float:
    """Return a finite number, also one of numpy's."""
    try:
        number = float(value)
    except (TypeError, ValueError):
        number = math.nan
    if isinstance(value, str | bool) or not math.isfinite(number):
        raise PluginError(f"{kind}: expected a finite number for {name}, got {value!r:.80}")
    return number
