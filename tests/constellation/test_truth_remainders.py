"""A change of truth in two parts: its first seconds before its time, the rest while those are flown."""

import math

import numpy as np
import pytest
from constellation_fakes import Star, parameters, state_rows

from madns_runtime.protocol.messages import Service
from madns_runtime.simulations.constellation.host_side import truth_remainders
from madns_runtime.simulations.constellation.messages import Command

THRUSTING = {
    "thruster": {"isp_s": 220.0, "propellant_kg": 20.0, "thrust_n": 20.0},
    "attitude": {"inertia_kg_m2": [10.0, 12.0, 14.0]},
}


def burn(number, at_s, *, commanded_s, speed=2.0):
    return Command(
        number=number, kind="delta_v", commanded_s=commanded_s, at_s=at_s, frame="rtn", vector=(0.0, speed, 0.0),
    ).to_message()  # fmt: skip


def torque(number, at_s, *, commanded_s):
    return Command(
        number=number, kind="torque", commanded_s=commanded_s, at_s=at_s, frame="body",
        vector=(1e-3, 0.0, 0.0), duration_s=0.1,
    ).to_message()  # fmt: skip


@pytest.fixture
def fly(tmp_path):
    (tmp_path / "idle.py").write_text(
        "from madns_runtime.simulations.constellation.flight.api import FlightSoftware\n"
        "class Idle(FlightSoftware):\n    pass\n"
    )

    def start(vehicle=None, count=2, **settings):
        params = parameters(flight="idle.py:Idle", vehicles=[vehicle or THRUSTING])
        star = Star(params, count, base_directory=tmp_path, **settings)
        star.run(12.0)
        return star

    return start


def left(star):
    return tuple(star.host._supply.remainders.vehicles)


def truth_of(star, vehicle=1):
    return [m for _, to, m in star.context.sent if to == star.context.agents[vehicle]]


def test_what_is_slow_to_propagate_goes_in_two_parts_that_join(fly):
    star = fly()
    star.context.sent.clear()

    star.host.receive("agent-02", torque(0, 12.1, commanded_s=11.99))

    assert left(star) == (1,)
    first = [m for m in truth_of(star) if m["kind"] == "segment"]
    ends = [m["t0_s"] + (len(m["states"]) - 1) * m["knot_s"] for m in first]
    assert max(ends) == 16.0
    assert {service for service, _ in star.context.deadlines} == {Service.SYNC}
    star.run(13.0, from_s=12.0)
    assert left(star) == ()
    rest = [m for m in truth_of(star) if m["kind"] == "segment"][len(first) :]
    assert {m["revision"] for m in (*first, *rest)} == {1}
    assert rest[0]["t0_s"] == 16.0
    assert rest[0]["states"][0].tolist() == first[-1]["states"][-1].tolist()
    assert star.host._supply.remainders.settled_in_loop == 0
    star.run(60.0, from_s=13.0)
    assert star.underruns() == 0
    assert star.summaries()["agent-02"]["joint_gap_m_max"] < 1e-6


def test_two_parts_fly_as_one_whole_does(fly, monkeypatch):
    split = fly()
    split.host.receive("agent-02", burn(0, 25.0, commanded_s=11.99))
    split.host.receive("agent-02", torque(1, 12.2, commanded_s=11.99))
    split.run(60.0, from_s=12.0)
    monkeypatch.setattr(truth_remainders, "WORTH_IT", math.inf)
    whole = fly()
    whole.host.receive("agent-02", burn(0, 25.0, commanded_s=11.99))
    whole.host.receive("agent-02", torque(1, 12.2, commanded_s=11.99))
    whole.run(60.0, from_s=12.0)

    rows, expected = state_rows(split, "agent-02"), state_rows(whole, "agent-02")
    # The integrator's own tolerance, not its steps: 1e-10 of 7000 km after 50 s.
    assert np.abs(rows[:, 1:4] - expected[:, 1:4]).max() < 1e-5
    assert np.abs(rows[:, 4:7] - expected[:, 4:7]).max() < 1e-7
    assert split.underruns() == 0


def test_a_point_mass_that_coasts_and_lockstep_are_not_split(fly):
    point, lockstep = fly({"thruster": {"isp_s": 220.0, "propellant_kg": 20.0}}), fly()
    lockstep.context.is_lockstep = True

    for star in (point, lockstep):
        star.host.receive("agent-02", burn(0, 12.1, commanded_s=11.99))

        assert left(star) == ()


def test_of_a_vehicle_commanded_at_every_tick_only_the_last_rest_is_computed(fly):
    star = fly()
    jobs = len(star.context.jobs)

    for number in range(20):
        now_s = 12.0 + 0.1 * number
        star.host.receive("agent-02", torque(number, now_s + 0.1, commanded_s=now_s))
        assert left(star) == (1,)
        star.run(now_s + 0.1, from_s=now_s)

    names = [function.__name__ for function, _ in star.context.jobs[jobs:]]
    assert names.count("propagate_vehicles") == 0
    star.run(30.0, from_s=14.0)
    names = [function.__name__ for function, _ in star.context.jobs[jobs:]]
    assert names.count("propagate_vehicles") == 1
    assert left(star) == ()
    assert star.underruns() == 0


def test_a_rest_that_the_executor_does_not_bring_is_computed_in_the_loop(fly):
    star = fly()
    star.job_s = 100.0

    star.host.receive("agent-02", torque(0, 12.1, commanded_s=11.99))
    star.run(14.9, from_s=12.0)
    assert left(star) == (1,)
    star.run(15.2, from_s=14.9)

    assert left(star) == ()
    assert star.host._supply.remainders.settled_in_loop == 1
    assert star.underruns() == 0


def test_a_command_behind_the_urgent_part_makes_it_whole_first(fly):
    star = fly()
    star.host.receive("agent-02", torque(0, 12.1, commanded_s=11.99))

    star.host.receive("agent-02", burn(1, 25.0, commanded_s=11.99))

    assert star.host._supply.remainders.settled_in_loop == 1
    star.run(60.0, from_s=12.0)
    maneuvers = star.host.finish()["maneuvers"]
    assert (maneuvers["executed"], star.underruns()) == (2, 0)


def test_windows_that_come_before_the_rest_take_the_new_future(fly):
    # A batch is asked for at 20 s: there before the rest, and after it.
    star, quick = fly(), fly()
    for each, job_s in ((star, 0.1), (quick, 0.001)):
        each.run(19.9, from_s=12.0)
        each.job_s = job_s
        each.run(20.09, from_s=19.9)
        each.host.receive("agent-02", torque(0, 20.2, commanded_s=20.08))
        each.run(60.0, from_s=20.09)

    error = state_rows(star, "agent-02")[:, 1:4] - state_rows(quick, "agent-02")[:, 1:4]
    assert np.abs(error).max() < 1e-3
    assert (star.underruns(), quick.underruns()) == (0, 0)
    assert [each.host._supply.remainders.settled_in_loop for each in (star, quick)] == [1, 0]
    assert star.host._supply.jobs._owners == {}


def test_an_agent_that_joins_in_between_is_given_all_of_it(fly):
    star = fly()
    star.host.agent_lost("agent-02", "killed")
    star.host.receive("agent-02", torque(0, 12.1, commanded_s=11.99))
    assert left(star) == (1,)

    initial = star.host.initial_data("agent-02")

    assert left(star) == ()
    parts = [initial["segment"], *initial["more"]]
    assert max(m["t0_s"] + (len(m["states"]) - 1) * m["knot_s"] for m in parts) >= 20.0
