"""Where truth is least exact, as rows of the tables of `accuracy`: bends of the air, fast bodies, rounded records."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime

import numpy as np
from numpy.typing import NDArray

from madns_runtime.errors import MissingExtraError
from madns_runtime.simulations.constellation.orbit.constants import EGM_96
from madns_runtime.simulations.constellation.orbit.elements import Elements, state_from_elements
from madns_runtime.simulations.constellation.orbit.interpolation import (
    evaluate_turn,
    knot_error_rad,
    turn_between,
)
from madns_runtime.simulations.constellation.orbit.quaternions import rotation_between
from madns_runtime.simulations.constellation.parameters import (
    AnyPropagator,
    Force,
    NumbaPropagator,
    ScipyPropagator,
)
from madns_runtime.simulations.constellation.truth.propagation import (
    PropagationParameters,
    load_propagator,
    propagate,
)
from madns_runtime.simulations.constellation.truth.propagators.attitude import propagate_attitude
from madns_runtime.simulations.constellation.truth.propagators.rigid_body import RigidBody

Array = NDArray[np.float64]
Row = tuple[str, ...]


def transfer_orbit(perigee_m: float) -> Array:
    """Return the state of an orbit up to 35,786 km, shape (1, 6)."""
    low, high = EGM_96.radius_m + perigee_m, EGM_96.radius_m + 35_786e3
    orbit = Elements(
        a_m=(low + high) / 2.0,
        e=(high - low) / (high + low),
        i_rad=0.1,
        raan_rad=0.3,
        argp_rad=1.0,
        mean_anomaly_rad=2.0,
    )
    r, v = state_from_elements(orbit, EGM_96.mu_m3_s2)
    return np.array([[*r, *v]])


def perigee_rows() -> Iterator[Row]:
    """Yield distances from short steps after a day with drag through a low perigee, if numba is installed."""
    forces: tuple[Force, ...] = ("two_body", "j2", "drag")
    try:
        load_propagator("numba")
    except MissingExtraError:
        return
    numba = NumbaPropagator(kind="numba", forces=forces)
    fine = replace(numba, rtol=1e-13, atol_m=1e-9, step_s_max=0.1)
    for perigee_km in (120, 150, 185, 250):
        state = transfer_orbit(1e3 * perigee_km)
        expected = day_in_windows(fine, state, 86_400.0)
        ways = (
            (ScipyPropagator(kind="scipy", forces=forces), 86_400.0),
            (numba, 86_400.0),
            (numba, 10.0),
        )
        found = [
            day_in_windows(settings, state, window_s) - expected for settings, window_s in ways
        ]
        yield (str(perigee_km), *(f"{np.linalg.norm(row[0, :3]):.0e}" for row in found))


def day_in_windows(settings: AnyPropagator, states: Array, window_s: float) -> Array:
    """Return states after a day in calls of *window_s*, shape (N, 6)."""
    parameters = _problem(settings, np.full(len(states), 0.01))
    for window in range(round(86_400.0 / window_s)):
        from_s, until_s = window * window_s, (window + 1) * window_s
        knots_s = np.array([(from_s + until_s) / 2.0, until_s])
        states = propagate(states, from_s, knots_s, parameters)[:, -1]
    return states


def turning_rows() -> Iterator[Row]:
    """Yield errors of attitude between knots 1 s apart, and what `knot_error_rad` makes of them."""
    body, share = RigidBody(inertia_kg_m2=(1.0, 1.9, 2.8)), 8
    direction = np.array([1.0, 0.8, -0.6]) / math.sqrt(2.0)
    times_s = np.arange(0, 30 * share + 1) / share
    parameters = _problem(ScipyPropagator(kind="scipy"))
    for rate_deg_s in (1.0, 6.0, 30.0, 60.0, 88.0):
        rates = np.radians(rate_deg_s * direction)
        states = np.array([[7.158e6, 0.0, 0.0, 0.0, 1e3, 7.4e3, 0.0, 0.0, 0.0, 1.0, *rates]])
        rows = propagate_attitude([body], states, t0_s=0.0, knots_s=times_s, parameters=parameters)
        fine = rows[0, :, 6:].tolist()
        worst = 0.0
        for first in range(0, len(fine) - share, share):
            turn = turn_between(fine[first], fine[first + share], 1.0)
            for inside in range(1, share):
                found = evaluate_turn(turn, inside / share, 1.0)
                off = rotation_between(found[:4], fine[first + inside][:4])
                worst = max(worst, math.hypot(*off))
        yield f"{rate_deg_s:g}", f"{worst:.0e}", f"{knot_error_rad(fine[::share], 1.0):.0e}"


def record_rows(states: Array) -> Iterator[Row]:
    """Yield how far off a day flown on from recorded states, shape (N, 6), is."""
    knots_s, parameters = np.array([86_400.0]), _problem(ScipyPropagator(kind="scipy"))
    expected = propagate(states, 0.0, knots_s, parameters)
    rounded = np.concatenate((np.round(states[:, :3], 5), np.round(states[:, 3:], 8)), axis=1)
    found = propagate(rounded, 0.0, knots_s, parameters)
    distance_m = np.linalg.norm((found - expected)[..., :3], axis=-1).max()
    yield "an agent's: 1e-5 m, 1e-8 m/s", f"{distance_m:.0e}"


def _problem(
    settings: AnyPropagator, ballistic_m2_kg: Array | None = None
) -> PropagationParameters:
    return PropagationParameters(
        settings=settings,
        gravity=EGM_96,
        epoch_utc=datetime(2000, 1, 1, 12, tzinfo=UTC),
        ballistic_m2_kg=ballistic_m2_kg,
    )
