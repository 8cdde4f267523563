"""What becomes of commands: accepted, postponed or refused with a reason, and the inequality's account."""

import math
from dataclasses import replace

import pytest

from madns_runtime.errors import PluginError
from madns_runtime.simulations.constellation.equipment import (
    Attitude,
    ReactionWheels,
    Thruster,
    Vehicle,
)
from madns_runtime.simulations.constellation.messages import Command
from madns_runtime.simulations.constellation.parameters import Maneuvers
from madns_runtime.simulations.constellation.truth.maneuvers.effects import Timeline
from madns_runtime.simulations.constellation.truth.maneuvers.rules import (
    WAITING_MAX,
    ManeuverDesk,
    Rules,
)

THRUSTER = Thruster(isp_s=220.0, propellant_kg=20.0)
PLAIN = Vehicle(thruster=THRUSTER, ballistic_m2_kg_range=(0.01, 0.05))
RIGID = Vehicle(
    thruster=THRUSTER,
    attitude=Attitude(
        inertia_kg_m2=(1.0, 1.0, 1.0),
        wheels=ReactionWheels(torque_n_m_max=0.1, momentum_n_m_s_max=1.0),
    ),
)


def desk(vehicle=PLAIN, *, can_maneuver=True, knot_s=1.0, duration_s=100.0, **settings):
    settings = Maneuvers(**{"propagation_s": 0.02, "network_s": 0.03, **settings})
    rules = Rules(
        settings=settings,
        can_maneuver=can_maneuver,
        duration_s=duration_s,
        tick_hz=10.0,
        knot_s=knot_s,
        seed=5,
    )
    return ManeuverDesk(rules, ["a"], [vehicle], [Timeline(vehicle.ballistic_m2_kg)])


def command(at_s=20.0, number=0, **rest):
    values = {
        "kind": "delta_v",
        "commanded_s": 10.0,
        "frame": "rtn",
        "vector": (0.0, 1.0, 0.0),
        **rest,
    }
    return Command(number=number, at_s=at_s, **values)


def test_a_command_in_time_is_accepted_at_its_time():
    taken = desk().decide(0, command(20.3), 10.001)

    assert (taken.status, taken.at_s, taken.reason) == ("accepted", 20.3, "")
    assert (taken.effect.kind, taken.effect.start_s, taken.effect.frame) == ("impulse", 20.3, "rtn")
    result = taken.result(3)
    assert (result.revision, result.delta_v_m_s) == (3, 1.0)
    assert result.propellant_kg == pytest.approx(20.0 - 0.04634, abs=1e-5)


def test_one_ticks_lead_is_feasible_and_less_than_the_margins_is_not():
    assert desk().decide(0, command(10.1), 10.002).status == "accepted"
    assert desk().decide(0, command(10.1), 10.049).status == "accepted"
    late = desk().decide(0, command(10.1), 10.06)
    assert (late.status, late.at_s) == ("postponed", 10.2)
    assert late.reason == "0.01 s too late"


def test_an_agent_that_lives_behind_has_its_time_later_too():
    taken = desk().decide(0, command(10.1, phase_s=0.09), 10.092)

    assert (taken.status, taken.at_s) == ("accepted", 10.1)
    late = desk().decide(0, command(10.1, phase_s=0.09), 10.192)
    # Feasible from 10.242 s on, which in its own time is 10.152 s.
    assert (late.status, late.at_s) == ("postponed", 10.2)


def test_a_time_that_means_a_knot_is_the_knots():
    assert desk().decide(0, command(20.00000005), 10.0).effect.start_s == 20.0
    assert desk().decide(0, command(20.3), 10.0).effect.start_s == 20.3


@pytest.mark.parametrize("at_s", [0.0, 10.0])
def test_a_late_command_is_postponed_to_a_later_tick_however_little_time_is_allowed(at_s):
    # Truth has no knot before time 0 from which it could begin anew.
    hasty = desk(propagation_s=1e-10, network_s=0.0)

    taken = hasty.decide(0, command(at_s, commanded_s=at_s), at_s)

    assert (taken.status, taken.at_s) == ("postponed", at_s + 0.1)
    assert taken.effect.start_s == at_s + 0.1


def test_late_commands_are_refused_where_the_scenario_says_so():
    strict = desk(late="refuse")

    taken = strict.decide(0, command(9.0), 10.0)

    assert (taken.status, taken.effect, taken.reason) == ("refused", None, "1.05 s too late")
    assert strict.account.refused == 1


@pytest.mark.parametrize(
    ("wrong", "reason"),
    [
        ({"at_s": 100.1}, "beyond the run"),
        ({"at_s": 100.0}, "100 s is the end of the run's 100 s"),
        ({"at_s": 100.0 - 1e-8}, "100 s is the end of the run's 100 s"),
        (
            {"at_s": 100.0, "kind": "ballistic", "vector": (0.02, 0.0, 0.0)},
            "100 s is the end of the run's 100 s",
        ),
        ({"at_s": math.nan}, "finite"),
        ({"vector": (math.inf, 0.0, 0.0)}, "finite"),
        ({"vector": (0.0, 0.0, 0.0)}, "0 m/s"),
        ({"vector": (0.0, 1e-200, 0.0)}, "a change of velocity of 1e-200 m/s"),
        ({"vector": (1e300, 0.0, 0.0)}, "propellant"),
        ({"at_s": 1e300}, "beyond the run"),
        ({"at_s": math.inf}, "finite"),
        ({"phase_s": math.nan}, "finite"),
        ({"vector": (math.nan, 0.0, 0.0)}, "finite"),
        ({"kind": "torque", "frame": "body", "duration_s": math.nan}, "finite"),
        ({"kind": "torque", "frame": "body", "vector": (0.0, 0.0, -math.inf)}, "finite"),
        ({"kind": "ballistic", "vector": (math.nan, 0.0, 0.0)}, "finite"),
        ({"vector": (900.0, 0.0, 0.0)}, "propellant"),
        ({"frame": "body"}, "without attitude"),
        ({"kind": "torque", "frame": "body", "duration_s": 1.0}, "without attitude"),
        ({"kind": "ballistic", "vector": (0.06, 0.0, 0.0)}, "expected 0.01 to 0.05"),
        ({"number": -1}, "from 0 on"),
    ],
)
def test_what_cannot_be_done_is_refused_and_says_why(wrong, reason):
    at = desk()

    taken = at.decide(0, command(**wrong), 10.0)

    assert taken.status == "refused"
    assert reason in taken.reason
    assert at._timelines[0].effects == ()
    assert (at.account.commanded, at.account.refused) == (1, 1)


def test_what_is_postponed_to_the_end_of_the_run_is_refused():
    taken = desk().decide(0, command(99.9), 99.9)

    assert (taken.status, taken.at_s) == ("refused", 100.0)


@pytest.mark.parametrize(("at_s", "status"), [(100.0, "accepted"), (100.1, "refused")])
def test_a_burn_around_the_end_of_the_run_is_flown_until_then(at_s, status):
    slow = Vehicle(thruster=replace(THRUSTER, thrust_n=20.0))

    taken = desk(slow).decide(0, command(at_s), 10.0)

    assert taken.status == status


@pytest.mark.parametrize(
    ("at_s", "status", "reason"),
    [(1.7e308, "refused", "beyond the run"), (-1.7e308, "postponed", "too late")],
)
def test_a_time_too_large_to_have_a_knot_is_judged_as_any_other(at_s, status, reason):
    dense = desk(knot_s=0.1)

    taken = dense.decide(0, command(at_s), 10.0)

    assert taken.status == status
    assert reason in taken.reason


def test_vehicles_without_the_actuator_are_told_so():
    bare = desk(Vehicle())

    assert "no thruster" in bare.decide(0, command(), 10.0).reason
    ballistic = command(kind="ballistic", vector=(0.02, 0.0, 0.0))
    assert "cannot be changed" in bare.decide(0, ballistic, 10.0).reason
    instant = command(kind="torque", frame="body", duration_s=0.0)
    assert "duration" in desk(RIGID).decide(0, instant, 10.0).reason


@pytest.mark.parametrize(("duration_s", "status"), [(60.0, "accepted"), (60.1, "refused")])
def test_a_torque_lasts_so_long_at_most_that_none_outlives_its_software_by_far(duration_s, status):
    turn = command(
        kind="torque", frame="body", vector=(1e-3, 0.0, 0.0), duration_s=duration_s, at_s=20.0
    )

    taken = desk(RIGID).decide(0, turn, 10.0)

    assert taken.status == status
    assert ("60 s at most (maneuvers.duration_s_max)" in taken.reason) == (status == "refused")


def test_truth_that_cannot_be_changed_refuses_all():
    taken = desk(can_maneuver=False).decide(0, command(), 10.0)

    assert "propagator" in taken.reason


def test_waiting_commands_are_bounded_and_make_room_when_executed():
    at = desk()
    taken = [
        at.decide(0, command(20.0 + n, number=n, vector=(0.001, 0, 0)), 10.0)
        for n in range(WAITING_MAX + 1)
    ]

    assert [t.status for t in taken[:-1]] == ["accepted"] * WAITING_MAX
    assert "waiting" in taken[-1].reason
    at.execute(taken[0])
    assert at.decide(0, command(99.0, number=99), 10.0).status == "accepted"


def test_a_finite_burn_is_centred_on_its_time_and_late_by_its_beginning():
    slow = Vehicle(thruster=Thruster(isp_s=220.0, propellant_kg=20.0, thrust_n=20.0))

    taken = desk(slow).decide(0, command(20.0), 10.0)
    late = desk(slow).decide(0, command(12.0), 10.0)

    # 100 kg and 1 m/s at 20 N: 5 s, less what the vehicle gets lighter.
    length_s = taken.effect.end_s - taken.effect.start_s
    assert length_s == pytest.approx(4.9988, abs=1e-4)
    assert (taken.effect.start_s + taken.effect.end_s) / 2 == pytest.approx(20.0)
    assert (late.status, late.effect.start_s) == ("postponed", 10.1)
    assert late.at_s == pytest.approx(10.1 + length_s / 2)


def test_a_thruster_does_one_burn_at_a_time():
    at = desk(Vehicle(thruster=Thruster(isp_s=220.0, propellant_kg=20.0, thrust_n=20.0)))
    at.decide(0, command(20.0), 10.0)
    left_kg = at.decide(0, command(50.0, number=1), 10.0).propellant_kg

    busy = at.decide(0, command(22.0, number=2), 10.0)

    assert busy.reason == "thruster busy from 17.501 s to 22.499 s"
    assert busy.propellant_kg == left_kg
    # What is over at once, too.
    short = at.decide(0, command(20.1, number=3, vector=(0.001, 0.0, 0.0)), 10.0)
    before = at.decide(0, command(13.0, number=4), 10.0)
    assert (short.reason, before.reason) == (busy.reason, "")
    at = desk(at._vehicles[0])
    at.decide(0, command(20.1, number=3, vector=(0.001, 0.0, 0.0)), 10.0)
    assert "busy from 20.100 s to 20.100 s" in at.decide(0, command(20.0), 10.0).reason


@pytest.mark.parametrize("is_later_first", [False, True])
def test_a_burn_may_begin_where_another_ends_whatever_their_times_are_rounded_to(is_later_first):
    exhaust_m_s = 220.0 * 9.80665
    vehicle = Vehicle(thruster=replace(THRUSTER, thrust_n=20.0))
    for tenth in range(1, 40):
        # Both as long as the rocket equation makes them in the order in which they are commanded.
        ratio = math.exp(-0.1 * tenth / exhaust_m_s)
        first_s = 100.0 * (1.0 - ratio) * exhaust_m_s / 20.0
        second_s = first_s * ratio
        lengths_s = (second_s, first_s) if is_later_first else (first_s, second_s)
        starts_s = (20.7, 20.7 + lengths_s[0])
        middles_s = [starts_s[n] + lengths_s[n] / 2.0 for n in (0, 1)]
        station = desk(vehicle)

        taken = [
            station.decide(0, command(at_s, number, vector=(0.0, 0.1 * tenth, 0.0)), 10.0)
            for number, at_s in enumerate(reversed(middles_s) if is_later_first else middles_s)
        ]

        assert [one.status for one in taken] == ["accepted", "accepted"]
        early, late = sorted((one.effect for one in taken), key=lambda effect: effect.start_s)
        assert early.end_s == late.start_s


def test_an_impulse_may_be_where_a_burn_ends():
    station = desk(Vehicle(thruster=replace(THRUSTER, thrust_n=1e5)))
    burn = station.decide(0, command(20.3, vector=(0.0, 100.0, 0.0)), 10.0)

    taken = station.decide(0, command(burn.effect.end_s - 1e-9, 1, vector=(0.0, 1.0, 0.0)), 10.0)

    assert (taken.status, taken.effect.kind) == ("accepted", "impulse")
    assert taken.effect.at_s == taken.effect.start_s == taken.effect.end_s == burn.effect.end_s


@pytest.mark.parametrize("factor", [0.0, 1e-3])
def test_a_thruster_that_gives_next_to_nothing_takes_its_command_as_ever(factor):
    thruster = Thruster(isp_s=220.0, propellant_kg=20.0, minimum_impulse_n_s=50.0)
    weak = desk(replace(PLAIN, thruster=thruster))
    weak.failures.weaken(1, {0: factor})

    taken = weak.decide(0, command(20.0), 10.0)

    assert (taken.status, taken.reason, taken.expected_m_s) == ("accepted", "", 1.0)
    over = weak.execute(taken)
    assert over.delta_v_m_s == pytest.approx(factor)
    assert weak.account.propellant_kg == pytest.approx(0.0463 * factor, rel=1e-2)


def test_impulses_of_one_moment_add_up():
    at = desk()

    both = [at.decide(0, command(20.0, number=n), 10.0) for n in range(2)]

    assert [taken.status for taken in both] == ["accepted"] * 2
    assert both[1].propellant_kg < both[0].propellant_kg


def test_what_was_burnt_counts_when_it_is_burnt_and_what_waits_is_told():
    at = desk()
    first, second = (at.decide(0, command(20.0 + n, number=n), 10.0) for n in range(2))
    assert (at.waiting, at.account.propellant_kg, at.account.delta_v_m_s) == (2, 0.0, 0.0)

    at.execute(first)

    assert (at.waiting, at.account.executed) == (1, 1)
    assert at.account.propellant_kg == pytest.approx(20.0 - first.propellant_kg)
    assert at.account.delta_v_m_s == 1.0
    assert second.used_kg > 0.0


def test_the_tank_holds_what_is_booked_for_burns_that_wait():
    at = desk()
    last, first = (at.decide(0, command(at_s, number=n), 10.0) for n, at_s in ((0, 40), (1, 20)))
    booked_kg = last.used_kg + first.used_kg
    first_kg = 100.0 * -math.expm1(-1.0 / (220.0 * 9.80665))
    drag = at.decide(0, command(30.0, 2, kind="ballistic", vector=(0.02, 0.0, 0.0)), 10.0)

    told = [at.execute(each).result(0, is_over=True) for each in (first, drag, last)]

    assert first.propellant_kg == pytest.approx(20.0 - booked_kg)  # as if it came after the other
    left_kg = [20.0 - first_kg, 20.0 - first_kg, 20.0 - booked_kg]
    assert [each.propellant_kg for each in told] == pytest.approx(left_kg, abs=1e-12)


@pytest.mark.parametrize("thrust_n", [None, 100.0])
def test_the_tank_holds_what_burns_use_in_the_order_of_their_times(thrust_n):
    # By Tsiolkovsky: 500 kg, of which 340 kg may burn, at 200 s; halves the mass, and two small ones before.
    exhaust_m_s, begins_kg = 200.0 * 9.80665, 340.0
    thruster = Thruster(isp_s=200.0, propellant_kg=begins_kg, thrust_n=thrust_n)
    vehicle = Vehicle(mass_kg=500.0, thruster=thruster, ballistic_m2_kg_range=(0.01, 0.05))
    at = desk(vehicle, duration_s=20_000.0)
    half_m_s = exhaust_m_s * math.log(2.0)
    burns = [(half_m_s, 12_000.0), (100.0, 500.0), (50.0, 3000.0)]
    half, first, second = (
        at.decide(0, command(at_s, n, vector=(m_s, 0.0, 0.0)), 10.0)
        for n, (m_s, at_s) in enumerate(burns)
    )
    drag = at.decide(0, command(500.0, 3, kind="ballistic", vector=(0.02, 0.0, 0.0)), 10.0)

    left_kg = [at.execute(each).propellant_kg for each in (first, drag, second, half)]

    masses_kg = [500.0 * math.exp(-m_s / exhaust_m_s) for m_s in (100.0, 150.0, half_m_s + 150.0)]
    during_kg = begins_kg - 500.0 + (500.0 + masses_kg[0]) / 2.0 if thrust_n else None
    after_kg = [begins_kg - 500.0 + kg for kg in masses_kg]
    drag_kg = after_kg[0] if during_kg is None else during_kg
    assert left_kg == pytest.approx([after_kg[0], drag_kg, *after_kg[1:]], abs=1e-9)


def test_burns_of_weak_thrusters_are_weighed_in_the_order_of_their_times_too():
    at = desk(duration_s=1000.0)
    late = at.decide(0, command(800.0, 0, vector=(200.0, 0.0, 0.0)), 10.0)
    at.failures.weaken(1, {0: 0.25})
    weak = at.decide(0, command(500.0, 1, vector=(200.0, 0.0, 0.0)), 10.0)

    left_kg = [at.execute(each).propellant_kg for each in (weak, late)]

    exhaust_m_s = 220.0 * 9.80665
    masses_kg = [100.0 * math.exp(-m_s / exhaust_m_s) for m_s in (50.0, 250.0)]
    assert left_kg == pytest.approx([kg - 80.0 for kg in masses_kg], abs=1e-9)


def test_a_torque_that_ends_during_or_after_a_burn_tells_what_is_left_then():
    slow = replace(RIGID, thruster=replace(THRUSTER, thrust_n=20.0))
    torque = {"kind": "torque", "frame": "body", "vector": (0.0, 0.0, 0.01)}
    at = desk(slow)
    during = at.decide(0, command(30.0, 0, duration_s=10.0, **torque), 10.0)
    after = at.decide(0, command(50.0, 1, duration_s=5.0, **torque), 10.0)
    burn = at.decide(0, command(40.0, 2), 10.0)
    assert burn.effect.start_s < 40.0 < burn.effect.end_s < 50.0

    left_kg = [at.execute(each).propellant_kg for each in (during, burn, after)]

    # T_m is the middle of a burn, whose flow is even.
    half_kg, over_kg = 20.0 - burn.used_kg / 2.0, 20.0 - burn.used_kg
    assert left_kg == pytest.approx([half_kg, over_kg, over_kg], abs=1e-12)


def test_a_burn_tells_truth_how_much_lighter_it_makes_the_vehicle():
    slow = Vehicle(thruster=Thruster(isp_s=220.0, propellant_kg=20.0, thrust_n=20.0))

    effect = desk(slow).decide(0, command(40.0, vector=(5.0, 0.0, 0.0)), 5.0).effect

    assert effect.burnt == pytest.approx(1.0 - math.exp(-5.0 / (220.0 * 9.80665)))


def test_a_torque_that_no_knot_could_tell_is_refused():
    free = Vehicle(attitude=Attitude(inertia_kg_m2=(10.0, 10.0, 2.0)))
    torque = {"kind": "torque", "frame": "body"}

    def given(vector, duration_s):
        at = desk(free, duration_s_max=1e10)
        return at.decide(0, command(vector=vector, duration_s=duration_s, **torque), 10.0)

    assert given((3.0, 0.0, 0.0), 10.0).status == "accepted"
    assert "6 rad/s; less than 3.142 rad/s" in given((6.0, 0.0, 0.0), 10.0).reason
    assert "5 rad/s; less than 3.142 rad/s" in given((0.0, 0.0, 1.0), 10.0).reason
    # Of a longer one than the run only the run's part acts.
    assert given((0.0, 0.1, 0.0), 1e9).status == "accepted"
    assert "rad/s" in given((0.0, 1e300, 0.0), 1e9).reason


def test_a_torque_fills_wheels_that_later_ones_find_full():
    at = desk(RIGID)
    torque = {"kind": "torque", "frame": "body", "duration_s": 10.0}

    first = at.decide(0, command(20.0, vector=(0.0, 0.0, 0.09), **torque), 10.0)
    second = at.decide(0, command(40.0, number=1, vector=(0.0, 0.0, 0.09), **torque), 10.0)
    third = at.decide(0, command(60.0, number=2, vector=(0.0, 0.0, 0.09), **torque), 10.0)

    assert first.effect.vector == (0.0, 0.0, 0.09)
    assert second.effect.vector[2] == pytest.approx(0.01)
    assert second.reason == "z: wheels saturate"
    assert third.reason == "the wheels are saturated"


def test_a_torque_that_comes_before_others_leaves_them_room_in_the_wheels():
    at = desk(RIGID)
    torque = {"kind": "torque", "frame": "body", "duration_s": 10.0}

    last = at.decide(0, command(60.0, 0, vector=(0.0, 0.0, 0.09), **torque), 10.0)
    back = at.decide(0, command(20.0, 1, vector=(0.0, 0.0, -0.1), **torque), 10.0)
    more = at.decide(0, command(35.0, 2, vector=(0.0, 0.0, -0.1), **torque), 10.0)
    on = at.decide(0, command(46.0, 3, vector=(0.0, 0.0, 0.1), **torque), 10.0)

    # Held at 30, 56 and 70 s: 1, 0 and -0.9 N m s. One more torque would have made it 1.9 at 45 s.
    assert [each.effect and each.effect.vector[2] for each in (last, back, on)] == pytest.approx(
        [0.09, -0.1, 0.1]
    )
    assert more.reason == "the wheels are saturated"


def test_the_inequality_is_measured_in_the_agents_own_time():
    at = desk()
    taken = at.decide(0, command(10.1, phase_s=0.05), 10.052)

    times = at.measure(taken, 10.055)

    assert times.network_s == pytest.approx(0.002)
    assert times.propagation_s == pytest.approx(0.003)
    assert times.slack_s == pytest.approx(0.1 - 0.003 - 2 * 0.002)
    assert at.account.inequality_broken == 0
    at.measure(at.decide(0, command(10.1, number=1), 10.09), 10.095)
    assert at.account.inequality_broken == 1


def test_a_late_command_that_finds_its_actuator_busy_counts_as_late():
    at = desk(Vehicle(thruster=Thruster(isp_s=220.0, propellant_kg=20.0, thrust_n=20.0)))
    at.decide(0, command(13.0), 10.0)

    busy = at.decide(0, command(10.0, number=1), 10.0)

    assert (busy.status, busy.is_late) == ("refused", True)
    assert "thruster busy" in busy.reason
    at.measure(busy, None)
    assert at.account.inequality_broken == 1


def test_what_came_late_and_was_limited_says_both():
    torque = {"kind": "torque", "frame": "body", "duration_s": 1.0}

    taken = desk(RIGID).decide(0, command(10.0, vector=(0.0, 0.2, 0.0), **torque), 10.0)

    assert (taken.status, taken.at_s) == ("postponed", 10.1)
    assert taken.reason == "0.05 s too late; y: 0.1 N m at most"


def test_a_burn_is_to_be_in_truth_when_it_begins():
    slow = Vehicle(thruster=Thruster(isp_s=220.0, propellant_kg=20.0, thrust_n=20.0))
    at, strict = desk(slow), desk(slow, late="refuse")

    # 5 s long: it begins at 17.5 s, or would have begun at 9.5 s.
    taken, late = at.decide(0, command(20.0), 10.0), strict.decide(0, command(12.0), 10.0)

    assert at.measure(taken, 10.1).slack_s == pytest.approx(7.5 - 0.1, abs=1e-3)
    assert strict.measure(late, None).slack_s == pytest.approx(-0.5 - 0.02, abs=1e-3)


def test_a_command_too_late_for_what_is_allowed_counts_although_it_was_quick():
    # As in lockstep, where nothing takes time.
    at, strict = desk(), desk(late="refuse")

    postponed, refused = (d.decide(0, command(10.0), 10.0) for d in (at, strict))

    assert at.measure(postponed, 10.0).slack_s == 0.0
    assert at.account.inequality_broken == 1
    times = strict.measure(refused, None)
    assert (times.propagation_s, times.slack_s) == (None, pytest.approx(-0.02))
    assert (strict.account.inequality_broken, strict.account.propagation_s_max) == (1, 0.0)


def test_the_same_command_gets_the_same_error_whatever_came_before():
    noisy = Vehicle(thruster=Thruster(isp_s=220.0, propellant_kg=20.0, magnitude_error=0.05))
    first, second = desk(noisy), desk(noisy)
    second.decide(0, command(30.0, number=7), 10.0)

    given = [d.decide(0, command(20.0, number=4), 10.0).effect.vector for d in (first, second)]

    assert given[0] == given[1] != (0.0, 1.0, 0.0)


def test_commands_travel_whole_and_others_are_named():
    original = command(20.3, number=4, phase_s=0.02)

    assert Command.from_message(original.to_message()) == original
    for wrong in ({"command": "explode"}, {"frame": "moon"}, {"vector": [1.0]}, {"number": "x"}):
        with pytest.raises(PluginError, match="command|frame"):
            Command.from_message({**original.to_message(), **wrong})
