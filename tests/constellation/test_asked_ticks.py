"""Which tick an answer of flight software is for, also where answers and ticks are lost on their way."""

import pytest

from madns_runtime.simulations.constellation.flight.asked_ticks import UNANSWERED_MAX, AskedTicks
from madns_runtime.simulations.constellation.flight.interface.answers import FlightAnswer

ANSWER_S = 1.0
HZ = 10


def asked_of(count, *, by_time=False, may_lose=True):
    asked = AskedTicks(ANSWER_S, by_time=by_time, may_lose=may_lose)
    asked.begun_s = 0.0
    for number in range(count):
        asked.add(number / HZ, number / HZ)
    return asked


def test_answer_that_names_its_tick_is_for_it_where_others_are_lost():
    asked = asked_of(4)

    assert asked.find(FlightAnswer(t_s=0.2), 0.3).t_s == 0.2
    assert (asked.unanswered, len(asked)) == (2, 1)
    assert asked.find(FlightAnswer(t_s=0.1), 0.3) is None
    assert not asked.must_be_asked(FlightAnswer(t_s=0.1))


def test_answer_by_order_is_for_the_oldest_where_nothing_is_lost_whatever_it_names():
    asked = asked_of(3, may_lose=False)

    assert asked.find(FlightAnswer(t_s=0.2), 30.0).t_s == 0.0
    assert asked.unanswered == 0


def test_answers_without_a_time_do_not_stay_behind_for_ever_after_a_loss():
    asked, behind = asked_of(0), []
    for number in range(40):
        now_s = number / HZ
        asked.add(now_s, now_s)
        if number not in range(3, 20):  # these are lost
            behind.append(round((now_s - asked.find(FlightAnswer(), now_s).t_s) * HZ))

    assert behind[:3] == [0, 0, 0]
    assert max(behind) <= ANSWER_S * HZ
    assert asked.unanswered + len(asked) == 17
    assert asked.unanswered > 0


def test_one_answer_too_many_is_no_loss_of_count_once_ticks_were_given_up():
    asked = asked_of(2)
    assert asked.must_be_asked(FlightAnswer())
    assert asked.find(FlightAnswer(), 1.05).t_s == 0.1

    assert asked.find(FlightAnswer(), 1.05) is None
    assert not asked.must_be_asked(FlightAnswer())


@pytest.mark.parametrize(("may_lose", "sent"), [(True, 5), (False, 0)])
def test_where_ticks_may_be_lost_one_is_sent_now_and_then_though_too_many_wait(may_lose, sent):
    asked = asked_of(UNANSWERED_MAX, by_time=True, may_lose=may_lose)
    began, ticks = UNANSWERED_MAX, round(5.5 * HZ)
    for number in range(began, began + ticks):
        if not asked.is_full(number / HZ):
            asked.add(number / HZ, number / HZ)

    assert len(asked) == UNANSWERED_MAX
    assert asked.unanswered == sent


@pytest.mark.parametrize("late_s", [-0.003, 0.0, 0.2])
def test_which_ticks_are_sent_hangs_on_simulated_time_alone(late_s):
    asked, sent = asked_of(0), []
    for number in range(UNANSWERED_MAX + 40):
        t_s = number / HZ
        if not asked.is_full(t_s):
            asked.add(t_s + late_s * (number % 2), t_s)
            sent.append(number)

    assert sent[UNANSWERED_MAX:] == [74, 85, 96]


def test_software_that_answers_again_after_very_many_lost_ticks_is_sent_every_tick_again():
    asked = asked_of(UNANSWERED_MAX, by_time=True)
    now_s = UNANSWERED_MAX / HZ + 2 * ANSWER_S
    assert not asked.is_full(now_s)
    asked.add(now_s, now_s)

    assert asked.find(FlightAnswer(t_s=now_s), now_s + 0.01).t_s == now_s
    assert len(asked) == 0
    assert not asked.is_full(now_s + 0.1)
