"""Truth in machine code against scipy's."""

import math
from dataclasses import replace
from datetime import UTC, datetime

import numpy as np
import pytest
from harness.late_module import LateModule, needs_library

from madns_runtime.errors import ConfigurationError
from madns_runtime.simulations.constellation.orbit.constants import EGM_96
from madns_runtime.simulations.constellation.orbit.elements import Elements, state_from_elements
from madns_runtime.simulations.constellation.parameters import NumbaPropagator, ScipyPropagator
from madns_runtime.simulations.constellation.truth.propagation import (
    PropagationParameters,
    propagate,
)
from madns_runtime.simulations.constellation.truth.propagators.forces import acceleration_of

PROPAGATORS = "madns_runtime.simulations.constellation.truth.propagators"
propagator = LateModule(f"{PROPAGATORS}.numba_propagator")
numba_dop853 = LateModule(f"{PROPAGATORS}.numba_dop853")
pytestmark = needs_library("numba", "fast")

ALL = ("two_body", "j2", "j3", "j4", "drag")


def make(forces=ALL, kind="numba", rest=None, **settings):
    classes = {"numba": NumbaPropagator, "scipy": ScipyPropagator}
    return PropagationParameters(
        settings=classes[kind](kind=kind, forces=forces, **settings),
        gravity=EGM_96,
        epoch_utc=datetime(2000, 1, 1, 12, tzinfo=UTC),
        **(rest or {}),
    )


def fleet(count, a_m=6.9e6, e=0.01):
    rng = np.random.default_rng(2)
    rows = []
    for _ in range(count):
        orbit = Elements(
            a_m=a_m,
            e=e,
            i_rad=math.pi * rng.random(),
            raan_rad=6.0 * rng.random(),
            argp_rad=6.0 * rng.random(),
            mean_anomaly_rad=6.0 * rng.random(),
        )
        r, v = state_from_elements(orbit, EGM_96.mu_m3_s2)
        rows.append((*r, *v))
    return np.array(rows)


def test_the_derivative_is_that_of_the_shared_forces():
    states = fleet(50, a_m=6.8e6)
    ballistic, thrust = np.linspace(0.0, 0.03, 50), np.random.default_rng(1).normal(size=(50, 3))
    parameters = make(rest={"ballistic_m2_kg": ballistic, "thrust_m_s2": thrust})
    expected = acceleration_of(parameters)(states[:, :3].T, states[:, 3:].T).T
    found = np.empty(6)

    for n, state in enumerate(states):
        vehicle = np.array((ballistic[n], *thrust[n]))
        numba_dop853.derive(
            state, found, propagator.model_of(parameters), propagator.air(), vehicle
        )

        assert found[:3].tolist() == state[3:].tolist()
        assert found[3:] == pytest.approx(expected[n], rel=1e-13)


@pytest.mark.slow
@pytest.mark.parametrize("forces", [ALL[:1], ALL[:2], ALL], ids="+".join)
def test_it_agrees_with_scipy_over_four_hours(forces):
    states = fleet(20)
    rest = {"ballistic_m2_kg": np.linspace(0.0, 0.02, 20)}
    knots_s = np.arange(0.0, 14_401.0, 300.0)

    found = propagate(states, 0.0, knots_s, make(forces, rest=rest))

    expected = propagate(states, 0.0, knots_s, make(forces, kind="scipy", rest=rest))
    # Measured: 9e-7.
    assert np.linalg.norm((found - expected)[..., :3], axis=-1).max() < 5e-6
    assert np.linalg.norm((found - expected)[..., 3:], axis=-1).max() < 5e-9


@pytest.mark.parametrize(
    # A wrong term of highest order shows with long steps only.
    ("step_s", "tolerance_m"),
    [(30.0, 2e-8), (120.0, 5e-5)],
)
def test_values_between_steps_are_as_good_as_those_at_their_ends(step_s, tolerance_m):
    states, knots_s = fleet(5), np.arange(1.0, 121.0)
    dense = propagate(states, 0.0, knots_s, make(step_s_max=step_s, rtol=1e-7))

    # Each knot is the end of a call of its own.
    landed = np.stack(
        [propagate(states, 0.0, knots_s[n : n + 1], make())[:, 0] for n in range(len(knots_s))],
        axis=1,
    )

    assert np.linalg.norm((dense - landed)[..., :3], axis=-1).max() < tolerance_m


def test_neighbours_change_no_digit():
    knots_s = np.arange(0.0, 301.0, 10.0)
    states = np.concatenate((fleet(3), fleet(3, a_m=2.6e7, e=0.7)))

    among = propagate(states, 0.0, knots_s, make())

    for n in range(6):
        assert np.array_equal(propagate(states[n : n + 1], 0.0, knots_s, make())[0], among[n])


@pytest.mark.parametrize("threads", [2, 3, 64])
def test_threads_change_no_digit(threads):
    states, knots_s = fleet(20), np.arange(0.0, 61.0)
    rest = {"ballistic_m2_kg": np.linspace(0.0, 0.02, 20), "thrust_m_s2": np.full((20, 3), 1e-3)}

    found = propagate(states, 0.0, knots_s, make(rest=rest, threads=threads))

    assert np.array_equal(found, propagate(states, 0.0, knots_s, make(rest=rest)))


def test_a_smaller_tolerance_gives_a_smaller_error():
    states, end = fleet(5, a_m=1.2e7, e=0.4), np.array([20_000.0])
    best = propagate(states, 0.0, end, make(ALL[:2], rtol=1e-13, step_s_max=20.0))
    errors = []
    for rtol in (1e-7, 1e-9, 1e-11):
        found = propagate(states, 0.0, end, make(ALL[:2], rtol=rtol, step_s_max=1e4))
        errors.append(np.linalg.norm((found - best)[..., :3], axis=-1).max())

    assert errors[0] > 10 * errors[1] > 100 * errors[2]
    assert errors[2] < 0.01


def test_all_failed_vehicles_are_named_up_to_a_limit():
    states = fleet(8)
    states[:7, 5] = math.nan
    parameters = make(rest={"names": tuple("ABCDEFGH")})

    with pytest.raises(ConfigurationError) as error:
        propagator.NumbaDop853().propagate(states, 5.0, np.array([100.0]), parameters)

    lines = str(error.value).splitlines()
    assert lines[0] == "A: numba DOP853 from 5 s: no step passes"
    assert [line[0] for line in lines[:5]] == list("ABCDE")
    assert lines[5] == "and 2 more"


def test_every_function_has_a_cache_of_its_own():
    """numba tells functions in its cache by name and line: two from one factory would share one."""
    functions = [value for value in vars(numba_dop853.load()).values() if hasattr(value, "py_func")]

    places = {(f.py_func.__qualname__, f.py_func.__code__.co_firstlineno) for f in functions}

    assert len(places) == len(functions) == 7
    assert all("<locals>" not in name for name, _ in places)
    # Compiled while imported, for one signature each: nothing is left to be compiled in a job.
    assert all(len(f.signatures) == 1 for f in functions)


def test_tables_have_the_layout_that_the_code_reads():
    table = propagator.tableau()

    assert table.shape == (22, 16)
    # A stage's coefficients add up to its time; the step's own to one.
    assert table[12].sum() == pytest.approx(1.0, abs=1e-14)
    assert table[1].sum() == pytest.approx(0.05260015195876773, abs=1e-16)
    assert table[13:16].sum(axis=1) == pytest.approx([0.1, 0.2, 7 / 9], abs=1e-13)
    assert not np.triu(table[:16]).any()
    # Error estimates of a constant derivative vanish.
    assert table[16:18].sum(axis=1) == pytest.approx([0.0, 0.0], abs=1e-13)
    assert propagator.limits_of(make().settings)[:3].tolist() == [1e-12, 1e-6, 30.0]
    two_body = propagator.model_of(make(ALL[:1]))
    assert two_body[[numba_dop853.K2, numba_dop853.K3, numba_dop853.K4]].tolist() == [0.0] * 3
    assert replace(make(), settings=make(ALL[:2]).settings).has_j2
