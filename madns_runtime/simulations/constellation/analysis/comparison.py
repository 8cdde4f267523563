"""
Comparison of two runs of a constellation: truth, measurements and estimates apart.

Truth is what the agents recorded of it ("state"); what was commanded and what it cost is the agents'
"commands" and the host's "maneuvers", the effort; the slot error is what flight software believed ("estimates").
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from madns_runtime.analysis.distribution import Summary
from madns_runtime.analysis.matching import Matched, match
from madns_runtime.analysis.sampling import BinnedRms, Stretch, as_array, as_rows, evenly
from madns_runtime.analysis.tables import ComparedRun, ComparedStream, Key
from madns_runtime.analysis.values import Floats
from madns_runtime.plain_values import mapping_at
from madns_runtime.simulations.constellation.analysis.attitudes import (
    AttitudeDifference,
    compare_attitudes,
)
from madns_runtime.simulations.constellation.analysis.burn_ends import EXECUTED, TIMES, ends_s
from madns_runtime.simulations.constellation.analysis.loop_latency import loop_latencies
from madns_runtime.simulations.constellation.analysis.measurement_errors import (
    MeasurementError,
    measurement_errors,
    rows_over_time,
)
from madns_runtime.simulations.constellation.analysis.orbits import state_fields
from madns_runtime.simulations.constellation.analysis.predictions import (
    PredictionScore,
    prediction_scores,
)
from madns_runtime.simulations.constellation.analysis.slots import (
    TIME_S,
    TIMES_MAX,
    ControlRow,
    read_control,
    recorded_times_s,
)

STATE = "state"
POSITION = tuple(re.compile(rf"^{axis}(_[a-z0-9]+)??_m$") for axis in "xyz")
VELOCITY = tuple(re.compile(rf"^v{axis}(_[a-z0-9]+)??_m_s$") for axis in "xyz")
Slots = tuple[ControlRow, ...]
Measured = dict[tuple[str, str], MeasurementError]
Scores = dict[tuple[str, str, str, str], PredictionScore]
"""By sensor, quantity, unit and agent."""
TIME_DECIMALS = 6
"""Times nearer each other are one."""
AXES = ("radial", "along", "normal")
ESTIMATES, COMMANDS, MANEUVERS = "estimates", "commands", "host_maneuvers"
SLOT_ERROR = "slot_error_deg"
SETTLED_SHARE = 0.1
"""The last part of a run, in which a controller has settled."""
GIVEN_FIELDS = ("delta_v_given_m_s", "dv_given_m_s", "given_m_s")


@dataclass(slots=True, kw_only=True)
class PositionDifference:
    """Distance of a satellite between both runs, m."""

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
    """Differences between two runs of a constellation; pairs are of the first and the second run."""

    frame: tuple[Any, Any]
    positions: dict[str, PositionDifference] = field(default_factory=dict)
    over_time: list[Stretch] = field(default_factory=list)
    attitudes: dict[str, AttitudeDifference] = field(default_factory=dict)
    efforts: tuple[dict[str, Effort], dict[str, Effort]] = ({}, {})
    slot_errors: tuple[dict[str, SlotError], dict[str, SlotError]] = ({}, {})
    slot_over_time: tuple[list[Stretch], list[Stretch]] = ([], [])
    slots: tuple[Slots, Slots] = ((), ())
    """Slot error by truth over time, of runs whose scenario says what a slot is."""
    measurements: tuple[Measured, Measured] = field(default_factory=lambda: ({}, {}))
    loops: tuple[dict[str, Summary], dict[str, Summary]] = field(default_factory=lambda: ({}, {}))
    """Latency of the loop through hardware, us, by its part."""
    scores: tuple[Scores, Scores] = field(default_factory=lambda: ({}, {}))
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


@np.errstate(over="ignore", invalid="ignore")  # of runs of which one diverged
def compare_runs(a: ComparedRun, b: ComparedRun) -> ConstellationDifference:
    """
    Return what differs between two runs.

    Raises:
        MachineError: A file cannot be read.
    """
    duration_s = max(a.run.duration_s, b.run.duration_s)
    hosts = [mapping_at(one.run.document, "simulation", "host") for one in (a, b)]
    epochs = [host.get("epoch_utc") for host in hosts]
    remark = (
        f"the epochs differ: {epochs[0]} against {epochs[1]}; positions are compared by"
        " the time since each run's own"
    )
    positions, over_time = _compare_positions(a, b, BinnedRms(duration_s))
    estimated = [
        slot_errors_of(one.streams, _tick_hz(one), one.run.duration_s, BinnedRms(duration_s))
        for one in (a, b)
    ]
    return ConstellationDifference(
        frame=(hosts[0].get("frame"), hosts[1].get("frame")),
        positions=positions,
        over_time=over_time,
        attitudes=compare_attitudes(a, b),
        efforts=(efforts_of(a), efforts_of(b)),
        slot_errors=(estimated[0][0], estimated[1][0]),
        slot_over_time=(estimated[0][1], estimated[1][1]),
        slots=_slots_of(a, b),
        measurements=(
            measurement_errors(a.streams, _tick_hz(a)),
            measurement_errors(b.streams, _tick_hz(b)),
        ),
        loops=(loop_latencies(a.run), loop_latencies(b.run)),
        scores=(prediction_scores(a.run), prediction_scores(b.run)),
        remarks=[] if epochs[0] == epochs[1] else [remark],
    )


def _tick_hz(one: ComparedRun) -> float:
    return one.run.tick_hz or 1.0


def _compare_positions(
    a: ComparedRun, b: ComparedRun, spread: BinnedRms
) -> tuple[dict[str, PositionDifference], list[Stretch]]:
    found: dict[str, PositionDifference] = {}
    same: list[ComparedStream] = []
    for key, recorded in a.streams.items():
        other, names = b.streams.get(key), state_fields(recorded.names(), POSITION, VELOCITY)
        if key[0] != STATE or names is None or other is None:
            continue
        agent = recorded.source
        if key in a.identical:
            found[agent] = PositionDifference(agent=agent, count=a.identical[key])
            same.append(recorded)
            continue
        columns = [*names[0], *names[1]]
        keys = [_time_key(one, hz) for one, hz in ((recorded, _tick_hz(a)), (other, _tick_hz(b)))]
        if keys[0] is None or keys[1] is None or not set(columns) <= set(other.names()):
            continue
        sides = (
            rows_over_time(recorded, columns, *keys[0]),
            rows_over_time(other, columns, *keys[1]),
        )
        difference = PositionDifference(agent=agent)
        for piece in match(*sides, tolerance=TIME_S):
            _add_positions(difference, piece, names, spread)
        if difference.count:
            found[agent] = difference
    if spread.rows():  # those in the same places count over time, too, where there are others
        _add_same_places(same, _tick_hz(a), spread)
    return found, spread.rows()


def _add_same_places(streams: Iterable[ComparedStream], tick_hz: float, spread: BinnedRms) -> None:
    for recorded in streams:
        key = _time_key(recorded, tick_hz)
        if key is None:
            continue
        for columns in recorded.batches(key[:1]):
            t_s = as_array(columns[key[0]]) * key[1]
            spread.add(t_s, np.zeros(len(t_s)))


def _time_key(recorded: ComparedStream, tick_hz: float) -> tuple[str, float] | None:
    """Return the field that tells a record's time and the seconds per unit of it."""
    if "tick" in recorded.names():
        return "tick", 1.0 / tick_hz
    return ("t_s", 1.0) if "t_s" in recorded.names() else None


def _add_positions(
    found: PositionDifference, piece: Matched, names: tuple[list[str], list[str]], spread: BinnedRms
) -> None:
    t_s = piece.a.keys
    r_a, v_a = (as_rows(piece.a.columns, part) for part in names)
    difference = as_rows(piece.b.columns, names[0]) - r_a
    is_there = np.isfinite(difference).all(axis=1) & np.isfinite(v_a).all(axis=1)
    if not is_there.any():
        return
    r_a, v_a, difference = r_a[is_there], v_a[is_there], difference[is_there]
    distance_m = np.linalg.norm(difference, axis=1)
    found.count += len(distance_m)
    found.squares += float(np.dot(distance_m, distance_m))
    along = np.einsum("nij,nj->ni", _rtn(r_a, v_a), difference)
    found.axis_squares = found.axis_squares + (along * along).sum(axis=0)
    worst = int(distance_m.argmax())
    if found.max_t_s is None or distance_m[worst] > found.max_m:
        found.max_m, found.max_t_s = float(distance_m[worst]), float(t_s[is_there][worst])
    found.last_m = float(distance_m[-1])
    spread.add(t_s[is_there], distance_m)


def _slots_of(a: ComparedRun, b: ComparedRun) -> tuple[Slots, Slots]:
    """Return both runs' slots over time, at times that both have, and that the longer one has alone."""
    of_a, of_b = (np.round(recorded_times_s(one.run.tables), TIME_DECIMALS) for one in (a, b))
    both_s = np.intersect1d(of_a, of_b)
    later_s = max(of_a, of_b, key=lambda times_s: times_s[-1:].tolist())
    times_s = np.concatenate((both_s, later_s[later_s > both_s.max(initial=-np.inf)]))
    times_s = times_s[evenly(len(times_s), TIMES_MAX)]
    slots_a, slots_b = (
        read_control(one.run.tables, one.run.config, times_s[times_s <= own_s.max(initial=-np.inf)])
        for one, own_s in zip((a, b), (of_a, of_b), strict=True)
    )
    return slots_a, slots_b


def _rtn(r_m: Floats, v_m_s: Floats) -> Floats:
    """Return for each state the matrix from the inertial frame to radial, along-track, normal."""
    radial = r_m / np.linalg.norm(r_m, axis=1, keepdims=True)
    normal = np.cross(r_m, v_m_s)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    return np.stack((radial, np.cross(normal, radial), normal), axis=1)


@dataclass(frozen=True, slots=True, kw_only=True)
class Effort:
    """Commands and delta-v of one run for one agent, or for all."""

    commanded_m_s: float = 0.0
    given_m_s: float | None = None
    """Delta-v that the actuators really gave, as the host knows; None where it did not record it."""
    commands: int = 0


@dataclass(frozen=True, slots=True, kw_only=True)
class SlotError:
    """Distance from its slot that flight software of one run believed in, deg."""

    rms_deg: float
    settled_rms_deg: float
    """Over the last tenth of the run."""
    last_deg: float
    count: int
    squares: float
    settled_count: int
    settled_squares: float


def efforts_of(one: ComparedRun) -> dict[str, Effort]:
    """Return what each agent commanded and what its actuators gave."""
    commanded: dict[str, list[float]] = {}
    given: dict[str, float] = {}
    for (table, source), recorded in one.streams.items():
        if table == COMMANDS and {"kind", "x", "y", "z"} <= set(recorded.names()):
            commanded[source] = _commanded(recorded)
        elif table == MANEUVERS:
            _add_given(recorded, given, one.run.end_s)
    return {
        agent: Effort(
            commanded_m_s=math.fsum(commanded.get(agent, ())),
            commands=len(commanded.get(agent, ())),
            given_m_s=given.get(agent, 0.0) if given else None,
        )
        for agent in dict.fromkeys((*commanded, *given))
    }


def total_effort(efforts: Mapping[str, Effort]) -> Effort:
    """Return what all agents commanded and spent."""
    given = [one.given_m_s for one in efforts.values() if one.given_m_s is not None]
    return Effort(
        commanded_m_s=sum(one.commanded_m_s for one in efforts.values()),
        commands=sum(one.commands for one in efforts.values()),
        given_m_s=sum(given) if given else None,
    )


def total_slot_error(errors: Mapping[str, SlotError]) -> SlotError | None:
    """Return the slot error over all agents; None if nobody estimated one."""
    if not errors:
        return None
    every = errors.values()
    return _made_slot_error(
        sum(e.squares for e in every),
        sum(e.count for e in every),
        (sum(e.settled_squares for e in every), sum(e.settled_count for e in every)),
        math.hypot(*(e.last_deg for e in every)) / math.sqrt(len(errors)),
    )


def slot_errors_of(
    streams: Mapping[Key, ComparedStream], tick_hz: float, duration_s: float, spread: BinnedRms
) -> tuple[dict[str, SlotError], list[Stretch]]:
    """Return the slot error that each agent's flight software estimated, and that of all over time."""
    found = {}
    for (table, agent), recorded in streams.items():
        if table == ESTIMATES and SLOT_ERROR in recorded.names():
            error = _slot_error(recorded, tick_hz, (1.0 - SETTLED_SHARE) * duration_s, spread)
            if error is not None:
                found[agent] = error
    return found, spread.rows()


def _commanded(recorded: ComparedStream) -> list[float]:
    sizes: list[float] = []
    for columns in recorded.batches(("kind", "x", "y", "z")):
        vectors = as_rows(columns, "xyz")
        is_delta_v = columns["kind"].astype(str) == "delta_v"
        sizes.extend(np.linalg.norm(vectors[is_delta_v], axis=1).tolist())
    return sizes


def _add_given(recorded: ComparedStream, given: dict[str, float], end_s: float) -> None:
    """Add what the host's account of maneuvers says was given by the end of the run, which may have come before some."""
    name = next((n for n in GIVEN_FIELDS if n in recorded.names()), None)
    if name is None or "agent" not in recorded.names():
        return
    times = [each for each in TIMES if each in recorded.names()]
    for columns in recorded.batches(("agent", name, *times)):
        values = np.nan_to_num(as_array(columns[name]))
        if EXECUTED in columns:
            values[ends_s(columns) > end_s] = 0.0
        for agent, value in zip(columns["agent"].tolist(), values.tolist(), strict=True):
            given[str(agent)] = given.get(str(agent), 0.0) + value


def _slot_error(
    recorded: ComparedStream, tick_hz: float, settled_from_s: float, spread: BinnedRms
) -> SlotError | None:
    count, squares, settled_count, settled_squares, last_deg = 0, 0.0, 0, 0.0, 0.0
    key = "tick" if "tick" in recorded.names() else "t_s"
    scale = 1.0 / tick_hz if key == "tick" else 1.0
    for columns in recorded.batches((key, SLOT_ERROR)):
        error_deg = as_array(columns[SLOT_ERROR])
        t_s = as_array(columns[key]) * scale
        is_there = np.isfinite(error_deg) & np.isfinite(t_s)
        error_deg, t_s = error_deg[is_there], t_s[is_there]
        if not len(error_deg):
            continue
        spread.add(t_s, error_deg)
        settled = error_deg[t_s >= settled_from_s]
        count += len(error_deg)
        squares += float(np.dot(error_deg, error_deg))
        settled_count += len(settled)
        settled_squares += float(np.dot(settled, settled))
        last_deg = float(error_deg[-1])
    if not count:
        return None
    return _made_slot_error(squares, count, (settled_squares, settled_count), last_deg)


def _made_slot_error(
    squares: float, count: int, settled: tuple[float, int], last_deg: float
) -> SlotError:
    return SlotError(
        rms_deg=math.sqrt(squares / count),
        settled_rms_deg=math.sqrt(settled[0] / settled[1]) if settled[1] else math.nan,
        last_deg=last_deg,
        count=count,
        squares=squares,
        settled_count=settled[1],
        settled_squares=settled[0],
    )
