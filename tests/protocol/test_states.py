"""Both state machines against Table A.2 of the thesis."""

import subprocess
import sys
from pathlib import Path

import pytest

from madns_runtime.errors import IllegalTransition
from madns_runtime.protocol.states import (
    AGENT_LIVE,
    AGENT_TABLE,
    HOST_LIVE,
    HOST_TABLE,
    AgentEvent,
    AgentState,
    HostEvent,
    HostState,
    agent_machine,
    host_machine,
)

HOST_WAY = [
    HostEvent.AGENTS_READY,
    HostEvent.SETUP_FINISHED,
    HostEvent.AGENTS_SIMULATION_READY,
    HostEvent.AGENTS_COMPLETE,
    HostEvent.STOP_ORDERED,
    HostEvent.AGENTS_STOPPED,
    HostEvent.CLEANED_UP,
    HostEvent.RECORDS_CLOSED,
    HostEvent.SERVER_STOPPED,
]
AGENT_WAY = [
    AgentEvent.SETUP_RECEIVED,
    AgentEvent.SETUP_FINISHED,
    AgentEvent.START_RECEIVED,
    AgentEvent.RUN_FINISHED,
    AgentEvent.STOP_RECEIVED,
    AgentEvent.RECORDS_CLOSED,
    AgentEvent.STOPPED_SAID,
    AgentEvent.SERVER_STOPPED,
]


def test_host_passes_through_the_states_of_table_a2_in_order():
    machine = host_machine()

    states = [machine.state, *(machine.fire(event) for event in HOST_WAY)]

    assert [state.name for state in states] == [
        "HOST_STARTUP",
        "SIMULATION_SETUP",
        "HOST_SIMULATION_READY",
        "SIMULATION_START",
        "SIMULATION_COMPLETE",
        "BEGIN_SHUTDOWN",
        "CLEANUP_FUNCTIONS",
        "END_HOST",
        "WAITING_SERVER_STOP",
        "EXIT",
    ]


def test_agent_passes_through_the_states_of_table_a2_in_order():
    machine = agent_machine()

    states = [machine.state, *(machine.fire(event) for event in AGENT_WAY)]

    assert [state.name for state in states] == [
        "AGENT_READY",
        "SIMULATION_SETUP",
        "AGENT_SIMULATION_READY",
        "RUN_SIMULATION",
        "SIMULATION_COMPLETE",
        "AGENT_SHUTDOWN",
        "END_AGENT",
        "WAITING_SERVER_STOP",
        "EXIT",
    ]


@pytest.mark.parametrize(
    ("machine", "events", "table"),
    [(host_machine, HostEvent, HOST_TABLE), (agent_machine, AgentEvent, AGENT_TABLE)],
)
def test_every_unlisted_event_raises_and_moves_nothing(machine, events, table):
    listed = {(line.state, line.event) for line in table}
    states = {line.state for line in table} | {line.target for line in table}

    for state in states:
        for event in events:
            if (state, event) in listed:
                continue
            one = machine()
            one.state = state
            with pytest.raises(IllegalTransition):
                one.fire(event)
            assert one.state is state
            assert not one.allows(event)


def test_emergency_is_reached_from_every_live_state_and_leads_to_the_exit():
    for state in HOST_LIVE:
        machine = host_machine()
        machine.state = state
        assert machine.fire(HostEvent.EMERGENCY) is HostState.EMERGENCY_SHUTDOWN
        for event in HOST_WAY[5:]:
            machine.fire(event)
        assert machine.state is HostState.EXIT
    for state in AGENT_LIVE:
        machine = agent_machine()
        machine.state = state
        assert machine.fire(AgentEvent.EMERGENCY) is AgentState.EMERGENCY_SHUTDOWN
        for event in AGENT_WAY[5:]:
            machine.fire(event)
        assert machine.state is AgentState.EXIT


def test_no_table_lists_an_event_twice_for_one_state():
    for table in (HOST_TABLE, AGENT_TABLE):
        keys = [(line.state, line.event) for line in table]

        assert len(keys) == len(set(keys))


@pytest.mark.process
def test_generated_documentation_is_current():
    script = Path(__file__).parents[2] / "docs" / "generate.py"

    done = subprocess.run(
        [sys.executable, str(script), "--check"], capture_output=True, text=True, check=False
    )

    assert done.returncode == 0, done.stderr
