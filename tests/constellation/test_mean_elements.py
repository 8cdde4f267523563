"""Mean elements: what stays under J2 truth, how fast it turns, and that both maps are each other's inverse."""

import math
from dataclasses import astuple, replace
from datetime import UTC, datetime

import numpy as np
import pytest

from madns_runtime.simulations.constellation.orbit.constants import EGM_96
from madns_runtime.simulations.constellation.orbit.elements import elements_from_state
from madns_runtime.simulations.constellation.orbit.mean_elements import (
    CircularElements,
    mean_from_osculating,
    mean_from_state,
    osculating_from_mean,
    osculating_from_state,
    secular_rates,
    state_from_circular,
    wrapped,
)
from madns_runtime.simulations.constellation.parameters import ScipyPropagator
from madns_runtime.simulations.constellation.truth.propagation import PropagationParameters
from madns_runtime.simulations.constellation.truth.propagators.scipy_propagator import ScipyDop853

MU = EGM_96.mu_m3_s2
ORBITS_S = 5 * 6030.0
MEAN = CircularElements(
    a_m=EGM_96.radius_m + 780e3,
    ex=4e-4,
    ey=-7e-4,
    i_rad=math.radians(86.4),
    raan_rad=1.2,
    lam_rad=0.7,
)


def truth(mean, every_s=60.0):
    """Return times and states of J2 truth from mean elements."""
    start = state_from_circular(osculating_from_mean(mean, EGM_96), MU)
    times_s = np.arange(0.0, ORBITS_S, every_s)
    parameters = PropagationParameters(
        settings=ScipyPropagator(kind="scipy"),
        gravity=EGM_96,
        epoch_utc=datetime(2020, 1, 1, tzinfo=UTC),
    )
    states = ScipyDop853().propagate(np.array([start]), 0.0, times_s, parameters)[0]
    return times_s, states.tolist()


def means(states):
    return [mean_from_state(tuple(s[:3]), tuple(s[3:]), EGM_96) for s in states]


@pytest.mark.slow
@pytest.mark.parametrize("i_deg", [30.0, 60.0, 86.4, 97.4])
def test_mean_semi_major_axis_holds_to_tens_of_metres_where_the_osculating_one_swings(i_deg):
    _, states = truth(replace(MEAN, i_rad=math.radians(i_deg)))
    osculating = [osculating_from_state(tuple(s[:3]), tuple(s[3:]), MU).a_m for s in states]
    mean = [m.a_m for m in means(states)]

    swing = 3.0 * EGM_96.j2 * EGM_96.radius_m**2 / MEAN.a_m * math.sin(math.radians(i_deg)) ** 2

    of_map = [
        mean_from_osculating(osculating_from_state(tuple(s[:3]), tuple(s[3:]), MU), EGM_96).a_m
        for s in states
    ]

    # 18 km at 780 km and 86.4 deg; first order leaves the map some J2^2 a = 8 m, the energy centimetres.
    assert np.ptp(osculating) == pytest.approx(swing, rel=0.02)
    assert np.ptp(of_map) < 40.0
    assert np.ptp(mean) < 0.1
    assert np.mean(mean) == pytest.approx(MEAN.a_m, abs=20.0)


@pytest.mark.slow
@pytest.mark.parametrize("i_deg", [30.0, 53.0, 86.4])
def test_mean_argument_of_latitude_and_node_turn_at_the_rates_of_theory(i_deg):
    mean = replace(MEAN, i_rad=math.radians(i_deg))
    times_s, states = truth(mean)
    found = means(states)
    rates = secular_rates(mean, EGM_96)

    lam = np.unwrap([m.lam_rad for m in found])
    raan = np.unwrap([m.raan_rad for m in found])
    slope, residual_deg = straight(times_s, lam)
    node_slope, node_residual_deg = straight(times_s, raan)

    # First order leaves some J2^2 = 1.2e-6 of the rate, some J2 of the node's; residuals are of the order J2 e.
    assert slope == pytest.approx(rates.lam_rad_s, rel=1e-5)
    assert residual_deg < 1e-3
    assert node_slope == pytest.approx(rates.raan_rad_s, rel=3e-3)
    assert node_residual_deg < 3e-4


def straight(times_s, angles_rad):
    """Return the slope of a straight line through angles, rad/s, and how far they lie beside it, deg."""
    line = np.polyfit(times_s, angles_rad, 1)
    return line[0], np.degrees(np.abs(angles_rad - np.polyval(line, times_s)).max())


def test_the_node_of_iridium_turns_at_its_published_rate():
    rate = secular_rates(MEAN, EGM_96).raan_rad_s

    assert math.degrees(rate) * 86_400 == pytest.approx(-0.4157, abs=0.003)


def test_two_maps_are_each_others_inverse_down_to_circular_orbits():
    for ex, ey in ((0.0, 0.0), (1e-6, -1e-6), (2e-3, 1e-3), (0.05, 0.0)):
        mean = replace(MEAN, ex=ex, ey=ey)

        back = mean_from_osculating(osculating_from_mean(mean, EGM_96), EGM_96)

        assert back.a_m == pytest.approx(mean.a_m, abs=1e-3)
        assert astuple(back)[1:5] == pytest.approx(astuple(mean)[1:5], abs=1e-8)
        assert wrapped(back.lam_rad - mean.lam_rad) == pytest.approx(0.0, abs=1e-8)


def test_state_of_circular_elements_has_the_classical_elements_too():
    elements = replace(MEAN, ex=0.03, ey=0.04)

    state = state_from_circular(elements, MU)
    classical = elements_from_state(state[:3], state[3:], MU)
    found = osculating_from_state(state[:3], state[3:], MU)

    assert classical.a_m == pytest.approx(elements.a_m, rel=1e-12)
    assert classical.e == pytest.approx(0.05, abs=1e-12)
    assert classical.argp_rad == pytest.approx(math.atan2(0.04, 0.03), abs=1e-10)
    latitude = classical.argp_rad + classical.mean_anomaly_rad
    assert wrapped(latitude - elements.lam_rad) == pytest.approx(0.0, abs=1e-10)
    assert astuple(found) == pytest.approx(astuple(elements), rel=1e-11)


def test_orbit_that_is_no_ellipse_is_refused():
    with pytest.raises(ValueError, match="bound orbit"):
        mean_from_state((7e6, 0.0, 0.0), (0.0, 8e3, 8e3), EGM_96)
    with pytest.raises(ValueError, match="node"):
        mean_from_state((7e6, 0.0, 0.0), (0.0, 7.5e3, 0.0), EGM_96)


def test_who_has_all_but_stopped_has_no_mean_elements():
    # Osculating an ellipse, of which J2's swing leaves none.
    r_m = (-13859434.306529447, 23354063.171546113, 399018.1303012041)
    v_m_s = (75.8011138923843, -92.33637790826799, -168.74614708607203)

    with pytest.raises(ValueError, match="expected mean elements of an ellipse"):
        mean_from_state(r_m, v_m_s, EGM_96)
