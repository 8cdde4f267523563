"""What an agent's session tells its composition root."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from madns_runtime.protocol.states import AgentState


@dataclass(frozen=True, slots=True)
class StateEntered:
    """The agent is in another state now."""

    state: AgentState


@dataclass(frozen=True, slots=True)
class SetupReceived:
    """Initial data came: set up the simulation, then call `setup_finished`."""

    initial: Any


@dataclass(frozen=True, slots=True)
class StartReceived:
    """Simulated time zero is *t0_host_s* on the host's clock."""

    t0_host_s: float


@dataclass(frozen=True, slots=True)
class DataReceived:
    """The host's half sent this."""

    payload: Any


@dataclass(frozen=True, slots=True)
class StopReceived:
    """Close the records, then call `records_closed`."""


@dataclass(frozen=True, slots=True)
class EmergencyDeclared:
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
    StateEntered
    | SetupReceived
    | StartReceived
    | DataReceived
    | StopReceived
    | EmergencyDeclared
    | ExpelledFromRun
    | ClockEstimated
    | SessionEnded
)
