import math
import random

import pytest

from madns_runtime.reactor.timers import STALE_MAX, TimerQueue


def run_due(queue, now_s):
    while (timer := queue.pop_due(now_s)) is not None:
        timer.callback()


@pytest.fixture
def fired():
    return []


def add(queue, when_s, fired, name):
    return queue.add(when_s, lambda: fired.append(name))


def test_timers_fire_by_time_and_those_of_one_time_as_made(fired):
    queue = TimerQueue()
    for name, when_s in (("c", 2.0), ("a", 1.0), ("d", 2.0), ("b", 1.0)):
        add(queue, when_s, fired, name)

    run_due(queue, 2.0)

    assert fired == ["a", "b", "c", "d"]


def test_timer_fires_at_its_time_and_only_once(fired):
    queue = TimerQueue()
    add(queue, 1.0, fired, "a")

    run_due(queue, 0.999)
    assert fired == []
    run_due(queue, 1.0)
    run_due(queue, 5.0)

    assert fired == ["a"]


def test_cancelled_timer_never_fires(fired):
    queue = TimerQueue()
    timer = add(queue, 1.0, fired, "a")
    timer.cancel()
    timer.cancel()

    run_due(queue, 2.0)

    assert fired == []
    assert queue.earliest_s() == math.inf


def test_cancelling_a_timer_that_fired_does_nothing(fired):
    queue = TimerQueue()
    timer = add(queue, 1.0, fired, "a")
    run_due(queue, 1.0)

    timer.cancel()
    add(queue, 2.0, fired, "b")
    run_due(queue, 2.0)

    assert fired == ["a", "b"]


@pytest.mark.parametrize("moved_to_s", [0.5, 1.0, 3.0])
def test_rescheduled_timer_fires_at_its_new_time_only(fired, moved_to_s):
    queue = TimerQueue()
    timer = add(queue, 1.0, fired, "a")
    timer.reschedule(moved_to_s)

    assert timer.when_s == queue.earliest_s() == moved_to_s
    run_due(queue, moved_to_s - 0.01)
    assert fired == []
    run_due(queue, 10.0)
    assert fired == ["a"]


def test_timer_moved_there_and_back_fires_once(fired):
    queue = TimerQueue()
    timer = add(queue, 5.0, fired, "a")
    for when_s in (3.0, 5.0, 4.0, 5.0):
        timer.reschedule(when_s)

    run_due(queue, 4.5)
    assert fired == []
    run_due(queue, 9.0)
    assert fired == ["a"]


def test_timer_may_set_itself_again(fired):
    queue = TimerQueue()

    def again():
        fired.append(timer.when_s)
        if timer.when_s < 3.0:
            timer.reschedule(timer.when_s + 1.0)

    timer = queue.add(1.0, again)
    run_due(queue, 10.0)

    assert fired == [1.0, 2.0, 3.0]


def test_cancelled_timer_can_be_set_again(fired):
    queue = TimerQueue()
    timer = add(queue, 1.0, fired, "a")
    timer.cancel()
    timer.reschedule(1.0)

    run_due(queue, 1.0)
    run_due(queue, 1.0)

    assert fired == ["a"]


def test_infinite_time_is_never_and_nan_is_refused(fired):
    queue = TimerQueue()
    timer = add(queue, math.inf, fired, "a")

    run_due(queue, 1e300)
    with pytest.raises(ValueError, match="nan"):
        timer.reschedule(math.nan)

    assert fired == []
    assert queue.earliest_s() == math.inf


def test_cleared_queue_fires_nothing(fired):
    queue = TimerQueue()
    add(queue, 1.0, fired, "a")

    queue.clear()
    run_due(queue, 2.0)

    assert fired == []


@pytest.mark.parametrize("direction", [1, -1])
def test_watchdog_put_off_for_ever_takes_no_memory(fired, direction):
    queue = TimerQueue()
    timer = add(queue, 0.0, fired, "a")

    for k in range(10_000):
        timer.reschedule(direction * k * 1e-3)

    assert len(queue) <= 2 * STALE_MAX + 2


def test_cancelled_timers_take_no_memory(fired):
    queue = TimerQueue()
    for k in range(10_000):
        add(queue, float(k), fired, k).cancel()

    assert len(queue) <= 2 * STALE_MAX + 2


@pytest.mark.parametrize("seed", range(20))
def test_queue_agrees_with_a_sorted_list(seed):
    chance = random.Random(seed)
    queue = TimerQueue()
    wanted = {}
    timers = []
    fired = []
    now_s = 0.0

    for _ in range(600):
        action = chance.random()
        when_s = now_s + chance.randrange(8)
        if action < 0.4 or not timers:
            name = len(timers)
            timers.append(add(queue, when_s, fired, name))
            wanted[name] = when_s
        elif action < 0.75:
            name = chance.randrange(len(timers))
            timers[name].reschedule(when_s)
            wanted[name] = when_s
        elif action < 0.9:
            name = chance.randrange(len(timers))
            timers[name].cancel()
            wanted.pop(name, None)
        else:
            now_s += chance.randrange(4)
            fired.clear()
            run_due(queue, now_s)
            due = sorted((when_s, name) for name, when_s in wanted.items() if when_s <= now_s)
            assert fired == [name for _, name in due]
            for name in fired:
                del wanted[name]
        assert queue.earliest_s() == min(wanted.values(), default=math.inf)
