"""
Commands of flight software, checked, numbered and recorded as they leave the vehicle.

What no vehicle could do is a mistake of the program and raises; what this one cannot do just now, such
as a delta-v without propellant, is for the host to refuse.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, get_args

from madns_runtime.errors import PluginError
from madns_runtime.plugin.api import HOST, AgentContext
from madns_runtime.protocol.messages import Service
from madns_runtime.simulations.constellation.equipment import Vehicle
from madns_runtime.simulations.constellation.messages import (
    Command,
    CommandFrame,
    CommandKind,
    CommandResult,
)
from madns_runtime.simulations.constellation.streams import COMMAND_RESULTS, commands_fields
from madns_runtime.simulations.constellation.thrust import Vector

COMMANDS_PER_TICK_MAX = 16
"""More in one tick is a loop gone wild, not a plan."""


class CommandDesk:
    """
    Takes one vehicle's commands.

    Args:
        context: Through which they leave.
        vehicle: What it is like.
        first_number: Of its first command.
        opens_streams: Whether the streams of commands and their results are not open yet.
    """

    def __init__(
        self,
        context: AgentContext,
        vehicle: Vehicle,
        first_number: int = 0,
        *,
        opens_streams: bool = True,
    ) -> None:
        self._context = context
        self._vehicle = vehicle
        self._first_number = first_number
        self._tick: int | None = None
        self._is_over = False
        self._t_s = -math.inf
        self._phase_s = 0.0
        self._in_tick = 0
        self.count = 0
        """Commands given."""
        if opens_streams:
            context.open_stream("commands", commands_fields(context.parameters))
            context.open_stream("command_results", COMMAND_RESULTS)

    def begin(self, tick: int, t_s: float, phase_s: float) -> None:
        """Begin a tick: from now on commands bear its time, and lie *phase_s* behind it as the vehicle's ticks do."""
        self._tick, self._t_s, self._phase_s = tick, t_s, phase_s
        self._in_tick = 0

    def end(self) -> None:
        """Take no more commands: no tick follows in which one could be carried out."""
        self._is_over = True

    def begin_answer(self) -> None:
        """Begin an answer to another tick, which may hold as many commands as any."""
        self._in_tick = 0

    def delta_v(self, delta_v_m_s: Any, *, at_s: float, frame: str = "rtn") -> int:
        """
        Command a change of velocity and return the command's number.

        Raises:
            PluginError: It is none that a vehicle of this kind could carry out.
        """
        check_running("delta_v", self._tick, is_over=self._is_over)
        if frame not in get_args(CommandFrame):
            expected = ", ".join(get_args(CommandFrame))
            raise PluginError(f"delta_v: expected frame to be one of {expected}, got {frame!r}")
        if frame == "body" and self._vehicle.attitude is None:
            raise PluginError("delta_v: frame body needs a vehicle with vehicles.attitude")
        vector = _vector("delta_v", delta_v_m_s, "m/s")
        return self._give("delta_v", at_s=at_s, vector=vector, frame=frame)

    def torque(self, torque_n_m: Any, *, at_s: float, duration_s: float) -> int:
        """
        Command a torque about the body axes and return the command's number.

        Raises:
            PluginError: It is none that a vehicle of this kind could carry out.
        """
        check_running("torque", self._tick, is_over=self._is_over)
        if self._vehicle.attitude is None:
            raise PluginError("torque: needs a vehicle with vehicles.attitude")
        duration_s = _duration("torque", duration_s)
        vector = _vector("torque", torque_n_m, "N m")
        return self._give("torque", at_s=at_s, vector=vector, duration_s=duration_s)

    def dipole(self, dipole_a_m2: Any, *, at_s: float, duration_s: float) -> int:
        """
        Command a magnetic dipole along the body axes and return the command's number.

        Raises:
            PluginError: It is none that a vehicle of this kind could carry out.
        """
        check_running("dipole", self._tick, is_over=self._is_over)
        attitude = self._vehicle.attitude
        if attitude is None or attitude.magnetorquers is None:
            raise PluginError("dipole: needs a vehicle with vehicles.attitude.magnetorquers")
        duration_s = _duration("dipole", duration_s)
        vector = _vector("dipole", dipole_a_m2, "A m^2")
        return self._give("dipole", at_s=at_s, vector=vector, duration_s=duration_s)

    def ballistic(self, ballistic_m2_kg: Any, *, at_s: float) -> int:
        """
        Command another ballistic coefficient and return the command's number.

        Raises:
            PluginError: The vehicle cannot have it.
        """
        check_running("ballistic", self._tick, is_over=self._is_over)
        value = _number("ballistic", "ballistic_m2_kg", ballistic_m2_kg)
        limits = self._vehicle.ballistic_m2_kg_range
        if limits is None:
            raise PluginError("ballistic: needs a vehicle with vehicles.ballistic_m2_kg_range")
        if not limits[0] <= value <= limits[1]:
            raise PluginError(
                f"ballistic: expected {limits[0]:g} to {limits[1]:g} m^2/kg, got {value:g}"
            )
        return self._give("ballistic", at_s=at_s, vector=(value, 0.0, 0.0))

    def record_result(self, tick: int, result: CommandResult) -> None:
        """Record what became of a command, as the vehicle is about to hear it."""
        row = (tick, result.number, result.status, result.at_s, result.revision)
        numbers = (result.delta_v_m_s, result.propellant_kg)
        self._context.record("command_results", (*row, *numbers, result.reason))

    def _give(
        self,
        kind: CommandKind,
        *,
        at_s: float,
        vector: Vector,
        frame: Any = "body",
        duration_s: float = 0.0,
    ) -> int:
        at_s = _number(kind, "at_s", at_s)
        if self._in_tick >= COMMANDS_PER_TICK_MAX:
            raise PluginError(
                f"{kind}: expected at most {COMMANDS_PER_TICK_MAX} commands in one tick; "
                f"the tick at {self._t_s:g} s wants more"
            )
        number = self._first_number + self.count
        self._in_tick += 1
        self.count += 1
        command = Command(
            number=number,
            kind=kind,
            commanded_s=self._t_s,
            phase_s=self._phase_s,
            at_s=at_s,
            frame=frame,
            vector=vector,
            duration_s=duration_s,
        )
        deadline_s = at_s + self._phase_s
        self._context.send(HOST, command.to_message(), Service.SYNC, deadline_s=deadline_s)
        self._context.record(
            "commands", (self._tick, number, kind, at_s, frame, *vector, duration_s)
        )
        return number


def check_running(name: str, tick: int | None, *, is_over: bool = False) -> None:
    """
    Check that flight software calls what it calls in a tick.

    Raises:
        PluginError: There was none yet, or the last *is_over*.
    """
    if tick is None:
        raise PluginError(f"{name}: there is no time before the first tick; call it in step()")
    if is_over:
        raise PluginError(
            f"{name}: no tick follows finish(), nothing would come of it; call it in step()"
        )


def _duration(kind: str, value: Any) -> float:
    duration_s = _number(kind, "duration_s", value)
    if duration_s <= 0.0:
        raise PluginError(f"{kind}: expected duration_s > 0, got {duration_s}")
    return duration_s


def _vector(kind: str, values: Any, unit: str) -> Vector:
    is_vector = isinstance(values, Sequence) or getattr(values, "ndim", 0) == 1
    if not is_vector or isinstance(values, str) or len(values) != 3:
        raise PluginError(f"{kind}: expected three numbers in {unit}, got {values!r:.80}")
    x, y, z = (_number(kind, "component", value) for value in values)
    return x, y, z


def _number(kind: str, name: str, value: Any) -> float:
    """Return a finite number, also one of numpy's."""
    try:
        number = float(value)
    except (TypeError, ValueError, OverflowError):
        number = math.nan
    if isinstance(value, str | bool) or not math.isfinite(number):
        raise PluginError(f"{kind}: expected a finite number for {name}, got {value!r:.80}")
    return number
