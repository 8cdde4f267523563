"""The agent's buffer for rigid bodies, thrust arcs, and revisions that come out of order."""

import math
from datetime import UTC, datetime

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from madns_runtime.simulations.constellation.equipment import Attitude
from madns_runtime.simulations.constellation.messages import Segment
from madns_runtime.simulations.constellation.orbit.constants import EGM_96
from madns_runtime.simulations.constellation.orbit.interpolation import (
    evaluate_turn,
    turn_between,
)
from madns_runtime.simulations.constellation.orbit.quaternions import (
    normalised,
    rotation_between,
)
from madns_runtime.simulations.constellation.parameters import ScipyPropagator
from madns_runtime.simulations.constellation.thrust import Thrust
from madns_runtime.simulations.constellation.truth.propagation import PropagationParameters
from madns_runtime.simulations.constellation.truth.propagators.attitude import propagate_attitude
from madns_runtime.simulations.constellation.truth.propagators.rigid_body import (
    RigidBody,
    initial_attitude,
)
from madns_runtime.simulations.constellation.vehicle.truth_buffer import TruthBuffer

START = (7_158_136.3, 0.0, 0.0, 0.0, 500.0, 7445.0)
PARAMETERS = PropagationParameters(
    settings=ScipyPropagator(kind="scipy"),
    gravity=EGM_96,
    epoch_utc=datetime(2026, 1, 1, tzinfo=UTC),
)


def straight(t0_s, knots=11, *, knot_s=1.0, revision=0, **rest):
    """A vehicle that moves along x; its speed tells the revision."""
    states = np.zeros((knots, 6))
    speed = 7000.0 + 10.0 * revision
    states[:, 0], states[:, 3] = speed * (t0_s + np.arange(knots) * knot_s), speed
    return Segment(revision=revision, t0_s=t0_s, knot_s=knot_s, states=states, **rest)


def revision_at(buffer, t_s):
    return round((buffer.lookup(t_s)[3] - 7000.0) / 10.0)


def truth(attitude, knots_s, inertia=(12.0, 14.0, 9.0)):
    body = RigidBody(inertia_kg_m2=inertia)
    states = np.array([(*START, *attitude)])
    return propagate_attitude([body], states, t0_s=0.0, knots_s=knots_s, parameters=PARAMETERS)[0]


def worst_between_knots(attitude):
    """Errors of attitude (rad) and rates (rad/s) at ten times in each interval of 60 s."""
    result = truth(attitude, np.arange(0.0, 60.01, 0.1))
    knots = result[::10]
    buffer = TruthBuffer()
    buffer.add(
        Segment(revision=0, t0_s=0.0, knot_s=1.0, states=knots[:, :6], attitude=knots[:, 6:])
    )
    angles, rates = [], []
    for index, expected in enumerate(result[:-1]):
        got = buffer.lookup(index * 0.1)
        assert len(got) == 13
        assert math.hypot(*got[6:10]) == pytest.approx(1.0, abs=1e-14)
        angles.append(math.hypot(*rotation_between(expected[6:10], got[6:10])))
        rates.append(math.dist(expected[10:], got[10:]))
    return max(angles), max(rates)


def test_attitude_between_knots_of_a_librating_body_errs_by_next_to_nothing():
    librating = initial_attitude(
        Attitude(inertia_kg_m2=(12.0, 14.0, 9.0), rates_deg_s=(0.02, 0.01, -0.02)),
        START[:3],
        START[3:],
    )
    angle_rad, rate_rad_s = worst_between_knots(librating)

    assert angle_rad < 1e-13
    assert rate_rad_s < 1e-13


def test_attitude_between_knots_of_a_tumbling_body_errs_by_microdegrees():
    angle_rad, rate_rad_s = worst_between_knots((0.0, 0.0, 0.0, 1.0, 0.06, -0.06, 0.06))

    assert 1e-10 < angle_rad < 1e-7
    assert rate_rad_s < 1e-6


def test_a_steady_spin_is_exact_however_fast():
    rate = 3.0
    first, second = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, rate), [0.0] * 7
    second[2:4], second[6] = (math.sin(rate / 2), math.cos(rate / 2)), rate
    turn = turn_between(first, second, 1.0)

    for s in (0.0, 0.003, 0.1, 0.5, 1.0):
        expected = (0.0, 0.0, math.sin(rate * s / 2), math.cos(rate * s / 2), 0.0, 0.0, rate)
        assert evaluate_turn(turn, s, 1.0) == pytest.approx(expected, abs=1e-14)


numbers = st.floats(-1.0, 1.0)
knots = st.tuples(*[numbers] * 4, *[st.floats(-0.5, 0.5)] * 3).filter(
    lambda knot: sum(x * x for x in knot[:4]) > 1e-3
)


@given(knots, knots, st.floats(0.1, 2.0))
def test_both_ends_of_an_interval_are_its_knots(first, second, knot_s):
    first, second = (normalised(k[:4]) + k[4:] for k in (first, second))
    turn = turn_between(first, second, knot_s)
    begin, end = evaluate_turn(turn, 0.0, knot_s), evaluate_turn(turn, 1.0, knot_s)

    assert begin == pytest.approx(first, abs=1e-12)
    assert math.hypot(*rotation_between(second[:4], end[:4])) < 1e-12
    assert end[4:] == pytest.approx(second[4:], abs=1e-9)


def test_the_sign_of_the_quaternion_never_jumps():
    result = truth((0.0, 0.0, 0.0, 1.0, 0.0, -0.35, 0.0), np.arange(0.0, 61.0))
    attitude = result[:, 6:].copy()
    # The same attitudes with signs at random, as if every knot had been computed by itself.
    attitude[np.random.default_rng(3).random(61) < 0.5, :4] *= -1.0
    buffer = TruthBuffer()
    for first in range(0, 60, 10):
        part = slice(first, first + 11)
        buffer.add(
            Segment(
                revision=0,
                t0_s=float(first),
                knot_s=1.0,
                states=result[part, :6],
                attitude=attitude[part],
            )
        )
    looked_up = np.array([buffer.lookup(t * 0.1)[6:10] for t in range(600)])

    assert np.sum(looked_up[1:] * looked_up[:-1], axis=1).min() > 0.999


def test_a_point_mass_stays_one():
    buffer = TruthBuffer()
    body = truth((0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.1), np.arange(0.0, 11.0))
    with_attitude = Segment(
        revision=0, t0_s=0.0, knot_s=1.0, states=body[:, :6], attitude=body[:, 6:]
    )
    buffer.add(with_attitude)
    buffer.add(straight(10.0))

    assert len(buffer.lookup(9.5)) == 13
    assert len(buffer.lookup(10.5)) == 6


def test_thrust_and_impulses_add_up_over_time():
    buffer = TruthBuffer()
    thrust = Thrust(start_s=5.25, acceleration_m_s2=(0.1, 0.0, -0.2))
    buffer.add(straight(0.0, 21))
    # Speeds differ by 10 m/s from revision to revision: an impulse at the beginning of each.
    buffer.add(straight(5.25, 2, knot_s=4.5, revision=1, thrust=thrust))
    buffer.add(straight(9.75, 12, revision=1))
    given = []
    for t_s in (5.0, 5.2, 5.25, 7.25, 9.7, 9.75, 20.75):
        assert buffer.lookup(t_s) is not None
        given.append(buffer.given_m_s(t_s))

    assert np.array(given) == pytest.approx(
        np.array(
            [((0, 0, 0), (0, 0, 0))] * 2
            + [((x, 0, z), (10, 0, 0)) for x, z in ((0, 0), (0.2, -0.4), (0.445, -0.89))]
            + [((0.45, 0, -0.9), (10, 0, 0))] * 2
        ),
        abs=1e-9,
    )


def test_a_burn_between_two_lookups_is_not_lost():
    buffer = TruthBuffer()
    buffer.add(straight(0.0, 21))
    buffer.lookup(5.0)
    buffer.given_m_s(5.0)
    thrust = Thrust(start_s=5.01, acceleration_m_s2=(1.0, 2.0, 0.0))
    buffer.add(straight(5.01, 2, knot_s=0.02, revision=1, thrust=thrust))
    buffer.add(straight(5.03, 2, knot_s=0.97, revision=1))
    buffer.lookup(5.1)

    thrust_m_s, impulses_m_s = buffer.given_m_s(5.1)
    assert thrust_m_s == pytest.approx((0.02, 0.04, 0.0), abs=1e-9)
    assert impulses_m_s == pytest.approx((10.0, 0.0, 0.0), abs=1e-9)


def test_a_burn_that_is_cut_short_late_is_taken_back():
    buffer = TruthBuffer()
    buffer.add(straight(0.0, 11, thrust=Thrust(start_s=0.0, acceleration_m_s2=(1.0, 0.0, 0.0))))
    buffer.lookup(0.0)
    buffer.given_m_s(0.0)
    buffer.lookup(5.0)
    assert buffer.given_m_s(5.0)[0][0] == pytest.approx(5.0)

    buffer.add(straight(4.0, 11, revision=1))  # without thrust, and 10 m/s faster
    buffer.lookup(5.1)

    thrust_m_s, impulses_m_s = buffer.given_m_s(5.1)
    assert (thrust_m_s[0], impulses_m_s[0]) == pytest.approx((4.0, 10.0))


def test_a_revision_may_begin_off_the_grid_and_go_on_along_it():
    buffer = TruthBuffer()
    buffer.add(straight(0.0, 21))
    buffer.add(straight(7.3, 2, knot_s=0.7, revision=1))
    buffer.add(straight(8.0, 13, revision=1))
    served = [revision_at(buffer, t_s) for t_s in (7.25, 7.3, 7.99, 8.0, 8.01, 20.0)]

    assert served == [0, 1, 1, 1, 1, 1]
    assert buffer.joint_gap_m_max == pytest.approx(0.0, abs=1e-9)
    assert buffer.underruns == 0


def test_the_first_segment_of_a_revision_may_come_after_its_second():
    buffer = TruthBuffer()
    for t0_s in (0.0, 10.0, 18.0):
        buffer.add(straight(t0_s))
    buffer.add(straight(20.0, revision=1))
    buffer.add(straight(17.3, 2, knot_s=2.7, revision=1))
    served = [revision_at(buffer, t_s) for t_s in (17.2, 17.3, 18.5, 20.5)]

    assert served == [0, 1, 1, 1]


def test_an_old_segment_never_overlays_a_revision_between_it_and_the_newest():
    buffer = TruthBuffer()
    buffer.add(straight(0.0, 51))
    buffer.add(straight(20.0, revision=1))
    buffer.add(straight(40.0, revision=2))

    assert buffer.add(straight(25.0, 31)) is False
    assert buffer.add(straight(30.0, 21, revision=1)) is True
    assert [revision_at(buffer, t_s) for t_s in (19.9, 20.0, 35.0, 45.0)] == [0, 1, 1, 2]


@given(
    st.lists(
        # Times in quarters of a second: between a tick and a knot lies more than rounding, or nothing.
        st.tuples(
            st.integers(0, 40),
            st.integers(2, 15),
            st.integers(0, 4),
            st.integers(0, 12).map(lambda quarters: quarters / 4),
        ),
        max_size=30,
    )
)
def test_whatever_arrives_the_newest_revision_of_a_time_is_served_or_none(arrivals):
    buffer, begun, now_s = TruthBuffer(), {}, 0.0
    for t0_s, count, revision, passed_s in arrivals:
        if buffer.add(straight(float(t0_s), count, revision=revision)):
            begun[revision] = min(begun.get(revision, math.inf), float(t0_s))
        now_s += passed_s
        if buffer.lookup(now_s) is not None:
            newest = max(number for number, at_s in begun.items() if at_s <= now_s)
            assert revision_at(buffer, now_s) == newest
        ahead = sum(at_s > now_s for _, at_s in buffer._starts)
        assert ahead <= len(buffer._pieces)
