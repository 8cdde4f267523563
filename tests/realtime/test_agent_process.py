"""What a process of agents keeps of one that leaves it, for its return."""

from types import SimpleNamespace

import pytest

from madns_runtime.config import Agents
from madns_runtime.hardware.port import Hardware
from madns_runtime.plugin.half import HalfFailed, RoleProgram
from madns_runtime.protocol.codec import NO_DATA
from madns_runtime.protocol.events import ClockEstimated, HostDataReceived
from madns_runtime.protocol.messages import ActionOrder
from madns_runtime.protocol.states import AgentState
from madns_runtime.realtime import agent_process
from madns_runtime.realtime.agent import AgentRunner
from madns_runtime.realtime.agent_calls import AgentCalls, LoopSeat
from madns_runtime.realtime.agent_process import AgentProcess, SupervisorCalls
from madns_runtime.realtime.agent_report import AgentOutcome

SUPERVISOR = SupervisorCalls(
    hardware_of=lambda agent: Hardware(),
    tell_killed=lambda *told: None,
    tell_left=lambda agent: None,
)


def test_an_agent_that_returns_is_given_what_its_conditions_had_counted(monkeypatch):
    given, devices = [], []

    def make(seat, launch, program, **more):
        given.append((program.incarnation, more["counted"]))
        devices.append(seat.hardware)
        return SimpleNamespace(
            counted=lambda: {3: 10 * program.incarnation},
            start=lambda: None,
            set_scheduling=lambda grant: None,
        )

    monkeypatch.setattr(agent_process, "AgentRunner", make)
    reactor = SimpleNamespace(
        now_s=lambda: 0.0, call_at=lambda due_s, call: call(), end_if_forked=lambda: None
    )
    seat = LoopSeat("a", 0, AgentCalls(), Hardware())
    program = RoleProgram(make=object, parameters=None)
    process = AgentProcess.__new__(AgentProcess)
    monkeypatch.setattr(agent_process, "Reactor", lambda: reactor)
    process.__init__(None, [seat], program, life_fd=-1, supervisor=SUPERVISOR)
    process._process = SimpleNamespace(awaited=2)
    process._packs = {"a": None}
    process._runners = {"a": process._make_runner(seat)}
    for _ in range(2):
        process._dropped["a"] = 0.5
        process._ended("a", AgentOutcome(as_ordered=False, reason="on purpose"))

    assert given == [(1, {}), (2, {3: 10}), (3, {3: 20})]
    assert (
        len({id(each) for each in devices}) == 3
    )  # nothing of the devices as an earlier start saw them


def test_an_agent_that_cannot_be_made_again_leaves_the_others_of_its_process_alone(monkeypatch):
    made = []

    def make(seat, launch, program, **more):
        made.append(seat.name)
        if made.count(seat.name) > 1:
            raise HalfFailed("Rover.__init__ raised ValueError: no link")
        return SimpleNamespace(counted=dict)

    monkeypatch.setattr(agent_process, "AgentRunner", make)
    stops = []
    reactor = SimpleNamespace(
        now_s=lambda: 0.0,
        call_at=lambda due_s, call: call(),
        end_if_forked=lambda: None,
        stop=lambda: stops.append(True),
    )
    seats = [LoopSeat(name, 0, AgentCalls(), Hardware()) for name in "ab"]
    program = RoleProgram(make=object, parameters=None)
    monkeypatch.setattr(agent_process, "Reactor", lambda: reactor)
    process = AgentProcess(None, seats, program, life_fd=-1, supervisor=SUPERVISOR)
    process._process = SimpleNamespace(awaited=1, close_if_unused=lambda: None)
    process._packs = dict.fromkeys("ab")
    process._runners = {seat.name: process._make_runner(seat) for seat in seats}

    process._dropped["a"] = 0.5
    process._ended("a", AgentOutcome(as_ordered=False, reason="on purpose"))

    outcome = process._outcomes["a"]
    assert outcome.reason == "cannot return: Rover.__init__ raised ValueError: no link"
    assert (outcome.as_ordered, outcome.may_restart) == (False, False)
    assert (list(process._runners), stops, process._process.awaited) == (["b"], [], 0)
    process._ended("b", AgentOutcome(as_ordered=True))
    assert stops == [True]


def test_every_pack_of_a_process_is_timed_anew_with_the_clock_that_they_share(monkeypatch):
    process_port = SimpleNamespace(agents=9, arms=[])
    monkeypatch.setattr(agent_process, "ProcessPort", lambda *_: process_port)
    monkeypatch.setattr(agent_process, "AgentRunner", lambda seat, *_, **more: more["pack"])
    config = SimpleNamespace(agents=Agents(count=9, tick_hz=10.0, per_process=9))
    process = AgentProcess.__new__(AgentProcess)
    process._reactor = SimpleNamespace(call_at=lambda due_s, call: None, end_if_forked=lambda: None)
    process._launch = SimpleNamespace(config=config, phases_s={})
    process._seats = [SimpleNamespace(name=name) for name in config.agents.resolved_names()]
    process._program, process._supervisor = RoleProgram(make=object, parameters=None), SUPERVISOR
    process._packs, process._incarnations, process._counted = {}, {}, {}

    packs = process._make_runners()

    assert len(packs) == 9
    assert process_port.arms == [pack.arm for pack in dict.fromkeys(packs)]
    assert len(process_port.arms) == 2


def test_agents_of_several_packs_that_share_a_process_keep_their_phases(monkeypatch):
    """As on a machine that has returned, without agents that may not be started again."""
    monkeypatch.setattr(agent_process, "ProcessPort", lambda *_: SimpleNamespace(agents=4, arms=[]))
    monkeypatch.setattr(agent_process, "AgentRunner", lambda seat, *_, **more: more["pack"])
    phases_s = {"a": 0.3, "b": 0.3, "c": 0.05, "d": 0.05}
    process = AgentProcess.__new__(AgentProcess)
    process._reactor = SimpleNamespace(call_at=lambda due_s, call: None, end_if_forked=lambda: None)
    process._launch = SimpleNamespace(config=None, phases_s=phases_s)
    process._seats = [SimpleNamespace(name=name) for name in phases_s]
    process._program, process._supervisor = RoleProgram(make=object, parameters=None), SUPERVISOR
    process._packs, process._incarnations, process._counted = {}, {}, {}

    packs = process._make_runners()

    assert [pack.phase_s for pack in packs] == [0.3, 0.3, 0.05, 0.05]
    assert len(set(packs)) == 2


@pytest.mark.parametrize(("t_s", "times"), [(-0.2, 1), (0.0, 0)])
def test_what_an_agent_learns_of_the_clock_is_followed_until_simulated_time_begins(t_s, times):
    followed, told_devices = [], []
    runner = AgentRunner.__new__(AgentRunner)
    runner._session = SimpleNamespace(state=AgentState.RUN_SIMULATION, clock=None)
    runner._records = SimpleNamespace(clock=lambda clock, now_s: None)
    process = SimpleNamespace(follow_clock=lambda: followed.append(t_s))
    runner._port = SimpleNamespace(now_s=lambda: t_s, process=process)
    runner._device_time = SimpleNamespace(tell=lambda: told_devices.append(t_s))

    runner._handle(ClockEstimated())

    assert followed == told_devices == [t_s] * times


def test_what_comes_when_an_agents_half_is_called_no_more_is_counted():
    heard = []
    runner = AgentRunner.__new__(AgentRunner)
    runner._port = SimpleNamespace(too_late=0)
    runner._session = SimpleNamespace(receive_data=lambda data, now_s: data or NO_DATA)
    runner._call = lambda *call: heard.append(call)
    runner._actions = SimpleNamespace(take=heard.append)
    runner._pump = lambda: None
    runner._takes_data = False

    runner._handle(HostDataReceived("reliable"))
    runner._handle(HostDataReceived(ActionOrder(1, "stop", {}, 2.0, None, is_end=False)))
    runner._take_datagram(b"best")
    runner._take_datagram(b"")  # an acknowledgement, say

    assert (runner._port.too_late, heard) == (3, [])


@pytest.mark.parametrize(("has_killed", "told"), [(True, []), (False, ["agent-2: why"])])
def test_an_agent_that_a_fault_ends_records_no_emergency_where_others_keep_its_process(
    has_killed, told
):
    said, left = [], []
    runner = AgentRunner.__new__(AgentRunner)
    runner.name, runner._on_left = "agent-2", left.append
    runner._ticks = SimpleNamespace(pacer=SimpleNamespace(is_over=False))
    runner._faults = SimpleNamespace(has_killed=has_killed)
    runner._journal = SimpleNamespace(emergency=said.append)
    runner._actions = SimpleNamespace(leave_clock=lambda: None)
    runner.half = SimpleNamespace(abandon=lambda: None)
    runner._reactor = SimpleNamespace(end_if_forked=lambda: None)
    runner._cancel_timers = runner._close_records = lambda: None

    runner._end_early("agent-2: why", is_own=True)

    assert said == told
    assert left == ["agent-2"]  # what it owns is made safe though its process goes on


def test_the_last_agent_of_a_process_that_a_fault_ends_keeps_the_socket_for_its_return(monkeypatch):
    waiting, awaited_at_its_end = [], []
    monkeypatch.setattr(
        agent_process,
        "Reactor",
        lambda: SimpleNamespace(
            now_s=lambda: 0.0, call_at=lambda due_s, call: waiting.append(call), stop=lambda: None
        ),
    )
    seats = [SimpleNamespace(name=name) for name in "ab"]
    process = AgentProcess(None, seats, None, life_fd=-1, supervisor=SUPERVISOR)
    process._process = SimpleNamespace(awaited=0, close_if_unused=lambda: None)

    def end(reason):
        # As a runner does: it leaves the socket, which the last one closes, and tells that it has ended.
        awaited_at_its_end.append(process._process.awaited)
        process._ended("b", AgentOutcome(as_ordered=False, reason=reason))

    process._runners = {"b": SimpleNamespace(emergency=end, counted=dict)}

    process._killed("b", "restarted on purpose", 0.0)
    waiting.pop()()

    assert awaited_at_its_end == [1]
    assert (process._process.awaited, len(waiting)) == (1, 1)
    process._end("the run is over")
    assert process._process.awaited == 0


def test_a_process_waits_for_nobody_who_was_to_return_to_a_run_that_is_over(monkeypatch):
    stops = []
    reactor = SimpleNamespace(now_s=lambda: 0.0, stop=lambda: stops.append(True))
    monkeypatch.setattr(agent_process, "Reactor", lambda: reactor)
    process = AgentProcess(None, [], None, life_fd=-1, supervisor=SUPERVISOR)
    process._process = SimpleNamespace(awaited=1, close_if_unused=lambda: None)
    process._away = {"a"}
    process._runners = {"b": SimpleNamespace(counted=dict)}

    process._ended("b", AgentOutcome(as_ordered=True, is_run_over=True))

    assert (stops, process._process.awaited) == ([True], 0)
    process._return(SimpleNamespace(name="a"))
    assert process._runners == {}
