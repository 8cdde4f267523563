"""Host and agent sessions over a simulated wire: set-up, run, loss of members, rejoin, shutdown."""

import heapq
import random

import pytest

from madns_runtime import __version__
from madns_runtime.config import Timeouts
from madns_runtime.protocol import events as a
from madns_runtime.protocol import events as h
from madns_runtime.protocol.agent_session import (
    CLOCK_ERROR_S_MAX,
    CLOCK_WAIT_S,
    UNUSED_S,
    AgentIdentity,
    AgentSession,
)
from madns_runtime.protocol.events import Phase
from madns_runtime.protocol.host_session import HostSession
from madns_runtime.protocol.link_settings import LinkSettings
from madns_runtime.protocol.messages import Service
from madns_runtime.protocol.ping_plan import PingPlan
from madns_runtime.protocol.states import AgentState, HostState
from madns_runtime.timing.clocksync import ClockEstimate

WIRE = LinkSettings(run_key=b"k" * 32, session=b"s" * 8)
TIMEOUTS = Timeouts(
    agents_ready_s=5,
    host_setup_s=5,
    agent_setup_s=5,
    start_lead_s=0.5,
    silence_s=2.5,
    complete_s=4,
    shutdown_s=3,
)
PINGS = PingPlan()
DURATION_S = 5.0
STEP_S = 0.005


class World:
    """One host and its agents on a wire with delay and seeded loss; plays both composition roots."""

    def __init__(self, names, *, policy="abort", loss=0.0, seed=1):
        self.now_s = 100.0
        self.random = random.Random(seed)
        self.loss = loss
        self.names = names
        self.host = HostSession(
            names, WIRE, timeouts=TIMEOUTS, on_agent_loss=policy, now_s=self.now_s
        )
        self.agents = {}
        self.frozen = set()
        self.mute = set()
        self.flight = []
        self.count = 0
        self.t0_s = None
        self.host_events = []
        self.agent_events = {name: [] for name in names}
        self.incarnation = 0
        self.host_is_dead = False
        self.host_sets_up = True

    def join(self, name, pings=PINGS):
        self.incarnation += 1
        self.agents[name] = AgentSession(
            AgentIdentity(
                name=name,
                index=self.names.index(name) + 1,
                incarnation_id=self.incarnation,
                runtime_version=__version__,
                pid=1,
            ),
            WIRE,
            timeouts=TIMEOUTS,
            report=lambda: {"ticks": 1},
            now_s=self.now_s,
            pings=pings,
        )

    def run_for(self, seconds):
        end_s = self.now_s + seconds
        while self.now_s < end_s:
            self.now_s += STEP_S
            self.step()

    def step(self):
        while self.flight and self.flight[0][0] <= self.now_s:
            _, _, target, data, source = heapq.heappop(self.flight)
            if target == "host":
                if not self.host_is_dead:
                    self.deliver_to_host(data, source)
            elif target in self.agents and target not in self.frozen:
                self.deliver_to_agent(target, data)
            elif target in self.frozen:
                self.post(target, data, source)  # the socket buffer keeps it
        if not self.host_is_dead:
            self.step_host()
        for name, session in self.agents.items():
            if name not in self.frozen:
                self.step_agent(name, session)

    def deliver_to_host(self, data, source):
        self.host.receive_datagram(data, (source,), self.now_s)

    def deliver_to_agent(self, name, data):
        self.agents[name].receive_datagram(data, self.now_s)

    def step_host(self):
        host = self.host
        due = host.get_timer()
        if due is not None and due <= self.now_s:
            host.handle_timer(self.now_s)
        while (event := host.next_event()) is not None:
            self.host_events.append(event)
            if isinstance(event, h.AgentsReady) and self.host_sets_up:
                host.setup_finished(
                    {n: {"hello": n} for n in host.agents_in(Phase.READY)}, self.now_s
                )
            elif isinstance(event, h.AgentsSimulationReady):
                self.t0_s = self.now_s + 0.5
                host.start(self.t0_s, DURATION_S, self.now_s)
            elif isinstance(event, h.AgentRejoining):
                host.send_setup(event.agent, {"again": True}, self.now_s)
            elif isinstance(event, h.AgentsComplete):
                host.order_stop(self.now_s)
            elif isinstance(event, h.AgentsStopped):
                host.cleaned_up()
                host.records_closed(self.now_s)
        for data, address in host.datagrams_to_send(self.now_s):
            self.post(address[0], data, "host")

    def step_agent(self, name, session):
        due = session.get_timer()
        if due is not None and due <= self.now_s:
            session.handle_timer(self.now_s)
        while (event := session.next_event()) is not None:
            self.agent_events[name].append(event)
            is_in_setup = session.state is AgentState.SIMULATION_SETUP
            if isinstance(event, a.SetupReceived) and name not in self.mute and is_in_setup:
                session.setup_finished(self.now_s)
            elif isinstance(event, a.StopReceived | a.EmergencyOrdered | a.ExpelledFromRun):
                session.records_closed({"written": 7}, self.now_s)
        over = self.t0_s is not None and self.now_s > self.t0_s + DURATION_S
        if session.state is AgentState.RUN_SIMULATION and over and name not in self.mute:
            session.run_finished({"ok": name}, self.now_s)
        for data in session.datagrams_to_send(self.now_s):
            self.post("host", data, name)

    def post(self, target, data, source):
        if self.random.random() < self.loss:
            return
        self.count += 1
        delay_s = 0.001 + 0.004 * self.random.random()
        heapq.heappush(self.flight, (self.now_s + delay_s, self.count, target, data, source))

    def host_event(self, kind):
        return next((event for event in self.host_events if isinstance(event, kind)), None)

    def agent_saw(self, name, kind):
        return next((event for event in self.agent_events[name] if isinstance(event, kind)), None)


def world(count=3, **options):
    names = tuple(f"agent-{i}" for i in range(1, count + 1))
    made = World(names, **options)
    for name in names:
        made.join(name)
    return made


@pytest.mark.parametrize("loss", [0.0, 0.2])
def test_a_run_goes_from_hello_to_exit_on_both_sides(loss):
    w = world(loss=loss)

    w.run_for(12)

    assert w.host.state is HostState.EXIT
    assert [s.state for s in w.agents.values()] == [AgentState.EXIT] * 3
    assert w.host_event(h.EmergencyDeclared) is None
    assert [p.summary for p in w.host.peers.values()] == [{"ok": n} for n in w.names]
    assert [p.records for p in w.host.peers.values()] == [{"written": 7}] * 3
    starts = [w.agent_saw(n, a.StartReceived) for n in w.names]
    assert [s.t0_host_s for s in starts] == [w.t0_s] * 3


class BusyInSetup(World):
    """One whose agents' answers waited 4 s in the socket while others in their process were set up."""

    def __init__(self, names):
        super().__init__(names)
        self.was_busy = set()

    def deliver_to_agent(self, name, data):
        session = self.agents[name]
        super().deliver_to_agent(name, data)
        if session.state is AgentState.SIMULATION_SETUP and name not in self.was_busy:
            self.was_busy.add(name)
            session.clock = ClockEstimate()
            for _ in range(3):
                session.clock.add_exchange(
                    self.now_s - 4, self.now_s - 4, self.now_s - 4, self.now_s
                )


def test_agents_are_ready_only_when_their_clocks_stand():
    names = ("agent-1", "agent-2")
    w = BusyInSetup(names)
    for name in names:
        w.join(name)

    while w.t0_s is None:
        w.run_for(0.05)

    w.run_for(0.2)
    for name, session in w.agents.items():
        assert session.state is AgentState.RUN_SIMULATION
        assert name in w.was_busy
        assert abs(session.clock.offset_s(w.now_s)) < 0.005  # both clocks are one here
        assert session.clock.uncertainty_s(w.now_s) < CLOCK_ERROR_S_MAX


def test_agent_whose_clock_never_stands_is_ready_all_the_same_and_says_so():
    w = world(1)
    session = w.agents["agent-1"]
    session.clock.add_exchange = lambda *times: False

    while w.t0_s is None:
        w.run_for(0.05)

    assert w.now_s > 100.0 + CLOCK_WAIT_S
    assert not session.clock.is_valid


def test_clock_estimate_stands_before_time_zero():
    w = world()

    while w.t0_s is None or w.now_s < w.t0_s:
        w.run_for(0.05)

    for session in w.agents.values():
        assert session.clock.is_valid
        uncertainty_s = session.clock.uncertainty_s(w.now_s)
        assert abs(session.clock.offset_s(w.now_s)) <= uncertainty_s + STEP_S


class SlowAtTheStart(World):
    """One whose agents know the host's clock from answers that took 19 ms on one way, as of a busy machine."""

    def __init__(self, names):
        super().__init__(names)
        self.taught = set()

    def step_agent(self, name, session):
        super().step_agent(name, session)
        if session.state is AgentState.AGENT_SIMULATION_READY and name not in self.taught:
            self.taught.add(name)
            session.clock = ClockEstimate()
            for _ in range(3):
                session.clock.add_exchange(self.now_s - 0.019, self.now_s, self.now_s, self.now_s)


def test_a_clock_that_is_known_badly_is_learnt_anew_before_time_zero_and_never_jumps_behind_it():
    names = ("agent-1", "agent-2")
    w = SlowAtTheStart(names)
    for name in names:
        w.join(name)
    offsets_s = {name: [] for name in names}

    while w.t0_s is None or w.now_s < w.t0_s + 2.0:
        w.run_for(STEP_S / 2)
        if w.t0_s is not None and w.now_s > w.t0_s - UNUSED_S / 2:
            for name, session in w.agents.items():
                offsets_s[name].append(session.clock.offset_s(w.now_s))

    for name, found_s in offsets_s.items():
        assert name in w.taught
        assert abs(found_s[0]) < 0.003  # both clocks are one here, and were told to be 9.5 ms apart
        steps_s = [abs(b - a) for a, b in zip(found_s, found_s[1:], strict=False)]
        assert max(steps_s) < 1e-4
        assert len(steps_s) > 300


def test_data_reaches_the_other_half_in_both_directions():
    w = world(count=1)
    w.run_for(1)
    w.agents["agent-1"].send([1, 2.5], Service.RELIABLE, w.now_s)
    w.host.send("agent-1", {"x": "y"}, Service.SYNC, w.now_s)

    w.run_for(0.5)

    assert w.host_event(h.AgentDataReceived) == h.AgentDataReceived("agent-1", [1, 2.5])
    assert w.agent_saw("agent-1", a.HostDataReceived) == a.HostDataReceived({"x": "y"})


def test_agents_that_never_say_hello_are_all_named():
    names = ("agent-1", "agent-2", "agent-3")
    w = World(names)
    w.join("agent-1")

    w.run_for(10)

    emergency = w.host_event(h.EmergencyDeclared)
    assert emergency.who == "agent-2, agent-3"
    assert "AGENT_READY in 5" in emergency.reason
    assert w.host.state is HostState.EXIT
    assert w.agents["agent-1"].state is AgentState.EXIT


def test_agent_that_never_becomes_ready_is_named():
    w = world()
    w.mute.add("agent-2")

    w.run_for(12)

    emergency = w.host_event(h.EmergencyDeclared)
    assert emergency.who == "agent-2"
    assert "AGENT_SIMULATION_READY" in emergency.reason


def test_lost_agent_aborts_run_within_three_seconds():
    w = world()
    w.run_for(2)
    w.frozen.add("agent-2")
    frozen_at_s = w.now_s

    while w.host_event(h.EmergencyDeclared) is None and w.now_s < frozen_at_s + 10:
        w.run_for(0.05)

    assert w.now_s - frozen_at_s <= 3.0
    assert w.host_event(h.AgentLost) == h.AgentLost("agent-2", "silent for 2.5 s while running")
    w.run_for(5)
    assert w.host.state is HostState.EXIT
    assert w.agents["agent-1"].state is AgentState.EXIT
    told = w.agent_saw("agent-1", a.EmergencyOrdered)
    assert told == a.EmergencyOrdered("agent-2", "silent for 2.5 s while running")


def test_swarm_survives_a_lost_agent_and_takes_it_back():
    w = world(policy="continue")
    w.run_for(1.5)
    w.host.agent_exited("agent-2", "killed by SIGKILL", w.now_s)
    del w.agents["agent-2"]
    w.run_for(0.5)

    w.join("agent-2")
    w.run_for(12)

    assert w.host_event(h.AgentLost) == h.AgentLost("agent-2", "killed by SIGKILL")
    assert w.host_event(h.AgentRejoined) == h.AgentRejoined("agent-2")
    assert a.SessionEnded() in w.agent_events["agent-2"]
    assert w.host.peers["agent-2"].summary == {"ok": "agent-2"}
    assert w.host_event(h.EmergencyDeclared) is None
    assert w.host.state is HostState.EXIT


def test_thawed_agent_is_expelled_and_may_join_anew():
    w = world(policy="continue")
    w.run_for(1.5)
    w.frozen.add("agent-2")
    w.run_for(3)
    assert w.host.peers["agent-2"].phase is Phase.LOST

    w.frozen.clear()
    w.run_for(1)

    expelled = w.agent_saw("agent-2", a.ExpelledFromRun)
    assert expelled == a.ExpelledFromRun("silent for 2.5 s while running")
    w.join("agent-2")
    w.run_for(8)
    assert w.host_event(h.AgentRejoined) == h.AgentRejoined("agent-2")
    assert w.host.state is HostState.EXIT


def test_agents_end_by_themselves_when_the_host_dies():
    w = world()
    w.run_for(2)
    w.host_is_dead = True

    w.run_for(5)

    for name, session in w.agents.items():
        assert session.state is AgentState.EXIT
        told = w.agent_saw(name, a.EmergencyOrdered)
        assert told.reason == "host: silent for 2.5 s"


def test_emergency_of_an_agent_ends_the_run_with_its_name():
    w = world()
    w.run_for(2)
    w.agents["agent-3"].emergency("step raised ValueError: bad", w.now_s)

    w.run_for(4)

    emergency = w.host_event(h.EmergencyDeclared)
    assert emergency == h.EmergencyDeclared("agent-3", "step raised ValueError: bad")
    assert w.host.state is HostState.EXIT
    assert w.host.peers["agent-3"].records == {"written": 7}


def test_emergency_of_the_host_reaches_every_agent():
    w = world(loss=0.1)
    w.run_for(2)
    w.host.emergency("operator", "interrupted", w.now_s)

    w.run_for(4)

    assert w.host.state is HostState.EXIT
    for name in w.names:
        told = w.agent_saw(name, a.EmergencyOrdered)
        assert told == a.EmergencyOrdered("operator", "interrupted")


def test_host_setup_has_a_deadline():
    w = world()
    w.host_sets_up = False

    w.run_for(9)

    emergency = w.host_event(h.EmergencyDeclared)
    assert emergency.who == "host"
    assert "setup of the simulation" in emergency.reason


def test_agent_that_never_completes_is_named():
    w = world()
    w.mute.discard("agent-1")
    w.run_for(2)
    w.mute.add("agent-1")

    w.run_for(10)

    emergency = w.host_event(h.EmergencyDeclared)
    assert emergency.who == "agent-1"
    assert "SIMULATION_COMPLETE" in emergency.reason


def test_host_that_was_frozen_itself_blames_nobody_at_once():
    w = world(policy="continue")
    w.run_for(1.5)

    w.now_s += 4.0
    w.host.handle_timer(w.now_s)

    assert all(p.phase is Phase.RUNNING for p in w.host.peers.values())


def test_another_process_in_an_agents_place_ends_the_first():
    w = world(policy="continue")
    w.run_for(1.5)
    w.join("agent-1")

    w.run_for(1.0)

    assert w.host_event(h.AgentLost) == h.AgentLost(
        "agent-1", "another process took its place", incarnation=1
    )
    assert w.host.peers["agent-1"].phase is Phase.RUNNING
    moved = [e for e in w.host_events if isinstance(e, h.AgentMoved) and e.agent == "agent-1"]
    lost = [e.phase for e in moved].index(Phase.LOST)
    assert {e.incarnation for e in moved[: lost + 1]} == {1}
    assert {e.incarnation for e in moved[lost + 1 :]} == {2}


def test_datagrams_of_strangers_change_nothing_but_counters():
    w = world()
    w.run_for(1.5)
    before = {n: p.phase for n, p in w.host.peers.items()}
    generator = random.Random(3)

    for _ in range(2000):
        w.host.receive_datagram(generator.randbytes(generator.randrange(0, 1500)), ("x",), w.now_s)
    stranger = World(("agent-1",))
    stranger.join("agent-1")
    session = AgentSession(
        AgentIdentity(
            name="agent-1", index=1, incarnation_id=77, runtime_version=__version__, pid=1
        ),
        LinkSettings(run_key=b"x" * 32, session=WIRE.session),
        timeouts=TIMEOUTS,
        report=dict,
        now_s=w.now_s,
    )
    for data in session.datagrams_to_send(w.now_s):
        w.host.receive_datagram(data, ("x",), w.now_s)

    assert {n: p.phase for n, p in w.host.peers.items()} == before
    assert sum(w.host.refused.values()) >= 2001


def test_all_agents_lost_ends_even_a_run_that_may_lose_members():
    w = world(policy="continue")
    w.run_for(1.5)
    for name in w.names:
        w.host.agent_exited(name, "killed by SIGKILL", w.now_s)

    w.run_for(4)

    assert w.host.state is HostState.EXIT
    assert w.host_event(h.EmergencyDeclared) is not None


def test_rejoin_survives_the_loss_of_its_first_datagram():
    w = world(policy="continue")
    w.run_for(1.5)
    w.host.agent_exited("agent-2", "killed by SIGKILL", w.now_s)
    del w.agents["agent-2"]
    w.run_for(0.3)
    w.join("agent-2")
    w.agents["agent-2"].datagrams_to_send(w.now_s)  # the hello, lost

    w.run_for(12)

    assert w.agent_saw("agent-2", a.ExpelledFromRun) is None
    assert w.host_event(h.AgentRejoined) == h.AgentRejoined("agent-2")
    assert w.host.peers["agent-2"].summary == {"ok": "agent-2"}


def test_who_rejoins_sets_up_by_the_present_time_and_who_was_there_by_none():
    w = world(policy="continue")
    w.run_for(1.5)
    w.host.agent_exited("agent-2", "killed by SIGKILL", w.now_s)
    w.agent_events["agent-2"].clear()
    del w.agents["agent-2"]
    w.join("agent-2")
    w.run_for(1)

    first, again = (w.agent_saw(name, a.SetupReceived) for name in ("agent-1", "agent-2"))
    assert first.t_s == 0.0
    assert 0.0 < again.t_s <= w.now_s - w.t0_s


def test_late_word_of_an_earlier_process_does_not_lose_its_successor():
    w = world(policy="continue")
    w.run_for(1.5)

    w.host.agent_exited("agent-2", "killed by SIGKILL", w.now_s, pid=999)

    assert w.host.peers["agent-2"].phase is Phase.RUNNING
    w.host.agent_exited("agent-2", "killed by SIGKILL", w.now_s, pid=1)
    assert w.host.peers["agent-2"].phase is Phase.LOST


def test_slow_summary_or_slow_disk_of_an_agent_costs_no_run():
    w = world()
    w.run_for(1.0 + DURATION_S - 0.5)
    w.frozen.add("agent-2")  # deep in finish(), then in closing its records
    w.run_for(3.5)
    w.frozen.clear()

    w.run_for(6)

    assert w.host_event(h.EmergencyDeclared) is None
    assert w.host.state is HostState.EXIT


def test_stop_overtakes_no_reliable_data():
    w = world(count=1, loss=0.2, seed=5)
    w.run_for(1.5)
    for number in range(40):
        w.host.send("agent-1", number, Service.RELIABLE, w.now_s)
        w.agents["agent-1"].send(number, Service.RELIABLE, w.now_s)
    w.now_s = w.t0_s + DURATION_S  # the end comes while they are under way

    w.run_for(8)

    got = [e.payload for e in w.agent_events["agent-1"] if isinstance(e, a.HostDataReceived)]
    back = [e.payload for e in w.host_events if isinstance(e, h.AgentDataReceived)]
    assert got == list(range(40))
    assert back == list(range(40))


def test_data_sent_before_set_up_waits_for_the_agents_half():
    w = world(count=1)
    w.host_sets_up = False
    w.run_for(0.5)
    w.host.send("agent-1", "early", Service.SYNC, w.now_s)
    w.run_for(0.3)
    assert w.agent_saw("agent-1", a.HostDataReceived) is None

    w.host.setup_finished({"agent-1": {}}, w.now_s)
    w.run_for(0.5)

    kinds = [type(e) for e in w.agent_events["agent-1"]]
    assert kinds.index(a.SetupReceived) < kinds.index(a.HostDataReceived)


def test_messages_to_a_lost_agent_are_counted():
    w = world(policy="continue")
    w.run_for(1.5)
    w.frozen.add("agent-2")
    w.host.send("agent-2", "never read", Service.RELIABLE, w.now_s)
    w.run_for(3)

    assert w.host.send("agent-2", "nobody there", Service.RELIABLE, w.now_s) is False

    peer = w.host.peers["agent-2"]
    assert peer.not_sent == 1
    assert peer.link.counters.reliable.lost == 1


def test_agent_of_another_version_is_refused_with_both_versions():
    w = World(("agent-1",))
    w.agents["agent-1"] = AgentSession(
        AgentIdentity(name="agent-1", index=1, incarnation_id=1, runtime_version="0.0.1", pid=1),
        WIRE,
        timeouts=TIMEOUTS,
        report=dict,
        now_s=w.now_s,
    )

    w.run_for(2)

    emergency = w.host_event(h.EmergencyDeclared)
    assert emergency.reason == f"agent-1 runs MADNS 0.0.1, the host {__version__}"


def test_broken_sync_deadline_is_told_by_the_side_that_sent():
    w = world(count=1)
    w.run_for(1.5)

    w.host.send("agent-1", "late", Service.SYNC, w.now_s, deadline_s=w.now_s - 0.1)
    w.run_for(1)

    assert w.host_event(h.SyncDeadlineBroken).agent == "agent-1"
    assert w.host.peers["agent-1"].link.counters.deadlines_broken == 1


def test_a_run_that_is_stopped_while_all_are_away_on_purpose_is_complete_at_its_end():
    w = world(policy="continue")
    w.run_for(1.5)
    w.host.await_returns(True)
    for name in w.names:
        w.host.agent_exited(name, "killed by SIGKILL", w.now_s)
        del w.agents[name]
    w.run_for(0.5)

    w.host.await_returns(False)  # a stop came: none of them returns before that
    w.host.end_at(w.now_s + 0.3)
    w.run_for(0.2)
    assert w.host.state is HostState.SIMULATION_START
    w.run_for(1.0)

    assert w.host_event(h.AgentsComplete) is not None
    assert w.host_event(h.EmergencyDeclared) is None
