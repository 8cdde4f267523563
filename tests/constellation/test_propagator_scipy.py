"""How much work scipy is given."""

from datetime import UTC, datetime

import numpy as np
import pytest

from madns_runtime.simulations.constellation.orbit.constants import EGM_96
from madns_runtime.simulations.constellation.parameters import ScipyPropagator
from madns_runtime.simulations.constellation.truth.propagation import PropagationParameters
from madns_runtime.simulations.constellation.truth.propagators import scipy_propagator
from madns_runtime.simulations.constellation.truth.propagators.scipy_propagator import (
    NODES,
    ScipyDop853,
    first_step_s,
    lagrange_weights,
)

STAGES = 12
DENSE_STAGES = 3
ORBIT = np.array([[7.0e6, 0.0, 0.0, 0.0, 1000.0, 7479.0]])


@pytest.fixture
def solvers(monkeypatch):
    kept = []
    make = scipy_propagator.DOP853

    def keep(*arguments, **options):
        kept.append(make(*arguments, **options))
        return kept[-1]

    monkeypatch.setattr(scipy_propagator, "DOP853", keep)
    return kept


def propagate(states, knots_s, **settings):
    parameters = PropagationParameters(
        settings=ScipyPropagator(kind="scipy", **settings),
        gravity=EGM_96,
        epoch_utc=datetime(2000, 1, 1, tzinfo=UTC),
    )
    return ScipyDop853().propagate(states, 0.0, knots_s, parameters)


def test_a_short_stretch_is_one_step(solvers):
    propagate(ORBIT, np.arange(0.0, 10.05, 0.1))

    assert solvers[0].nfev == 1 + STAGES + DENSE_STAGES


def test_a_fleet_in_low_orbit_takes_no_more_steps_than_one_vehicle(solvers):
    propagate(np.repeat(ORBIT, 1000, axis=0), np.arange(0.0, 10.05, 0.1))

    assert solvers[0].nfev == 1 + STAGES + DENSE_STAGES


def test_long_stretches_are_cut_at_the_longest_step(solvers):
    propagate(ORBIT, np.arange(0.0, 121.0), step_s_max=30.0)

    assert solvers[0].nfev == 1 + 4 * (STAGES + DENSE_STAGES)


def test_the_first_step_is_not_refused_at_any_height(solvers):
    for radius_m in (6.6e6, 8.0e6, 2.6e7, 4.2e7):
        speed = (EGM_96.mu_m3_s2 / radius_m) ** 0.5
        state = np.array([[radius_m, 0.0, 0.0, 0.0, speed, 0.0]])
        step_s = first_step_s(state, EGM_96.mu_m3_s2, 1e-12)

        propagate(state, np.array([step_s]), step_s_max=1e4)

        # No state within the step is wanted, and so none of the dense output's stages.
        assert solvers[-1].nfev == 1 + STAGES
        assert step_s > 50.0


def test_tolerances_hold_for_a_vehicle_among_many_as_for_it_alone():
    high = np.array([[4.2e7, 0.0, 0.0, 0.0, (EGM_96.mu_m3_s2 / 4.2e7) ** 0.5, 0.0]])
    fleet, end_s = np.concatenate((ORBIT, np.repeat(high, 999, axis=0))), np.array([6000.0])
    expected = propagate(ORBIT, end_s, rtol=1e-13)[0, 0, :3]

    errors_m = [
        np.linalg.norm(propagate(states, end_s, rtol=1e-8, step_s_max=1e4)[0, 0, :3] - expected)
        for states in (ORBIT, fleet)
    ]

    # A root mean square over all would let it err thirty times as much.
    assert errors_m[0] > 1e-3
    assert errors_m[1] < 2.0 * errors_m[0]


def test_many_states_in_a_step_are_those_of_few():
    many_s = np.arange(1, 301) * 0.1

    found = propagate(np.repeat(ORBIT, 3, axis=0), many_s)

    for first in range(0, 300, 7):
        few = propagate(np.repeat(ORBIT, 3, axis=0), np.append(many_s[first : first + 7], 30.0))
        few = few[:, :-1]
        assert np.abs(found[:, first : first + 7] - few)[..., :3].max() < 4e-9
        assert np.abs(found[:, first : first + 7] - few)[..., 3:].max() < 1e-11


def test_weights_reproduce_polynomials_of_seventh_degree():
    parts = np.linspace(0.0, 1.0, 41)

    weights = lagrange_weights(parts)

    for degree in range(8):
        assert weights @ NODES**degree == pytest.approx(parts**degree, abs=1e-14)
    assert np.abs(weights @ NODES**8 - parts**8).max() > 1e-6
    assert lagrange_weights(NODES) == pytest.approx(np.eye(8), abs=1e-14)
