"""
What differs between two runs of a constellation: truth, measurements and estimates apart.

Truth is what the agents recorded of it ("state"); what was commanded and what it cost is the agents'
"commands" and the host's "maneuvers"; the slot error is what flight software believed ("estimates").
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from cosmos_cli.diff.control import Effort, SlotError, efforts_of, slot_errors_of
from cosmos_cli.diff.matching import Floats, Matched
from cosmos_cli.diff.measurements import MeasurementError, measurement_errors
from cosmos_cli.diff.recorded import Key, Recorded
from cosmos_cli.diff.side import Side
from cosmos_cli.diff.stream import Observer, Pairing, StreamDifference
from cosmos_cli.expectation import mapping_at
from cosmos_cli.report.control import TIMES_MAX, ControlRow, read_control, recorded_times_s
from cosmos_cli.report.sampling import evenly
from cosmos_cli.report.style import as_array
from cosmos_cli.spread import Spread, Stretch
from cosmos_cli.tables import open_tables

CONSTELLATION, STATE = "constellation", "state"
POSITION = tuple(re.compile(rf"^{axis}(_[a-z0-9]+)??_m$") for axis in "xyz")
VELOCITY = tuple(re.compile(rf"^v{axis}(_[a-z0-9]+)??_m_s$") for axis in "xyz")
Slots = tuple[ControlRow, ...]
Measured = dict[tuple[str, str], MeasurementError]
TIME_DECIMALS = 6
"""Times nearer each other are one."""
AXES = ("radial", "along", "normal")


@dataclass(slots=True, kw_only=True)
class PositionDifference:
    """How far apart a satellite of both runs was, in m."""

    agent: str
    count: int = 0
    max_m: float = 0.0
    max_t_s: float | None = None
    last_m: float = 0.0
    squares: float = 0.0
    axis_squares: Floats = field(default_factory=lambda: np.zeros(3))
    """Radial, along-track and normal to the orbit of the first run."""

    @property
    def rms_m(self) -> float:
        """Root mean square, m."""
        return math.sqrt(self.squares / self.count) if self.count else 0.0

    def axes_m(self) -> tuple[float, float, float]:
        """Return the root mean squares along radial, along-track and normal, m."""
        radial, along, normal = np.sqrt(self.axis_squares / max(self.count, 1)).tolist()
        return radial, along, normal


@dataclass(slots=True, kw_only=True)
class ConstellationDifference:
    """The comparison; pairs are of the first and the second run."""

    frame: tuple[Any, Any]
    positions: dict[str, PositionDifference] = field(default_factory=dict)
    over_time: list[Stretch] = field(default_factory=list)
    efforts: tuple[dict[str, Effort], dict[str, Effort]] = ({}, {})
    slot_errors: tuple[dict[str, SlotError], dict[str, SlotError]] = ({}, {})
    slot_over_time: tuple[list[Stretch], list[Stretch]] = ([], [])
    slots: tuple[Slots, Slots] = ((), ())
    """Slot error by truth over time, of runs whose scenario says what a slot is."""
    measurements: tuple[Measured, Measured] = field(default_factory=lambda: ({}, {}))
    remarks: list[str] = field(default_factory=list)

    def all_positions(self) -> PositionDifference | None:
        """Return the difference over all satellites; None without truth in both."""
        if not self.positions:
            return None
        total = PositionDifference(agent="*")
        for one in self.positions.values():
            total.count += one.count
            total.squares += one.squares
            total.axis_squares = total.axis_squares + one.axis_squares
            total.last_m = max(total.last_m, one.last_m)
            if one.max_t_s is not None and (total.max_t_s is None or one.max_m > total.max_m):
                total.max_m, total.max_t_s = one.max_m, one.max_t_s
        return total


class Constellation:
    """
    Gathers the comparison while streams are being compared.

    Args:
        a: The first run.
        b: The second.
    """

    def __init__(self, a: Side, b: Side) -> None:
        self._sides = (a, b)
        self._duration_s = max(a.duration_s, b.duration_s)
        self._spread = Spread(self._duration_s)
        hosts = [mapping_at(side.document, "simulation", "host") for side in (a, b)]
        self._result = ConstellationDifference(frame=(hosts[0].get("frame"), hosts[1].get("frame")))
        epochs = [host.get("epoch_utc") for host in hosts]
        if epochs[0] != epochs[1]:
            self._result.remarks.append(
                f"the epochs differ: {epochs[0]} against {epochs[1]}; positions are compared by"
                " the time since each run's own"
            )

    @classmethod
    def of(cls, a: Side, b: Side) -> Constellation | None:
        """Return what gathers the comparison of these runs; None if they are of something else."""
        return cls(a, b) if a.simulation == CONSTELLATION else None

    def observer(self, recorded: Recorded, pairing: Pairing) -> Observer | None:
        """Return what wants to be told of this stream's records, if anything does."""
        names = state_names(recorded)
        if recorded.table != STATE or names is None or pairing.by == "order":
            return None
        per_key_s = 1.0 if pairing.by == "time" else 1.0 / self._sides[0].tick_hz

        def observe(agent: str, piece: Matched) -> None:
            self._add_positions(agent, piece, names, piece.a.keys * per_key_s)

        return observe

    def take_identical(self, recorded: Recorded, found: StreamDifference) -> None:
        """Take a stream that is the same in both."""
        if recorded.table == STATE and state_names(recorded) is not None:
            agent = recorded.source
            self._result.positions[agent] = PositionDifference(agent=agent, count=found.matched)

    def finish(
        self, of_a: Mapping[Key, Recorded], of_b: Mapping[Key, Recorded]
    ) -> ConstellationDifference:
        """Add what is told of each run by itself, and return the comparison."""
        result = self._result
        result.over_time = self._spread.rows()
        first, second = self._sides
        result.slots = _slots_of(first, second)
        result.measurements = (
            measurement_errors(of_a, first.tick_hz),
            measurement_errors(of_b, second.tick_hz),
        )
        result.efforts = (efforts_of(of_a), efforts_of(of_b))
        found_a, found_b = (
            slot_errors_of(streams, side.tick_hz, side.duration_s, Spread(self._duration_s))
            for side, streams in zip(self._sides, (of_a, of_b), strict=True)
        )
        result.slot_errors = (found_a[0], found_b[0])
        result.slot_over_time = (found_a[1], found_b[1])
        return result

    def _add_positions(
        self, agent: str, piece: Matched, names: tuple[list[str], list[str]], t_s: Floats
    ) -> None:
        r_a, v_a = (_vectors(piece.a.columns, part) for part in names)
        difference = _vectors(piece.b.columns, names[0]) - r_a
        is_there = np.isfinite(difference).all(axis=1) & np.isfinite(v_a).all(axis=1)
        if not is_there.any():
            return
        r_a, v_a, difference = r_a[is_there], v_a[is_there], difference[is_there]
        distance_m = np.linalg.norm(difference, axis=1)
        found = self._result.positions.setdefault(agent, PositionDifference(agent=agent))
        found.count += len(distance_m)
        found.squares += float(np.dot(distance_m, distance_m))
        along = np.einsum("nij,nj->ni", _rtn(r_a, v_a), difference)
        found.axis_squares = found.axis_squares + (along * along).sum(axis=0)
        worst = int(distance_m.argmax())
        if found.max_t_s is None or distance_m[worst] > found.max_m:
            found.max_m, found.max_t_s = float(distance_m[worst]), float(t_s[is_there][worst])
        found.last_m = float(distance_m[-1])
        self._spread.add(t_s[is_there], distance_m)


def _slots_of(a: Side, b: Side) -> tuple[Slots, Slots]:
    """Return both runs' slots over time, at times that both have, and that the longer one has alone."""
    tables = open_tables(a.run.tables), open_tables(b.run.tables)
    of_a, of_b = (np.round(recorded_times_s(one), TIME_DECIMALS) for one in tables)
    both_s = np.intersect1d(of_a, of_b)
    later_s = max(of_a, of_b, key=lambda times_s: times_s[-1:].tolist())
    times_s = np.concatenate((both_s, later_s[later_s > both_s.max(initial=-np.inf)]))
    times_s = times_s[evenly(len(times_s), TIMES_MAX)]
    slots_a, slots_b = (
        read_control(one, side.run.read_config(), times_s[times_s <= own_s.max(initial=-np.inf)])
        for one, side, own_s in zip(tables, (a, b), (of_a, of_b), strict=True)
    )
    return slots_a, slots_b


def state_names(recorded: Recorded) -> tuple[list[str], list[str]] | None:
    """Return the fields of position, m, and velocity, m/s; None if the stream has no such."""
    found: list[list[str]] = []
    for patterns in (POSITION, VELOCITY):
        matches = [next((n for n in recorded.names() if p.match(n)), None) for p in patterns]
        if None in matches:
            return None
        found.append([name for name in matches if name is not None])
    return found[0], found[1]


def _vectors(columns: Mapping[str, Any], names: list[str]) -> Floats:
    return np.column_stack([as_array(columns[name]) for name in names])


def _rtn(r_m: Floats, v_m_s: Floats) -> Floats:
    """Return for each state the matrix from the inertial frame to radial, along-track, normal."""
    radial = r_m / np.linalg.norm(r_m, axis=1, keepdims=True)
    normal = np.cross(r_m, v_m_s)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    return np.stack((radial, np.cross(normal, radial), normal), axis=1)
