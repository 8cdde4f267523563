"""Flight software that gives the commands of a recorded run again, each in the tick in which it was given."""

from __future__ import annotations

import math
from collections import defaultdict
from pathlib import Path
from typing import Any, Final

from madns_runtime.errors import BlamedError
from madns_runtime.recording.reader import read_stream
from madns_runtime.simulations.constellation.flight.api import (
    FlightContext,
    FlightSoftware,
    Readings,
)

DEVICES_FROM: Final = 2**30
"""Numbers from here on are commands of devices, which a rerun takes from the devices' records."""
COMMANDS_MAX: Final = 16
"""Of one step, as a vehicle takes them: of software that is faster than the ticks, the next steps of the tick give the others."""
TICK_TOLERANCE: Final = 1e-6
"""Rounding of times, in ticks."""


class RecordedCommands(FlightSoftware):
    """In the place of software that cannot be stepped; setting `agents`: folder of the run's agents."""

    def setup(self, context: FlightContext) -> None:
        """
        Read what was commanded.

        Raises:
            BlamedError: No commands of this agent are on record.
        """
        self._context = context
        self._rows: dict[int, list[dict[str, Any]]] = defaultdict(list)
        path = Path(str(context.settings["agents"])) / context.name / "commands.jsonl"
        if not path.is_file():
            raise BlamedError(f"{path}: expected the commands of the recorded run, found none")
        stream = read_stream(path)
        names = stream.field_names
        for values in stream.records():
            row = dict(zip(names, values, strict=True))
            if row["number"] < DEVICES_FROM:
                self._rows[row["tick"]].append(row)

    def step(self, t_s: float, readings: Readings) -> None:
        """Give the commands of this tick, in the first of its steps: in real time that took all that had come."""
        context = self._context
        rows = self._rows.get(math.ceil(t_s * context.tick_hz - TICK_TOLERANCE), [])
        given, rows[:] = rows[:COMMANDS_MAX], rows[COMMANDS_MAX:]
        for row in given:
            vector, at_s = (row["x"], row["y"], row["z"]), row["at_s"]
            if row["kind"] == "delta_v":
                context.delta_v(vector, at_s=at_s, frame=row["frame"])
            elif row["kind"] == "torque":
                context.torque(vector, at_s=at_s, duration_s=row["duration_s"])
            elif row["kind"] == "dipole":
                context.dipole(vector, at_s=at_s, duration_s=row["duration_s"])
            else:
                context.ballistic(vector[0], at_s=at_s)
