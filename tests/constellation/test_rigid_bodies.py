"""Rigid bodies against what is conserved, what has a closed solution, and what the orbit does to them."""

import math
from datetime import UTC, datetime

import numpy as np
import pytest

from madns_runtime.simulations.constellation.equipment import Attitude
from madns_runtime.simulations.constellation.orbit.constants import EGM_96
from madns_runtime.simulations.constellation.orbit.quaternions import (
    IDENTITY,
    from_rotation,
    multiply,
    normalised,
    rotate,
    rotate_back,
    rotation_between,
)
from madns_runtime.simulations.constellation.parameters import ScipyPropagator
from madns_runtime.simulations.constellation.truth.propagation import (
    PropagationParameters,
    load_propagator,
)
from madns_runtime.simulations.constellation.truth.propagators.attitude import (
    ATTITUDE,
    propagate_attitude,
)
from madns_runtime.simulations.constellation.truth.propagators.rigid_body import (
    RigidBody,
    initial_attitude,
)

RADIUS_M = EGM_96.radius_m + 780e3
MOTION_RAD_S = math.sqrt(EGM_96.mu_m3_s2 / RADIUS_M**3)
PERIOD_S = math.tau / MOTION_RAD_S
CIRCULAR = (RADIUS_M, 0.0, 0.0, 0.0, 0.0, math.sqrt(EGM_96.mu_m3_s2 / RADIUS_M))
"""A polar circular orbit: along-track is z, the normal is -y."""
INERTIA = (12.0, 14.0, 9.0)
FREE = {"has_gravity_gradient": False}
HOUR = np.arange(0.0, 3601.0, 60.0)


def two_body(*forces):
    return PropagationParameters(
        settings=ScipyPropagator(kind="scipy", forces=("two_body", *forces)),
        gravity=EGM_96,
        epoch_utc=datetime(2026, 1, 1, tzinfo=UTC),
    )


def turned(bodies, attitudes, knots_s, *, t0_s=0.0, parameters=None):
    states = np.array([(*CIRCULAR, *attitude) for attitude in attitudes])
    parameters = parameters or two_body()
    return propagate_attitude(bodies, states, t0_s=t0_s, knots_s=knots_s, parameters=parameters)


def momentum_inertial(row, inertia):
    return rotate_back(row[6:10], np.multiply(inertia, row[10:]))


def test_a_free_body_keeps_momentum_and_energy_for_an_hour():
    body = RigidBody(inertia_kg_m2=INERTIA, **FREE)
    tumble = (*normalised((0.1, -0.3, 0.2, 0.9)), 0.02, -0.03, 0.011)
    result = turned([body], [tumble], HOUR)[0]

    momentum = np.array([momentum_inertial(row, INERTIA) for row in result])
    energy = 0.5 * np.sum(np.multiply(INERTIA, result[:, 10:] ** 2), axis=1)
    drift = np.linalg.norm(momentum - momentum[0], axis=1) / np.linalg.norm(momentum[0])
    assert drift.max() < 1e-10
    assert np.abs(energy / energy[0] - 1.0).max() < 1e-10
    assert np.abs(np.linalg.norm(result[:, 6:10], axis=1) - 1.0).max() < 1e-15


def test_a_symmetric_top_precesses_as_its_closed_solution():
    across, along = 14.0, 9.0
    rates, start = (0.03, 0.0, 0.05), normalised((0.3, 0.1, -0.2, 0.9))
    body = RigidBody(inertia_kg_m2=(across, across, along), **FREE)
    result = turned([body], [(*start, *rates)], HOUR)[0]

    momentum = np.array(rotate_back(start, np.multiply((across, across, along), rates)))
    for t_s, row in zip(HOUR.tolist(), result, strict=True):
        # Precession about the momentum at |H| / It, spin about the axis of symmetry.
        precession = from_rotation(momentum * (t_s / across))
        spin = from_rotation((0.0, 0.0, rates[2] * (1.0 - along / across) * t_s))
        expected = multiply(multiply(precession, start), spin)
        assert math.hypot(*rotation_between(expected, row[6:10])) < 1e-10
        phase = rates[2] * (along / across - 1.0) * t_s
        assert row[10:] == pytest.approx(
            (rates[0] * math.cos(phase), rates[0] * math.sin(phase), rates[2]), abs=1e-12
        )


def test_a_constant_torque_about_a_principal_axis_spins_up_as_it_should():
    body = RigidBody(inertia_kg_m2=INERTIA, torque_n_m=(0.0, 0.0, 0.018), **FREE)
    knots_s = np.array((100.0, 107.5, 130.0))
    result = turned([body], [(*IDENTITY, 0.0, 0.0, 0.0)], knots_s, t0_s=90.0)

    for t_s, row in zip((knots_s - 90.0).tolist(), result[0], strict=True):
        assert row[10:] == pytest.approx((0.0, 0.0, 0.002 * t_s), abs=1e-13)
        assert rotation_between(IDENTITY, row[6:10]) == pytest.approx(
            (0.0, 0.0, 0.001 * t_s**2), abs=1e-11
        )


def test_wheels_take_up_what_the_body_is_given():
    wheels, torque = (0.2, -0.1, 0.3), (0.002, 0.001, -0.003)
    body = RigidBody(inertia_kg_m2=INERTIA, wheels_n_m_s=wheels, torque_n_m=torque, **FREE)
    result = turned([body], [(*IDENTITY, 0.01, 0.02, -0.01)], HOUR[:11])[0]

    total = [
        rotate_back(row[6:10], np.multiply(INERTIA, row[10:]) + wheels - np.multiply(torque, t_s))
        for t_s, row in zip(HOUR.tolist(), result, strict=False)
    ]
    assert np.ptp(total, axis=0).max() < 1e-11
    assert np.ptp(result[:, 10:], axis=0).max() > 1e-3


def test_a_body_that_points_to_the_earth_turns_with_its_orbit():
    attitude = Attitude(inertia_kg_m2=INERTIA)
    start = initial_attitude(attitude, CIRCULAR[:3], CIRCULAR[3:])
    quarter = np.arange(0.0, 1.01, 0.25) * PERIOD_S
    result = turned([RigidBody.of(attitude)], [start], quarter)[0]

    for row in result:
        r, v = row[:3] / np.linalg.norm(row[:3]), row[3:6] / np.linalg.norm(row[3:6])
        assert rotate(row[6:10], -r) == pytest.approx((0.0, 0.0, 1.0), abs=1e-9)
        assert rotate(row[6:10], v) == pytest.approx((1.0, 0.0, 0.0), abs=1e-9)
        assert row[10:] == pytest.approx((0.0, -MOTION_RAD_S, 0.0), abs=1e-12)
    # After one orbit the quaternion is back, with the other sign: half a turn of a quaternion a turn.
    assert result[-1, 6:10] == pytest.approx(-result[0, 6:10], abs=1e-9)


@pytest.mark.slow
def test_small_pitch_angles_librate_at_the_frequency_of_theory():
    attitude = Attitude(inertia_kg_m2=INERTIA)
    pitch_rad = 1e-5
    straight = initial_attitude(attitude, CIRCULAR[:3], CIRCULAR[3:])
    tilted = multiply(straight[:4], from_rotation((0.0, pitch_rad, 0.0)))
    knots_s = np.linspace(0.0, PERIOD_S, 41)
    both = turned([RigidBody.of(attitude)] * 2, [straight, (*tilted, *straight[4:])], knots_s)

    frequency = MOTION_RAD_S * math.sqrt(3.0 * (INERTIA[0] - INERTIA[2]) / INERTIA[1])
    for t_s, one, other in zip(knots_s.tolist(), both[0], both[1], strict=True):
        angle = rotation_between(one[6:10], other[6:10])
        # Pitch is a sine of itself to third order: 1e-15 rad.
        expected = (0.0, pitch_rad * math.cos(frequency * t_s), 0.0)
        assert angle == pytest.approx(expected, abs=2e-11)


def test_an_initial_attitude_may_rest_or_be_given_rates():
    at = (CIRCULAR[:3], CIRCULAR[3:])
    rest = Attitude(inertia_kg_m2=INERTIA, initial="inertial", rates_deg_s=(0.0, 1.0, 2.0))
    nadir = Attitude(inertia_kg_m2=INERTIA, rates_deg_s=(0.0, 1.0, 2.0))
    rates = np.radians((0.0, 1.0, 2.0))

    assert initial_attitude(rest, *at) == pytest.approx((*IDENTITY, *rates))
    assert initial_attitude(nadir, *at)[4:] == pytest.approx(rates - (0.0, MOTION_RAD_S, 0.0))


def test_the_orbit_is_that_of_a_point_mass_to_the_last_digit():
    bodies = [RigidBody(inertia_kg_m2=INERTIA), RigidBody(inertia_kg_m2=(1.0, 2.0, 3.0))]
    parameters, knots_s = two_body("j2"), np.array((1000.5, 1001.0, 1040.0))
    start = (*IDENTITY, 0.0, 0.001, 0.0)
    result = turned(bodies, [start] * 2, knots_s, t0_s=1000.25, parameters=parameters)

    points = load_propagator("scipy").propagate(
        np.array([CIRCULAR] * 2), 1000.25, knots_s, parameters
    )
    assert np.array_equal(result[..., :6], points)


def test_positions_far_apart_are_as_good_for_the_gravity_gradient_as_near_ones():
    body = RigidBody(inertia_kg_m2=(5.0, 14.0, 9.0))
    start = (*IDENTITY, 0.001, 0.002, 0.0)
    near = turned([body], [start], np.arange(0.0, 601.0, 1.0))[0, -1]
    far = turned([body], [start], np.array((600.0,)))[0, -1]

    assert math.hypot(*rotation_between(near[6:10], far[6:10])) < 1e-11


def test_no_time_leaves_everything_as_it_is():
    body, start = RigidBody(inertia_kg_m2=INERTIA), (*IDENTITY, 0.1, 0.2, 0.3)
    result = turned([body], [start], np.array((5.0,)), t0_s=5.0)

    assert result[0, 0, ATTITUDE] == pytest.approx(start)
