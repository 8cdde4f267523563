"""Truth against authorities, and against what it must conserve."""

import json
import math
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
import sgp4
from constellation_fakes import parameters

from madns_runtime.errors import ConfigurationError
from madns_runtime.simulations.constellation.orbit.constants import EGM_96
from madns_runtime.simulations.constellation.orbit.elements import (
    Elements,
    elements_from_state,
    state_from_elements,
)
from madns_runtime.simulations.constellation.orbit.invariants import (
    ENERGY,
    MOMENTUM,
    MOMENTUM_Z,
    invariants,
)
from madns_runtime.simulations.constellation.parameters import ScipyPropagator
from madns_runtime.simulations.constellation.truth.element_sets import read_element_sets
from madns_runtime.simulations.constellation.truth.propagation import (
    PropagationParameters,
    StretchRequest,
    propagate_stretch,
)
from madns_runtime.simulations.constellation.truth.propagators.scipy_propagator import ScipyDop853
from madns_runtime.simulations.constellation.truth.propagators.sgp4_propagator import sgp4_states
from madns_runtime.simulations.constellation.truth.tle_files import tle_checksum

AUTHORITIES = Path(__file__).parents[1] / "authorities"
TWO_BODY = json.loads((AUTHORITIES / "two_body.json").read_text())
J2_RATES = json.loads((AUTHORITIES / "j2_secular_rates.json").read_text())
EPOCH = datetime(2000, 1, 1, 12, tzinfo=UTC)
POSITION_TOLERANCE_M = 1e-6
"""Over 4 h; measured 4.3e-7. A float64 of GEO's radius resolves 7e-9 m, and errors along track grow with time."""


def propagation(*forces):
    settings = ScipyPropagator(kind="scipy", forces=forces)
    return PropagationParameters(settings=settings, gravity=EGM_96, epoch_utc=EPOCH)


def analytic(orbits, t_s):
    """States of two-body orbits by Kepler's equation."""
    rows = []
    for orbit in orbits:
        mean = orbit.mean_anomaly_rad + math.sqrt(EGM_96.mu_m3_s2 / orbit.a_m**3) * t_s
        r, v = state_from_elements(replace(orbit, mean_anomaly_rad=mean), EGM_96.mu_m3_s2)
        rows.append((*r, *v))
    return np.array(rows)


def two_body_cases():
    cases = TWO_BODY["cases"]
    states = np.array([case["state_m_m_s"] for case in cases])
    table = np.array([case["t_s_and_states"] for case in cases])
    return states, table[0, :, 0], table[:, :, 1:]


def test_the_authoritys_constant_is_ours():
    assert TWO_BODY["mu_m3_s2"] == EGM_96.mu_m3_s2


def test_two_body_truth_in_one_call_agrees_with_the_authority():
    states, t_s, expected = two_body_cases()

    found = ScipyDop853().propagate(states, 0.0, t_s, propagation("two_body"))

    assert np.linalg.norm((found - expected)[..., :3], axis=-1).max() < POSITION_TOLERANCE_M
    assert np.linalg.norm((found - expected)[..., 3:], axis=-1).max() < 2e-9


def test_two_body_truth_window_by_window_agrees_with_the_authority():
    states, t_s, expected = two_body_cases()
    found = {}
    for window in range(144):
        stretch = propagate_stretch(
            StretchRequest(first_knot=window * 100, knots=101, knot_s=1.0, states=states),
            propagation("two_body"),
        )
        for column, t in enumerate(t_s):
            if window * 100 < t <= (window + 1) * 100:
                found[column] = stretch.states[:, round(t) - window * 100]
        states = np.ascontiguousarray(stretch.states[:, -1])

    assert len(found) == len(t_s)
    for column, got in found.items():
        error_m = np.linalg.norm((got - expected[:, column])[:, :3], axis=-1)
        assert error_m.max() < POSITION_TOLERANCE_M


def test_one_vehicle_is_as_accurate_among_a_thousand_as_alone():
    rng = np.random.default_rng(3)
    molniya = Elements(
        a_m=2.66e7, e=0.72, i_rad=1.1, raan_rad=1.0, argp_rad=4.7, mean_anomaly_rad=6.2
    )
    others = [
        Elements(
            a_m=6.9e6 + 1e6 * rng.random(),
            e=0.02 * rng.random(),
            i_rad=3.0 * rng.random(),
            raan_rad=6.0 * rng.random(),
            argp_rad=6.0 * rng.random(),
            mean_anomaly_rad=6.0 * rng.random(),
        )
        for _ in range(999)
    ]
    fleet = [molniya, *others]

    found = ScipyDop853().propagate(
        analytic(fleet, 0.0), 0.0, np.array([14_400.0]), propagation("two_body")
    )

    error_m = np.linalg.norm((found[:, 0] - analytic(fleet, 14_400.0))[:, :3], axis=-1)
    # Measured: 1e-7 for the eccentric one, 7e-7 for the worst of the others.
    assert error_m.max() < 2 * POSITION_TOLERANCE_M


def test_propagating_there_and_back_returns_to_the_start():
    states, _, _ = two_body_cases()
    knots_s = np.array([0.0, 3600.0])
    there = ScipyDop853().propagate(states, 0.0, knots_s, propagation("two_body", "j2"))[:, 1]
    mirrored = there * (1.0, 1.0, 1.0, -1.0, -1.0, -1.0)

    back = ScipyDop853().propagate(mirrored, 0.0, knots_s, propagation("two_body", "j2"))[:, 1]

    assert np.linalg.norm((back - states)[:, :3], axis=-1).max() < POSITION_TOLERANCE_M


def j2_orbit(altitude_km, i_deg, knots_s):
    orbit = Elements(
        a_m=EGM_96.radius_m + altitude_km * 1000.0,
        e=0.001,
        i_rad=math.radians(i_deg),
        raan_rad=0.0,
        argp_rad=1.0,
        mean_anomaly_rad=0.0,
    )
    forces = propagation("two_body", "j2")
    return ScipyDop853().propagate(analytic([orbit], 0.0), 0.0, knots_s, forces)[0]


@pytest.mark.slow
@pytest.mark.parametrize("rate", J2_RATES["rates"], ids=lambda r: f"{r['altitude_km']} km")
def test_j2_turns_the_node_at_the_authoritys_rate(rate):
    knots_s = np.arange(0.0, 86_401.0, 60.0)
    states = j2_orbit(rate["altitude_km"], rate["i_deg"], knots_s).tolist()
    raan = [elements_from_state(s[:3], s[3:], EGM_96.mu_m3_s2).raan_rad for s in states]

    slope = math.degrees(np.polyfit(knots_s, np.unwrap(raan), 1)[0]) * 86_400.0

    # The mean semi-major axis differs from the osculating one at the start: up to 0.44 %.
    assert slope == pytest.approx(rate["node_deg_day"], rel=0.0044)


@pytest.mark.slow
def test_j2_turns_the_node_of_iridium_at_about_the_stated_rate():
    about = J2_RATES["about_780_km_86_4_deg"]
    knots_s = np.arange(0.0, 86_401.0, 60.0)
    states = j2_orbit(780.0, 86.4, knots_s).tolist()
    raan = [elements_from_state(s[:3], s[3:], EGM_96.mu_m3_s2).raan_rad for s in states]

    slope = math.degrees(np.polyfit(knots_s, np.unwrap(raan), 1)[0]) * 86_400.0

    assert slope == pytest.approx(about["node_deg_day"], abs=about["within_deg_day"])


@pytest.mark.slow
def test_perigee_stays_at_the_critical_inclination_and_turns_elsewhere():
    knots_s = np.arange(0.0, 86_401.0, 120.0)
    turned = {}
    for i_deg in (63.4349488, 28.5):
        orbit = Elements(
            a_m=9.0e6,
            e=0.2,
            i_rad=math.radians(i_deg),
            raan_rad=0.0,
            argp_rad=1.0,
            mean_anomaly_rad=0.0,
        )
        states = ScipyDop853().propagate(
            analytic([orbit], 0.0), 0.0, knots_s, propagation("two_body", "j2")
        )[0]
        argp = [
            elements_from_state(s[:3], s[3:], EGM_96.mu_m3_s2).argp_rad for s in states.tolist()
        ]
        turned[i_deg] = math.degrees(np.polyfit(knots_s, np.unwrap(argp), 1)[0]) * 86_400.0
    n = math.sqrt(EGM_96.mu_m3_s2 / 9.0e6**3)
    p = 9.0e6 * (1.0 - 0.04)
    cosine = math.cos(math.radians(28.5))
    scale = math.degrees(n * EGM_96.j2 * (EGM_96.radius_m / p) ** 2) * 86_400.0
    expected = 0.75 * scale * (5.0 * cosine**2 - 1.0)

    assert abs(turned[63.4349488]) < 0.01
    assert turned[28.5] == pytest.approx(expected, rel=0.01)


def test_j2_truth_conserves_energy_with_its_potential_and_momentum_about_the_pole():
    states = j2_orbit(780.0, 86.4, np.arange(0.0, 14_401.0, 10.0))

    values = invariants(states, EGM_96, with_j2=True)
    without = invariants(states, EGM_96, with_j2=False)

    energy = values[:, ENERGY]
    assert np.abs(energy / energy[0] - 1.0).max() < 1e-13
    assert np.abs(values[:, MOMENTUM_Z] - values[0, MOMENTUM_Z]).max() < 1e-14 * values[0, MOMENTUM]
    # Without the whole potential the same orbit seems to swing by a thousandth.
    assert np.abs(without[:, ENERGY] / without[0, ENERGY] - 1.0).max() > 1e-3


def test_acceleration_is_the_gradient_of_the_potential():
    state = np.array([[4.0e6, -3.0e6, 5.0e6, 0.0, 0.0, 0.0]])
    step_m = 10.0
    gradient = []
    for axis in range(3):
        shift = np.zeros(6)
        shift[axis] = step_m
        up = invariants(state + shift, EGM_96, with_j2=True)[0, ENERGY]
        down = invariants(state - shift, EGM_96, with_j2=True)[0, ENERGY]
        gradient.append((up - down) / (2.0 * step_m))

    # From rest, v = a t for a short time.
    after = ScipyDop853().propagate(state, 0.0, np.array([1e-2]), propagation("two_body", "j2"))[
        0, 0
    ]

    assert after[3:] / 1e-2 == pytest.approx(-np.array(gradient), rel=1e-8)


UNPROPAGATED = "33334"
"""The one set of the vectors that exists to be refused."""


def verification_cases():
    """The sgp4 package's own vectors: sets from SGP4-VER.TLE, states from tcppver.out."""
    folder = Path(sgp4.__file__).parent
    lines = [
        line for line in (folder / "SGP4-VER.TLE").read_text().splitlines() if line[:1] in "12"
    ]
    expected, current = {}, None
    for line in (folder / "tcppver.out").read_text().splitlines():
        words = line.split()
        if len(words) == 2 and words[1] == "xx":
            current = expected.setdefault(int(words[0]), [])
        elif len(words) >= 7 and current is not None:
            current.append([float(word) for word in words[:7]])
    sets = {}
    for first, second in zip(lines[::2], lines[1::2], strict=True):
        sets.setdefault(int(first[2:7]), (first[:69], second[:69]))
    return {number: (sets[number], rows) for number, rows in expected.items() if rows}


def test_sgp4_agrees_with_the_verification_vectors(tmp_path):
    cases = verification_cases()
    compared, worst_km, worst_km_s = 0, 0.0, 0.0
    for (first, second), rows in cases.values():
        # Some of these lines carry no right checksum; that is not what they are here for.
        path = tmp_path / "one.tle"
        path.write_text("\n".join(line[:68] + str(tle_checksum(line)) for line in (first, second)))
        table = np.array(rows)
        if first[2:7] == UNPROPAGATED:
            with pytest.raises(
                ConfigurationError, match=r":2: MEAN_MOTION: expected .* 0\.00001000"
            ):
                read_element_sets(path)
            continue
        sets = read_element_sets(path)
        states = sgp4_states(sets, sets[0].epoch_utc, table[:, 0] * 60.0)[0] / 1000.0
        compared += len(rows)
        worst_km = max(worst_km, float(np.abs(states[:, :3] - table[:, 1:4]).max()))
        worst_km_s = max(worst_km_s, float(np.abs(states[:, 3:] - table[:, 4:7]).max()))

    assert len(cases) >= 30
    assert compared > 600
    # The vectors are printed to 1e-8 km and 1e-9 km/s by another compiler's mathematics.
    assert worst_km < 1.3e-7
    assert worst_km_s < 2e-9


def test_epoch_and_parameters_default_to_named_constants():
    params = parameters()

    assert params.frame == "TEME"
    assert params.gravity == "EGM-96"
