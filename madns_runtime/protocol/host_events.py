"""What a host's session tells of: the phases of its agents, its events, and what it knows of each agent."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import Any

from madns_runtime.protocol.deadlines import BrokenDeadline
from madns_runtime.protocol.link import Link
from madns_runtime.protocol.states import HostState

Address = tuple[Any, ...]

PINGS_MAX = 16


class Phase(Enum):
    """How far one agent has come."""

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
class StateEntered:
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


@dataclass(frozen=True, slots=True)
class AgentLost:
    """An agent is gone; under on_agent_loss: abort an emergency follows."""

    agent: str
    reason: str


@dataclass(frozen=True, slots=True)
class AgentRejoining:
    """A new incarnation of an agent says hello in mid-run: answer with `send_setup`."""

    agent: str


@dataclass(frozen=True, slots=True)
class AgentRejoined:
    """An agent's new incarnation is set up and has T0."""

    agent: str


@dataclass(frozen=True, slots=True)
class DataReceived:
    """An agent's half sent this."""

    agent: str
    payload: Any


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
    StateEntered
    | AgentsReady
    | AgentsSimulationReady
    | AgentMoved
    | AgentLost
    | AgentRejoining
    | AgentRejoined
    | DataReceived
    | AgentsComplete
    | AgentsStopped
    | EmergencyDeclared
    | SyncDeadlineBroken
)


@dataclass(slots=True, kw_only=True)
class Peer:
    """What the host knows of one agent."""

    name: str
    index: int
    phase: Phase = Phase.ABSENT
    link: Link | None = None
    address: Address | None = None
    pid: int | None = None
    """Of the process that said hello; None until it did."""
    incarnations_seen: set[int] = field(default_factory=set)
    """Of all processes that spoke for it; the link's is the present one."""
    heard_s: float = 0.0
    pings: deque[tuple[float, float]] = field(default_factory=lambda: deque(maxlen=PINGS_MAX))
    """Pings not answered yet: the agent's time, and when it came. Older ones give way: they would tell less of its clock."""
    timer_s: float = float("inf")
    loss_reason: str | None = None
    report: Mapping[str, Any] = field(default_factory=dict)
    summary: Mapping[str, Any] = field(default_factory=dict)
    records: Mapping[str, Any] = field(default_factory=dict)
    not_sent: int = 0
    """Messages of the host's half that had nobody to go to."""
    retired_counters: list[Mapping[str, Any]] = field(default_factory=list)
    """Counters of the links of earlier incarnations."""
