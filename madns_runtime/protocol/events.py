"""Events of the two sessions, for their composition roots."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Any

from madns_runtime.protocol.deadlines import BrokenDeadline
from madns_runtime.protocol.messages import Service
from madns_runtime.protocol.states import AgentState, HostState


class Phase(Enum):
    """Progress of one agent through a run."""

    ABSENT = "absent"
    JOINING = "joining"
    READY = "ready"
    SETTING_UP = "setting-up"
    SIMULATION_READY = "simulation-ready"
    RUNNING = "running"
    COMPLETE = "complete"
    STOPPED = "stopped"
    LOST = "lost"


@dataclass(frozen=True, slots=True)
class HostStateEntered:
    """The host is in another state now."""

    state: HostState


@dataclass(frozen=True, slots=True)
class AgentsReady:
    """Every agent has said hello: set up the host's half, then call `setup_finished`."""


@dataclass(frozen=True, slots=True)
class AgentsSimulationReady:
    """Every agent's half is set up: choose T0 and call `start`."""


@dataclass(frozen=True, slots=True)
class AgentMoved:
    """An agent has reached another phase."""

    agent: str
    phase: Phase
    reason: str | None = None
    incarnation: int = 1
    """Which of its starts has; another may have begun since."""


@dataclass(frozen=True, slots=True)
class AgentLost:
    """An agent is gone; under on_agent_loss: abort an emergency follows."""

    agent: str
    reason: str
    incarnation: int = 1
    """Which of its starts has ended; another may have begun since."""


@dataclass(frozen=True, slots=True)
class AgentRejoining:
    """A new incarnation of an agent says hello in mid-run: answer with `send_setup`."""

    agent: str


@dataclass(frozen=True, slots=True)
class AgentRejoined:
    """An agent's new incarnation is set up and has T0."""

    agent: str


@dataclass(frozen=True, slots=True)
class AgentDataReceived:
    """An agent's half sent this, to the host's or to other agents; or a condition on its records is met."""

    agent: str
    payload: Any
    """A message's payload, or a Transmission or ConditionMet, which no payload is."""
    service: Service = Service.RELIABLE


@dataclass(frozen=True, slots=True)
class AgentsComplete:
    """Every agent that is left has run its simulated time: take the summary, call `order_stop`."""


@dataclass(frozen=True, slots=True)
class AgentsStopped:
    """Every agent has flushed its records, or its deadline is over: clean up and end."""

    missing: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class EmergencyDeclared:
    """The run ends here; who declared it and why."""

    who: str
    reason: str


@dataclass(frozen=True, slots=True)
class SyncDeadlineBroken:
    """A SYNC message to *agent* was not there by its deadline."""

    agent: str
    broken: BrokenDeadline


HostSessionEvent = (
    HostStateEntered
    | AgentsReady
    | AgentsSimulationReady
    | AgentMoved
    | AgentLost
    | AgentRejoining
    | AgentRejoined
    | AgentDataReceived
    | AgentsComplete
    | AgentsStopped
    | EmergencyDeclared
    | SyncDeadlineBroken
)


@dataclass(frozen=True, slots=True)
class AgentStateEntered:
    """The agent is in another state now."""

    state: AgentState


@dataclass(frozen=True, slots=True)
class SetupReceived:
    """Initial data came: set up the simulation, then call `setup_finished`."""

    initial: Any
    t_s: float
    """Simulated time, for one that rejoins; 0 for all others."""


@dataclass(frozen=True, slots=True)
class StartReceived:
    """Simulated time zero is *t0_host_s* on the host's clock."""

    t0_host_s: float


@dataclass(frozen=True, slots=True)
class HostDataReceived:
    """The host's half sent this, or this came of messages between agents."""

    payload: Any
    """A message's payload, or a Delivery or TransmissionRefusal, which no payload is."""


@dataclass(frozen=True, slots=True)
class StopReceived:
    """Close the records, then call `records_closed`."""


@dataclass(frozen=True, slots=True)
class EmergencyOrdered:
    """End now: close the records, then call `records_closed`."""

    who: str
    reason: str


@dataclass(frozen=True, slots=True)
class ExpelledFromRun:
    """The host had declared this agent lost; this conversation is over, a new incarnation may join."""

    reason: str


@dataclass(frozen=True, slots=True)
class ClockEstimated:
    """A clock exchange came in; `AgentSession.clock` has changed."""


@dataclass(frozen=True, slots=True)
class SessionEnded:
    """Nothing more is to be sent or awaited."""


AgentSessionEvent = (
    AgentStateEntered
    | SetupReceived
    | StartReceived
    | HostDataReceived
    | StopReceived
    | EmergencyOrdered
    | ExpelledFromRun
    | ClockEstimated
    | SessionEnded
)
