"""What a process of agents keeps of one that leaves it, for its return."""

from types import SimpleNamespace

from madns_runtime.plugin.half import RoleProgram
from madns_runtime.realtime import agent_process
from madns_runtime.realtime.agent_process import AgentProcess
from madns_runtime.realtime.agent_report import AgentOutcome


def test_an_agent_that_returns_is_given_what_its_conditions_had_counted(monkeypatch):
    given = []

    def make(seat, launch, program, **more):
        given.append((program.life, more["counted"]))
        return SimpleNamespace(
            counted=lambda: {3: 10 * program.life},
            start=lambda: None,
            set_scheduling=lambda grant: None,
        )

    monkeypatch.setattr(agent_process, "AgentRunner", make)
    reactor = SimpleNamespace(now_s=lambda: 0.0, call_at=lambda due_s, call: call())
    seat = SimpleNamespace(name="a")
    program = RoleProgram(make=object, parameters=None)
    process = AgentProcess.__new__(AgentProcess)
    monkeypatch.setattr(agent_process, "Reactor", lambda: reactor)
    process.__init__(None, [seat], program, life_fd=-1, tell_killed=lambda *told: None)
    process._process = SimpleNamespace(awaited=0)
    process._packs = {"a": None}
    process._runners = {"a": process._make_runner(seat)}
    for _ in range(2):
        process._dropped["a"] = 0.5
        process._ended("a", AgentOutcome(as_ordered=False, reason="on purpose"))

    assert given == [(1, {}), (2, {3: 10}), (3, {3: 20})]
