import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cosmos_cli.launch.busiest_interval import POINTS_MAX, Sending, busiest_interval


def sending(wire_bytes, rate_hz, within_s, **changes):
    return Sending(
        name="x", wire_bytes=wire_bytes, rate_hz=rate_hz, within_s=within_s, **changes
    )  # fmt: skip


def carried(sendings, agents, length_s):
    return sum(e.senders(agents) * e.wire_bytes * e.messages(length_s) for e in sendings)


def test_messages_that_may_wait_for_the_next_are_their_mean_rate():
    found = busiest_interval([sending(100, 10, 0.1), sending(38400, 0.2, 5)], 3)

    assert found.bytes_s == pytest.approx(3 * (1000 + 7680))


def test_a_burst_of_maneuvers_counts_in_the_interval_of_their_lead_and_not_on_average():
    found = busiest_interval([sending(100, 10, 0.1), sending(1000, 1, 0.1)], 10)

    assert found.length_s == pytest.approx(0.1)
    assert found.bytes_s == pytest.approx(10 * 1100 / 0.1)


def test_a_burst_of_refills_that_must_arrive_soon_counts_likewise():
    assert busiest_interval([sending(5000, 0.1, 0.5)], 20).bytes_s == pytest.approx(200_000)


def test_only_as_many_maneuver_as_are_said_to():
    found = busiest_interval([sending(1000, 1, 0.1, senders_max=2)], 10)

    assert found.bytes_s == pytest.approx(2 * 1000 / 0.1)


def test_nothing_sent_is_nothing_carried():
    assert busiest_interval([], 10).bytes_s == 0.0


SENDINGS = st.lists(
    st.builds(
        sending, st.floats(1, 1e5), st.sampled_from([0.1, 0.5, 1, 3, 10]), st.floats(0.01, 20)
    ),
    min_size=1,
    max_size=4,
)


@given(SENDINGS, st.integers(1, 100), st.floats(0.01, 100))
def test_no_interval_carries_more_for_its_length(sendings, agents, length_s):
    found = busiest_interval(sendings, agents)

    assert carried(sendings, agents, length_s) / length_s <= found.bytes_s * (1 + 1e-9)


def test_many_points_end_with_a_bound():
    close = [sending(1, 1000.0, 0.00099999), sending(1, 1 / 3.0, 1e5)]

    found = busiest_interval(close, 1)

    assert math.isfinite(found.bytes_s)
    assert found.bytes_s >= carried(close, 1, 0.002) / 0.002
    assert POINTS_MAX < 1e5
