"""Flight software that gives the commands and the estimates of a recorded run again, each in the tick in which it was given."""

from __future__ import annotations

import math
from collections import defaultdict
from pathlib import Path
from typing import Any, Final

from madns_runtime.errors import BlamedError
from madns_runtime.recording.reader import read_stream
from madns_runtime.simulations.constellation.command_numbers import is_of_device
from madns_runtime.simulations.constellation.flight.api import (
    AnsweredContext,
    Readings,
)

COMMANDS_MAX: Final = 16
"""Of one answer, as a vehicle takes them: of more that were given in one tick, several answers had come."""
TICK_TOLERANCE: Final = 1e-6
"""Rounding of times, in ticks."""


class RecordedCommands:
    """In the place of software that cannot be stepped; setting `agents`: folder of the run's agents."""

    def setup(self, context: AnsweredContext) -> None:
        """
        Read what was commanded and what was believed.

        Raises:
            BlamedError: No commands of this agent are on record.
        """
        self._context = context
        folder = Path(str(context.settings["agents"])) / context.name
        path = folder / "commands.jsonl"
        if not path.is_file():
            raise BlamedError(f"{path}: expected the commands of the recorded run, found none")
        self._rows = {
            # Those of devices a rerun takes from the devices' records.
            tick: [row for row in rows if not is_of_device(row["number"])]
            for tick, rows in _rows_by_tick(path).items()
        }
        path = folder / "estimates.jsonl"
        self._believed = _rows_by_tick(path) if path.is_file() else {}

    def step(self, t_s: float, readings: Readings) -> None:
        """Give commands and estimates of this tick, in the first of its steps: in real time that took all that had come."""
        context = self._context
        tick = math.ceil(t_s * context.tick_hz - TICK_TOLERANCE)
        for row in self._believed.pop(tick, []):
            context.estimate({name: row[name] for name in row if name != "tick"})
        for number, row in enumerate(self._rows.pop(tick, [])):
            if number and not number % COMMANDS_MAX:
                context.begin_answer()
            vector, at_s = (row["x"], row["y"], row["z"]), row["at_s"]
            if row["kind"] == "delta_v":
                context.delta_v(vector, at_s=at_s, frame=row["frame"])
            elif row["kind"] == "torque":
                context.torque(vector, at_s=at_s, duration_s=row["duration_s"])
            elif row["kind"] == "dipole":
                context.dipole(vector, at_s=at_s, duration_s=row["duration_s"])
            else:
                context.ballistic(vector[0], at_s=at_s)


def _rows_by_tick(path: Path) -> dict[int, list[dict[str, Any]]]:
    """Return the records of a stream by their ticks, each as a mapping of the fields' names."""
    found: dict[int, list[dict[str, Any]]] = defaultdict(list)
    stream = read_stream(path)
    names = stream.field_names
    for values in stream.records():
        row = dict(zip(names, values, strict=True))
        found[row["tick"]].append(row)
    return dict(found)
