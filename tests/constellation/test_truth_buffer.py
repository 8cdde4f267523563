"""The agent's buffer: bounded, continuous, counting what is missing, obeying revisions."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from madns_runtime.simulations.constellation.messages import Segment
from madns_runtime.simulations.constellation.vehicle import truth_buffer
from madns_runtime.simulations.constellation.vehicle.truth_buffer import TruthBuffer


def straight(t0_s, knots=11, *, knot_s=1.0, revision=0, speed=7000.0, x0=0.0):
    """A vehicle that moves along x at constant speed."""
    t = t0_s + np.arange(knots) * knot_s
    states = np.zeros((knots, 6))
    states[:, 0], states[:, 3] = x0 + speed * t, speed
    return Segment(revision=revision, t0_s=t0_s, knot_s=knot_s, states=states)


def test_truth_between_knots_is_continuous_across_segments():
    buffer = TruthBuffer()
    buffer.add(straight(0.0))
    buffer.add(straight(10.0))

    for t in np.arange(0.0, 20.01, 0.13):
        x, _, _, vx, _, _ = buffer.lookup(float(t))
        assert x == pytest.approx(7000.0 * t, abs=1e-8)
        assert vx == pytest.approx(7000.0, abs=1e-8)
    assert buffer.underruns == 0
    assert buffer.joint_gap_m_max == 0.0


def test_beyond_the_last_knot_nothing_is_made_up():
    buffer = TruthBuffer()
    buffer.add(straight(0.0))

    assert buffer.lookup(10.0) is not None
    assert buffer.lookup(10.1) is None
    assert buffer.lookup(10.2) is None
    assert buffer.underruns == 2


def test_an_empty_buffer_and_a_time_before_its_truth_are_underruns():
    buffer = TruthBuffer()
    assert buffer.lookup(0.0) is None
    buffer.add(straight(5.0))

    assert buffer.lookup(4.9) is None
    assert buffer.lookup(5.0) is not None
    assert buffer.underruns == 2


def test_truth_after_a_hole_is_served_again():
    buffer = TruthBuffer()
    buffer.add(straight(0.0))
    buffer.add(straight(20.0))

    assert buffer.lookup(9.0) is not None
    assert buffer.lookup(15.0) is None
    assert buffer.lookup(20.0) is not None
    assert buffer.underruns == 1


def test_of_joints_that_differ_by_rounding_the_last_one_holds():
    # Two impulses for one time, which flight software has worked out on two ways.
    first_s, second_s = 7.0 - 2.0**-50, 7.0
    buffer = TruthBuffer()
    buffer.add(straight(0.0))
    buffer.add(straight(first_s, revision=1, speed=7001.0))
    buffer.add(straight(second_s, revision=2, speed=7003.0))

    assert buffer.lookup(6.9)[3] == 7000.0
    assert buffer.given_m_s(6.9) == ((0.0,) * 3, (0.0,) * 3)
    assert buffer.lookup(second_s)[3] == 7003.0
    assert buffer.given_m_s(second_s) == ((0.0,) * 3, (3.0, 0.0, 0.0))


def test_segments_may_come_in_any_order():
    buffer = TruthBuffer()
    for t0_s in (20.0, 0.0, 10.0):
        buffer.add(straight(t0_s))

    assert all(buffer.lookup(float(t)) is not None for t in np.arange(0.0, 30.1, 0.5))


def test_rounding_of_knot_times_leaves_no_hole_at_joints():
    buffer = TruthBuffer()
    knots = [window * 10 * 0.1 for window in range(30)]
    for t0_s in knots:
        buffer.add(straight(t0_s, knot_s=0.1))

    assert all(buffer.lookup(tick * 0.1) is not None for tick in range(300))
    assert buffer.underruns == 0


def test_a_newer_revision_replaces_the_future_from_its_start():
    buffer = TruthBuffer()
    buffer.add(straight(0.0))
    buffer.add(straight(10.0))
    buffer.lookup(3.0)

    buffer.add(straight(5.5, 20, revision=1, speed=8000.0, x0=-5500.0))

    assert buffer.lookup(5.4)[3] == pytest.approx(7000.0)
    assert buffer.lookup(5.5)[3] == pytest.approx(8000.0)
    assert buffer.lookup(12.0)[0] == pytest.approx(8000.0 * 12.0 - 5500.0)
    assert buffer.end_s == 24.5


def test_a_revision_within_the_interval_in_use_counts_at_once():
    buffer = TruthBuffer()
    buffer.add(straight(0.0))
    buffer.lookup(5.1)

    buffer.add(straight(5.3, revision=1, speed=8000.0))

    assert buffer.lookup(5.2)[3] == pytest.approx(7000.0)
    assert buffer.lookup(5.35)[3] == pytest.approx(8000.0)


def test_a_segment_of_an_old_revision_fills_only_the_time_before_the_new_one():
    buffer = TruthBuffer()
    buffer.add(straight(0.0, 6))
    buffer.add(straight(12.0, revision=1, speed=8000.0))

    assert buffer.add(straight(5.0)) is True
    assert buffer.add(straight(15.0)) is False

    assert buffer.lookup(11.5)[3] == pytest.approx(7000.0)
    assert buffer.lookup(12.0)[3] == pytest.approx(8000.0)
    assert buffer.lookup(15.5)[3] == pytest.approx(8000.0)
    assert buffer.superseded == 1


def test_a_segment_from_the_past_is_worthless():
    buffer = TruthBuffer()
    buffer.add(straight(20.0))
    buffer.lookup(25.0)

    assert buffer.add(straight(0.0)) is False
    assert buffer.superseded == 1


def test_a_segment_twice_changes_nothing():
    buffer = TruthBuffer()
    for _ in range(3):
        buffer.add(straight(0.0))
        buffer.add(straight(10.0))

    assert all(buffer.lookup(float(t)) is not None for t in np.arange(0.0, 20.1, 0.25))


def test_a_step_between_segments_is_measured():
    buffer = TruthBuffer()
    buffer.add(straight(0.0))
    buffer.add(straight(10.0, x0=0.25))

    assert buffer.joint_gap_m_max == pytest.approx(0.25)


def test_more_segments_than_the_bound_are_refused_and_counted(monkeypatch):
    buffer = TruthBuffer()
    taken = [buffer.add(straight(10.0 * n)) for n in range(truth_buffer.SEGMENTS_MAX + 3)]

    assert taken.count(True) == truth_buffer.SEGMENTS_MAX
    assert buffer.refused == 3

    monkeypatch.setattr(truth_buffer, "KNOTS_HELD_MAX", 25)
    small = TruthBuffer()
    assert [small.add(straight(10.0 * n)) for n in range(3)] == [True, True, False]
    assert small.refused == 1


def test_a_segment_that_is_cut_short_gives_up_the_knots_behind(monkeypatch):
    monkeypatch.setattr(truth_buffer, "KNOTS_HELD_MAX", 170)
    buffer = TruthBuffer()
    changes = [buffer.add(straight(3.5 * n, 101, revision=n, speed=7000.0 + n)) for n in range(12)]

    assert all(changes)
    assert [buffer.lookup(3.5 * n + 3.4)[3] for n in range(12)] == pytest.approx(
        [7000.0 + n for n in range(12)]
    )


def test_an_hour_of_refills_keeps_memory_bounded():
    buffer = TruthBuffer()
    for window in range(360):
        assert buffer.add(straight(10.0 * window))
        for tick in range(10):
            assert buffer.lookup(10.0 * window + tick) is not None
        assert len(buffer._pieces) <= 2
        assert buffer._knots == sum(len(piece.rows) for piece in buffer._pieces)


@given(
    st.lists(
        st.tuples(st.integers(0, 40), st.integers(2, 15), st.integers(0, 3), st.floats(0.0, 3.0)),
        max_size=30,
    )
)
def test_whatever_arrives_order_and_bounds_hold(arrivals):
    buffer = TruthBuffer()
    now_s = 0.0
    for t0_s, knots, revision, passed_s in arrivals:
        buffer.add(straight(float(t0_s), knots, revision=revision))
        now_s += passed_s
        state = buffer.lookup(now_s)
        if state is not None:
            assert state[0] == pytest.approx(7000.0 * now_s, abs=1e-6)
        pieces = list(buffer._pieces)
        assert [p.t0_s for p in pieces] == sorted(p.t0_s for p in pieces)
        assert all(a.end_s <= b.t0_s + 1e-9 for a, b in zip(pieces, pieces[1:], strict=False))
        assert buffer._knots == sum(len(piece.rows) for piece in pieces)
