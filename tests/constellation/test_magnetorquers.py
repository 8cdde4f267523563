"""Magnetorquers: what truth makes of a dipole, against an independent integration and what must hold, and their rules."""

import math
from dataclasses import replace
from datetime import UTC, datetime

import numpy as np
import pytest
from constellation_fakes import Star, parameters, state_rows
from scipy.integrate import solve_ivp

from madns_runtime.simulations.constellation.check import find_faults
from madns_runtime.simulations.constellation.equipment import (
    Attitude,
    Magnetometer,
    Magnetorquers,
    ReactionWheels,
    Sensors,
    Vehicle,
)
from madns_runtime.simulations.constellation.messages import Command
from madns_runtime.simulations.constellation.orbit.constants import EGM_96
from madns_runtime.simulations.constellation.orbit.earth import days_since_j2000, gmst_rad
from madns_runtime.simulations.constellation.orbit.magnetic import (
    IGRF_14_DIPOLE_NT,
    decimal_year,
)
from madns_runtime.simulations.constellation.orbit.quaternions import (
    from_rotation,
    rotate,
    rotation_between,
)
from madns_runtime.simulations.constellation.parameters import Maneuvers, ScipyPropagator
from madns_runtime.simulations.constellation.truth.maneuvers.effects import Effect, Timeline
from madns_runtime.simulations.constellation.truth.maneuvers.rules import ManeuverDesk, Rules
from madns_runtime.simulations.constellation.truth.orbit_curves import OrbitCurve, earth_field
from madns_runtime.simulations.constellation.truth.propagation import (
    PropagationParameters,
    propagate,
)
from madns_runtime.simulations.constellation.truth.propagators.rigid_body import RigidBody
from madns_runtime.simulations.constellation.truth.vehicle_propagation import (
    VehicleRequest,
    propagate_vehicle,
)
from madns_runtime.simulations.constellation.vehicles import field_of

EPOCH = datetime(2025, 1, 1, tzinfo=UTC)
RADIUS_M = EGM_96.radius_m + 600e3
SPEED_M_S = math.sqrt(EGM_96.mu_m3_s2 / RADIUS_M)
INCLINED = (RADIUS_M, 0.0, 0.0, 0.0, SPEED_M_S * math.cos(1.2), SPEED_M_S * math.sin(1.2))
INERTIA = (0.05, 0.07, 0.04)
TUMBLE = (*from_rotation((0.4, -0.2, 0.7)), 0.08, -0.06, 0.1)
TWO_BODY = PropagationParameters(
    settings=ScipyPropagator(kind="scipy", forces=("two_body",)), gravity=EGM_96, epoch_utc=EPOCH
)


def dipole(start_s, end_s, vector, number=0):
    return Effect(
        number=number, kind="dipole", at_s=start_s, start_s=start_s, end_s=end_s, vector=vector,
        frame="body",
    )  # fmt: skip


def flown(effects, *, end_s=60.0, body=None, attitude=TUMBLE, orbit=None, knot_s=1.0):
    request = VehicleRequest(
        start_s=0.0,
        state=np.array((*INCLINED, *attitude)),
        change_s=0.0,
        end_knot=round(end_s / knot_s),
        knot_s=knot_s,
        effects=effects,
        body=body or RigidBody(inertia_kg_m2=INERTIA),
        orbit=orbit,
    )
    return propagate_vehicle(request, TWO_BODY)


def dipole_field_t(r_m, t_s):
    """The tilted dipole, written anew: from the moment's direction, as in textbooks."""
    angle = gmst_rad(days_since_j2000(EPOCH, t_s))
    spin = np.array(
        [[math.cos(angle), -math.sin(angle), 0], [math.sin(angle), math.cos(angle), 0], [0, 0, 1]]
    )
    part = (decimal_year(days_since_j2000(EPOCH)) - 2025.0) / 5.0
    tables = (np.array(IGRF_14_DIPOLE_NT[year]) for year in (2025.0, 2030.0))
    g10, g11, h11 = (1.0 - part) * next(tables) + part * next(tables)
    moment = spin @ np.array((g11, h11, g10)) * 1e-9 * 6_371_200.0**3
    r = np.linalg.norm(r_m)
    return 3.0 * r_m * (moment @ r_m) / r**5 - moment / r**3


def independent(vector, end_s, attitude=TUMBLE):
    """All thirteen numbers together, rotation by matrix."""
    inertia, m = np.array(INERTIA), np.array(vector)

    def derivative(t_s, y):
        r, v, q, w = y[:3], y[3:6], y[6:10], y[10:]
        vector, scalar = q[:3], q[3]
        cross = np.array(
            [[0, -vector[2], vector[1]], [vector[2], 0, -vector[0]], [-vector[1], vector[0], 0]]
        )
        matrix = (scalar**2 - vector @ vector) * np.eye(3) + 2 * np.outer(vector, vector)
        to_body = matrix - 2 * scalar * cross
        b, down = to_body @ dipole_field_t(r, t_s), to_body @ r
        radius = np.linalg.norm(r)
        torque = np.cross(m, b) + 3 * EGM_96.mu_m3_s2 / radius**5 * np.cross(down, inertia * down)
        turn = (torque - np.cross(w, inertia * w)) / inertia
        change = 0.5 * (scalar * w + np.cross(vector, w))
        pull = -EGM_96.mu_m3_s2 * r / radius**3
        return np.concatenate((v, pull, change, [-0.5 * vector @ w], turn))

    start = np.array((*INCLINED, *attitude))
    times_s = np.arange(0.0, end_s + 0.5, 1.0)
    atol = (1e-5,) * 3 + (1e-8,) * 3 + (1e-13,) * 7
    found = solve_ivp(
        derivative, (0.0, end_s), start, method="DOP853", t_eval=times_s, rtol=1e-12, atol=atol
    )
    return found.y.T


def test_a_dipole_turns_the_body_as_an_independent_integration_says():
    truth = flown((dipole(0.0, 60.0, (0.2, -0.3, 0.25)),))

    expected = independent((0.2, -0.3, 0.25), 60.0)
    for row, other in zip(truth.attitude.tolist(), expected.tolist(), strict=True):
        # A tenth of what a tumbling body's attitude errs between knots.
        assert math.hypot(*rotation_between(other[6:10], row[:4])) < 1e-9
        assert row[4:] == pytest.approx(other[10:], abs=1e-10)
    coasted = flown(())
    assert math.hypot(*rotation_between(coasted.attitude[-1, :4], truth.attitude[-1, :4])) > 0.03


def test_what_a_dipole_does_to_the_energy_is_the_work_of_its_torque():
    body = RigidBody(inertia_kg_m2=INERTIA, has_gravity_gradient=False)
    moment = (0.2, -0.3, 0.25)
    truth = flown((dipole(0.0, 20.0, moment),), end_s=20.0, body=body, knot_s=0.05)

    field_t = earth_field("dipole", EPOCH)
    times_s = np.arange(len(truth.states)) * 0.05
    power = []
    for t_s, state, turned in zip(times_s, truth.states, truth.attitude, strict=True):
        b = rotate(turned[:4], field_t(tuple(state[:3]), t_s))
        torque = np.cross(moment, b)
        assert abs(torque @ b) < 1e-20  # nothing along the field
        power.append(torque @ turned[4:])
    # Simpson's rule over the knots.
    weights = np.array([1.0, *([4.0, 2.0] * (len(power) // 2 - 1)), 4.0, 1.0])
    work = 0.05 / 3.0 * float(weights @ power)
    energy = 0.5 * np.sum(np.multiply(INERTIA, truth.attitude[:, 4:] ** 2), axis=1)
    assert energy[-1] - energy[0] == pytest.approx(work, rel=1e-7)
    assert abs(work) > 1e-6


def test_a_dipole_along_the_field_turns_nothing_and_one_across_it_does():
    body = RigidBody(inertia_kg_m2=INERTIA, has_gravity_gradient=False)
    rest = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
    b = np.array(earth_field("dipole", EPOCH)(INCLINED[:3], 0.0))
    along, across = 0.3 * b / np.linalg.norm(b), np.cross(b, (1.0, 0.0, 0.0)) / np.linalg.norm(b)
    ends = [
        flown((dipole(0.0, 1.0, tuple(m)),), end_s=1.0, body=body, attitude=rest).attitude[-1, 4:]
        for m in (along, across)
    ]

    # The field itself turns by two milliradians meanwhile, and grows by half a percent.
    assert np.linalg.norm(ends[0] * INERTIA) < 2e-3 * 0.3 * np.linalg.norm(b)
    assert ends[1] * INERTIA == pytest.approx(np.cross(across, b), rel=1e-2)


def test_a_known_orbit_gives_the_same_turn_as_one_that_is_propagated():
    times_s = np.arange(0.0, 61.0)
    states = propagate(np.array([INCLINED]), 0.0, times_s, TWO_BODY)[0]
    effects = (dipole(10.3, 10.4, (0.3, 0.0, 0.1)), dipole(10.4, 10.5, (-0.3, 0.0, 0.1), number=1))
    by_orbit = flown(effects, orbit=OrbitCurve(times_s, states))
    propagated = flown(effects)

    assert np.array_equal(by_orbit.states, states)
    assert by_orbit.attitude == pytest.approx(propagated.attitude, abs=1e-9)
    assert [p.end_s - p.t0_s for p in by_orbit.pieces] == pytest.approx(
        [p.end_s - p.t0_s for p in propagated.pieces]
    )


TORQUERS = Magnetorquers(dipole_a_m2_max=0.2, dipole_error=0.05)
MAGNETIC = Vehicle(attitude=Attitude(inertia_kg_m2=INERTIA, magnetorquers=TORQUERS))


def desk(vehicle=MAGNETIC, **rest):
    rules = Rules(
        settings=Maneuvers(), can_maneuver=True, duration_s=100.0, tick_hz=10.0, knot_s=1.0, seed=5,
        **rest,
    )  # fmt: skip
    return ManeuverDesk(rules, ["a"], [vehicle], [Timeline()])


def command(number=0, at_s=20.0, vector=(0.1, 0.0, -0.1), duration_s=0.1, kind="dipole"):
    return Command(
        number=number, kind=kind, commanded_s=at_s - 0.2, at_s=at_s, frame="body", vector=vector,
        duration_s=duration_s,
    )  # fmt: skip


def test_a_dipole_is_limited_on_each_axis_and_errs_by_the_commands_own_chance():
    one, other = desk(), desk()
    first = one.decide(0, command(0, 20.0, (0.1, -0.5, 0.0)), 19.801)
    second = one.decide(0, command(1, 30.0), 29.801)
    alone = other.decide(0, command(1, 30.0), 29.801)

    x, y, z = first.effect.vector
    assert (first.reason, z) == ("y: 0.2 A m^2 at most", 0.0)
    assert y / x == pytest.approx(-2.0)
    assert x != 0.1
    assert x == pytest.approx(0.1, rel=0.25)
    assert second.effect.vector == alone.effect.vector
    assert first.effect.vector[0] / 0.1 != second.effect.vector[0] / 0.1


@pytest.mark.parametrize(
    ("wish", "vehicle", "rules", "words"),
    [
        (command(), Vehicle(), {}, "a dipole on a vehicle without attitude"),
        (command(), Vehicle(attitude=Attitude(inertia_kg_m2=INERTIA)), {}, "no magnetorquers"),
        (command(), MAGNETIC, {"can_magnetise": False}, "follows no magnetic dipole"),
        (command(duration_s=0.001), MAGNETIC, {}, "a duration of at least 0.01 s"),
        (command(vector=(0.0, 0.0, 0.0)), MAGNETIC, {}, "a dipole of 0 A m^2"),
    ],
)
def test_a_dipole_that_cannot_be_is_refused_with_its_reason(wish, vehicle, rules, words):
    taken = desk(vehicle, **rules).decide(0, wish, 19.801)

    assert taken.status == "refused"
    assert words in taken.reason


def test_dipoles_one_after_the_other_meet_whatever_their_times_rounding():
    judge = desk()
    starts_s = [20.0 + number * 0.1 for number in range(100)]
    taken = [judge.decide(0, command(n, t), t - 0.199) for n, t in enumerate(starts_s[:40])]

    assert {one.status for one in taken} == {"accepted"}
    ends = [one.effect.end_s for one in taken]
    assert [one.effect.start_s for one in taken[1:]] == ends[:-1]
    busy = judge.decide(0, command(99, 20.05), 19.9)
    assert busy.reason == "torquers busy from 20.000 s to 20.100 s"


def test_torquers_work_beside_wheels():
    wheels = ReactionWheels(torque_n_m_max=0.1, momentum_n_m_s_max=1.0)
    judge = desk(replace(MAGNETIC, attitude=replace(MAGNETIC.attitude, wheels=wheels)))
    torque = judge.decide(0, command(0, 20.0, (0.01, 0.0, 0.0), 10.0, "torque"), 19.8)
    both = judge.decide(0, command(1, 21.0), 20.8)

    assert (torque.status, both.status) == ("accepted", "accepted")
    assert judge.execute(torque).wheels_n_m_s == pytest.approx((-0.1, 0.0, 0.0))
    assert judge.execute(both).wheels_n_m_s is None


def test_the_field_that_turns_is_the_one_that_is_measured_unless_the_torquers_say():
    igrf = Sensors(magnetometer=Magnetometer(field="igrf"))
    own = replace(MAGNETIC.attitude, magnetorquers=replace(TORQUERS, field="dipole"))

    assert field_of(MAGNETIC) == "dipole"
    assert field_of(replace(MAGNETIC, sensors=igrf)) == "igrf"
    assert field_of(replace(MAGNETIC, sensors=igrf, attitude=own)) == "dipole"


@pytest.mark.parametrize(
    ("propagator", "refused"),
    [
        ({"kind": "scipy"}, False),
        ({"kind": "numba"}, False),
        ({"kind": "basilisk"}, True),
        ({"kind": "custom", "implementation": "json:JSONDecoder"}, True),
    ],
)
def test_validate_refuses_magnetorquers_where_the_propagator_cannot_follow(
    tmp_path, propagator, refused
):
    body = {"inertia_kg_m2": list(INERTIA), "magnetorquers": {"dipole_a_m2_max": 0.2}}
    given = parameters(vehicles=[{"attitude": body}], propagator=propagator)
    faults = [f for f in find_faults(given, 1, tmp_path) if "magnetorquers" in f]

    assert bool(faults) == refused
    if refused:
        assert "parameters.vehicles[0].attitude.magnetorquers: " in faults[0]
        assert "follows no magnetic dipole" in faults[0]


BDOT = """
class Bdot:
    def setup(self, context):
        self.context, self.results, self.wheels = context, [], []

    def step(self, t_s, readings):
        if 0.0 < t_s < 8.0:
            self.context.dipole((0.15, -0.1, 0.1), at_s=t_s + 0.2, duration_s=0.1)
        if t_s == 5.0:
            self.context.torque((0.0, 0.002, 0.0), at_s=6.0, duration_s=1.0)
        if "wheels" in readings:
            self.wheels.append((t_s, *readings["wheels"].values))

    def command_result(self, result):
        self.results.append(result.status)

    def finish(self):
        return {"results": {s: self.results.count(s) for s in set(self.results)}, "wheels": self.wheels}
"""


@pytest.mark.slow
def test_ten_dipoles_per_second_are_all_executed_and_leave_the_orbit_alone(tmp_path):
    (tmp_path / "bdot.py").write_text(BDOT)
    wheels = {"torque_n_m_max": 0.01, "momentum_n_m_s_max": 0.1}
    body = {
        "inertia_kg_m2": list(INERTIA), "rates_deg_s": [4, 4, -4], "wheels": wheels,
        "magnetorquers": {"dipole_a_m2_max": 0.2},
    }  # fmt: skip
    quiet = Star(parameters(vehicles=[{"attitude": body}]), 1, duration_s=20.0)
    quiet.run(12.0)
    flying = parameters(vehicles=[{"attitude": body}], flight="bdot.py:Bdot")
    star = Star(flying, 1, base_directory=tmp_path, duration_s=20.0)
    star.run(12.0)

    summary = star.summaries()["agent-01"]
    assert summary["flight"]["results"] == {"accepted": 80, "executed": 80}
    assert summary["underruns"] == 0
    ((told_s, *momentum),) = summary["flight"]["wheels"]
    assert told_s == pytest.approx(7.1, abs=0.11)
    assert momentum == pytest.approx((0.0, -0.002, 0.0), abs=1e-12)
    # Two of the last digits on record.
    assert state_rows(star, "agent-01") == pytest.approx(state_rows(quiet, "agent-01"), abs=2e-5)
    last, coasted = (s.contexts["agent-01"].records["attitude"][-1] for s in (star, quiet))
    assert math.dist(last[5:], coasted[5:]) > 1e-3
    units = {field.name: field.unit for field in star.contexts["agent-01"].streams["commands"]}
    assert units["x"] == "m/s | N m | m^2/kg | A m^2"


def test_who_joins_a_vehicle_that_was_commanded_often_is_given_what_is_to_come(tmp_path):
    (tmp_path / "bdot.py").write_text(BDOT.replace("if t_s == 5.0", "if False"))
    body = {"inertia_kg_m2": list(INERTIA), "magnetorquers": {"dipole_a_m2_max": 0.2}}
    params = parameters(vehicles=[{"attitude": body}], flight="bdot.py:Bdot")
    star = Star(params, 1, base_directory=tmp_path, duration_s=20.0)
    star.run(7.0)
    given = star.host.initial_data("agent-01")
    segments = [given["segment"], *given["more"]]

    assert len(segments) < 48
    assert min(s["t0_s"] for s in segments) <= 7.0


LONG = """
class Long:
    def setup(self, context):
        self.context = context

    def step(self, t_s, readings):
        if t_s == 1.0:
            self.context.dipole((0.2, 0.1, -0.1), at_s=2.0, duration_s=20.0)
"""


def test_a_dipole_across_windows_of_truth_is_one_with_that_in_a_single_call(tmp_path):
    (tmp_path / "long.py").write_text(LONG)
    body = {
        "inertia_kg_m2": list(INERTIA),
        "rates_deg_s": [4, 4, -4],
        "magnetorquers": {"dipole_a_m2_max": 0.2},
    }
    params = parameters(
        vehicles=[{"attitude": body}],
        flight="long.py:Long",
        propagator={"kind": "scipy", "forces": ["two_body"]},
        segments={"buffer_s": 4.0},
        epoch_utc="2025-01-01T00:00:00Z",
    )
    star = Star(params, 1, base_directory=tmp_path, duration_s=40.0)
    star.run(25.0)
    records = star.contexts["agent-01"].records
    state, turned = records["state"][10][1:], records["attitude"][10][1:]
    request = VehicleRequest(
        start_s=1.0,
        state=np.array((*state, *turned)),
        change_s=1.0,
        end_knot=24,
        knot_s=1.0,
        effects=(dipole(2.0, 22.0, (0.2, 0.1, -0.1)),),
        body=RigidBody(inertia_kg_m2=INERTIA),
    )
    expected = propagate_vehicle(request, TWO_BODY).attitude[-1]

    assert star.underruns() == 0
    assert records["attitude"][240][1:] == pytest.approx(expected, abs=1e-9)
