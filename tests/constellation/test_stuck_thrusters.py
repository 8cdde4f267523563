"""A thruster that is stuck open: truth moves, propellant drains, and flight software that notices it closes it off."""

import math
from dataclasses import replace

import numpy as np
import pytest
from constellation_fakes import Star, parameters, state_rows

from madns_runtime.plugin.api import ActionRefused, TimelineAction
from madns_runtime.simulations.constellation.actions import STICK_THRUSTER_OPEN, StuckThruster
from madns_runtime.simulations.constellation.equipment import Thruster, Vehicle
from madns_runtime.simulations.constellation.messages import Command
from madns_runtime.simulations.constellation.truth.maneuvers.actuators import exhaust_m_s
from madns_runtime.simulations.constellation.truth.maneuvers.effects import Effect, Timeline
from madns_runtime.simulations.constellation.truth.maneuvers.stuck_thrusters import (
    ARC_S,
    StuckDirection,
    StuckThrusters,
)
from madns_runtime.simulations.constellation.truth.maneuvers.tank import Tank

GUARD = '''
class Guard:
    """Closes its thruster off some seconds after the accelerometer has felt a thrust that nobody commanded."""

    def setup(self, context):
        self.context, self.felt_s, self.masses, self.told, self.given_m_s = context, None, [], [], 0.0

    def step(self, t_s, readings):
        if "mass" in readings:
            self.masses.append(readings["mass"].values[1])
        felt = readings.get("accelerometer")
        if self.felt_s is None and felt and max(map(abs, felt.values)) > 1e-3:
            self.felt_s = t_s
            wait_s = self.context.settings.get("wait_s")
            if wait_s is not None:
                self.context.delta_v((0.0, 0.0, 0.0), at_s=t_s + wait_s)
        if self.context.settings.get("turn_s") == t_s:
            self.context.torque((0.0, 0.0, 1e-4), at_s=t_s + 2.0, duration_s=1.0)
        if self.context.settings.get("burn_s") == t_s:
            self.context.delta_v((0.0, 0.01, 0.0), at_s=t_s + 1.0)
        if t_s == 1.0 and "later_m_s" in self.context.settings:
            self.context.delta_v((0.0, self.context.settings["later_m_s"], 0.0), at_s=45.0)

    def command_result(self, result):
        self.told.append(f"{result.status} {result.at_s:.2f} {result.propellant_kg:.4f} {result.reason}")
        self.given_m_s = result.delta_v_m_s

    def finish(self):
        return {"felt_s": self.felt_s, "masses": self.masses, "told": self.told, "given_m_s": self.given_m_s}
'''
THRUSTER = {"isp_s": 220.0, "propellant_kg": 2.0, "thrust_n": 1.0}
EXHAUST_M_S = 220.0 * 9.80665


def action(agents=("agent-02",), for_s=None, **given):
    return TimelineAction(
        number=0,
        word=STICK_THRUSTER_OPEN.word,
        agents=agents,
        parameters=StuckThruster(**given),
        t_s=10.0,
        for_s=for_s,
    )


@pytest.fixture
def fly(tmp_path):
    (tmp_path / "guard.py").write_text(GUARD)

    def start(*, thruster=THRUSTER, rate_hz=None, attitude=None, **settings):
        flight = {"software": "guard.py:Guard", "settings": settings, "rate_hz": rate_hz}
        sensors = {"accelerometer": {"rate_hz": 10.0}}
        vehicle = {"thruster": thruster, "sensors": sensors, "attitude": attitude}
        params = parameters(flight=flight, vehicles=[vehicle])
        return Star(params, 3, base_directory=tmp_path)

    return start


def stick(star, *, ends_s=None, until_s=60.0, **given):
    star.run(10.0)
    star.host.begin_action(action(**given))
    if ends_s is not None:
        star.run(ends_s, from_s=10.0)
        star.host.end_action(action(**given))
    star.run(until_s, from_s=ends_s or 10.0)
    summary = star.host.finish()
    assert [check["name"] for check in summary["checks"] if not check["passed"]] == []
    return summary["maneuvers"]["stuck_thrusters"]["agent-02"]


def test_truth_is_that_of_a_commanded_burn_of_the_same_length_and_thrust(fly):
    stuck, burnt = fly(), fly()

    (told,) = stick(stuck, ends_s=30.0)
    given_m_s = -EXHAUST_M_S * math.log1p(-20.0 / EXHAUST_M_S / 100.0)
    burnt.run(10.0)
    middle_s = (told["from_s"] + told["to_s"]) / 2.0
    command = Command(
        number=0,
        kind="delta_v",
        commanded_s=9.0,
        at_s=middle_s,
        frame="rtn",
        vector=(0.0, given_m_s, 0.0),
    )
    burnt.host.receive("agent-02", command.to_message())
    burnt.run(60.0, from_s=10.0)

    assert told["ended"] == "mended"
    assert told["to_s"] - told["from_s"] == pytest.approx(20.0)
    assert told["delta_v_m_s"] == pytest.approx(given_m_s, rel=1e-9)
    assert told["propellant_left_kg"] == pytest.approx(2.0 - 20.0 / EXHAUST_M_S)
    apart = state_rows(stuck, "agent-02")[-1] - state_rows(burnt, "agent-02")[-1]
    # Of 8 m and 0.2 m/s: one direction for all of it there, and here one for each arc.
    assert np.linalg.norm(apart[1:4]) < 0.02
    assert np.linalg.norm(apart[4:7]) < 1e-3
    assert stuck.underruns() == 0
    others = [state_rows(star, "agent-01") for star in (stuck, burnt)]
    assert np.array_equal(*others)


@pytest.mark.slow
def test_a_push_along_an_axis_of_a_body_that_spins_turns_with_it(fly):
    spin = {"inertia_kg_m2": [1, 1, 1], "initial": "inertial", "rates_deg_s": [0, 0, 72]}
    stuck, quiet = (fly(attitude={**spin, "has_gravity_gradient": False}) for _ in range(2))

    (told,) = stick(stuck, ends_s=30.0, frame="body", direction=(1.0, 0.0, 0.0))
    quiet.run(60.0)

    # Four turns in 20 s: what 0.01 m/s^2 gives in one half of a turn is taken back in the other.
    rate_rad_s = math.radians(72.0)
    angle_rad = rate_rad_s * told["from_s"]
    drift_m_s = 0.01 / rate_rad_s * np.array((-math.sin(angle_rad), math.cos(angle_rad), 0.0))
    apart = state_rows(stuck, "agent-02")[-1] - state_rows(quiet, "agent-02")[-1]
    assert apart[1:4] == pytest.approx(20.0 * drift_m_s, abs=5e-3)
    assert apart[4:7] == pytest.approx(0.0, abs=5e-4)
    assert told["delta_v_m_s"] == pytest.approx(0.2, rel=1e-3)
    assert told["propellant_left_kg"] == pytest.approx(2.0 - 20.0 / EXHAUST_M_S)


def test_flight_software_feels_it_reads_its_tank_and_closes_it_off(fly):
    star = fly(wait_s=15.0)

    (told,) = stick(star)

    flight = star.summaries()["agent-02"]["flight"]
    assert told["from_s"] < flight["felt_s"] <= told["from_s"] + 0.3
    assert (told["ended"], told["to_s"]) == ("closed", pytest.approx(flight["felt_s"] + 15.0))
    left_kg = 2.0 - (told["to_s"] - told["from_s"]) / EXHAUST_M_S
    assert [line.split()[0] for line in flight["told"]] == ["accepted", "executed"]
    assert float(flight["told"][1].split()[2]) == pytest.approx(left_kg, abs=1e-4)
    assert flight["masses"][0] == pytest.approx(2.0)
    assert flight["masses"][-1] == pytest.approx(left_kg)
    assert sorted(flight["masses"], reverse=True) == flight["masses"]
    rows = star.context.records["stuck_thrusters"]
    assert [row[2] for row in rows] == ["open"] * (len(rows) - 1) + ["closed"]
    assert rows[-1][4] == pytest.approx(left_kg)


def test_software_that_steps_seldom_reads_what_the_tank_holds_now(fly):
    star = fly(rate_hz=0.1, turn_s=20.0, attitude={"inertia_kg_m2": [1.0, 1.0, 1.0]})

    (told,) = stick(star, until_s=41.0)

    # The torque is over at 23 s; since then the gauge was read seven times until the step at 30 s.
    flight = star.summaries()["agent-02"]["flight"]
    assert [line.split()[0] for line in flight["told"]] == ["accepted", "executed"]
    burnt_s = [(2.0 - left_kg) * EXHAUST_M_S for left_kg in flight["masses"]]
    assert burnt_s == pytest.approx([t_s - told["from_s"] for t_s in (20.0, 30.0, 40.0)], abs=1.01)


def test_it_burns_until_the_propellant_is_gone(fly):
    star = fly(thruster={**THRUSTER, "propellant_kg": 0.01})

    (told,) = stick(star)

    assert told["ended"] == "empty"
    assert told["to_s"] - told["from_s"] == pytest.approx(0.01 * EXHAUST_M_S)
    assert told["propellant_left_kg"] == 0.0
    assert star.underruns() == 0


def test_while_it_is_stuck_no_other_burn_is_taken_and_after_its_end_one_is(fly):
    meanwhile, after = fly(burn_s=20.0), fly(burn_s=40.0)

    for star in (meanwhile, after):
        (burn,) = stick(star, ends_s=30.0)
        # What is burnt later is no part of it.
        assert burn["propellant_left_kg"] == pytest.approx(2.0 - 20.0 / EXHAUST_M_S, abs=1e-9)

    (refused,) = meanwhile.summaries()["agent-02"]["flight"]["told"]
    assert refused.startswith("refused")
    assert refused.endswith("a change of velocity of 0 m/s closes it off")
    told = after.summaries()["agent-02"]["flight"]["told"]
    assert told[0].startswith("accepted")


def test_one_may_stick_in_the_moment_in_which_another_is_mended(fly):
    star = fly()
    star.run(10.0)
    first, second = action(), replace(action(agents=("agent-03",)), number=1, t_s=20.0)
    star.host.begin_action(first)
    star.run(20.0, from_s=10.0)

    star.host.end_action(first)
    star.host.begin_action(second)
    star.run(30.0, from_s=20.0)
    stuck = star.host.finish()["maneuvers"]["stuck_thrusters"]

    assert [stuck[name][0]["ended"] for name in ("agent-02", "agent-03")] == ["mended", "open"]


def test_a_burn_that_the_runs_end_forestalls_ends_no_sooner_than_it_begins(fly):
    star = fly()
    star.run(10.0)
    star.host.begin_action(action())

    (burn,) = star.host.finish()["maneuvers"]["stuck_thrusters"]["agent-02"]

    assert (burn["to_s"], burn["delta_v_m_s"]) == (burn["from_s"], 0.0)


def test_a_thruster_without_thrust_needs_one_and_a_point_has_no_body_axes(fly):
    star = fly(thruster={"isp_s": 220.0, "propellant_kg": 2.0})
    star.run(1.0)

    with pytest.raises(ActionRefused, match="give thrust_n"):
        star.host.begin_action(action())
    with pytest.raises(ActionRefused, match="body axes of a vehicle without attitude"):
        star.host.begin_action(action(thrust_n=0.1, frame="body"))
    star.host.begin_action(action(thrust_n=0.1))
    with pytest.raises(ActionRefused, match="stuck open already"):
        star.host.begin_action(action(thrust_n=0.1))


@pytest.mark.parametrize("thrust_n", [None, 20.0])
def test_a_burn_that_waits_changes_nothing_of_it_and_is_weighed_after_it(fly, thrust_n):
    thruster = {"isp_s": 220.0, "propellant_kg": 50.0, "thrust_n": thrust_n}
    alone, before = fly(thruster=thruster), fly(thruster=thruster, later_m_s=5.0)

    (free,) = stick(alone, ends_s=30.0, thrust_n=1.0)
    (told,) = stick(before, ends_s=30.0, thrust_n=1.0)

    assert told == free
    flight = before.summaries()["agent-02"]["flight"]
    stuck_kg = 20.0 / EXHAUST_M_S
    mass_kg = (100.0 - stuck_kg) * math.exp(-5.0 / EXHAUST_M_S)
    assert flight["told"][-1].split()[0] == "executed"
    assert flight["given_m_s"] == 5.0
    assert flight["masses"][-1] == pytest.approx(mass_kg - 50.0, abs=1e-9)
    early = [state_rows(star, "agent-02") for star in (alone, before)]
    assert np.array_equal(*(rows[rows[:, 0] < 30.0] for rows in early))


@pytest.mark.parametrize(
    ("thrust_n", "later_m_s", "stuck_n", "ended"),
    [(None, 43.5, 1.0, "mended"), (200.0, 43.5, 1.0, "mended"), (None, 0.1, 300.0, "empty")],
)
def test_it_burns_what_was_meant_for_a_burn_that_waits(fly, thrust_n, later_m_s, stuck_n, ended):
    thruster = {"isp_s": 220.0, "propellant_kg": 2.0, "thrust_n": thrust_n}
    star = fly(thruster=thruster, later_m_s=later_m_s)

    (told,) = stick(star, ends_s=30.0, thrust_n=stuck_n)

    flight = star.summaries()["agent-02"]["flight"]
    all_m_s = EXHAUST_M_S * math.log(100.0 / 98.0)
    assert told["ended"] == ended
    assert (told["propellant_left_kg"] > 0.0) == (ended == "mended")
    assert "executed" in flight["told"][-1]
    assert flight["told"][-1].endswith(
        "0.0000 the tank ran empty: the thruster was stuck open before"
    )
    assert told["delta_v_m_s"] + flight["given_m_s"] == pytest.approx(all_m_s, abs=1e-9)


def test_arcs_leave_room_for_a_burn_that_was_commanded_before():
    vehicle = Vehicle(thruster=Thruster(isp_s=220.0, propellant_kg=2.0, thrust_n=1.0))
    timeline, tank = Timeline(0.0), Tank(vehicle)
    burn = Effect(
        number=0, kind="thrust", at_s=16.0, start_s=14.0, end_s=18.5, vector=(0.0, 1.0, 0.0)
    )
    timeline.add(burn)
    stuck = StuckThrusters([vehicle], [timeline], [tank], knot_s=1.0, duration_s=100.0)
    push = StuckDirection(thrust_n=1.0, direction=(0.0, 1.0, 0.0), frame="rtn")

    opened = stuck.open(0, push, 10.04)
    for t_s in range(10, 25):
        stuck.extend(opened, float(t_s))

    edges = [(each.start_s, each.end_s) for each in timeline.effects]
    assert edges == [(10.04, 14.0), (14.0, 18.5), (18.5, 23.0), (23.0, 28.0)]
    assert edges[-1][1] - edges[-1][0] == ARC_S
    burnt_kg = (3.96 + 4.5 + 5.0) / exhaust_m_s(vehicle.thruster)
    assert tank.propellant_kg == pytest.approx(2.0 - burnt_kg)
    assert stuck.close(0, 24.0, "closed") == 24.0
    assert tank.propellant_kg == pytest.approx(2.0 - burnt_kg + 4.0 / exhaust_m_s(vehicle.thruster))


def waiting_burn(*, is_arc, burnt=0.01):
    vehicle = Vehicle(
        mass_kg=100.0, thruster=Thruster(isp_s=220.0, propellant_kg=1.0, thrust_n=20.0)
    )
    timeline, tank = Timeline(0.0), Tank(vehicle)
    half_s = 4.0 if is_arc else 0.0
    gain_m_s = -exhaust_m_s(vehicle.thruster) * math.log1p(-burnt)
    effect = Effect(
        number=0,
        kind="thrust" if is_arc else "impulse",
        at_s=22.0,
        start_s=22.0 - half_s,
        end_s=22.0 + half_s,
        vector=(0.0, gain_m_s, 0.0),
        burnt=burnt,
    )
    timeline.add(effect)
    tank.book(effect, 100.0 * burnt, now_s=0.0)
    stuck = StuckThrusters([vehicle], [timeline], [tank], knot_s=1.0, duration_s=100.0)
    push = StuckDirection(thrust_n=10.0, direction=(0.0, 1.0, 0.0), frame="rtn")
    return effect, timeline, tank, stuck, stuck.open(0, push, 10.0)


def test_no_arc_goes_on_over_an_impulse_that_makes_the_vehicle_lighter():
    _, timeline, tank, stuck, opened = waiting_burn(is_arc=False, burnt=0.001)

    for t_s in range(10, 23):
        stuck.extend(opened, float(t_s))

    edges = [(each.start_s, each.end_s) for each in timeline.effects]
    assert edges == [(10.0, 15.0), (15.0, 20.0), (20.0, 22.0), (22.0, 22.0), (22.0, 27.0)]
    masses_kg = [mass_kg for _, mass_kg in opened.arcs]
    before_kg = 100.0 - 12.0 * opened.flow_kg_s
    assert masses_kg[-1] == pytest.approx(before_kg * 0.999, abs=1e-12)
    left_kg = before_kg * 0.999 - 99.0 - 5.0 * opened.flow_kg_s
    assert tank.left_kg(27.0) == pytest.approx(left_kg, abs=1e-12)


@pytest.mark.parametrize("is_arc", [False, True])
def test_a_thruster_that_is_closed_in_time_leaves_a_burn_what_was_given_ahead(is_arc):
    effect, timeline, tank, stuck, opened = waiting_burn(is_arc=is_arc)
    for t_s in (10.0, 13.0):
        stuck.extend(opened, t_s)
    (drained,) = [each for each in timeline.effects if each.number == 0]
    ahead_kg = opened.flow_kg_s * (8.0 if is_arc else 10.0)
    assert drained.burnt == pytest.approx((1.0 - ahead_kg) / (100.0 - ahead_kg), abs=1e-15)

    stuck.close(0, 10.0, "closed")

    assert timeline.effects == (effect,)
    assert stuck.drained == {}
    assert (tank.propellant_kg, tank.left_kg(10.0)) == pytest.approx((0.0, 1.0), abs=1e-12)


@pytest.mark.parametrize(("burnt", "end_s"), [(0.005, 14.0), (1e-5, 10.0), (0.0, 10.0)])
def test_a_drained_arc_ends_sooner_and_one_that_is_hardly_there_is_an_impulse(burnt, end_s):
    whole = Effect(
        number=0,
        kind="thrust",
        at_s=14.0,
        start_s=10.0,
        end_s=18.0,
        vector=(0.0, math.log1p(-0.01), 0.0),
        burnt=0.01,
    )

    drained = whole.drained(burnt)

    assert (drained.kind, drained.start_s) == ("thrust" if end_s > 10.0 else "impulse", 10.0)
    assert drained.end_s == pytest.approx(end_s)
    assert drained.vector == pytest.approx((0.0, math.log1p(-burnt), 0.0), abs=1e-15)
