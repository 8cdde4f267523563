"""
Settings of a run as frozen dataclasses that travel as plain mappings.

The sections are also what a person writes in a scenario: the operator's side validates the same classes through pydantic (the
bounds are `annotated_types`), so that a new setting has one home. Agents read them back with `from_mapping`, without pydantic.
"""

from __future__ import annotations

import functools
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

from annotated_types import Ge, Gt, Le, MinLen

from madns_runtime.agent_parameters import AgentParameters
from madns_runtime.conditions.condition import Condition
from madns_runtime.plain_values import FORBID_EXTRA
from madns_runtime.plain_values import from_mapping as from_mapping
from madns_runtime.plain_values import to_mapping as to_mapping
from madns_runtime.timeline.entries import ScheduledEntry

AGENTS_MAX = 5000
RATE_HZ_MAX = 10_000
SEED_MAX = 2**63 - 1
"""A seed travels in messages as a signed integer of 64 bits."""
DURATION_S_MAX = 10 * 365.25 * 86_400.0
"""Ten years, of a run and of each wait: a tick's number, every clock and every timer of a run bear the sum of all."""


class ScenarioSection:
    """A section of a scenario: validated, it refuses keys that it does not know."""

    __slots__ = ()
    __pydantic_config__ = FORBID_EXTRA


@dataclass(frozen=True, slots=True, kw_only=True)
class Agents(ScenarioSection):
    """The agents of a run: how many, their names, and how fast their software ticks."""

    count: Annotated[int, Ge(1), Le(AGENTS_MAX)]
    """Number of agents."""
    tick_hz: Annotated[float, Gt(0), Le(10_000)] = 10.0
    """Rate of every agent's loop, Hz."""
    names: tuple[str, ...] = ()
    """Names, one per agent; empty for agent-01, agent-02, ..."""
    phase: Literal["staggered", "aligned"] = "staggered"
    """Spread the agents' ticks over the period, or let all tick at one instant."""
    per_process: Annotated[int, Ge(1)] = 1
    """Agents in one process."""
    restarts_max: Annotated[int, Ge(0), Le(100)] = 0
    """Number of times an agent that died is started again (with on_agent_loss: continue)."""

    def resolved_names(self) -> tuple[str, ...]:
        """Return the name of each agent, in order."""
        return self.names or _numbered_names(self.count)


@functools.lru_cache(maxsize=4)
def _numbered_names(count: int) -> tuple[str, ...]:
    # Every agent holds the names of all: of thousands, a tuple of its own would be gigabytes.
    width = max(2, len(str(count)))
    return tuple(f"agent-{index:0{width}d}" for index in range(1, count + 1))


@dataclass(frozen=True, slots=True, kw_only=True)
class TimeSettings(ScenarioSection):
    """Passing of simulated time."""

    mode: Literal["realtime", "lockstep"] = "realtime"
    """realtime: simulated seconds pass as wall seconds do; lockstep: as fast as all agents allow, here, the same under a seed."""
    duration_s: Annotated[float, Gt(0), Le(DURATION_S_MAX)] = 60.0
    """Simulated time of the run, s."""
    rtf_tolerance: Annotated[float, Gt(0)] = 1e-3
    """Largest deviation of the real-time factor from 1."""

    @property
    def is_lockstep(self) -> bool:
        """Whether simulated time waits for everybody instead of following the clock."""
        return self.mode == "lockstep"


@dataclass(frozen=True, slots=True, kw_only=True)
class Deadline(ScenarioSection):
    """The real-time budget that a run is judged by."""

    __old_keys__ = {"tolerance_ms": "overrun_ms"}

    overrun_ms: Annotated[float, Ge(0)] = 5.0
    """A step that ends later than this after its period is an error, before it a warning (thesis A.2.5)."""
    lateness_ms: Annotated[float, Ge(0)] | None = None
    """Latest wake-up of an idle loop that `cosmos doctor` finds good enough for a run; a tick that begins later is told with its cause. Not given: overrun_ms."""
    max_miss_ratio: Annotated[float, Ge(0), Le(1)] = 1e-3
    """Largest share of ticks that may be missed, and of ticks whose step ended more than overrun_ms too late."""

    @property
    def lateness_limit_s(self) -> float:
        """Latest begin of a tick that needs no explanation, s."""
        return (self.overrun_ms if self.lateness_ms is None else self.lateness_ms) * 1e-3


@dataclass(frozen=True, slots=True, kw_only=True)
class Network(ScenarioSection):
    """Address of the host, and what its sockets ask for."""

    address: str = "127.0.0.1"
    """Address that the host binds and agents send to."""
    port: Annotated[int, Ge(0), Le(65535)] = 0
    """UDP port of the host; 0 lets the kernel choose a free one."""
    receive_buffer_bytes: Annotated[int, Ge(16_384), Le(2**31 - 1)] = 4 * 1024 * 1024
    """Socket receive buffer that is asked for; a smaller one is granted with a warning."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Timeouts(ScenarioSection):
    """
    Every wait has an end; when it comes, the message names whom it waited for.

    In time.mode lockstep the time that a process waits for a processor does not count.
    """

    host_start_s: Annotated[float, Gt(0), Le(DURATION_S_MAX)] = 60.0
    """From the start of the host's process until it listens: imports, workers of the executor."""
    loading_s: Annotated[float, Gt(0), Le(3600)] = 60.0
    """For each import of the simulation's code, and before the run for each question to it (check, demand); in the run at most 0.8 of host_start_s, of agents_ready_s. Waiting for a processor does not count."""
    agents_ready_s: Annotated[float, Gt(0), Le(DURATION_S_MAX)] = 30.0
    """From the host's start until every agent has said hello."""
    host_setup_s: Annotated[float, Gt(0), Le(DURATION_S_MAX)] = 120.0
    """For the host's half of the simulation to set itself up."""
    agent_setup_s: Annotated[float, Gt(0), Le(DURATION_S_MAX)] = 60.0
    """From sending the initial data until every agent is ready to run."""
    start_lead_s: Annotated[float, Ge(0.05), Le(DURATION_S_MAX)] = 0.5
    """From the order to start until T0."""
    silence_s: Annotated[float, Gt(0.2), Le(DURATION_S_MAX)] = 2.5
    """An agent or a host that says nothing for this long is lost."""
    complete_s: Annotated[float, Gt(0), Le(DURATION_S_MAX)] = 10.0
    """From the end of the simulated time until every agent has reported it complete."""
    shutdown_s: Annotated[float, Gt(0), Le(DURATION_S_MAX)] = 10.0
    """For shutdown: the last reports, and flushing of records."""
    tick_s: Annotated[float, Gt(0), Le(DURATION_S_MAX)] = 30.0
    """time.mode lockstep: for one tick of all agents of a process, or one call of the host's half."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Scheduling(ScenarioSection):
    """Requests to the kernel for a loop; what it grants is recorded."""

    policy: Literal["auto", "fifo", "normal"] = "auto"
    """auto: SCHED_FIFO where permitted, and a note where not; fifo: a refusal is a warning."""
    priority: Annotated[int, Ge(1), Le(80)] = 10
    """SCHED_FIFO priority of agents; the host runs one above."""
    cpu_affinity: tuple[Annotated[int, Ge(0)], ...] = ()
    """Processors the agents may use; empty for all."""
    timer_slack_ns: Annotated[int, Ge(1)] = 1
    """Timer slack of a loop that runs without SCHED_FIFO, ns."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Recording(ScenarioSection):
    """Settings of the records and of their way to the disk."""

    flush_interval_s: Annotated[float, Ge(1e-3), Le(60)] = 0.25
    """The most that a killed process loses, s."""
    sync_interval_s: Annotated[float, Ge(0), Le(600)] | None = None
    """Time between syncs to the disk, s: what a power cut costs at most; 0 leaves it to the kernel. Not given: 5 on other machines, 0 on this one."""
    buffer_bytes: Annotated[int, Ge(65_536)] = 4 * 1024 * 1024
    """Bound of the buffer between loop and disk; what does not fit is dropped and counted."""
    access: Literal["private", "group", "all"] | None = None
    """Readers of the run's folder, its package and what it records on machines: private (its owner), group, or all. Not given: as COSMOS_ACCESS says, else private."""
    not_finite_max: Annotated[int, Ge(0)] = 0
    """Values of all records that may be NaN or infinite: more break the check records.not_finite. A value that is not there is null (None), which is no such value."""
    verbosity: Annotated[int, Ge(0), Le(5)] = 4
    """0 nothing, 1 critical, 2 error, 3 warning, 4 info, 5 debug: the thesis's VERBOSITY (table A.1)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Health(ScenarioSection):
    """State of health, sampled beside the loops."""

    period_s: Annotated[float, Ge(0.1)] = 5.0
    """Time between samples, s."""
    stress_workers: Annotated[int, Ge(0), Le(256)] = 0
    """Processes that factorise primes on each agent machine beside the run (thesis A.2.7, run_benchmark)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ExecutorSettings(ScenarioSection):
    """The executor of the host's long work."""

    kind: str = "process"
    """process, thread, dask, or module:callable that returns a concurrent.futures.Executor."""
    workers: Annotated[int, Ge(1), Le(1024)] = 1
    """Workers: N_p of the thesis's inequalities; of a cluster, how many jobs it is given at once."""
    address: str = ""
    """dask: the scheduler, such as tcp://10.0.0.1:8786; empty for a cluster of our own on this machine."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ScenarioDevice:
    """A device that needs no hardware: each of some agents gets one of its own."""

    __pydantic_config__ = FORBID_EXTRA

    name: Annotated[str, MinLen(1)]
    """Name by which agents know it, such as gps."""
    kind: Annotated[str, MinLen(1)]
    """Registered kind, module:NAME or ./file.py:NAME beside the scenario."""
    agents: tuple[str, ...] = ("*",)
    """Names, labels or globs of the agents that get one."""
    rate_hz: Annotated[float, Gt(0), Le(RATE_HZ_MAX)] | None = None
    """Rate at which it is read, Hz; the kind's own if not given."""
    parameters: Mapping[str, Any] = field(default_factory=dict)
    """The kind's own."""
    hang_s: Annotated[float, Ge(0.1), Le(3600)] = 15.0
    """A device that says nothing for so long is given up: its process is killed and started anew."""
    frozen_s: Mapping[str, Annotated[float, Gt(0)]] = field(default_factory=dict)
    """By input: one that has not changed, or not come, for so many seconds is frozen."""


@dataclass(frozen=True, slots=True, kw_only=True)
class HardwareUse:
    """Which agents use which devices of the machine that they run on."""

    __pydantic_config__ = FORBID_EXTRA

    devices: Annotated[tuple[str, ...], MinLen(1)]
    """Names of devices, as the inventory's cosmos_devices gives them."""
    agents: tuple[str, ...] = ("*",)
    """Names, labels or globs of agents; those whose machine has no such device use none."""
    owner: str = ""
    """The agent that may move the devices' outputs; needed only where several agents of a machine use one."""


@dataclass(frozen=True, slots=True, kw_only=True)
class HardwareSettings:
    """Devices in the loop: who uses what, whether outputs may move, and what a loss means."""

    __pydantic_config__ = FORBID_EXTRA

    use: tuple[HardwareUse, ...] = ()
    """Devices of the inventory."""
    devices: tuple[ScenarioDevice, ...] = ()
    """Devices that need no hardware, one per agent."""
    armed: bool = False
    """Outputs move only with this, and where the inventory permits it (outputs: true of the device)."""
    on_device_loss: Literal["abort", "continue"] = "abort"
    """abort: a run in real time ends (exit code 3) when a device is lost; continue, and in lockstep always: the checks below tell."""
    stale_ratio: Annotated[float, Ge(0), Le(1)] = 1e-2
    """Largest share of the run in which a device's newest sample may be stale or missing."""
    lost: Annotated[int, Ge(0)] = 0
    """Times that devices may be lost."""
    frozen: Annotated[int, Ge(0)] = 0
    """Times that inputs may be frozen (unchanged, or not come, for their frozen_s)."""
    lost_bytes: Annotated[int, Ge(0)] = 0
    """Bytes for which serial lines of emulated boards may have no room, such as of firmware that floods."""
    stimulus_late_ms: Annotated[float, Ge(0), Le(60_000)] = 10.0
    """From how far behind its time on a point of a stimulus is late."""
    stimulus_late: Annotated[float, Ge(0), Le(1)] = 1e-2
    """Largest share of a stimulus's points that may be late, or not put out at all."""
    stimulus_underruns: Annotated[int, Ge(0)] = 0
    """Times that stimuli may run out."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names by which agents know their devices."""
        used = [name for use in self.use for name in use.devices]
        return tuple(dict.fromkeys([*used, *(each.name for each in self.devices)]))


@dataclass(frozen=True, slots=True, kw_only=True)
class RunConfig:
    """All that host and agents know of a run; holds no secret and may be written to disk."""

    run: str
    """Name of the run, such as 0007-iridium10."""
    scenario: str
    """Name of the scenario."""
    simulation: str
    """Registered name, module:attribute, or ./file.py:attribute beside the scenario."""
    base_directory: str
    """Root of the scenario, its folder if it names none: relative files in parameters are found from here."""
    agents: Agents
    time: TimeSettings = field(default_factory=TimeSettings)
    deadline: Deadline = field(default_factory=Deadline)
    network: Network = field(default_factory=Network)
    timeouts: Timeouts = field(default_factory=Timeouts)
    scheduling: Scheduling = field(default_factory=Scheduling)
    recording: Recording = field(default_factory=Recording)
    health: Health = field(default_factory=Health)
    executor: ExecutorSettings = field(default_factory=ExecutorSettings)
    hardware: HardwareSettings = field(default_factory=HardwareSettings)
    on_agent_loss: Literal["abort", "continue"] = "abort"
    seed: Annotated[int, Ge(0), Le(SEED_MAX)] = 0
    parameters: Mapping[str, Any] = field(default_factory=dict)
    """The simulation's own, already validated, defaults filled in."""
    agent_parameters: tuple[AgentParameters, ...] = ()
    """The whole parameters of agents, by name, for which others hold."""
    conditions: tuple[Condition, ...] = ()
    """On recorded values, each evaluated by whoever records them."""
    timeline: tuple[ScheduledEntry, ...] = ()
    """Events of the run, and when each is to happen."""

    @property
    def longest_s(self) -> float:
        """Longest time that a run may take: all its waits, one behind the other, s."""
        t = self.timeouts
        setup_s = t.agents_ready_s + t.host_setup_s + t.agent_setup_s + t.start_lead_s
        return setup_s + self.time.duration_s + t.complete_s + 4 * t.shutdown_s


OPERATOR_SOCKET = "operator.{}.sock"
"""Name, with the incarnation, of the socket at which a process waits for an operator whose connection broke."""
RELAY_CONNECTED = b'{"event":"relayed"}\n'
"""First word of `madns_runtime.reactor.relay`."""
RELAY_NOBODY = 3
"""Its exit code if no process waits there; 0 if one did and has closed its side."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DeviceLaunch:
    """One device that a machine drives in a run."""

    name: str
    """Name by which agents know it."""
    place: str
    """The machine's name, or that of the agent whose own it is."""
    kind: str
    """Registered kind, module:NAME or ./file.py:NAME."""
    base_directory: str
    """Folder here from which files are found."""
    rate_hz: Annotated[float, Gt(0)]
    parameters: Mapping[str, Any] = field(default_factory=dict)
    serial: str = ""
    """Identity that the device must have; empty for any."""
    users: tuple[str, ...] = ()
    """Agents that use it, all on this machine."""
    owner: str = ""
    """The agent that may move its outputs; empty for nobody."""
    may_move: bool = False
    """Whether outputs may move: the scenario is armed and the inventory permits it."""
    why_not: str = ""
    """If they may not: what is missing."""
    hang_s: Annotated[float, Gt(0)] = 15.0
    frozen_s: Mapping[str, float] = field(default_factory=dict)
    late_s: Annotated[float, Ge(0)] = 0.01
    """Behind its time, a point of a profile is late."""
    seed: int = 0

    @property
    def full_name(self) -> str:
        """Name of the device among all of the run, such as pi22/imu."""
        return f"{self.place}/{self.name}"


@dataclass(frozen=True, slots=True, kw_only=True)
class Launch:
    """First line of a program's standard input. Holds the run key: never argv, environment or disk."""

    config: RunConfig
    run_key_hex: Annotated[str, MinLen(64)] = field(repr=False)
    session_hex: str
    directory: str
    """Folder to record in: of the host, host/ of the run's; of agents the run's, with agents/<name>/, machines/<machine>/."""
    is_detached: bool = False
    """The operator leaves while the run goes on: the end of standard input is no end."""
    reattach_s: Annotated[float, Ge(0)] = 0.0
    """Time for an operator on another computer to come back when its line has ended, s; 0: that is its end."""
    devices: tuple[DeviceLaunch, ...] = ()
    """Devices that are driven: of agents those of their machine; of the host, in lockstep, those of all agents."""
    phases_s: Mapping[str, float] = field(default_factory=dict)
    """Offset of an agent's deadlines within the period, s, in real time: of agents of this machine; of the host of all. Without, 0."""


@dataclass(frozen=True, slots=True, kw_only=True)
class HostLaunch(Launch):
    """Launch of the host."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AgentLaunch(Launch):
    """Launch of an agent supervisor: which agents this machine runs, and where the host is."""

    machine: str
    """Name of this machine in the inventory."""
    agents: tuple[str, ...]
    """Names of the agents to run here."""
    host_address: str
    host_port: int
    life: Annotated[int, Ge(1)] = 1
    """Incarnation of this supervisor on its machine: more than 1 when the machine was lost and has returned."""
    first_incarnations: Mapping[str, int] = field(default_factory=dict)
    """The number that an agent's first process here gets; 1 where none is named."""
    killed_before: Mapping[str, int] = field(default_factory=dict)
    """How many processes of an agent a fault had ended on purpose before; 0 where none is named."""

    def first_incarnation(self, agents: Iterable[str]) -> int:
        """Return the number of the first process of *agents*: their others were of an earlier supervisor."""
        return max(self.first_incarnations.get(agent, 1) for agent in agents)
