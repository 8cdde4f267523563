"""The Hohmann injection against the textbook's figures, and on ten real satellites from their own states."""

import math
from pathlib import Path

import numpy as np
import pytest
from control_harness import SCENARIOS, Fleet, flight_class

from madns_runtime.simulations.constellation.orbit.constants import EGM_96
from madns_runtime.simulations.constellation.orbit.mean_elements import (
    CircularElements,
    state_from_circular,
)
from madns_runtime.simulations.constellation.parameters import (
    ConstellationParameters,
    ElementSetSatellites,
)
from madns_runtime.simulations.constellation.truth.initial_states import load_fleet

APOGEE_M = 42_164e3
LOW_M = 6378.137e3 + 780e3
"""The oracle's radius: 780 km above WGS-84's equator."""
SETTINGS = {"burn_s": 60.0, "lead_s": 3.0}
MODULE = {
    name: flight_class("hohmann.py", name) for name in ("Hohmann", "injection_m_s", "apogee_m")
}


def circle(lam_rad=0.3):
    elements = CircularElements(
        a_m=LOW_M, ex=0.0, ey=0.0, i_rad=math.radians(86.4), raan_rad=0.5, lam_rad=lam_rad
    )
    return state_from_circular(elements, EGM_96.mu_m3_s2)


def distances_km(fleet, until_s):
    found = []
    fleet.run(until_s, lambda _t, states: found.append(np.linalg.norm(states[:, :3], axis=1) / 1e3))
    return np.array(found)


def farthest_km(fleet):
    """Truth's largest distances on the way through the apogee, under J2."""
    fleet.tick_s = 300.0
    fleet.ticks = math.ceil(fleet.t_s / fleet.tick_s)
    found = distances_km(fleet, 20_000.0)
    return found.max(axis=0)


def test_first_burn_from_a_circular_orbit_is_the_textbooks():
    # mu 398600.4418: dv1 = 2295.160 m/s; this gravity model's mu is 7.5e-10 less.
    assert MODULE["injection_m_s"](circle(), APOGEE_M, 0.0) == pytest.approx(2295.160, abs=2e-3)


@pytest.mark.slow
def test_second_burn_comes_after_half_an_ellipse_and_makes_the_orbit_round():
    fleet = Fleet(
        MODULE["Hohmann"],
        [circle()],
        # A short lead: the predictor knows J2, which the textbook's world has not.
        settings=SETTINGS | {"circularise": True, "lead_s": 0.1, "has_j2": False},
        tick_s=3.0,
        forces=("two_body",),
    )

    fleet.run(66.0)
    planned_s = fleet.software[0]._burn_s
    fleet.run(60.0 + 19_271.0 + 60.0)
    first, second = fleet.vehicles[0].commands
    high_km = distances_km(fleet, fleet.t_s + 600.0)

    assert first.vector[1] == pytest.approx(2295.160, abs=2e-3)
    assert second.vector[1] == pytest.approx(1418.164, abs=2e-3)
    assert planned_s - first.at_s == pytest.approx(19_270.76, abs=0.02)
    # In the first tick from then on: this harness's are 3 s long.
    assert second.at_s == pytest.approx(planned_s, abs=3.1)
    assert high_km == pytest.approx(42_164.0, abs=0.1)
    assert fleet.software[0].finish()["delta_v_m_s"] == pytest.approx(2295.160 + 1418.164, abs=4e-3)


@pytest.mark.parametrize("lead_s", [3.0, 0.0])
def test_ten_real_satellites_reach_the_apogee_from_their_own_states(lead_s):
    parameters = ConstellationParameters(
        satellites=ElementSetSatellites(elements="data/iridium10.tle")
    )
    states = load_fleet(parameters, 10, Path(SCENARIOS)).states
    fleet = Fleet(
        MODULE["Hohmann"], states, settings=SETTINGS | {"lead_s": lead_s, "burn_s": 6.0}, tick_s=1.0
    )

    fleet.run(12.0)
    asked = [vehicle.commands[0].vector[1] for vehicle in fleet.vehicles]
    apogees_km = [MODULE["apogee_m"](state, EGM_96.j2) / 1e3 for state in fleet.states]

    assert [len(vehicle.commands) for vehicle in fleet.vehicles] == [1] * 10
    assert {vehicle.commands[0].at_s for vehicle in fleet.vehicles} == {6.0}
    # Their own orbits differ from the circle at 780 km by up to 15 km.
    assert asked == pytest.approx([2295.0] * 10, abs=15.0)
    assert apogees_km == pytest.approx([42_164.0] * 10, abs=3.0)
    assert farthest_km(fleet) == pytest.approx([42_164.0] * 10, abs=10.0)


def test_burn_of_the_wrong_sign_does_not_reach_the_apogee():
    fleet = Fleet(MODULE["Hohmann"], [circle()], settings=SETTINGS, tick_s=3.0, sign=-1.0)

    fleet.run(66.0)

    assert MODULE["apogee_m"](fleet.states[0], EGM_96.j2) < 0.5 * APOGEE_M


def test_burn_time_that_is_over_is_made_up_for_at_once():
    fleet = Fleet(MODULE["Hohmann"], [circle()], settings=SETTINGS | {"burn_s": 0.0}, tick_s=1.0)

    fleet.run(5.0)

    assert [command.at_s for command in fleet.vehicles[0].commands] == [3.0]
