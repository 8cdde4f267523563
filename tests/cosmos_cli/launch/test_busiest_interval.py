import math
import random
from fractions import Fraction

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


def exactly(kinds, agents, until_s=30):
    """The busiest interval's load by fractions: of all lengths up to *until_s* at which a message more must be there."""

    def senders(most):
        return agents if most is None else min(agents, most)

    def load(length):
        return sum(
            senders(most) * size * (math.floor((length - within) * rate) + 1)
            for size, rate, within, most in kinds
            if length >= within
        )

    lengths = {
        within + number / rate
        for _, rate, within, _ in kinds
        for number in range(math.ceil(until_s * rate))
    }
    mean = sum(senders(most) * size * rate for size, rate, _, most in kinds)
    return max(mean, *(load(length) / length for length in lengths if length <= until_s))


@pytest.mark.parametrize("seed", range(40))
def test_decimals_are_judged_as_fractions_are(seed):
    chance = random.Random(seed)
    kinds = []
    for _ in range(4):
        rate = Fraction(chance.choice(["0.1", "0.2", "1", "2", "10", "12"]))
        within = chance.choice([1 / rate, Fraction("0.05"), Fraction(1), Fraction("0.5")])
        kinds.append((chance.choice([100, 757, 5437]), rate, within, chance.choice([None, 3])))
    sendings = [
        sending(size, float(rate), float(within), senders_max=math.inf if most is None else most)
        for size, rate, within, most in kinds
    ]
    # What comes within the first second is the most, or next to it.
    assert busiest_interval(sendings, 10).bytes_s == pytest.approx(
        float(exactly(kinds, 10)), rel=2e-3
    )


def test_ten_tenths_of_a_second_are_a_second():
    # 176,736 B in a second; sums of 0.1 in floats pass it by.
    kinds = [sending(5437, 2, 0.5), sending(5437, 0.1, 1), sending(757, 10, 0.5, senders_max=3)]

    found = busiest_interval(kinds, 10)

    assert (found.length_s, found.bytes_s) == (pytest.approx(1.0), pytest.approx(176_736))


def test_one_kind_that_has_time_makes_up_for_one_that_has_not():
    found = busiest_interval([sending(100, 1, 0.5), sending(5000, 1, 3)], 10)

    assert (found.length_s, found.bytes_s) == (math.inf, 51_000)
