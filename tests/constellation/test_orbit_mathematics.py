"""Elements, Kepler's equation, Hermite interpolation."""

import math
from dataclasses import astuple, replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from madns_runtime.simulations.constellation.orbit.constants import EGM_96, GRAVITY_MODELS
from madns_runtime.simulations.constellation.orbit.elements import (
    ConvergenceError,
    Elements,
    elements_from_state,
    mean_from_true,
    solve_kepler,
    state_from_elements,
    true_from_eccentric,
)
from madns_runtime.simulations.constellation.orbit.interpolation import (
    coefficients,
    evaluate,
    interpolate,
)

MU = EGM_96.mu_m3_s2
ANGLES = st.floats(0.0, math.tau, exclude_max=True)
ORBIT = Elements(a_m=7.158e6, e=0.01, i_rad=1.5, raan_rad=0.7, argp_rad=2.0, mean_anomaly_rad=4.0)


def angle_between(a, b):
    return abs(math.remainder(a - b, math.tau))


@given(mean=st.floats(-100.0, 100.0), e=st.floats(0.0, 0.9999))
def test_keplers_equation_is_solved_for_every_ellipse(mean, e):
    eccentric = solve_kepler(mean, e)

    assert angle_between(eccentric - e * math.sin(eccentric), mean) < 1e-13


@pytest.mark.parametrize("e", [1.0, 1.5, -0.1, math.nan])
def test_what_is_no_ellipse_is_refused(e):
    with pytest.raises(ConvergenceError, match="eccentricity"):
        solve_kepler(1.0, e)


@pytest.mark.parametrize(
    ("mean", "open_by"),
    [
        (1.1046391421946006e-10, 2.6309970259e-7),
        (2.0621698581552357e-16, 1.5244e-12),
        (1.3e-23, 4e-16),
    ],
)
def test_keplers_equation_is_solved_at_the_perigee_of_the_longest_ellipses(mean, open_by):
    e = 1.0 - open_by

    eccentric = solve_kepler(mean, e)

    # E - sin E by its series, as the difference of two nearly equal numbers would lose its digits.
    solved = (1.0 - e) * eccentric + e * (eccentric**3 / 6.0 - eccentric**5 / 120.0)
    assert solved == pytest.approx(mean, rel=1e-9, abs=4e-16 * eccentric)


@given(eccentric=st.floats(-3.1, 3.1), e=st.floats(0.0, 0.95))
def test_mean_anomaly_of_true_anomaly_is_keplers(eccentric, e):
    nu = true_from_eccentric(eccentric, e)

    assert mean_from_true(nu, e) == pytest.approx(eccentric - e * math.sin(eccentric), abs=1e-13)


@given(
    st.builds(
        Elements,
        a_m=st.floats(6.6e6, 5e7),
        e=st.floats(0.0, 0.9),
        i_rad=st.floats(0.0, math.pi),
        raan_rad=ANGLES,
        argp_rad=ANGLES,
        mean_anomaly_rad=ANGLES,
    )
)
def test_elements_and_state_are_each_others_inverse(orbit):
    r, v = state_from_elements(orbit, MU)

    found = elements_from_state(r, v, MU)
    again_r, again_v = state_from_elements(found, MU)

    # State to elements to state holds for circular and equatorial orbits too; what float64 resolves
    # grows with eccentricity, and where perigee or node is dropped 1e-11 of the radius is.
    assert math.dist(r, again_r) < 1e-9 * orbit.a_m
    assert math.dist(v, again_v) < 1e-9 * math.hypot(*v)
    assert found.a_m == pytest.approx(orbit.a_m, rel=1e-12)
    assert found.e == pytest.approx(orbit.e, abs=1e-10)
    assert found.i_rad == pytest.approx(orbit.i_rad, abs=1e-7)
    assert all(0.0 <= angle < math.tau for angle in astuple(found)[3:])


def test_ordinary_elements_come_back_one_by_one():
    r, v = state_from_elements(ORBIT, MU)

    assert astuple(elements_from_state(r, v, MU)) == pytest.approx(astuple(ORBIT), rel=1e-12)


def test_a_circular_orbits_anomaly_counts_from_the_node():
    orbit = replace(ORBIT, e=0.0, argp_rad=0.0)
    r, v = state_from_elements(orbit, MU)

    found = elements_from_state(r, v, MU)

    assert (found.e, found.argp_rad) == (0.0, 0.0)
    assert found.mean_anomaly_rad == pytest.approx(4.0, abs=1e-12)


def test_an_equatorial_orbits_perigee_counts_from_the_x_axis():
    orbit = replace(ORBIT, i_rad=0.0, raan_rad=0.0)
    r, v = state_from_elements(orbit, MU)

    found = elements_from_state(r, v, MU)

    assert (found.i_rad, found.raan_rad) == (0.0, 0.0)
    assert found.argp_rad == pytest.approx(2.0, abs=1e-12)
    assert found.mean_anomaly_rad == pytest.approx(4.0, abs=1e-12)


def test_a_circular_equatorial_orbits_anomaly_counts_from_the_x_axis():
    speed = math.sqrt(MU / 7e6)

    for retrograde in (False, True):
        sign = -1.0 if retrograde else 1.0
        found = elements_from_state((0.0, 7e6, 0.0), (-sign * speed, 0.0, 0.0), MU)
        r, v = state_from_elements(found, MU)

        assert (found.e, found.raan_rad, found.argp_rad) == (0.0, 0.0, 0.0)
        assert found.i_rad == (math.pi if retrograde else 0.0)
        assert math.dist(r, (0.0, 7e6, 0.0)) < 1e-7
        assert math.dist(v, (-sign * speed, 0.0, 0.0)) < 1e-10


@pytest.mark.parametrize("v", [(0.0, 12_000.0, 0.0), (1000.0, 0.0, 0.0)])
def test_a_state_without_an_ellipse_is_refused(v):
    with pytest.raises(ValueError, match="bound orbit"):
        elements_from_state((7e6, 0.0, 0.0), v, MU)


def orbit_states(times_s):
    n = math.sqrt(MU / ORBIT.a_m**3)
    rows = []
    for t in times_s:
        moved = replace(ORBIT, e=0.0, mean_anomaly_rad=n * float(t))
        r, v = state_from_elements(moved, MU)
        rows.append((*r, *v))
    return np.array(rows)


@pytest.mark.parametrize(
    ("knot_s", "error_m", "error_m_s"), [(1.0, 2.6e-8, 7e-8), (10.0, 2.2e-4, 7e-5)]
)
def test_interpolation_errs_as_its_formula_says(knot_s, error_m, error_m_s):
    times_s = np.arange(0.0, 20.0 * knot_s, knot_s / 7.0)

    found = interpolate(orbit_states(np.arange(21) * knot_s), times_s, t0_s=0.0, knot_s=knot_s)

    error = found - orbit_states(times_s)
    assert np.linalg.norm(error[:, :3], axis=1).max() < error_m
    assert np.linalg.norm(error[:, 3:], axis=1).max() < error_m_s


def test_one_at_a_time_and_all_at_once_are_the_same():
    knots = orbit_states(np.arange(2) * 1.0)
    cubics = coefficients(knots[0].tolist(), knots[1].tolist(), 1.0)

    for s in (0.0, 0.1, 0.5, 0.999, 1.0):
        one = evaluate(cubics, s, 1.0)
        many = interpolate(knots, np.array([s]), t0_s=0.0, knot_s=1.0)[0]
        assert one == pytest.approx(many, rel=1e-13)


def test_knots_themselves_come_back():
    knots = orbit_states(np.arange(5) * 2.0)

    found = interpolate(knots, np.arange(5) * 2.0, t0_s=0.0, knot_s=2.0)

    assert np.abs(found - knots)[:, :3].max() < 4e-9
    assert np.abs(found - knots)[:, 3:].max() < 4e-9


def test_times_outside_the_knots_are_refused():
    with pytest.raises(ValueError, match="within 1 intervals"):
        interpolate(orbit_states(np.arange(2)), np.array([1.5]), t0_s=0.0, knot_s=1.0)


def test_gravity_models_are_found_by_the_name_they_carry():
    assert all(name == model.name for name, model in GRAVITY_MODELS.items())
