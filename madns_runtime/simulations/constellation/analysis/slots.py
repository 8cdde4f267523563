"""
Performance of a constellation under control: slot error by truth, delta-v given and messages sent, over time.

The slot error is worked out here from the recorded truth, by mean elements; what flight software believed
stands beside it and is never taken for it. The scenario says in flight.settings.slots, of one rule of flight or of several alike, what a slot is:

    even   equal spacing of all agents in their order, all around or by flight.settings.spacing_deg, whatever
           the common phase
    kept   the phase at the start, against the mean of those in the same plane, at the same height, who could
           hear each other at the start, directly or over others of them

Who flies no software that believes anything of its slot, such as a dead satellite, has a place in the order and no slot.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from madns_runtime.analysis.sampling import as_array, as_rows, evenly, largest_size
from madns_runtime.analysis.tables import RecordedRun, RecordedTable, Tables
from madns_runtime.analysis.values import Floats
from madns_runtime.config import RunConfig
from madns_runtime.plain_values import mapping_at
from madns_runtime.simulations.constellation.orbit.constants import EGM_96, GRAVITY_MODELS
from madns_runtime.simulations.constellation.orbit.mean_elements import mean_from_state
from madns_runtime.simulations.constellation.orbit.visibility import have_line_of_sight
from madns_runtime.simulations.constellation.parameters import Crosslinks
from madns_runtime.simulations.constellation.vehicles import EVEN_SLOTS, SLOTS

MEANING = ("slots", "spacing_deg", "plane_deg", "sma_km")
"""Settings that say what a slot is."""
TIMES_MAX = 97
"""Times at which slots are judged: every quarter of an hour of a day."""
TIME_S = 1e-6
"""Times nearer each other are one: a tick's time is its number divided by the rate."""
STATE = ("x_teme_m", "y_teme_m", "z_teme_m", "vx_teme_m_s", "vy_teme_m_s", "vz_teme_m_s")
PLANE_DEG, SMA_M = 4.0, 5000.0
"""kept: how near each other the planes and heights of satellites are that are judged together; those of
`RingSettings` unless the scenario says otherwise."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ControlRow:
    """The constellation at one time."""

    t_s: float
    slot_error_deg_rms: float | None
    """By truth, over all that have a slot; None if nobody has."""
    slot_error_deg_max: float | None
    satellites: int
    """Number of satellites that have a slot, and truth on record."""
    slot_error_estimated_deg_rms: float | None
    """Slot error as flight software believed it."""
    delta_v_m_s_mean: float
    """Given until then, over all vehicles."""
    delta_v_m_s_max: float
    messages: int
    """Handed to the radio until then, by all."""
    height_km: float | None
    """Mean semi-major axis less the Earth's radius, over all."""


def read_control(
    tables: Tables, config: RunConfig | None, times_s: Floats | None = None
) -> tuple[ControlRow, ...]:
    """
    Return the constellation over time; nothing for a run without slots or without truth on record.

    Args:
        tables: The run's.
        config: Its settings.
        times_s: Recorded times to judge at, from the start on; by default some, evenly spread.
    """
    state, estimates = tables.get("state"), tables.get("estimates")
    if state is None or config is None or not state.has("t_s", *STATE) or not state.rows:
        return ()
    settings = mapping_at(_keeping_rule(config.parameters), "settings")
    slots = settings.get("slots")
    if slots is None:
        return ()
    # By the run's agents, not by the table's: one that died early still has its place in the ring.
    agents = config.agents.resolved_names()
    if times_s is None:
        recorded_s = recorded_times_s(tables)
        times_s = recorded_s[evenly(len(recorded_s), TIMES_MAX)]
    if not len(times_s):
        return ()
    mean = _mean_elements(state, agents, times_s, str(config.parameters.get("gravity")))
    believed = _believed(estimates, agents, times_s)
    keepers = mean.copy()
    if believed is not None:
        keepers[np.isnan(believed).all(axis=1)] = np.nan
    if slots == EVEN_SLOTS:
        errors = even_errors_deg(keepers, spacing_deg=_number(settings.get("spacing_deg")))
    else:
        heard = _who_hears_whom(state, agents, times_s[:1], config)
        errors = kept_errors_deg(keepers, heard, settings)
    given, sent = _delta_v(tables, agents, times_s), _messages(tables, times_s)
    return tuple(
        ControlRow(
            t_s=t_s,
            slot_error_deg_rms=_rms(errors[:, index]),
            slot_error_deg_max=largest_size(errors[:, index]),
            satellites=int(np.isfinite(errors[:, index]).sum()),
            slot_error_estimated_deg_rms=None if believed is None else _rms(believed[:, index]),
            delta_v_m_s_mean=float(given[:, index].mean()),
            delta_v_m_s_max=float(given[:, index].max()),
            messages=int(sent[index]),
            height_km=_height_km(mean[:, index, 1]),
        )
        for index, t_s in enumerate(times_s.tolist())
    )


def _keeping_rule(parameters: Mapping[str, Any]) -> Mapping[str, Any]:
    """
    Return the rule of flight software whose settings say what a slot is, of several the first; empty without any.

    Several that mean different slots tell of none that all could be judged by.
    """
    flight = parameters.get("flight")
    rules = flight if isinstance(flight, list | tuple) else (flight,)
    described = [rule for rule in rules if isinstance(rule, Mapping)]
    found = [rule for rule in described if mapping_at(rule, "settings").get("slots") in SLOTS]
    settings = [mapping_at(rule, "settings") for rule in found]
    meant = {tuple(repr(one.get(key)) for key in MEANING) for one in settings}
    return found[0] if len(meant) == 1 else {}


def recorded_times_s(tables: Tables) -> Floats:
    """Return the times at which any agent recorded its truth, ascending: one may be lost early; none without truth on record."""
    state = tables.get("state")
    found = np.empty(0)
    if state is None or not state.has("t_s") or not state.rows:
        return found
    for _, columns in state.each(("t_s",)):
        t_s = as_array(columns["t_s"])
        if not np.array_equal(t_s, found):  # most have the same
            found = np.union1d(found, t_s)
    return found


def document(run: RecordedRun) -> dict[str, Any]:
    """Return what `cosmos report --json` tells of slots; nothing of a run without."""
    rows = read_control(run.tables, run.config)
    if not rows or run.config is None:
        return {}
    flight = _keeping_rule(run.config.parameters)
    control = {
        "software": flight.get("software"),
        "slots": mapping_at(flight, "settings").get("slots"),
        "rows": [asdict(row) for row in rows],
    }
    return {"control": control}


def even_errors_deg(mean: Floats, *, spacing_deg: float | None = None) -> Floats:
    """
    Return how far each satellite is ahead of its slot of an evenly spaced ring or chain, deg.

    Args:
        mean: Columns lam (rad), a (m) and the plane's unit normal, shape (N, K, 5); NaN where unknown.
        spacing_deg: From one slot to the next, deg; None for all around.
    """
    count = len(mean)
    spacing = math.tau / count if spacing_deg is None else math.radians(spacing_deg)
    place = mean[:, :, 0] - spacing * np.arange(count)[:, None]
    return _about_mean_deg(place, np.zeros(count, dtype=np.int64))


def kept_errors_deg(mean: Floats, heard: NDArray[np.bool_], settings: Mapping[str, Any]) -> Floats:
    """
    Return how far each satellite is ahead of its phase at the start, deg; NaN for one that is alone.

    Args:
        mean: As for `even_errors_deg`.
        heard: Who hears whom at the start, shape (N, N).
        settings: Those of flight software.
    """
    plane = math.cos(math.radians(float(settings.get("plane_deg", PLANE_DEG))))
    sma_m = 1e3 * float(settings.get("sma_km", SMA_M / 1e3))
    in_plane = mean[:, 0, 2:] @ mean[:, 0, 2:].T >= plane
    at_height = np.abs(mean[:, 0, 1][:, None] - mean[:, 0, 1]) <= sma_m
    # One that recorded nothing is near nobody but itself.
    near = (in_plane & at_height & heard) | np.eye(len(mean), dtype=np.bool_)
    groups = _connected(near)
    errors = _about_mean_deg(mean[:, :, 0] - mean[:, :1, 0], groups)
    errors[np.bincount(groups)[groups] < 2] = np.nan
    return errors


def _number(value: object) -> float | None:
    """Return a setting that a person wrote, if it is a number."""
    return float(value) if isinstance(value, int | float) else None


def _about_mean_deg(place_rad: Floats, groups: NDArray[np.int64]) -> Floats:
    """Return angles, shape (N, K), about the circular mean of each row's group, deg."""
    errors = np.empty_like(place_rad)
    for group in np.unique(groups):
        members = groups == group
        turned = np.exp(1j * place_rad[members])
        # Sums instead of means: a time at which nobody of a group is known gives zero, and no warning.
        error = np.angle(turned * np.conj(np.nansum(turned, axis=0)))
        known = np.maximum(np.isfinite(error).sum(axis=0), 1)
        errors[members] = np.degrees(error - np.nansum(error, axis=0) / known)
    return errors


def _connected(near: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return the number of each one's group: those who are near each other, over any of the others."""
    groups = np.arange(len(near))
    for _ in range(len(near)):
        joined = np.array([groups[row].min() for row in near])
        if (joined == groups).all():
            break
        groups = joined
    return groups


def _who_hears_whom(
    state: RecordedTable, agents: Sequence[str], first_s: Floats, config: RunConfig
) -> NDArray[np.bool_]:
    """Return whom each agent's radio reached at the start, shape (N, N); everybody if there is none."""
    crosslinks = mapping_at(config.parameters, "crosslinks")
    if not crosslinks:
        return np.ones((len(agents), len(agents)), dtype=np.bool_)
    r_m = np.full((len(agents), 3), np.nan)
    for row, agent in enumerate(agents):
        columns = state.read(agent, ("t_s", *STATE[:3]))
        for _, index in _at(as_array(columns["t_s"]), first_s):
            r_m[row] = [float(columns[name][index]) for name in STATE[:3]]
    known = Crosslinks()
    range_km = float(crosslinks.get("range_km_max", known.range_km_max))
    height_km = float(crosslinks.get("atmosphere_km", known.atmosphere_km))
    near = np.linalg.norm(r_m[:, None] - r_m, axis=2) <= 1e3 * range_km
    return np.asarray(near & have_line_of_sight(r_m[:, None], r_m[None], 1e3 * height_km))


def _mean_elements(
    state: RecordedTable, agents: Sequence[str], times_s: Floats, gravity: str
) -> Floats:
    """Return lam, a and the plane's normal of each agent at each time, shape (N, K, 5)."""
    model = GRAVITY_MODELS.get(gravity, EGM_96)
    found = np.full((len(agents), len(times_s), 5), np.nan)
    for row, agent in enumerate(agents):
        columns = state.read(agent, ("t_s", *STATE))
        at_s = as_array(columns["t_s"])
        states = as_rows(columns, STATE)
        for place, index in _at(at_s, times_s):
            x, y, z, vx, vy, vz = states[index].tolist()
            try:
                mean = mean_from_state((x, y, z), (vx, vy, vz), model)
            except ValueError:
                continue  # no ellipse, or in the equator: it has no place in a ring
            sine = math.sin(mean.i_rad)
            normal = (sine * math.sin(mean.raan_rad), -sine * math.cos(mean.raan_rad))
            found[row, place] = (mean.lam_rad, mean.a_m, *normal, math.cos(mean.i_rad))
    return found


def _at(recorded_s: Floats, times_s: Floats) -> Iterator[tuple[int, int]]:
    """Yield the places of *times_s* that were recorded, and where."""
    for place, index in enumerate(np.searchsorted(recorded_s, times_s - TIME_S).tolist()):
        if index < len(recorded_s) and abs(recorded_s[index] - times_s[place]) < TIME_S:
            yield place, index


def _believed(
    estimates: RecordedTable | None, agents: Sequence[str], times_s: Floats
) -> Floats | None:
    """Return each agent's newest estimate at each time, deg, shape (N, K); None without any."""
    if estimates is None or not estimates.has("t_s", "slot_error_deg"):
        return None
    found = np.full((len(agents), len(times_s)), np.nan)
    for row, agent in enumerate(agents):
        columns = estimates.read(agent, ("t_s", "slot_error_deg"))
        values = as_array(columns["slot_error_deg"])
        newest = np.searchsorted(as_array(columns["t_s"]), times_s + TIME_S, side="right") - 1
        known = newest >= 0
        found[row, known] = values[newest[known]]
    return found


def _delta_v(tables: Tables, agents: Sequence[str], times_s: Floats) -> Floats:
    """Return the delta-v given to each agent until each time, m/s, shape (N, K)."""
    found = np.zeros((len(agents), len(times_s)))
    table = tables.get("command_results")
    if table is None or not table.has("at_s", "status", "delta_v_m_s"):
        return found
    for row, agent in enumerate(agents):
        columns = table.read(agent, ("at_s", "status", "delta_v_m_s"))
        executed = columns["status"].astype(str) == "executed"
        at_s = as_array(columns["at_s"])[executed]
        order = np.argsort(at_s, kind="stable")
        total = np.concatenate(
            ([0.0], np.cumsum(as_array(columns["delta_v_m_s"])[executed][order]))
        )
        found[row] = total[np.searchsorted(at_s[order], times_s + TIME_S, side="right")]
    return found


def _messages(tables: Tables, times_s: Floats) -> NDArray[np.int64]:
    """Return how many messages all agents had sent until each time, shape (K,)."""
    found = np.zeros(len(times_s), dtype=np.int64)
    table = tables.get("messages")
    if table is None or not table.has("way", "sent_s"):
        return found
    for _, columns in table.each(("way", "sent_s")):
        sent_s = np.sort(as_array(columns["sent_s"])[columns["way"].astype(str) == "sent"])
        found += np.searchsorted(sent_s, times_s + TIME_S, side="right")
    return found


def _rms(values: Floats) -> float | None:
    finite = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(finite**2))) if finite.size else None


def _height_km(sma_m: Floats) -> float | None:
    finite = sma_m[np.isfinite(sma_m)]
    return float(finite.mean() - EGM_96.radius_m) / 1e3 if finite.size else None
