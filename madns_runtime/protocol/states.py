"""
The two state machines of a run, each one readable table (thesis, Table A.2).

An event that the table does not list for the present state raises and moves nothing. The diagram in
the documentation is generated from these tables by `mermaid`.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import Enum
from typing import Generic, TypeVar

from madns_runtime.errors import IllegalTransition

S = TypeVar("S", bound=Enum)
E = TypeVar("E", bound=Enum)


class HostState(Enum):
    """States of the host."""

    HOST_STARTUP = "HOST_STARTUP"
    SIMULATION_SETUP = "SIMULATION_SETUP"
    HOST_SIMULATION_READY = "HOST_SIMULATION_READY"
    SIMULATION_START = "SIMULATION_START"
    SIMULATION_COMPLETE = "SIMULATION_COMPLETE"
    BEGIN_SHUTDOWN = "BEGIN_SHUTDOWN"
    CLEANUP_FUNCTIONS = "CLEANUP_FUNCTIONS"
    END_HOST = "END_HOST"
    WAITING_SERVER_STOP = "WAITING_SERVER_STOP"
    EXIT = "EXIT"
    EMERGENCY_SHUTDOWN = "EMERGENCY_SHUTDOWN"


class HostEvent(Enum):
    """Events that move the host."""

    AGENTS_READY = "every agent has said hello"
    SETUP_FINISHED = "host half set up, initial data sent"
    AGENTS_SIMULATION_READY = "every agent's half is set up"
    AGENTS_COMPLETE = "every agent has run its simulated time"
    STOP_ORDERED = "summary taken, SYSTEM_STOP sent"
    AGENTS_STOPPED = "every agent has flushed its records, or its deadline is over"
    CLEANED_UP = "simulation and executor closed"
    RECORDS_CLOSED = "records on disk"
    SERVER_STOPPED = "last acknowledgements sent"
    EMERGENCY = "emergency"


class AgentState(Enum):
    """States of an agent."""

    AGENT_READY = "AGENT_READY"
    SIMULATION_SETUP = "SIMULATION_SETUP"
    AGENT_SIMULATION_READY = "AGENT_SIMULATION_READY"
    RUN_SIMULATION = "RUN_SIMULATION"
    SIMULATION_COMPLETE = "SIMULATION_COMPLETE"
    AGENT_SHUTDOWN = "AGENT_SHUTDOWN"
    END_AGENT = "END_AGENT"
    WAITING_SERVER_STOP = "WAITING_SERVER_STOP"
    EXIT = "EXIT"
    EMERGENCY_SHUTDOWN = "EMERGENCY_SHUTDOWN"


class AgentEvent(Enum):
    """Events that move an agent."""

    SETUP_RECEIVED = "initial data received"
    SETUP_FINISHED = "agent half set up"
    START_RECEIVED = "T0 received"
    RUN_FINISHED = "simulated time is over"
    STOP_RECEIVED = "SYSTEM_STOP received"
    RECORDS_CLOSED = "records on disk"
    STOPPED_SAID = "last counts sent"
    SERVER_STOPPED = "acknowledged, or its deadline is over"
    EMERGENCY = "emergency"


@dataclass(frozen=True, slots=True)
class Transition(Generic[S, E]):
    """One line of a table."""

    state: S
    event: E
    target: S


_H, _HE = HostState, HostEvent

HOST_LIVE = (
    _H.HOST_STARTUP,
    _H.SIMULATION_SETUP,
    _H.HOST_SIMULATION_READY,
    _H.SIMULATION_START,
    _H.SIMULATION_COMPLETE,
    _H.BEGIN_SHUTDOWN,
)
"""States in which agents may still run, and from which an emergency leads out."""

HOST_TABLE: tuple[Transition[HostState, HostEvent], ...] = (
    Transition(_H.HOST_STARTUP, _HE.AGENTS_READY, _H.SIMULATION_SETUP),
    Transition(_H.SIMULATION_SETUP, _HE.SETUP_FINISHED, _H.HOST_SIMULATION_READY),
    Transition(_H.HOST_SIMULATION_READY, _HE.AGENTS_SIMULATION_READY, _H.SIMULATION_START),
    Transition(_H.SIMULATION_START, _HE.AGENTS_COMPLETE, _H.SIMULATION_COMPLETE),
    Transition(_H.SIMULATION_COMPLETE, _HE.STOP_ORDERED, _H.BEGIN_SHUTDOWN),
    Transition(_H.BEGIN_SHUTDOWN, _HE.AGENTS_STOPPED, _H.CLEANUP_FUNCTIONS),
    Transition(_H.EMERGENCY_SHUTDOWN, _HE.AGENTS_STOPPED, _H.CLEANUP_FUNCTIONS),
    Transition(_H.CLEANUP_FUNCTIONS, _HE.CLEANED_UP, _H.END_HOST),
    Transition(_H.END_HOST, _HE.RECORDS_CLOSED, _H.WAITING_SERVER_STOP),
    Transition(_H.WAITING_SERVER_STOP, _HE.SERVER_STOPPED, _H.EXIT),
    *(Transition(state, _HE.EMERGENCY, _H.EMERGENCY_SHUTDOWN) for state in HOST_LIVE),
)

_A, _AE = AgentState, AgentEvent

AGENT_LIVE = (
    _A.AGENT_READY,
    _A.SIMULATION_SETUP,
    _A.AGENT_SIMULATION_READY,
    _A.RUN_SIMULATION,
    _A.SIMULATION_COMPLETE,
)
"""States in which records are still open, and from which an emergency leads out."""

AGENT_TABLE: tuple[Transition[AgentState, AgentEvent], ...] = (
    Transition(_A.AGENT_READY, _AE.SETUP_RECEIVED, _A.SIMULATION_SETUP),
    Transition(_A.SIMULATION_SETUP, _AE.SETUP_FINISHED, _A.AGENT_SIMULATION_READY),
    Transition(_A.AGENT_SIMULATION_READY, _AE.START_RECEIVED, _A.RUN_SIMULATION),
    Transition(_A.RUN_SIMULATION, _AE.RUN_FINISHED, _A.SIMULATION_COMPLETE),
    Transition(_A.SIMULATION_COMPLETE, _AE.STOP_RECEIVED, _A.AGENT_SHUTDOWN),
    Transition(_A.AGENT_SHUTDOWN, _AE.RECORDS_CLOSED, _A.END_AGENT),
    Transition(_A.EMERGENCY_SHUTDOWN, _AE.RECORDS_CLOSED, _A.END_AGENT),
    Transition(_A.END_AGENT, _AE.STOPPED_SAID, _A.WAITING_SERVER_STOP),
    Transition(_A.WAITING_SERVER_STOP, _AE.SERVER_STOPPED, _A.EXIT),
    *(Transition(state, _AE.EMERGENCY, _A.EMERGENCY_SHUTDOWN) for state in AGENT_LIVE),
)


class StateMachine(Generic[S, E]):
    """A present state and the table that moves it."""

    __slots__ = ("_targets", "state")

    def __init__(self, table: Iterable[Transition[S, E]], initial: S) -> None:
        self._targets = {(line.state, line.event): line.target for line in table}
        self.state = initial

    def allows(self, event: E) -> bool:
        """Tell whether *event* moves the present state."""
        return (self.state, event) in self._targets

    def fire(self, event: E) -> S:
        """
        Move by *event* and return the new state.

        Raises:
            IllegalTransition: The table does not list it; the state stays.
        """
        target = self._targets.get((self.state, event))
        if target is None:
            raise IllegalTransition(f"{event.name} is not expected in state {self.state.value}")
        self.state = target
        return target


def host_machine() -> StateMachine[HostState, HostEvent]:
    """Return a host's machine in its first state."""
    return StateMachine(HOST_TABLE, HostState.HOST_STARTUP)


def agent_machine() -> StateMachine[AgentState, AgentEvent]:
    """Return an agent's machine in its first state."""
    return StateMachine(AGENT_TABLE, AgentState.AGENT_READY)


def mermaid(table: Iterable[Transition[S, E]], initial: S) -> str:
    """Return a table as a Mermaid state diagram."""
    lines = ["stateDiagram-v2", f"    [*] --> {initial.value}"]
    lines += [f"    {t.state.value} --> {t.target.value}: {t.event.value}" for t in table]
    return "\n".join([*lines, "    EXIT --> [*]"])
