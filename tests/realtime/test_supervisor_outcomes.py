"""Words of a supervisor's children about their ends."""

from __future__ import annotations

import errno
import os
import select
import signal
from types import SimpleNamespace

import pytest

from madns_runtime.config import Agents
from madns_runtime.realtime import outcome_pipe
from madns_runtime.realtime.agent_calls import AgentCalls
from madns_runtime.realtime.agent_report import AgentOutcome
from madns_runtime.realtime.outcome_pipe import OutcomePipe
from madns_runtime.realtime.supervisor import RESTART_DELAY_S, SupervisedProcess, Supervisor


def test_a_reader_that_finds_nothing_after_reaping_does_not_wait():
    supervisor = Supervisor.__new__(Supervisor)
    supervisor._children = {}
    supervisor._outcomes = pipe = OutcomePipe()
    told = (
        b'{"pid": 1, "agent": "agent-01", "as_ordered": true, "reason": "", "may_restart": false}\n'
    )
    os.write(pipe.write_fd, told)
    signal.alarm(20)  # ends a test that waits
    try:
        supervisor._read_outcomes()  # as reaping does
        supervisor._read_outcomes()  # as the loop does, which had found it readable before
    finally:
        signal.alarm(0)
        os.close(pipe.read_fd)
        os.close(pipe.write_fd)


def test_words_that_are_read_in_pieces_are_whole(monkeypatch):
    """A pipe holds more than is read at once where a kernel's pages are large."""
    monkeypatch.setattr(outcome_pipe, "READ_BYTES_MAX", 100)
    pipe = OutcomePipe()
    names = [f"agent-{number:02d}" for number in range(1, 10)]
    for name in names:
        pipe.write_outcomes({name: AgentOutcome(as_ordered=True)})

    told = []
    while select.select([pipe.read_fd], [], [], 0)[0]:
        told += pipe.read()

    assert [each["agent"] for each in told] == names
    for fd in (pipe.read_fd, pipe.write_fd):
        os.close(fd)


@pytest.mark.parametrize(
    ("incarnation", "killed_before", "may"),
    [(1, 0, True), (2, 0, False), (2, 1, True), (3, 1, False), (4, 3, True)],
)
def test_ends_on_purpose_are_no_failures_after_which_an_agent_is_not_started_again(
    incarnation, killed_before, may
):
    supervisor = Supervisor.__new__(Supervisor)
    supervisor._operator, supervisor._is_run_over = SimpleNamespace(is_silent=False), False
    agents = Agents(count=1, restarts_max=1)
    config = SimpleNamespace(on_agent_loss="continue", agents=agents)
    supervisor._launch = SimpleNamespace(config=config)
    child = SupervisedProcess(
        ("agent-01",), 1, incarnation, AgentCalls(), killed_before=killed_before
    )

    assert supervisor._may_restart(child) is may


def test_nobody_is_started_anew_once_one_tells_that_the_run_is_over():
    stopped = []
    supervisor = Supervisor.__new__(Supervisor)
    supervisor._outcomes = pipe = OutcomePipe()
    supervisor._is_ending = supervisor._is_run_over = False
    supervisor._devices = SimpleNamespace(reap=lambda: None)
    supervisor._reactor = SimpleNamespace(stop=lambda: stopped.append(True))
    away = SupervisedProcess(("agent-01",), 1, 1, AgentCalls(), is_killed=True, returns_after_s=9.0)
    ended = SupervisedProcess(("agent-02",), os.getpid(), 1, AgentCalls())
    supervisor._to_fork, supervisor._children = [away.agents], {os.getpid(): ended}

    pipe.write_outcomes({"agent-02": AgentOutcome(as_ordered=True, is_run_over=True)})
    supervisor._read_outcomes()
    supervisor._children.clear()
    supervisor._restart(away)

    assert (stopped, supervisor._children) == ([True], {})
    assert not supervisor._may_restart(away)
    for fd in (pipe.read_fd, pipe.write_fd):
        os.close(fd)


def test_a_process_that_cannot_be_started_anew_is_tried_again_and_costs_no_other(monkeypatch):
    said, due, forks = [], [], []
    supervisor = Supervisor.__new__(Supervisor)
    supervisor._operator = SimpleNamespace(is_cut=False, emit=said.append)
    supervisor._reactor = SimpleNamespace(now_s=lambda: 5.0, call_at=lambda *call: due.append(call))
    supervisor._is_ending = supervisor._is_run_over = False
    child = SupervisedProcess(
        ("agent-01",), 1, 1, AgentCalls(), is_killed=True, returns_after_s=9.0
    )
    supervisor._to_fork, supervisor._children = [child.agents], {}
    supervisor._devices = SimpleNamespace(agents_started=lambda *started: None)

    def fork():
        forks.append(1)
        if len(forks) <= 2:
            raise OSError(errno.EAGAIN, "Resource temporarily unavailable")
        return 77

    monkeypatch.setattr(os, "fork", fork)

    supervisor._restart(child)
    for _ in range(2):
        assert due[-1][0] == pytest.approx(5.2)
        due[-1][1]()

    told = (
        "cannot start the process of agent-01: Resource temporarily unavailable; it is tried again"
    )
    assert [each["event"] for each in said] == ["log", "started"]
    assert told in said[0]["text"]
    assert said[1]["incarnation"] == 2
    assert supervisor._to_fork == []


def test_a_process_that_was_to_return_while_the_operator_was_cut_off_does_not_wait_its_time_again(
    monkeypatch,
):
    due = []
    supervisor = Supervisor.__new__(Supervisor)
    supervisor._operator = SimpleNamespace(is_cut=True, emit=lambda event: None)
    supervisor._reactor = SimpleNamespace(now_s=lambda: 5.0, call_at=lambda *call: due.append(call))
    supervisor._is_ending = supervisor._is_run_over = False
    child = SupervisedProcess(
        ("agent-01",), 1, 1, AgentCalls(), is_killed=True, returns_after_s=9.0
    )
    supervisor._to_fork, supervisor._children = [child.agents], {}
    supervisor._devices = SimpleNamespace(agents_started=lambda *started: None)
    monkeypatch.setattr(os, "fork", lambda: 77)

    supervisor._restart(child)
    supervisor._operator.is_cut = False
    due[-1][1]()

    assert due[-1][0] == pytest.approx(5.0 + RESTART_DELAY_S)
    assert list(supervisor._children) == [77]


@pytest.mark.parametrize(
    ("agents", "who", "told"),
    [
        (("agent-01", "agent-02"), "agent-02", "agent-02: no room"),
        (("agent-01",), "agent-01", "no room"),
        (("agent-01", "agent-02"), None, "no room"),
    ],
)
def test_what_ended_a_process_is_told_as_nobodys_in_particular(agents, who, told):
    supervisor = Supervisor.__new__(Supervisor)
    child = SupervisedProcess(agents, os.getpid(), 1, AgentCalls())
    supervisor._children = {os.getpid(): child}
    supervisor._outcomes = pipe = OutcomePipe()
    outcome = AgentOutcome(as_ordered=False, reason="no room", may_restart=True)
    if who is None:
        pipe.write_failure("no room")
    else:
        pipe.write_outcomes({who: outcome})

    supervisor._read_outcomes()

    assert (child.reason, child.may_restart) == (told, True)
    os.close(pipe.read_fd)
    os.close(pipe.write_fd)
