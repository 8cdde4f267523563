"""How long an agent listens after its last tick: until the host has come to all, and not for ever."""

import math
from types import SimpleNamespace

import pytest

from madns_runtime.config import Timeouts
from madns_runtime.protocol.states import AgentState
from madns_runtime.realtime import last_answers
from madns_runtime.realtime.last_answers import DRAIN_S, LastAnswers

END_S, COMPLETE_S = 50.0, 8.0


class Timer:
    def __init__(self):
        self.at_s = math.inf

    def reschedule(self, at_s):
        self.at_s = at_s

    def cancel(self):
        self.at_s = math.inf


class Rig:
    """An agent whose last tick was over at 49 s, and a clock that is set."""

    def __init__(self, monkeypatch, complete_s=COMPLETE_S):
        self.now_s, self.finished_s, self.pings = END_S - 1.0, None, []
        monkeypatch.setattr(last_answers, "monotonic", lambda: self.now_s)
        self.timer = Timer()
        self.session = SimpleNamespace(
            state=AgentState.RUN_SIMULATION,
            answered_s=-math.inf,
            answer_heard_s=-math.inf,
            ping_due_s=math.inf,
            handle_timer=self.pings.append,
        )
        self.waiting = lambda: None
        port = SimpleNamespace(
            session=self.session, process=SimpleNamespace(drain=lambda: self.waiting())
        )
        self.listening = LastAnswers(
            SimpleNamespace(call_at=self._made),
            port,
            Timeouts(complete_s=complete_s),
            pump=lambda: None,
            finish=self._finish,
        )
        self.listening.begin(END_S)

    def _made(self, at_s, look):
        self.look = look
        return self.timer

    def _finish(self):
        self.finished_s = self.now_s

    def answer(self):
        self.session.answered_s, self.session.answer_heard_s = self.pings[-1], self.now_s

    def run_until(self, to_s):
        while self.timer.at_s <= to_s and self.finished_s is None:
            self.now_s, self.timer.at_s = max(self.now_s, self.timer.at_s), math.inf
            self.look()
        self.now_s = max(self.now_s, to_s)


@pytest.fixture
def rig(monkeypatch):
    return Rig(monkeypatch)


def test_a_host_that_answers_at_once_is_listened_to_for_a_moment(rig):
    rig.run_until(END_S)
    rig.answer()
    rig.run_until(END_S + 5.0)

    assert rig.pings == [END_S]
    assert rig.finished_s == pytest.approx(END_S + DRAIN_S)


def test_the_host_is_not_asked_while_last_ticks_of_others_are_due(rig):
    rig.run_until(END_S - 1e-3)
    assert rig.pings == []

    rig.run_until(END_S)
    assert rig.pings == [END_S]


def test_an_agent_whose_last_tick_is_over_late_asks_at_once(rig):
    rig.now_s = END_S + 2.0
    rig.listening.begin(END_S)
    rig.run_until(END_S + 2.0)

    assert rig.pings == [END_S + 2.0]


def test_a_host_that_was_held_up_is_waited_for_and_what_it_then_says(rig):
    rig.run_until(END_S + 2.0)
    rig.answer()
    rig.run_until(END_S + 5.0)

    assert END_S + 2.0 + DRAIN_S <= rig.finished_s <= END_S + 2.0 + 2 * DRAIN_S


def test_what_waits_in_the_socket_of_a_late_agent_is_heard_first(rig):
    rig.run_until(END_S)
    rig.waiting = rig.answer
    rig.now_s = END_S + 3.0
    rig.run_until(END_S + 3.0)

    assert rig.finished_s is None
    rig.waiting = lambda: None
    rig.run_until(END_S + 5.0)
    assert rig.finished_s == pytest.approx(END_S + 3.0 + DRAIN_S)


def test_a_host_that_says_nothing_is_not_waited_for_for_ever(rig):
    rig.run_until(END_S + 100.0)

    assert rig.finished_s == pytest.approx(END_S + COMPLETE_S / 2, abs=2 * DRAIN_S)


@pytest.mark.parametrize("complete_s", [0.2, 0.05, 0.001])
@pytest.mark.parametrize("answered_after", [0.0, 0.4, math.inf])
def test_an_agent_is_complete_in_time_however_short_that_is(
    monkeypatch, complete_s, answered_after
):
    rig = Rig(monkeypatch, complete_s)
    rig.run_until(END_S)
    if answered_after < math.inf:
        rig.run_until(END_S + answered_after * complete_s)
        rig.answer()
    rig.run_until(END_S + 1.0)

    assert END_S < rig.finished_s <= END_S + 0.9 * complete_s


def test_a_run_that_ended_otherwise_is_not_finished(rig):
    rig.session.state = AgentState.EXIT
    rig.run_until(END_S + 100.0)

    assert (rig.finished_s, rig.pings) == (None, [])


@pytest.mark.parametrize("due_s", [END_S - 4.0, END_S + 0.2])
def test_a_ping_that_is_overdue_stays_so_and_one_to_come_is_sent_at_once(rig, due_s):
    rig.session.ping_due_s = due_s

    rig.run_until(END_S)

    assert (rig.pings, rig.session.ping_due_s) == ([END_S], min(due_s, END_S))
