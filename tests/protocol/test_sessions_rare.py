"""Sessions where things happen out of turn: each is counted or refused, and nothing moves wrongly."""

import pytest
from test_sessions import STEP_S, TIMEOUTS, WIRE, World, world

from madns_runtime import __version__
from madns_runtime.protocol import events as a
from madns_runtime.protocol import events as h
from madns_runtime.protocol.agent_session import HELD_MAX, AgentIdentity, AgentSession
from madns_runtime.protocol.codec import encode_message
from madns_runtime.protocol.events import Phase
from madns_runtime.protocol.messages import (
    AgentStopped,
    Hello,
    Pong,
    Service,
    SimulationComplete,
    SimulationReady,
    SimulationStart,
    SystemStop,
    Transmission,
)
from madns_runtime.protocol.ping_plan import PingPlan
from madns_runtime.protocol.states import AgentState, HostState


def say(w, name, message):
    """Let an agent's link say something out of turn."""
    w.agents[name].link.send_urgent(encode_message(message), Service.SYNC, w.now_s)
    w.run_for(0.3)


def order(w, name, message, *, step_agent=None):
    """Let the host's link say something out of turn."""
    w.step_agent = step_agent or w.step_agent
    w.host.peers[name].link.send_urgent(encode_message(message), Service.SYNC, w.now_s)
    w.host._links.mark(w.host.peers[name])
    w.run_for(0.3)


def test_messages_of_the_wrong_side_or_without_sense_are_counted():
    w = world(count=1)
    w.run_for(1.5)

    say(w, "agent-1", Pong(1.0, 2.0, 3.0))
    w.agents["agent-1"].link.send_urgent(b"\xff\x00", Service.SYNC, w.now_s)
    order(w, "agent-1", Hello("agent-1", __version__, 1))
    order(w, "agent-1", SimulationStart(1.0))  # it runs already
    w.host.peers["agent-1"].link.send_urgent(b"\xff\x00", Service.SYNC, w.now_s)
    w.host._links.mark(w.host.peers["agent-1"])
    w.run_for(0.3)

    assert w.host.malformed_count == 2
    assert w.agents["agent-1"].malformed_count == 3
    assert w.host.peers["agent-1"].phase is Phase.RUNNING


def test_agent_that_stops_before_it_is_told_to_is_lost():
    w = world(count=2, policy="continue")
    w.run_for(1.5)

    say(w, "agent-1", AgentStopped({}))

    lost = w.host_event(h.AgentLost)
    assert lost == h.AgentLost("agent-1", "it stopped before it was told to")


def test_stop_out_of_turn_moves_no_agent():
    w = world(count=1)
    w.run_for(1.5)

    order(w, "agent-1", SystemStop())

    assert w.agents["agent-1"].state is AgentState.RUN_SIMULATION
    assert w.agents["agent-1"].malformed_count == 1


def test_what_waits_for_set_up_is_bounded_and_the_rest_counted():
    w = world(count=1)
    w.host_sets_up = False
    w.run_for(0.5)
    for number in range(HELD_MAX + 5):
        w.host.send("agent-1", number, Service.RELIABLE, w.now_s)
    w.run_for(2)

    w.host.setup_finished({"agent-1": {}}, w.now_s)
    w.run_for(2)

    got = [e.payload for e in w.agent_events["agent-1"] if isinstance(e, a.HostDataReceived)]
    assert got == list(range(HELD_MAX))
    assert w.agents["agent-1"].held_dropped_count == 5


def test_newcomer_at_the_end_of_a_run_is_sent_away():
    w = world(count=2, policy="continue")
    w.run_for(1.5)
    w.host.agent_exited("agent-2", "killed by SIGKILL", w.now_s)
    del w.agents["agent-2"]
    w.run_for(0.2)
    w.host.emergency("operator", "interrupted", w.now_s)
    w.join("agent-2")

    w.run_for(1.0)

    told = w.agent_saw("agent-2", a.EmergencyOrdered)
    assert told.who == "host"
    assert "already ending" in told.reason or told.reason == "interrupted"


def test_successor_of_a_completed_agent_is_refused():
    w = world(count=2)
    w.agents["agent-2"].run_finished = lambda summary, now_s: None  # agent-2 is slow to finish
    while w.host.peers["agent-1"].phase is not Phase.COMPLETE:
        w.run_for(0.05)
    first = w.agents["agent-1"]
    w.join("agent-1")
    w.run_for(0.2)

    assert w.host.refused["old_incarnation"] > 0
    assert w.host.peers["agent-1"].phase is Phase.COMPLETE
    assert first is not w.agents["agent-1"]


def test_agents_that_are_ready_or_silent_at_a_deadline_are_told_apart_under_continue():
    w = World(("agent-1", "agent-2"), policy="continue")
    w.join("agent-1")

    w.run_for(6)

    assert w.host.peers["agent-2"].phase is Phase.LOST
    assert w.host.peers["agent-2"].loss_reason.startswith("no AGENT_READY in 5")
    assert w.host.peers["agent-1"].phase is Phase.RUNNING


def test_host_ends_though_agents_never_say_that_they_stopped():
    w = world(count=2)
    w.run_for(1.5)
    w.frozen.update(w.names)
    w.host.emergency("operator", "interrupted", w.now_s)

    w.run_for(5)

    assert w.host_event(h.AgentsStopped).missing == w.names
    assert w.host.state is HostState.EXIT
    assert w.host.get_timer() is None


def test_word_of_unknown_or_ended_agents_changes_nothing():
    w = world(count=2, policy="continue")
    w.run_for(1.5)
    w.host.agent_exited("agent-1", "gone", w.now_s)
    events = len(w.host_events)

    w.host.agent_exited("agent-1", "gone again", w.now_s)
    w.host.agent_exited("nobody", "gone", w.now_s)
    w.host.send_setup("agent-2", {}, w.now_s)
    w.run_for(0.01)

    lost = [e for e in w.host_events if isinstance(e, h.AgentLost)]
    assert lost == [h.AgentLost("agent-1", "gone")]
    assert len(w.host_events) <= events + 4


def test_second_emergency_has_no_effect_on_either_side():
    w = world(count=1)
    w.run_for(1.5)
    w.host.emergency("operator", "first", w.now_s)
    w.host.emergency("operator", "second", w.now_s)
    w.run_for(0.3)
    w.agents["agent-1"].emergency("third", w.now_s)
    order(w, "agent-1", Hello("agent-1", __version__, 1))
    w.run_for(3)

    declared = [e for e in w.host_events if isinstance(e, h.EmergencyDeclared)]
    assert declared == [h.EmergencyDeclared("operator", "first")]
    seen = [e for e in w.agent_events["agent-1"] if isinstance(e, a.EmergencyOrdered)]
    assert seen == [a.EmergencyOrdered("operator", "first")]


def test_agent_without_a_host_says_what_to_look_at_and_ends():
    w = World(("agent-1",))
    w.host_is_dead = True
    w.join("agent-1")

    w.run_for(8)

    told = w.agent_saw("agent-1", a.EmergencyOrdered)
    assert "no answer to HELLO in 5 s" in told.reason
    assert "UDP port" in told.reason
    assert w.agents["agent-1"].state is AgentState.EXIT
    assert w.agents["agent-1"].get_timer() is None
    w.agents["agent-1"].handle_timer(w.now_s)  # over: nothing moves
    w.agents["agent-1"].receive_datagram(b"late", w.now_s)
    assert w.agents["agent-1"].state is AgentState.EXIT


def test_agent_that_is_never_told_to_go_on_ends_by_its_deadline():
    w = world(count=1)
    w.host.start = lambda *arguments: None

    w.run_for(12)

    told = w.agent_saw("agent-1", a.EmergencyOrdered)
    assert "no order to go on from AGENT_SIMULATION_READY" in told.reason


def test_broken_deadline_of_an_agents_own_message_is_told_once():
    w = world(count=1)
    w.run_for(1.5)
    session = w.agents["agent-1"]
    session.send("late", Service.SYNC, w.now_s, deadline_s=w.now_s - 1.0)
    w.run_for(0.3)

    assert session.next_broken_deadline().deadline_s < w.now_s
    assert session.next_broken_deadline() is None


@pytest.mark.parametrize("name", ["agent-2", "somebody"])
def test_agent_that_gives_another_name_than_its_place_is_refused(name):
    w = World(("agent-1",))
    w.agents["agent-1"] = AgentSession(
        AgentIdentity(name=name, index=1, incarnation_id=9, runtime_version=__version__, pid=1),
        WIRE,
        timeouts=TIMEOUTS,
        report=dict,
        now_s=w.now_s,
    )

    w.run_for(1)

    assert w.host.peers["agent-1"].phase is Phase.LOST


@pytest.mark.parametrize(
    "word",
    [
        Hello("agent-1", __version__, 1),
        SimulationReady(),
        SimulationComplete({"never": "ran"}),
    ],
    ids=lambda word: type(word).__name__,
)
def test_word_out_of_turn_moves_no_agent_and_holds_up_no_wait(word):
    w = World(("agent-1", "agent-2"))
    w.join("agent-1")
    w.run_for(0.5)

    say(w, "agent-1", word)

    assert w.host.malformed_count == 1
    assert w.host.peers["agent-1"].phase is Phase.READY
    assert w.host.peers["agent-1"].summary == {}
    w.run_for(8)
    assert w.host_event(h.EmergencyDeclared).who == "agent-2"
    assert w.host.state is HostState.EXIT


def test_agents_silent_at_once_are_all_lost_and_named():
    w = world(count=3)
    w.run_for(1.6)  # no ping is on its way
    w.host.peers["agent-2"].heard_s = w.host.peers["agent-3"].heard_s = w.now_s - 2.6
    w.frozen.update(("agent-2", "agent-3"))

    w.run_for(0.15)

    reason = "silent for 2.5 s while running"
    lost = [e for e in w.host_events if isinstance(e, h.AgentLost)]
    assert lost == [h.AgentLost("agent-2", reason), h.AgentLost("agent-3", reason)]
    declared = [e for e in w.host_events if isinstance(e, h.EmergencyDeclared)]
    assert declared == [h.EmergencyDeclared("agent-2, agent-3", reason)]


def test_one_that_is_killed_on_purpose_is_missed_soon_though_nobody_tells_of_it():
    w = world(count=2, policy="continue")
    w.run_for(1.6)
    w.host.agent_is_being_killed("agent-2", w.now_s)
    w.frozen.add("agent-2")

    w.run_for(1.9)
    assert w.host.peers["agent-2"].phase is Phase.RUNNING
    w.run_for(0.3)

    assert w.host_event(h.AgentLost) == h.AgentLost("agent-2", "silent for 2 s while running")


def test_a_run_whose_agents_were_all_killed_ends_well_when_it_is_stopped_before_they_return():
    w = world(count=2, policy="continue")
    w.run_for(1.6)
    w.frozen.update(w.names)
    for name in w.names:
        w.host.agent_is_being_killed(name, w.now_s)
    w.host.await_returns(True)
    w.run_for(0.5)

    w.host.await_returns(False, are_cut_off=True)
    w.host.end_at(w.now_s + 0.2)
    w.run_for(3)

    assert w.host_event(h.AgentsComplete) is not None
    assert w.host_event(h.EmergencyDeclared) is None


def test_a_loss_between_a_stop_and_the_end_of_the_run_ends_it_no_earlier():
    w = world(count=1, policy="continue")
    w.run_for(1.6)
    w.frozen.add("agent-1")
    w.host.await_returns(False, are_cut_off=True)
    w.host.end_at(w.now_s + 0.5)

    w.host.agent_exited("agent-1", "killed by SIGKILL", w.now_s)
    w.run_for(0.4)
    assert w.host.state is HostState.SIMULATION_START
    w.run_for(0.4)

    assert w.host_event(h.AgentsComplete) is not None
    assert w.host_event(h.EmergencyDeclared) is None


def test_one_that_was_slow_to_hear_that_it_is_killed_is_not_expelled_and_may_return():
    w = world(count=2, policy="continue")
    w.run_for(1.6)
    w.host.agent_is_being_killed("agent-2", w.now_s)
    w.frozen.add("agent-2")
    w.run_for(2.3)
    assert w.host.peers["agent-2"].phase is Phase.LOST

    w.frozen.clear()
    w.run_for(0.5)

    assert w.agent_saw("agent-2", a.ExpelledFromRun) is None
    w.join("agent-2")
    w.run_for(1)
    assert w.host.peers["agent-2"].killed_s is None
    assert w.host_event(h.AgentRejoined) == h.AgentRejoined("agent-2")


def test_what_an_agent_missed_of_a_deadline_is_counted_as_lost_with_it():
    for sent in (["never read"], []):
        w = world(count=1)
        w.host_sets_up = False
        w.join("agent-1")
        w.agents["agent-1"].datagrams_to_send(w.now_s)
        w.run_for(0.5)
        for payload in sent:
            w.host.send("agent-1", payload, Service.RELIABLE, w.now_s)
        w.frozen.add("agent-1")
        w.run_for(16)

        peer = w.host.peers["agent-1"]
        assert peer.phase is Phase.LOST
        assert peer.link.counters.reliable.lost == len(sent)


def test_orders_to_a_process_that_another_replaced_are_lost_and_their_deadlines_broken():
    w = world(count=2, policy="continue")
    w.run_for(1.5)
    w.frozen.add("agent-1")
    w.host.send("agent-1", "burn", Service.SYNC, w.now_s, deadline_s=w.now_s + 60.0)
    w.run_for(0.2)
    w.frozen.clear()

    w.join("agent-1")
    w.run_for(1.0)

    broken = w.host_event(h.SyncDeadlineBroken)
    assert (broken.agent, broken.broken.late_s) == ("agent-1", None)
    (earlier,) = w.host.peers["agent-1"].retired_counters
    assert earlier["deadlines_broken"] == earlier["sync"]["lost"] == 1


def test_last_word_of_an_agent_that_returns_is_kept_and_is_not_taken_for_that_of_the_next_incarnation():
    w = world(count=2, policy="continue")
    w.run_for(1.5)
    w.agents["agent-1"].emergency("it raised", w.now_s)
    w.run_for(1.0)

    w.join("agent-1")
    w.run_for(1.0)

    peer = w.host.peers["agent-1"]
    assert peer.retired_records == [{"written": 7}]
    assert peer.records == {}


def test_nothing_waits_for_a_process_that_has_not_said_hello():
    w = world(count=2, policy="continue")
    w.run_for(1.5)
    w.host.agent_exited("agent-2", "killed by SIGKILL", w.now_s)
    w.join("agent-2")
    w.agents["agent-2"].datagrams_to_send(w.now_s)  # the hello, lost
    while w.host.peers["agent-2"].phase is Phase.LOST:
        w.run_for(STEP_S)
    assert w.host.peers["agent-2"].phase is Phase.JOINING

    assert w.host.send("agent-2", "too early", Service.RELIABLE, w.now_s) is False

    assert w.host.peers["agent-2"].not_sent == 1
    assert w.host.peers["agent-2"].link.is_flushed


def test_timer_of_an_agent_that_takes_long_to_close_its_records_does_not_stand_still():
    w = world(count=1)
    w.run_for(1.5)
    session = w.agents["agent-1"]
    session.run_finished({}, w.now_s)
    order(w, "agent-1", SystemStop(), step_agent=lambda name, session: None)
    assert session.state is AgentState.AGENT_SHUTDOWN  # its owner closes the records

    for _ in range(100):
        w.now_s = max(w.now_s + STEP_S, session.get_timer())
        session.handle_timer(w.now_s)
        session.datagrams_to_send(w.now_s)
        assert session.get_timer() > w.now_s


def test_process_that_another_replaced_does_not_come_back():
    w = world(count=2, policy="continue")
    w.run_for(1.5)
    first = w.agents["agent-1"]
    w.join("agent-1")
    w.run_for(1.0)
    assert w.host.peers["agent-1"].phase is Phase.RUNNING

    first.handle_timer(w.now_s)
    for data in first.datagrams_to_send(w.now_s):
        w.host.receive_datagram(data, ("agent-1",), w.now_s)

    assert w.host.refused["old_incarnation"] > 0
    assert w.host.peers["agent-1"].phase is Phase.RUNNING
    assert len(w.host.peers["agent-1"].retired_counters) == 1


@pytest.mark.parametrize("sent_s", [float("nan"), float("inf"), float("-inf")])
def test_transmission_of_no_time_reaches_no_medium_and_is_counted(sent_s):
    w = world(count=2)
    w.run_for(1.5)

    for number in range(3):
        w.agents["agent-1"].transmit(Transmission("agent-2", number, sent_s, {}), w.now_s)
    good = Transmission("agent-2", 3, 0.5, {})
    w.agents["agent-1"].transmit(good, w.now_s)
    w.run_for(0.3)

    assert w.host.malformed_count == 3
    heard = [event for event in w.host_events if isinstance(event, h.AgentDataReceived)]
    assert heard == [h.AgentDataReceived("agent-1", good)]
    assert w.host.next_event() is None
    assert w.host.peers["agent-1"].phase is Phase.RUNNING


def test_an_agent_that_is_called_once_per_second_misses_a_host_that_is_gone():
    w = World(("agent-1",))
    w.join("agent-1", PingPlan(interval_s=1.0))  # as one of many in a process
    w.run_for(2.0)
    session, gone_s = w.agents["agent-1"], w.now_s
    assert session.state is AgentState.RUN_SIMULATION

    for number in range(1, 10):  # each call a little later behind its time than the one before
        called_s = session.ping_due_s + number * 1e-4
        session.handle_timer(called_s)
        if session.state is not AgentState.RUN_SIMULATION:
            break

    assert session.state is AgentState.EMERGENCY_SHUTDOWN
    assert called_s - gone_s < TIMEOUTS.silence_s + 1.1


def test_an_agent_that_was_itself_held_up_between_rare_calls_blames_nobody():
    w = World(("agent-1",))
    w.join("agent-1", PingPlan(interval_s=1.0))
    w.run_for(2.0)
    session = w.agents["agent-1"]

    session.handle_timer(session.ping_due_s + 3.0)

    assert session.state is AgentState.RUN_SIMULATION


def test_an_agent_whose_set_up_took_long_blames_nobody_for_what_it_did_not_hear():
    w = World(("agent-1",))
    w.mute.add("agent-1")  # in its set-up
    # Which comes before it knows the clock.
    w.join("agent-1", PingPlan(brings_clock_up=False, delay_s=9.0))
    w.run_for(0.1)
    session = w.agents["agent-1"]
    assert session.state is AgentState.SIMULATION_SETUP

    w.now_s += TIMEOUTS.silence_s + 0.5
    session.setup_finished(w.now_s)
    session.handle_timer(w.now_s)
    w.run_for(1.0)

    assert session.state is AgentState.RUN_SIMULATION
