"""
Commands of devices: values of their channels become commands of the vehicle, beside those of flight software.

They go the same way: a desk that numbers and records them, the host's rules, results on record. Their numbers have a
range of their own, so that flight software's keep the order in which it gave them.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from typing import Any

from madns_runtime.errors import BlamedError, PluginError
from madns_runtime.plugin.api import AgentContext
from madns_runtime.simulations.constellation.actuation import VECTOR_SIZE, Actuation
from madns_runtime.simulations.constellation.command_numbers import first_number
from madns_runtime.simulations.constellation.equipment import Vehicle
from madns_runtime.simulations.constellation.messages import CommandResult
from madns_runtime.simulations.constellation.thrust import Vector
from madns_runtime.simulations.constellation.vehicle.commands import (
    COMMANDS_PER_TICK_MAX,
    CommandDesk,
)


class DeviceCommands:
    """
    The commands of one vehicle's devices.

    Args:
        context: Whose devices they are, and through which commands leave.
        vehicle: What it is like.
        has_flight: Whether flight software has opened the streams of commands.

    Raises:
        BlamedError: A device or its channel is not there.
    """

    def __init__(self, context: AgentContext, vehicle: Vehicle, *, has_flight: bool) -> None:
        self._context = context
        rejoined_tick = max(0, math.ceil(context.now_s() * context.tick_hz))
        first = first_number(rejoined_tick * COMMANDS_PER_TICK_MAX, of_device=True)
        self._desk = CommandDesk(context, vehicle, first, opens_streams=not has_flight)
        self._lines = [
            _Line(actuation, context, place, is_rejoined=rejoined_tick > 0)
            for place, actuation in enumerate(vehicle.actuation)
        ]
        self._results: list[CommandResult] = []
        self._counts: Counter[str] = Counter()
        self._tick_s = 1.0 / context.tick_hz

    def step(self, tick: int, t_s: float, phase_s: float) -> None:
        """
        Record what became of commands, and give those of new samples.

        Raises:
            BlamedError: A channel's values are not as many as its entry says.
        """
        self._desk.begin(tick, t_s, phase_s)
        for result in self._results:
            self._desk.record_result(tick, result)
        self._results.clear()
        for line in self._lines:
            vector = line.take()
            if vector is not None:
                self._give(line, vector, t_s)

    def tell(self, result: CommandResult) -> None:
        """Take what became of a command; the first refusal is told in the log."""
        self._results.append(result)
        self._counts[result.status] += 1
        if result.status == "refused":
            self._refused(f"command {result.number} of {result.at_s:g} s", result.reason)

    def finish(self) -> dict[str, Any]:
        """Return what was commanded, what became of it, and the samples that nobody saw."""
        names = ("executed", "postponed", "refused", "refused_on_board")
        return {
            "commands": self._desk.count,
            **{name: self._counts[name] for name in names},
            "samples_skipped": sum(line.skipped for line in self._lines),
        }

    def _give(self, line: _Line, vector: Vector, t_s: float) -> None:
        wanted, desk = line.actuation, self._desk
        at_s = t_s + (self._tick_s if wanted.lead_s is None else wanted.lead_s)
        try:
            if wanted.command == "delta_v":
                desk.delta_v(vector, at_s=at_s, frame=wanted.frame)
            elif wanted.command == "torque":
                desk.torque(vector, at_s=at_s, duration_s=wanted.duration_s or 0.0)
            else:
                desk.dipole(vector, at_s=at_s, duration_s=wanted.duration_s or 0.0)
        except PluginError as error:
            self._counts["refused_on_board"] += 1
            self._refused(f"{wanted.channel} at {t_s:g} s", str(error))

    def _refused(self, what: str, reason: str) -> None:
        if self._counts["refused"] + self._counts["refused_on_board"] == 1:
            self._context.log(
                "warning",
                f"a device's {what} was refused: {reason}; others like it are counted in actuation",
            )


class _Line:
    """One channel that commands."""

    def __init__(
        self, actuation: Actuation, context: AgentContext, place: int, *, is_rejoined: bool
    ) -> None:
        self.actuation = actuation
        self.skipped = 0
        """Samples that a newer one had replaced before a tick could see them."""
        self._number = 0
        self._field = f"{context.name}: vehicles.actuation[{place}].channel"
        device, _, self._channel = actuation.channel.rpartition(".")
        found = context.hardware.get(device)
        if found is None:
            raise BlamedError(
                f"{self._field}: expected a device of this agent's, {_listed(tuple(context.hardware))}, got {device!r}"
            )
        if self._channel not in found.inputs:
            raise BlamedError(
                f"{self._field}: expected an input of {device}, {_listed(found.inputs)}, got {self._channel!r}"
            )
        self._device = found
        if is_rejoined:  # by the newest sample so far an earlier incarnation may have commanded
            self._number = found[self._channel].number

    def take(self) -> Vector | None:
        """
        Return the command of the newest sample, if there is a new one above the threshold.

        Raises:
            BlamedError: Its values are not as many as the entry says.
        """
        reading = self._device[self._channel]
        if reading.number == self._number:
            return None
        if self._number:  # those before the first one seen were before the run
            self.skipped += reading.number - self._number - 1
        self._number = reading.number
        value = reading.value
        values = tuple(value) if isinstance(value, Sequence) else (value,)
        magnitude = math.hypot(*values)
        if not math.isfinite(magnitude) or magnitude <= self.actuation.threshold:
            return None  # what is no number is counted where it was sampled
        vector = self._vector(values)
        return vector if any(vector) else None

    def _vector(self, values: tuple[float, ...]) -> Vector:
        wanted = self.actuation
        expected = VECTOR_SIZE if wanted.vector is None else 1
        if len(values) != expected:
            which = "without vector" if wanted.vector is None else "with vector"
            raise BlamedError(
                f"{self._field}: expected {expected} numbers ({which}), got {len(values)} from {wanted.channel}"
            )
        scale = wanted.scale
        if wanted.vector is not None:
            x, y, z = (scale * part * values[0] for part in wanted.vector)
        elif wanted.matrix is not None:
            x, y, z = (
                scale * sum(a * b for a, b in zip(row, values, strict=True))
                for row in wanted.matrix
            )
        else:
            x, y, z = (scale * part for part in values)
        return x, y, z


def _listed(names: Sequence[str]) -> str:
    return f"one of {', '.join(names)}" if names else "of which there is none"
