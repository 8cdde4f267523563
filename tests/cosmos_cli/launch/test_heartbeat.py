"""When a machine counts as lost, on a simulated clock."""

from __future__ import annotations

from cosmos_cli.launch.machine_watch import (
    LOOK_S_MAX,
    PING_INTERVAL_S,
    SILENCE_S,
    Pulse,
    WatchedTime,
)

STEP_S = 0.25
"""How often the operator looks."""


def beat(pulse: Pulse, now_s: float, *, answers: bool = True) -> None:
    if pulse.is_due(now_s):
        number = pulse.ping(now_s)
        if answers:
            pulse.pong(number, now_s + 0.001)


def test_machine_that_answers_is_never_lost() -> None:
    pulse = Pulse()

    for step in range(1000):
        beat(pulse, step * STEP_S)
        assert not pulse.is_lost(step * STEP_S)


def test_machine_that_falls_silent_is_lost_within_three_seconds_and_not_before_its_time() -> None:
    for phase in range(8):
        pulse = Pulse()
        heard_s = 0.0
        silent_from_s = 10.0 + phase * PING_INTERVAL_S / 8
        now_s = 0.0
        while not pulse.is_lost(now_s):
            answers = now_s < silent_from_s
            if answers and pulse.is_due(now_s):
                heard_s = now_s
            beat(pulse, now_s, answers=answers)
            now_s += STEP_S

        assert SILENCE_S <= now_s - heard_s <= 3.0


def test_machine_that_has_never_answered_is_still_starting() -> None:
    pulse = Pulse()

    for step in range(100):
        beat(pulse, step * STEP_S, answers=False)

    assert not pulse.was_heard
    assert pulse.silent_s(25.0) == 0.0


def test_answers_to_what_was_asked_while_it_started_are_not_late() -> None:
    pulse = Pulse()
    numbers = [pulse.ping(float(second)) for second in range(5)]

    assert [pulse.pong(number, 5.0) for number in numbers] == [0.0] * 5


def test_late_answer_says_how_late() -> None:
    pulse = Pulse()
    pulse.pong(pulse.ping(0.0), 0.0)
    numbers = [pulse.ping(1.0), pulse.ping(2.0)]

    assert pulse.silent_s(2.9) == 2.9
    assert pulse.pong(numbers[0], 3.0) == 2.0
    assert pulse.silent_s(3.0) == 0.0
    assert pulse.pong(numbers[1], 3.0) == 1.0


def test_operator_that_was_stopped_itself_blames_nobody() -> None:
    pulse = Pulse()
    pulse.pong(pulse.ping(0.0), 0.0)

    assert not pulse.is_lost(3600.0)
    pulse.ping(3600.0)
    assert not pulse.is_lost(3600.0 + SILENCE_S - PING_INTERVAL_S - 0.01)


def test_operator_that_was_stopped_with_a_question_under_way_blames_nobody() -> None:
    pulse, time = Pulse(), WatchedTime()
    pulse.pong(pulse.ping(time.look(0.0)), time.at(0.0))
    number = pulse.ping(time.look(1.0))

    # The answer waits to be read; the check is first.
    assert not pulse.is_lost(time.look(61.0))
    assert pulse.pong(number, time.at(61.01)) <= LOOK_S_MAX + 0.011


def test_silence_counts_in_full_while_the_operator_looks() -> None:
    pulse, time = Pulse(), WatchedTime()
    pulse.pong(pulse.ping(time.look(0.0)), time.at(0.0))
    pulse.ping(time.look(STEP_S))
    now_s = STEP_S
    while not pulse.is_lost(time.look(now_s)):
        now_s += STEP_S

    assert SILENCE_S <= now_s <= 3.0
