"""
Every message on the wire, one frozen dataclass each, and the classes of service they travel in.

A message's KIND is the first byte of its body and never changes its meaning; new messages take new numbers.
Times named t_host_s or t_agent_s are seconds of that side's monotonic clock.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, ClassVar

VERSION = 1


class Service(IntEnum):
    """Classes of service. A loss in one never delays another."""

    BEST = 0
    """Telemetry: the newest wins, gaps are counted, nothing is sent again."""
    RELIABLE = 1
    """Ordered, fragmented, windowed, exactly once."""
    SYNC = 2
    """As RELIABLE, in a stream of its own that is sent before any fragment, with a deadline."""


@dataclass(frozen=True, slots=True)
class Hello:
    """Agent -> host: I am here (AGENT_READY). Repeated until the host answers."""

    KIND: ClassVar[int] = 1
    agent: str
    runtime_version: str
    pid: int


@dataclass(frozen=True, slots=True)
class SimulationSetup:
    """Host -> agent: the initial data of your half of the simulation."""

    KIND: ClassVar[int] = 2
    initial: Any


@dataclass(frozen=True, slots=True)
class SimulationReady:
    """Agent -> host: my half is set up (AGENT_SIMULATION_READY)."""

    KIND: ClassVar[int] = 3


@dataclass(frozen=True, slots=True)
class SimulationStart:
    """Host -> agent: simulated time zero is t0_host_s on the host's clock."""

    KIND: ClassVar[int] = 4
    t0_host_s: float


@dataclass(frozen=True, slots=True)
class SimulationComplete:
    """Agent -> host: the simulated time is over, and this is my summary."""

    KIND: ClassVar[int] = 5
    summary: Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class SystemStop:
    """Host -> agent: flush your records and end (thesis: SYSTEM_STOP)."""

    KIND: ClassVar[int] = 6


@dataclass(frozen=True, slots=True)
class AgentStopped:
    """Agent -> host: records are on disk; these are their last counts."""

    KIND: ClassVar[int] = 7
    records: Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class EmergencyShutdown:
    """Either side: end now, keep the records; who declared it and why."""

    KIND: ClassVar[int] = 8
    who: str
    reason: str


@dataclass(frozen=True, slots=True)
class Expelled:
    """Host -> agent: you were declared lost; start anew if the policy lets you."""

    KIND: ClassVar[int] = 9
    reason: str


@dataclass(frozen=True, slots=True)
class Ping:
    """Agent -> host, BEST, all through the run: sign of life, clock exchange, and how the agent fares."""

    KIND: ClassVar[int] = 10
    t_agent_s: float
    report: Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class Pong:
    """Host -> agent, BEST: the other three timestamps of the exchange."""

    KIND: ClassVar[int] = 11
    t_agent_s: float
    t_host_received_s: float
    t_host_sent_s: float


@dataclass(frozen=True, slots=True)
class SimulationData:
    """Either side: what a plug-in sent."""

    KIND: ClassVar[int] = 12
    payload: Any


Message = (
    Hello
    | SimulationSetup
    | SimulationReady
    | SimulationStart
    | SimulationComplete
    | SystemStop
    | AgentStopped
    | EmergencyShutdown
    | Expelled
    | Ping
    | Pong
    | SimulationData
)

MESSAGES: tuple[type[Message], ...] = (
    Hello,
    SimulationSetup,
    SimulationReady,
    SimulationStart,
    SimulationComplete,
    SystemStop,
    AgentStopped,
    EmergencyShutdown,
    Expelled,
    Ping,
    Pong,
    SimulationData,
)
