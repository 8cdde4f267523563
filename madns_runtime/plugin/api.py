"""
The contract between the framework and a simulation.

A simulation is a `Simulation` descriptor that names two classes, one for each role. Each is made without arguments
and subclasses `HostSimulation` or `AgentSimulation` (or merely looks like it). All calls come from one thread, the
loop's: no call may take longer than a millisecond on the host; longer work goes through `HostContext.submit`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

from madns_runtime.errors import BlamedError
from madns_runtime.medium.outcomes import EVERYBODY, LinkOutcome, Medium, MessageAccount
from madns_runtime.plugin.device_view import ChannelFrame, ChannelReading, DeviceStatus, DeviceView
from madns_runtime.plugin.returned_values import (
    Check,
    DeclaredStream,
    Demand,
    DeviceUse,
    Flow,
    PlaceUse,
    Rerun,
    Tabulated,
)
from madns_runtime.protocol.messages import Delivery, Service, Transmission, TransmissionRefusal
from madns_runtime.recording.records import Field
from madns_runtime.timeline.action import ActionKind, ActionRefused, PlannedAction, TimelineAction

if TYPE_CHECKING:
    import numpy as np  # 0.2 s of import time that `cosmos validate` has no use for

__all__ = [
    "EVERYBODY",
    "HOST",
    "ActionKind",
    "ActionRefused",
    "AgentContext",
    "AgentSimulation",
    "Check",
    "Context",
    "DeclaredStream",
    "Delivery",
    "DeviceStatus",
    "DeviceUse",
    "PlaceUse",
    "PlannedAction",
    "DeviceView",
    "Demand",
    "Field",
    "Flow",
    "ChannelFrame",
    "HostContext",
    "HostSimulation",
    "LinkOutcome",
    "Medium",
    "MessageAccount",
    "ChannelReading",
    "Rerun",
    "Service",
    "Simulation",
    "Tabulated",
    "Tick",
    "TimelineAction",
    "Transmission",
    "TransmissionRefusal",
]

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
    """The framework as either half of a simulation sees it."""

    name: str
    """host, or the agent's name."""
    agents: tuple[str, ...]
    """Names of all agents of the run, in order."""
    parameters: Any
    """An instance of the descriptor's parameters class: of an agent its own, at the host those of the scenario."""
    tick_hz: float
    duration_s: float
    base_directory: Path
    """Root of the scenario, its folder if it names none: relative files are found from here."""
    random: np.random.Generator
    """Seeded from the run's seed and `name`; an agent that is started anew begins it anew."""
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
    ) -> int | None:
        """
        Send *message* to an agent by name, or from an agent to "host" or to another agent.

        From one agent to another, or to all of them (EVERYBODY), it goes through the medium that the simulation
        declares, bears the time of the newest tick, and reaches `AgentSimulation.hear` of its receivers in their
        first tick at or after the simulated time of its arrival.

        Args:
            to: The receiver's name.
            message: None, bool, int, float, str, bytes, lists, mappings with string keys, and
                float64 arrays, in any nesting.
            service: BEST must fit one datagram.
            deadline_s: SYNC only: simulated time by which it must have arrived; a broken one is counted and reported.

        Returns:
            Of a message to other agents the number by which a refusal names it.

        Raises:
            MessageTooLarge: It does not fit its class of service.
            SendQueueFull: The receiver has not taken what was sent before.
            PluginError: It holds what messages do not carry, or there is no such receiver, class of
                service or deadline; to agents: the simulation declares no medium, it is not RELIABLE, or no
                tick has begun.
        """

    def open_stream(self, name: str, fields: Sequence[Field]) -> None:
        """Declare a record stream; call it in `setup`."""

    def record(self, stream: str, values: Sequence[Any]) -> None:
        """Record one value per field. Never blocks; what does not fit is counted."""

    def keep_text(self, name: str, data: bytes) -> None:
        """
        Keep what a program of one's own wrote in NAME.txt beside the records; never blocks.

        Of what is too long the first 1 MiB and the last 64 KiB are kept. It is no record: neither judged
        nor part of what two lockstep runs have in common.
        """

    def log(self, level: str, text: str) -> None:
        """Log a sentence at critical, error, warning, info or debug."""


class HostContext(Context, Protocol):
    """The framework as the host's half sees it."""

    agent_parameters: Mapping[str, Any]
    """The `parameters` of each agent as its half sees them, by name: a scenario may give some agents their own."""
    workers: int
    """Workers of the executor, N_p: jobs that may be under way at once."""
    timer_lateness_s: float
    """Delay of the last call of `HostSimulation.timer` behind the time it asked for, s; in lockstep more
    than 0 only after a `wake` for a time that had passed."""

    def submit(self, function: Callable[..., Any], *arguments: Any) -> int:
        """
        Run a module-level function in the executor and return the job's number.

        Its value comes back through `HostSimulation.result`. An exception in it is one in the plug-in.
        """

    def wake(self, t_s: float) -> None:
        """Have `HostSimulation.timer` called at simulated time *t_s* if it wants a later one, or none."""

    def enter(
        self, sender: str, transmission: Transmission, outcomes: Sequence[LinkOutcome]
    ) -> Sequence[LinkOutcome]:
        """
        See to a message of *sender*, a place that is no agent, such as a ground station.

        It is delivered to those of its *outcomes* that are agents, and counted, as what `Medium.carry` returns. Returned
        is what becomes of it in the end: faults of a timeline may lose it, delay it or deliver it twice.

        Raises:
            PluginError: There is no outcome, one is impossible or arrives no later than it was sent, or the
                transmission holds what messages do not carry.
        """

    def account(self, channel: str = "") -> MessageAccount:
        """Return what became of the messages between agents, of a channel of the medium's outcomes."""


class AgentContext(Context, Protocol):
    """The framework as an agent's half sees it."""

    hardware: Mapping[str, DeviceView]
    """The devices that this agent uses, by name, as the scenario's `hardware:` says."""

    def transmit(self, to: str, message: Any, *, number: int | None = None) -> int:
        """
        Hand *message* to the medium, for whatever receiver the medium knows: `send` takes agents alone.

        Args:
            to: An agent, EVERYBODY, or a place such as a ground station; the medium refuses what it does not know.
            message: As of `send`.
            number: The sender's own, greater than all before; the next one if None. Refusals name it, and chance
                is drawn for it.

        Returns:
            The number.

        Raises:
            MessageTooLarge: It is longer than messages are.
            SendQueueFull: The host has not taken what was sent before.
            PluginError: It holds what messages do not carry, the simulation declares no medium, or no tick has
                begun.
        """

    def message_counts(self) -> Mapping[str, int]:
        """Return how many messages of agents were received, are held until their time, came late, found no room."""


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
        """
        Do what is due at simulated time *t_s*, the time that was asked for, and return the next time wanted.

        Called for the first time right after `start`, for its time, which is before 0. The next time must be later than *t_s*, or None;
        how much later than asked for the call came says `HostContext.timer_lateness_s`.
        """
        return None

    def result(self, job: int, value: Any) -> None:
        """Take the value of a submitted job."""

    def agent_lost(self, agent: str, reason: str) -> None:
        """*agent* is gone; the policy lets the run go on. Told after `setup` if it was lost before."""

    def agent_rejoined(self, agent: str) -> None:
        """*agent* runs again, from initial data given just before."""

    def begin_action(self, action: TimelineAction) -> None:
        """
        Carry out an action of the timeline that the descriptor declares for this half.

        Its parameters are an instance of the declared class.

        Raises:
            ActionRefused: It cannot take place now; the run goes on.
            BlamedError: Always, where this is not overridden.
        """
        raise BlamedError(
            f"action {action.word}: {type(self).__name__} has no begin_action(action)"
        )

    def end_action(self, action: TimelineAction) -> None:
        """Let what *action* did be over, if it lasts."""

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

    def hear(self, delivery: Delivery) -> None:
        """
        Take a message of another agent, before the first tick at or after its arrival; ordered by (arrival, sender, time sent).

        Raises:
            BlamedError: Always, where this is not overridden.
        """
        raise BlamedError(
            f"{delivery.sender} sent a message, and {type(self).__name__} has no hear(delivery)"
        )

    def refused(self, refusal: TransmissionRefusal) -> None:
        """Take that the medium refused a message to other agents; of one that is lost nobody is told."""

    def device_changed(self, device: str, status: DeviceStatus) -> None:
        """Take that a device's status has changed; right before the step of the first tick that finds it so."""

    def begin_action(self, action: TimelineAction) -> None:
        """Carry out a declared action on this agent, between two steps; otherwise as `HostSimulation.begin_action`."""
        raise BlamedError(
            f"action {action.word}: {type(self).__name__} has no begin_action(action)"
        )

    def end_action(self, action: TimelineAction) -> None:
        """Let what *action* did be over, if it lasts."""

    def abandon(self) -> None:
        """Let go at once of what outlives this object, such as programs, after `setup`: the agent is lost, and not to finish."""

    def finish(self) -> Mapping[str, Any]:
        """Return this agent's summary; a list under "checks" is judged (see `Check`)."""
        return {}


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
    such as a missing file, each starting with the dotted parameter name and a colon, remarks with "remark: " before. A fourth parameter
    called names is given the agents' names, a fifth called duration_s the run's simulated duration,
    a sixth called is_lockstep whether simulated time waits for everybody, a seventh called tick_hz the ticks' rate; behind a `*` any by name."""
    check_actions: str | None = None
    """module:function of (parameters, actions: tuple[PlannedAction, ...], agents: tuple[str, ...], base_directory: Path)
    -> list[str]: faults in a timeline's entries of its own `actions`, each starting with place and parameter and a colon."""
    streams: str | None = None
    """module:function of (parameters, agents: tuple[str, ...]) -> sequence of `DeclaredStream`: all that either
    half may open. What a run recorded otherwise is a remark in its run.json; None if nothing is declared."""
    labels: str | None = None
    """module:function of (parameters, agents: tuple[str, ...], base_directory: Path) -> mapping of agents to second
    names: placement, selections of agents and tables find an agent by either; None if it has but one."""
    device_uses: str | None = None
    """module:function of (parameters, agents: tuple[str, ...], base_directory: Path) -> sequence of `DeviceUse`: the
    channels of devices that the parameters name; `cosmos validate` looks for them. None if they name none."""
    place_uses: str | None = None
    """module:function of (parameters, agents: tuple[str, ...], base_directory: Path) -> sequence of `PlaceUse`: what
    each agent takes of its machine for itself, such as a TCP port; two on one machine are refused before a run."""
    rerun: str | None = None
    """module:function of (parameters, agents: tuple[str, ...], run_directory: Path) -> `Rerun`: how a recorded run is
    flown again in lockstep with its devices played back (`cosmos rerun`). None: with the same parameters."""
    placeholders: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    """Words that the simulation itself replaces in texts of its parameters, as ${name}, by the dotted keys of the
    fields (globs; no indices of lists), such as {"flight.command": ("name",)}: there a scenario's variables leave
    them alone, and $${ is the simulation's to read."""
    agent_parameters: tuple[str, ...] | None = None
    """Names of the parameters that a scenario may change for some agents (`agent_parameters`); None: all of them. Those
    that host and agents must have in common do not belong here."""
    actions: tuple[ActionKind, ...] = ()
    """Actions that a timeline may name beside the framework's own; the half that each names is called."""
    columns: tuple[str, ...] = ()
    """Fields of the agents' declared streams, as "drive.speed_m_s", at most six: whoever watches a run is shown
    their newest values per agent."""
    label_column: str = "label"
    """Kind of the second names, and the column of tables that bears them, such as satellite."""
    medium: str | None = None
    """module:function of (host: the host's half, context: HostContext) -> `Medium` for messages between agents, or
    None for a run without; called right after the host half's `setup`. None: agents cannot send to each other."""
    tabulate: str | None = None
    """module:function of (host_directory: Path, agents: tuple[str, ...], times_s: array) -> iterator of
    `Tabulated`: what the host recorded of each agent in a form of its own, at any times; None if nothing."""
    figures: str | None = None
    """module:function of (run: madns_runtime.analysis.tables.RecordedRun) -> list of
    `madns_runtime.analysis.values.Section`: what a report shows of a run beyond a line per number; None for no
    more. Loaded by the operator's side alone, after a run."""
    document: str | None = None
    """module:function of (run: madns_runtime.analysis.tables.RecordedRun) -> mapping of names to plain values: what
    `cosmos report --json` tells beside run.json; None for nothing. Loaded as `figures`."""
    compare: str | None = None
    """module:function of two `madns_runtime.analysis.tables.ComparedRun` ->
    `madns_runtime.analysis.values.SimulationDifference`: what differs between two runs beyond their records; None
    for nothing. Loaded by the operator's side alone, after a run."""
