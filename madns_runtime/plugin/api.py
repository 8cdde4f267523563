"""
The contract between the framework and a simulation.

A simulation is a `Simulation` descriptor that names two classes, one for each role. Each is made
without arguments and subclasses `HostSimulation` or `AgentSimulation` (or merely looks like it).
All calls come from one thread, the loop's: no call may take longer than a millisecond on the host;
longer work goes through `HostContext.submit`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

from madns_runtime.protocol.messages import Service
from madns_runtime.recording.records import Field

if TYPE_CHECKING:
    import numpy as np  # 0.2 s of import time that `cosmos validate` has no use for

HOST = "host"


class Tick(NamedTuple):
    """One step of an agent's fixed-rate loop. A tuple, because one is made for every tick."""

    index: int  # type: ignore[assignment]  # hides tuple.index, which nobody asks of a tick
    """0 at simulated time zero; skipped ticks leave gaps."""
    t_s: float
    """Nominal simulated time, index / tick_hz: the same for every agent."""
    period_s: float
    lateness_s: float
    """Wake-up time minus deadline."""
    missed: int
    """Ticks skipped since the one before."""
    deadline_s: float = 0.0
    """Simulated time at which this agent's tick was due: t_s plus its phase."""


class Context(Protocol):
    """What the framework offers to either half of a simulation."""

    name: str
    """host, or the agent's name."""
    agents: tuple[str, ...]
    """Names of all agents of the run, in order."""
    parameters: Any
    """An instance of the descriptor's parameters class."""
    tick_hz: float
    duration_s: float
    base_directory: Path
    """Folder of the scenario: relative files are found from here."""
    random: np.random.Generator
    """Seeded from the run's seed and `name`."""
    is_lockstep: bool
    """Whether simulated time waits for everybody: nothing recorded may then depend on the wall clock."""

    def now_s(self) -> float:
        """Return the simulated time, s: negative before T0; -timeouts.start_lead_s before that is set."""

    def send(
        self,
        to: str,
        message: Any,
        service: Service = Service.RELIABLE,
        *,
        deadline_s: float | None = None,
    ) -> None:
        """
        Send *message* to an agent by name, or from an agent to "host".

        Args:
            to: The receiver's name.
            message: None, bool, int, float, str, bytes, lists, mappings with string keys, and
                float64 arrays, in any nesting.
            service: BEST must fit one datagram.
            deadline_s: SYNC only: simulated time by which it must have arrived; a broken one is
                counted, recorded and reported.

        Raises:
            MessageTooLarge: It does not fit its class of service.
            SendQueueFull: The receiver has not taken what was sent before.
            PluginError: It holds what messages do not carry, or there is no such receiver, class of
                service or deadline.
        """

    def open_stream(self, name: str, fields: Sequence[Field]) -> None:
        """Declare a record stream; call it in `setup`."""

    def record(self, stream: str, values: Sequence[Any]) -> None:
        """Record one value a field. Never blocks; what does not fit is counted."""

    def log(self, level: str, text: str) -> None:
        """Log a sentence at critical, error, warning, info or debug."""


class HostContext(Context, Protocol):
    """What the framework offers to the host's half."""

    workers: int
    """Workers of the executor, N_p: jobs that may be under way at once."""

    def submit(self, function: Callable[..., Any], *arguments: Any) -> int:
        """
        Run a module-level function in the executor and return the job's number.

        Its value comes back through `HostSimulation.result`. An exception in it is one in the plug-in.
        """

    def wake(self, t_s: float) -> None:
        """Have `HostSimulation.timer` called at simulated time *t_s* if it wants a later one, or none."""


class AgentContext(Context, Protocol):
    """What the framework offers to an agent's half."""


class HostSimulation(Protocol):
    """The host's half: it holds the truth. Subclass it and override what is needed."""

    def setup(self, context: HostContext) -> None:
        """Prepare. Jobs submitted here are all finished before initial data are asked for."""

    def initial_data(self, agent: str) -> Mapping[str, Any]:
        """Return what *agent* needs to set itself up, now: also called when it rejoins in mid-run."""
        return {}

    def start(self, t_s: float) -> None:
        """Simulated time is about to run; *t_s* is not later than 0."""

    def receive(self, agent: str, message: Any) -> None:
        """Take a message that *agent* sent."""

    def timer(self, t_s: float) -> float | None:
        """Do what is due at simulated time *t_s* and return the next time wanted; called once after start."""
        return None

    def result(self, job: int, value: Any) -> None:
        """Take the value of a submitted job."""

    def agent_lost(self, agent: str, reason: str) -> None:
        """*agent* is gone; the policy lets the run go on. Told after `setup` if it was lost before."""

    def agent_rejoined(self, agent: str) -> None:
        """*agent* runs again, from initial data given just before."""

    def finish(self) -> Mapping[str, Any]:
        """Return the summary; a list under "checks" is judged (see `Check`)."""
        return {}


class AgentSimulation(Protocol):
    """An agent's half: one vehicle. Subclass it and override what is needed."""

    def setup(self, context: AgentContext, initial: Mapping[str, Any]) -> None:
        """Prepare from the host's initial data."""

    def step(self, tick: Tick) -> None:
        """Do one tick's work; what takes longer than the period costs the next ticks."""

    def receive(self, message: Any) -> None:
        """Take a message that the host sent."""

    def finish(self) -> Mapping[str, Any]:
        """Return this agent's summary; a list under "checks" is judged (see `Check`)."""
        return {}


@dataclass(frozen=True, slots=True, kw_only=True)
class Check:
    """One line of a verdict. In a summary it stands as a plain mapping with these keys."""

    name: str
    limit: float
    got: float
    passed: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class Flow:
    """Messages of one kind that every agent exchanges with the host."""

    name: str
    message_bytes: int
    """Encoded size of one message, without datagram overhead."""
    rate_hz: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Demand:
    """What a simulation asks of host and network: the terms of the thesis's inequalities 2.7-2.10."""

    flows: tuple[Flow, ...]
    """S_Di and R_Di of every planned flow, a single agent's."""
    buffer_s: float
    """T_bi: how long an agent can go on from what it holds; infinity if it needs nothing."""
    batch_bytes: int
    """S_b: encoded size of one asynchronous batch, of one agent."""
    batch_compute_s: float
    """T_p(S_b): host time to make one agent's batch."""
    sync_bytes: int
    """S_sync: encoded size of one synchronous batch; 0 without maneuvers."""
    sync_compute_s: float
    """T_p(S_sync)."""
    sync_rate_hz: float
    """N_sync: synchronous exchanges a second, of one agent, at worst."""
    lead_s: float
    """T_m - T_s: how far ahead of its execution a maneuver is commanded."""
    measured: bool
    """Whether the compute times were measured on this machine (else they are declared)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Simulation:
    """Names the parts of a simulation; importing it imports neither half."""

    name: str
    parameters: type
    """A frozen stdlib dataclass; bounds are annotated_types, units stand in field names."""
    agent: str
    """module:Class, or :Class in the descriptor's own file."""
    host: str | None = None
    """The same for the host's half; None if the host has nothing to do."""
    demand: str | None = None
    """module:function of (parameters, agents: int, tick_hz: float, base_directory: Path) -> Demand, or None."""
    check: str | None = None
    """module:function of (parameters, agents: int, base_directory: Path) -> list[str]: faults beyond bounds,
    such as a missing file, each starting with the dotted parameter name and a colon. A fourth parameter
    called names is given the agents' names."""
