"""Forces against potentials, analytic rates and published numbers."""

import math
from dataclasses import replace
from datetime import UTC, datetime

import numpy as np
import pytest
from sgp4 import earth_gravity

from madns_runtime.simulations.constellation.orbit.atmosphere import (
    BASES,
    SCALE_HEIGHTS_M,
    density_kg_m3,
    height_m,
)
from madns_runtime.simulations.constellation.orbit.constants import (
    EARTH_FLATTENING,
    EARTH_RATE_RAD_S,
    EGM_96,
    GRAVITY_MODELS,
    WGS_72,
    WGS_84,
)
from madns_runtime.simulations.constellation.orbit.elements import elements_from_state
from madns_runtime.simulations.constellation.orbit.invariants import (
    ENERGY,
    MOMENTUM,
    MOMENTUM_Z,
    specific_energy,
)
from madns_runtime.simulations.constellation.parameters import NumbaPropagator, ScipyPropagator
from madns_runtime.simulations.constellation.truth.propagation import (
    PropagationParameters,
    conserved_by,
    propagate,
)
from madns_runtime.simulations.constellation.truth.propagators.forces import (
    FORCES,
    acceleration_of,
    two_body,
)

ALL = ("two_body", "j2", "j3", "j4", "drag")
PUBLISHED_SCALE_HEIGHTS_KM = (
    7.249, 6.349, 6.682, 7.554, 8.382, 7.714, 6.549, 5.799, 5.382, 5.877, 7.263, 9.473, 12.636,
    16.149, 22.523, 29.740, 37.105, 45.546, 53.628, 53.298, 58.515, 60.828, 63.822, 71.835, 88.667,
    124.64, 181.05, 268.00,
)  # fmt: skip
"""Vallado, 4th ed., table 8-4: what the program computes from densities instead."""


def with_forces(*forces, settings=None, **rest):
    settings = ScipyPropagator(kind="scipy", forces=forces, **(settings or {}))
    epoch = datetime(2000, 1, 1, 12, tzinfo=UTC)
    return PropagationParameters(settings=settings, gravity=EGM_96, epoch_utc=epoch, **rest)


def places(count=20):
    rng = np.random.default_rng(11)
    r = rng.normal(size=(count, 3))
    return r / np.linalg.norm(r, axis=1, keepdims=True) * rng.uniform(6.6e6, 9e6, (count, 1))


def potential(r, force):
    """Energy at rest, of the one force."""
    at_rest = np.concatenate((r, np.zeros(3)))
    whole = specific_energy(at_rest, EGM_96, with_j2=force == "j2", also=(force,))
    return float(whole - specific_energy(at_rest, EGM_96, with_j2=False))


@pytest.mark.parametrize("force", ["j2", "j3", "j4"])
def test_harmonics_are_gradients_of_their_potentials(force):
    step_m = 200.0
    parameters = with_forces("two_body", force)
    for r in places():
        gradient = []
        for axis in np.eye(3):
            near = [potential(r + n * step_m * axis, force) for n in (-2, -1, 1, 2)]
            gradient.append((near[0] - 8 * near[1] + 8 * near[2] - near[3]) / (12 * step_m))
        column = r[:, None]

        found = FORCES[force](column, np.sum(column**2, axis=0), np.zeros((3, 1)), parameters)[:, 0]

        # What the whole potential's digits leave of a difference of its smallest part.
        assert found == pytest.approx(-np.array(gradient), abs=2e-10, rel=1e-7)
        assert np.linalg.norm(found) > 1e-7


def legendre_potential(r, degree, value):
    """Written down another way: numpy's Legendre series."""
    radius = float(np.linalg.norm(r))
    series = np.polynomial.legendre.Legendre.basis(degree)
    ratio = (EGM_96.radius_m / radius) ** degree
    return EGM_96.mu_m3_s2 / radius * value * ratio * series(r[2] / radius)


@pytest.mark.parametrize(("degree", "force"), [(2, "j2"), (3, "j3"), (4, "j4")])
def test_potentials_are_legendres(degree, force):
    for r in places():
        expected = legendre_potential(r, degree, getattr(EGM_96, force))

        assert potential(r, force) == pytest.approx(expected, abs=5e-8)


def test_constants_are_those_of_their_sources():
    assert pytest.approx(-math.sqrt(5.0) * -0.484165371736e-3, rel=1e-15) == EGM_96.j2
    assert pytest.approx(-math.sqrt(7.0) * 0.957254173792e-6, rel=1e-15) == EGM_96.j3
    assert pytest.approx(-math.sqrt(9.0) * 0.539873863789e-6, rel=1e-15) == EGM_96.j4
    assert (WGS_84.j3, WGS_84.j4) == (EGM_96.j3, EGM_96.j4)
    sgp4s = earth_gravity.wgs72
    assert (WGS_72.j2, WGS_72.j3, WGS_72.j4) == (sgp4s.j2, sgp4s.j3, sgp4s.j4)
    # Of one Earth: no sign or digit is out of place.
    for model in GRAVITY_MODELS.values():
        assert model.j3 == pytest.approx(-2.53e-6, rel=5e-3)
        assert model.j4 == pytest.approx(-1.62e-6, rel=3e-2)


def inclined_orbit(a_m=7.0e6, i_rad=1.2):
    speed = math.sqrt(EGM_96.mu_m3_s2 / a_m)
    return np.array([[a_m, 0, 0, 0, speed * math.cos(i_rad), speed * math.sin(i_rad)]])


@pytest.mark.parametrize("kind", [ScipyPropagator, NumbaPropagator])
def test_energy_and_axial_momentum_stay_under_all_harmonics(kind):
    name = kind.__name__.removesuffix("Propagator").lower()
    if name == "numba":
        pytest.importorskip("numba")
    settings = kind(kind=name, forces=ALL[:4])
    parameters = replace(with_forces(*ALL[:4]), settings=settings)
    states = propagate(inclined_orbit(), 0.0, np.arange(0.0, 14_401.0, 60.0), parameters)

    values = conserved_by(states, parameters)[0]
    without_j4 = replace(parameters, settings=replace(settings, forces=ALL[:3]))

    assert np.abs(values[:, ENERGY] / values[0, ENERGY] - 1.0).max() < 1e-13
    drift = np.abs(values[:, MOMENTUM_Z] - values[0, MOMENTUM_Z]).max()
    assert drift < 1e-13 * values[0, MOMENTUM]
    wrong = conserved_by(states, without_j4)[0, :, ENERGY]
    assert np.abs(wrong / wrong[0] - 1.0).max() > 1e-7


@pytest.mark.slow
def test_j3_makes_the_eccentricity_of_a_frozen_orbit():
    """First order: omega stays at 90 deg where e = -J3 R sin i / (2 J2 a)."""
    a_m, i_rad = 7.2e6, math.radians(98.0)
    frozen = -EGM_96.j3 / (2.0 * EGM_96.j2) * EGM_96.radius_m / a_m * math.sin(i_rad)
    coarse = {"rtol": 1e-9, "step_s_max": 300.0}
    vectors = {}
    for forces in (("two_body", "j2"), ("two_body", "j2", "j3")):
        knots_s = np.arange(0.0, 5 * 86_400.0, 600.0)
        parameters = with_forces(*forces, settings=coarse)
        states = propagate(inclined_orbit(a_m, i_rad), 0.0, knots_s, parameters)[0]
        elements = [elements_from_state(s[:3], s[3:], EGM_96.mu_m3_s2) for s in states.tolist()]
        vectors[forces[-1]] = np.array([e.e * math.sin(e.argp_rad) for e in elements])

    # e sin(omega) swings about the frozen value, and moves towards it from the same start.
    lead = (vectors["j3"] - vectors["j2"])[-144:].mean()

    rate = 3.0 * math.sqrt(EGM_96.mu_m3_s2 / a_m**3) * EGM_96.j2 * (EGM_96.radius_m / a_m) ** 2
    turned = rate * (1.0 - 1.25 * math.sin(i_rad) ** 2) * 4.5 * 86_400.0
    assert lead == pytest.approx(frozen * (1.0 - math.cos(turned)), rel=0.05)


def test_density_is_the_tables_at_its_heights_and_continuous_between():
    for number, (height_km, density) in enumerate(BASES):
        at_m = height_km * 1000.0

        assert density_kg_m3(np.array([at_m]))[0] == pytest.approx(density, rel=1e-12)
        if number:
            below, above = density_kg_m3(np.array([at_m - 1e-3, at_m + 1e-3]))
            assert below == pytest.approx(above, rel=1e-6)


def test_scale_heights_are_the_tables_own():
    for found_m, expected_km in zip(SCALE_HEIGHTS_M, PUBLISHED_SCALE_HEIGHTS_KM, strict=True):
        assert found_m / 1000.0 == pytest.approx(expected_km, rel=4e-4)


def test_below_the_ground_the_air_is_no_denser():
    assert density_kg_m3(np.array([-1e5, 0.0])).tolist() == [1.225, 1.225]


def test_height_is_above_the_ellipsoid():
    for latitude_deg in range(-90, 91, 15):
        # The point of geodetic latitude and 500 km, by the ellipsoid's own formulas.
        latitude = math.radians(latitude_deg)
        e2 = EARTH_FLATTENING * (2.0 - EARTH_FLATTENING)
        normal = WGS_84.radius_m / math.sqrt(1.0 - e2 * math.sin(latitude) ** 2)
        across = (normal + 5e5) * math.cos(latitude)
        along = (normal * (1.0 - e2) + 5e5) * math.sin(latitude)
        r = np.array([[across], [0.0], [along]])

        found = height_m(r, np.sum(r**2, axis=0), WGS_84.radius_m)[0]

        assert found == pytest.approx(5e5, abs=80.0)


def test_air_that_turns_along_does_not_drag():
    r = np.array([[6.9e6], [1e5], [2e5]])
    along = np.array([[-EARTH_RATE_RAD_S * 1e5], [EARTH_RATE_RAD_S * 6.9e6], [0.0]])
    parameters = with_forces("two_body", "drag", ballistic_m2_kg=np.array([0.02]))

    still = FORCES["drag"](r, np.sum(r**2, axis=0), along, parameters)

    assert np.abs(still).max() == 0.0


@pytest.mark.parametrize("kind", [ScipyPropagator, NumbaPropagator])
@pytest.mark.parametrize("sense", [1.0, -1.0], ids=["with the Earth", "against it"])
def test_a_circular_equatorial_orbit_decays_at_the_analytic_rate(kind, sense):
    """dE/dt = -B rho w^2 v / 2, with w the speed against air that turns with the Earth."""
    name = kind.__name__.removesuffix("Propagator").lower()
    if name == "numba":
        pytest.importorskip("numba")
    a_m, ballistic, density = EGM_96.radius_m + 400e3, 1e-3, 3.725e-12
    speed = math.sqrt(EGM_96.mu_m3_s2 / a_m)
    period_s = math.tau * a_m / speed
    parameters = replace(
        with_forces("two_body", "drag", ballistic_m2_kg=np.array([ballistic])),
        settings=kind(kind=name, forces=("two_body", "drag")),
    )

    end = propagate(
        np.array([[a_m, 0, 0, 0, sense * speed, 0]]), 0.0, np.array([period_s]), parameters
    )[0]

    lost = specific_energy(end, EGM_96, with_j2=False)[0] + speed**2 / 2.0
    against = speed - sense * EARTH_RATE_RAD_S * a_m
    # The metre that it sinks makes air denser by 2e-5.
    expected = -0.5 * ballistic * density * against**2 * speed * period_s
    assert lost == pytest.approx(expected, rel=5e-5)
    # The same as semi-major axis: about a metre a revolution.
    sunk = lost * 2.0 * a_m**2 / EGM_96.mu_m3_s2
    assert sunk == pytest.approx(-math.tau * ballistic * density * a_m**2, rel=0.15)


def test_an_inclined_eccentric_orbit_loses_what_drag_does_along_it():
    states = inclined_orbit(6.9e6, 1.1)
    states[0, 3:] *= 0.995
    t_s = np.arange(0.0, 6001.0, 5.0)
    path = propagate(states, 0.0, t_s, with_forces("two_body"))[0]
    power = []
    for x, y, z, *v in path.tolist():
        distance = math.sqrt(x * x + y * y + z * z)
        height_km = (
            distance - EGM_96.radius_m * (1 - EARTH_FLATTENING * (z / distance) ** 2)
        ) / 1e3
        layer = max(n for n, (base_km, _) in enumerate(BASES) if base_km <= height_km)
        base_km, density = BASES[layer]
        density *= math.exp((base_km - height_km) / PUBLISHED_SCALE_HEIGHTS_KM[layer])
        wind = np.array(v) - np.cross((0.0, 0.0, EARTH_RATE_RAD_S), (x, y, z))
        power.append(-0.5 * 1e-3 * density * np.linalg.norm(wind) * float(wind @ v))
    expected = 5.0 * (math.fsum(power) - 0.5 * (power[0] + power[-1]))

    parameters = with_forces("two_body", "drag", ballistic_m2_kg=np.array([1e-3]))
    end = propagate(states, 0.0, t_s, parameters)[0]

    energy = specific_energy(end, EGM_96, with_j2=False)
    assert energy[-1] - energy[0] == pytest.approx(expected, rel=1e-3)


def test_thrust_adds_to_the_sum():
    thrust = np.array([[1.0, 2.0, 3.0], [0.0, 0.0, -1.0]])
    r, v = places(2).T, np.zeros((3, 2))

    found = acceleration_of(with_forces("two_body", thrust_m_s2=thrust))(r, v)

    gravity = two_body(r, np.sum(r**2, axis=0), v, with_forces("two_body"))
    assert found == pytest.approx(gravity + thrust.T)


def test_a_force_named_twice_acts_once():
    r, v = places(3).T, np.zeros((3, 3))

    twice = acceleration_of(with_forces("two_body", "j2", "j2"))(r, v)

    assert np.array_equal(twice, acceleration_of(with_forces("two_body", "j2"))(r, v))
