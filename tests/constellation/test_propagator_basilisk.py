"""Truth, for points and for rigid bodies, against Basilisk."""

import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from datetime import UTC, datetime

import numpy as np
import pytest
from constellation_fakes import Star, parameters
from harness.late_module import LateModule, needs_library

from madns_runtime.errors import ConfigurationError
from madns_runtime.simulations.constellation.equipment import Attitude
from madns_runtime.simulations.constellation.orbit.constants import EGM_96
from madns_runtime.simulations.constellation.orbit.quaternions import normalised, rotate
from madns_runtime.simulations.constellation.parameters import BasiliskPropagator, ScipyPropagator
from madns_runtime.simulations.constellation.truth.propagation import (
    PropagationParameters,
    propagate,
)
from madns_runtime.simulations.constellation.truth.propagators.attitude import propagate_attitude
from madns_runtime.simulations.constellation.truth.propagators.rigid_body import (
    RigidBody,
    initial_attitude,
)

PROPAGATORS = "madns_runtime.simulations.constellation.truth.propagators"
propagator = LateModule(f"{PROPAGATORS}.basilisk_propagator")
simulation = LateModule(f"{PROPAGATORS}.basilisk_simulation")
pytestmark = needs_library("Basilisk", "basilisk")


def make(kind="basilisk", forces=("two_body", "j2"), rest=None, **settings):
    classes = {"basilisk": BasiliskPropagator, "scipy": ScipyPropagator}
    return PropagationParameters(
        settings=classes[kind](kind=kind, forces=forces, **settings),
        gravity=EGM_96,
        epoch_utc=datetime(2000, 1, 1, 12, tzinfo=UTC),
        **(rest or {}),
    )


def orbits(count=3, radius_m=7.0e6):
    rng = np.random.default_rng(8)
    r = rng.normal(size=(count, 3))
    r /= np.linalg.norm(r, axis=1, keepdims=True)
    v = np.cross(r, rng.normal(size=(count, 3)))
    v /= np.linalg.norm(v, axis=1, keepdims=True)
    return np.hstack((r * radius_m, v * math.sqrt(EGM_96.mu_m3_s2 / radius_m)))


@pytest.mark.slow
@pytest.mark.parametrize("forces", [("two_body",), ("two_body", "j2")], ids="+".join)
def test_it_agrees_with_scipy_over_four_hours(forces):
    end = np.array([14_400.0])

    found = propagate(orbits(), 0.0, end, make(forces=forces))

    expected = propagate(orbits(), 0.0, end, make("scipy", forces))
    assert np.linalg.norm((found - expected)[..., :3], axis=-1).max() < 1e-5


def test_vehicles_in_one_simulation_move_as_in_their_own():
    knots_s = np.arange(0.0, 31.0, 3.0)

    together = propagate(orbits(), 0.0, knots_s, make(simulations="one"))

    assert np.array_equal(
        together, propagate(orbits(), 0.0, knots_s, make(simulations="per_vehicle"))
    )


def test_a_delta_v_is_taken_up_from_any_state_at_any_time():
    coasting = propagate(orbits(), 0.0, np.arange(0.0, 21.0), make())
    burnt = coasting[:, 10].copy()
    burnt[1, 3:] += (1.0, -2.0, 3.0)

    found = propagate(burnt, 10.0, np.arange(10.0, 21.0), make())

    assert np.array_equal(found[[0, 2]], coasting[[0, 2], 10:])
    expected = propagate(burnt, 10.0, np.arange(10.0, 21.0), make("scipy"))
    assert np.abs(found - expected)[..., :3].max() < 1e-7


def test_simulations_are_kept_and_bounded():
    basilisk = propagator.Basilisk()
    for step_s in (0.1, 0.2, 0.25, 0.5, 1.0, 1.25):
        basilisk.propagate(orbits(), 0.0, np.array([5.0]), make(step_s=step_s))
    kept = dict(basilisk._kept.sets)

    basilisk.propagate(orbits(), 5.0, np.array([10.0]), make(step_s=1.25))

    assert len(basilisk._kept.sets) == propagator.SETS_MAX
    assert all(basilisk._kept.sets[key] is kept[key] for key in kept)


def test_a_coarse_step_costs_accuracy():
    end, expected = np.array([3600.0]), None
    errors = []
    for step_s in (1.0, 10.0):
        expected = propagate(orbits(), 0.0, end, make("scipy"))
        found = propagate(orbits(), 0.0, end, make(step_s=step_s))
        errors.append(float(np.linalg.norm((found - expected)[..., :3], axis=-1).max()))

    # Of fourth order.
    assert errors[0] < 1e-3
    assert 3e3 < errors[1] / errors[0] < 3e4


@pytest.mark.parametrize(
    ("gap_ns", "step_ns_max", "expected"),
    [
        (1_000_000_000, 100_000_000, (100_000_000, 10)),
        (1_000_000_000, 300_000_000, (250_000_000, 4)),
        (50, 100, (50, 1)),
        (7, 3, (1, 7)),
        # A prime: none divides it.
        (999_999_937, 100_000_000, (99_999_993, 10)),
    ],
)
def test_steps_end_on_knots_and_are_no_longer_than_set(gap_ns, step_ns_max, expected):
    if gap_ns == 999_999_937:
        step_ns, steps = propagator.whole_steps(gap_ns, step_ns_max)
        assert 0 < gap_ns - step_ns * steps < steps
        assert step_ns <= step_ns_max
        return

    assert propagator.whole_steps(gap_ns, step_ns_max) == expected


def test_what_whole_nanoseconds_leave_is_drifted():
    states = orbits()

    found = propagator.drifted(states, 1e-6, make())

    # 1 us of 7.5 km/s is 7.5 mm; the rest of the series 1e-18 m.
    assert found[:, :3] - states[:, :3] == pytest.approx(1e-6 * states[:, 3:], abs=2e-9)
    assert np.linalg.norm(found[:, 3:] - states[:, 3:], axis=1) == pytest.approx(8e-6, rel=0.03)


def test_parameters_of_attitude_go_there_and_back():
    for q in ((0.1, 0.2, 0.3, 0.9), (0.5, -0.5, 0.5, -0.5), (1.0, 0.0, 0.0, 0.0), (0, 0, 0, -1.0)):
        q = normalised(q)

        mrp = simulation.mrp_of(list(q))
        back = simulation.quaternions_of(np.array([mrp]))[0]

        assert np.linalg.norm(mrp) <= 1.0 + 1e-15
        # Of the two quaternions of an attitude it may be the other one.
        assert abs(float(np.dot(back, q))) == pytest.approx(1.0, abs=1e-15)
        assert rotate(back, (1.0, 2.0, 3.0)) == pytest.approx(rotate(q, (1.0, 2.0, 3.0)))


def bodies_in_orbit():
    inertia = (10.0, 24.0, 17.0)
    attitude = Attitude(inertia_kg_m2=inertia, rates_deg_s=(1.0, -2.0, 0.5))
    still = Attitude(inertia_kg_m2=inertia)
    states = [
        (*row, *initial_attitude(which, row[:3], row[3:]))
        for row, which in zip(orbits().tolist(), (attitude, attitude, still), strict=True)
    ]
    torques = ((1e-3, 0.0, -5e-4), (0.0, 2e-4, 0.0), (0.0, 0.0, 0.0))
    bodies = [
        RigidBody(inertia_kg_m2=inertia, has_gravity_gradient=has_gradient, torque_n_m=torque)
        for has_gradient, torque in zip((True, False, True), torques, strict=True)
    ]
    return bodies, np.array(states)


def turned(bodies, states, knots_s, parameters, t0_s=0.0):
    return propagate_attitude(bodies, states, t0_s=t0_s, knots_s=knots_s, parameters=parameters)


def turned_rad(a, b):
    """Angle between attitudes, shape (M, K); good for small ones, of one sign."""
    return 2.0 * np.linalg.norm(a[..., 6:10] - b[..., 6:10], axis=-1)


@pytest.mark.slow
def test_our_rigid_bodies_turn_as_basilisks():
    bodies, states = bodies_in_orbit()
    knots_s = np.append(np.arange(1, 60) * 10.0, (595.5, 600.0))

    ours = turned(bodies, states, knots_s, make("scipy"))

    basilisks = turned(bodies, states, knots_s, make(step_s=0.05))
    assert turned_rad(ours, basilisks).max() < 1e-9
    assert np.abs(ours[..., 10:] - basilisks[..., 10:]).max() < 1e-12
    assert np.abs(ours[..., :3] - basilisks[..., :3]).max() < 1e-6


def test_bodies_fly_the_orbits_of_points_to_the_last_digit_also_with_thrust():
    bodies, states = bodies_in_orbit()
    knots_s = np.arange(4.0, 9.0)
    parameters = make(rest={"thrust_m_s2": np.full((3, 3), 1e-3)})

    found = turned(bodies, states, knots_s, parameters, t0_s=3.25)
    itself = propagator.Basilisk().propagate_bodies(
        bodies, states, offsets_s=knots_s - 3.25, parameters=parameters
    )

    assert np.array_equal(found[..., :6], propagate(states[:, :6], 3.25, knots_s, parameters))
    assert np.array_equal(found[..., :6], itself[..., :6])


def test_bodies_in_one_simulation_turn_as_in_their_own():
    bodies, states = bodies_in_orbit()
    bodies[1] = replace(bodies[1], inertia_kg_m2=(3.0, 2.0, 4.0))
    knots_s = np.arange(0.0, 11.0)

    together = turned(bodies, states, knots_s, make())

    assert np.array_equal(
        together, turned(bodies, states, knots_s, make(simulations="per_vehicle"))
    )


def test_a_torque_that_is_over_acts_no_more():
    bodies, states = bodies_in_orbit()
    at_rest = [replace(body, torque_n_m=(0.0, 0.0, 0.0)) for body in bodies]
    knots_s = np.array([10.0])
    expected = turned(at_rest, states, knots_s, make())

    pushed = turned(bodies, states, knots_s, make(rest={"thrust_m_s2": np.ones((3, 3))}))

    assert not np.array_equal(pushed, expected)
    assert np.array_equal(turned(at_rest, states, knots_s, make()), expected)


def test_the_comparison_sees_a_missing_gravity_gradient():
    bodies, states = bodies_in_orbit()
    blind = [replace(body, has_gravity_gradient=False) for body in bodies]
    knots_s = np.array([300.0])

    ours = turned(blind, states, knots_s, make("scipy"))

    angles = turned_rad(ours, turned(bodies, states, knots_s, make()))[:, 0]
    assert angles[0] > 1e-4
    assert angles[1] < 1e-9


def test_what_whole_nanoseconds_leave_is_turned_too():
    bodies, states = bodies_in_orbit()
    # A prime number of nanoseconds: none of the steps tried divides it.
    knots_s = np.array([0.999999937, 2 * 0.999999937])

    found = turned(bodies, states, knots_s, make(step_s=0.09))

    ours = turned(bodies, states, knots_s, make("scipy"))
    assert turned_rad(ours, found).max() < 1e-12
    assert np.abs(ours[..., :3] - found[..., :3]).max() < 1e-7


def test_wheels_are_refused_by_name():
    bodies, states = bodies_in_orbit()
    bodies[1] = replace(bodies[1], wheels_n_m_s=(0.0, 0.0, 1.0))

    with pytest.raises(ConfigurationError, match="^B: basilisk does rigid bodies without wheels"):
        turned(bodies, states, np.array([1.0]), make(rest={"names": ("A", "B", "C")}))


def test_threads_do_not_step_the_same_simulations():
    basilisk, knots_s = propagator.Basilisk(), np.arange(1.0, 41.0)
    fleets = [orbits(radius_m=radius_m) for radius_m in (6.9e6, 7.0e6, 7.1e6, 7.2e6)] * 3
    expected = [basilisk.propagate(fleet, 0.0, knots_s, make()) for fleet in fleets]

    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda f: basilisk.propagate(f, 0.0, knots_s, make()), fleets))

    assert np.array_equal(found, expected)


def test_a_run_with_basilisk_has_its_rigid_bodies_turned_by_it(monkeypatch):
    turned_by_it = []
    propagate_bodies = propagator.Basilisk.propagate_bodies

    def count(self, bodies, states, **rest):
        turned_by_it.append(len(bodies))
        return propagate_bodies(self, bodies, states, **rest)

    monkeypatch.setattr(propagator.Basilisk, "propagate_bodies", count)
    body = {"attitude": {"inertia_kg_m2": [10, 24, 17], "rates_deg_s": [1, -2, 0.5]}}
    last = []
    for kind in ("basilisk", "scipy"):
        star = Star(parameters(propagator={"kind": kind}, vehicles=[body]), 2, duration_s=12.0)
        star.run(12.0)
        last.append([star.contexts[name].records["attitude"][-1] for name in star.agents])

    assert turned_by_it == [2]
    assert np.array(last[0]) == pytest.approx(np.array(last[1]), abs=1e-10)
