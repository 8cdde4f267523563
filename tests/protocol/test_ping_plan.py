"""When agents that share a clock exchange times with the host."""

import pytest

from madns_runtime.protocol.ping_plan import PingPlan

STARTED_S = 1000.0
PLAN = PingPlan(brings_clock_up=False, delay_s=0.3, interval_s=0.8)


@pytest.mark.parametrize(
    ("pinged_s", "next_s"),
    [
        (0.3, 1.1),  # in its place
        (0.312, 1.1),  # with a tick that came a little later
        (0.69, 1.1),
        (0.71, 1.9),  # out of place: never two within half an interval
        (0.0, 1.1),
        (-5.0, 0.3),
        (80.31, 81.1),
    ],
)
def test_after_any_ping_the_next_is_in_the_agents_own_place(pinged_s, next_s):
    got_s = PLAN.next_s(STARTED_S, STARTED_S + pinged_s)

    assert got_s - STARTED_S == pytest.approx(next_s)


def test_agents_that_pinged_at_once_are_spread_over_the_interval_again():
    plans = [PingPlan(delay_s=0.1 * number, interval_s=0.8) for number in range(1, 9)]

    due_s = sorted(plan.next_s(STARTED_S, STARTED_S + 7.0) for plan in plans)

    assert [b - a for a, b in zip(due_s, due_s[1:], strict=False)] == pytest.approx([0.1] * 7)
