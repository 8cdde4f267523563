"""
Every message on the wire, one frozen dataclass each, and the classes of service they travel in.

A message's KIND is the first byte of its body and never changes its meaning; new messages take new numbers.
Times named t_host_s or t_agent_s are seconds of that side's monotonic clock.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum
from math import isnan
from typing import Any, ClassVar, get_args

VERSION = 1


class Service(IntEnum):
    """Classes of service. A loss in one never delays another."""

    BEST = 0
    """Telemetry: the newest wins, gaps are counted, nothing is sent again."""
    RELIABLE = 1
    """Ordered, fragmented, windowed, exactly once."""
    SYNC = 2
    """Delivery of RELIABLE, in a stream of its own that is sent before any fragment, with a deadline."""


SERVICE_NAMES = tuple(service.name.lower() for service in Service)
"""As people and records name them, by number."""


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
    t_s: float = 0.0
    """Simulated time by which an agent that rejoins sets up; its clock is not set yet. 0 before the start."""


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
    """Agent -> host, BEST, all through the run: sign of life, clock exchange, and now and then how the agent fares."""

    KIND: ClassVar[int] = 10
    t_agent_s: float
    report: Mapping[str, Any]
    """Empty: as before."""


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


@dataclass(frozen=True, slots=True)
class Transmission:
    """Agent -> host: a message for other agents, by the simulation's medium."""

    KIND: ClassVar[int] = 13
    to: str
    """An agent's name, * for all in reach, or a place that the medium knows."""
    number: int
    """The sender's own, growing."""
    sent_s: float
    """Simulated time of the tick that sent it."""
    payload: Any


@dataclass(frozen=True, slots=True)
class Delivery:
    """Host -> agent: a message of another agent, or of a place that the medium knows."""

    KIND: ClassVar[int] = 14
    sender: str
    """An agent's name, or the place's."""
    sent_s: float
    """Simulated time of the tick that sent it."""
    arrives_s: float
    """Simulated time of its arrival: it is received in the first tick at or after it."""
    payload: Any


@dataclass(frozen=True, slots=True)
class TransmissionRefusal:
    """Host -> agent: a message for other agents that its medium refused."""

    KIND: ClassVar[int] = 15
    number: int
    """The message's."""
    to: str
    """Receiver, as it was given."""
    sent_s: float
    reason: str
    """The medium's word, such as out_of_range."""


@dataclass(frozen=True, slots=True)
class FaultOrder:
    """Host -> agent: insert a fault around a device that you use; the answer comes with a ping's report."""

    KIND: ClassVar[int] = 16
    number: int
    """The order's."""
    device: str
    """Full name of the device, such as pi22/imu."""
    action: str
    value: float
    """Not a number for an action without one."""


@dataclass(frozen=True, slots=True)
class ConditionMet:
    """Agent -> host, RELIABLE: a condition on what I record is met."""

    KIND: ClassVar[int] = 17
    number: int
    """The condition's in the run."""
    t_s: float
    """Simulated time of it."""


@dataclass(frozen=True, slots=True)
class ActionOrder:
    """Host -> agent, SYNC as AgentFault: carry out an action of the timeline, or let what it did be over."""

    KIND: ClassVar[int] = 19
    number: int
    """The action's in the run; -1 for what the framework orders by itself."""
    word: str
    parameters: Any
    """A mapping."""
    t_s: float
    """Simulated time at which it was due; of a stop that at which the run is over."""
    for_s: Any
    """How long it lasts, s; None for no end."""
    is_end: Any
    """Whether what it did is to be over: true or false."""


@dataclass(frozen=True, slots=True)
class AgentFault:
    """Host -> agent, SYNC: a fault of you or of your steps begins or ends; see `timeline.fault_kinds`."""

    KIND: ClassVar[int] = 18
    number: int
    """The action's in the run."""
    word: str
    begins: bool
    value: float
    """The factor of slow; of kill and restart the time until the return, s, not a number for never."""
    reason: str = ""

    @property
    def loss(self) -> dict[str, Any]:
        """Return what events tell of a loss: why, and the time until the return, s, None for never."""
        after_s = None if isnan(self.value) else self.value
        return {"reason": self.reason, "returns_after_s": after_s}


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
    | Transmission
    | Delivery
    | TransmissionRefusal
    | FaultOrder
    | ConditionMet
    | ActionOrder
    | AgentFault
)

MESSAGES: tuple[type[Message], ...] = get_args(Message)
WITH_DATA = (Delivery, TransmissionRefusal, FaultOrder, ActionOrder, AgentFault)
"""Words of the framework that the host sends to a running agent as it sends its half's messages."""
