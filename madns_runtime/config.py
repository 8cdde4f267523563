"""
What a run needs to know, as frozen dataclasses that travel as plain mappings.

The sections are also what a person writes in a scenario: the operator's side validates the same
classes through pydantic (the bounds are `annotated_types`), so that a new setting has one home.
Agents read them back with `from_mapping` and never need pydantic.
"""

from __future__ import annotations

import dataclasses
import functools
import types
import typing
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal, TypeVar

from annotated_types import Ge, Gt, Le, MinLen

from madns_runtime.errors import ConfigurationError

T = TypeVar("T")

AGENTS_MAX = 5000
SEED_MAX = 2**63 - 1
"""A seed travels in messages as a signed integer of 64 bits."""
DURATION_S_MAX = 10 * 365.25 * 86_400.0
"""Ten years: a tick's number and every clock of a run stay exact far beyond it."""
FORBID_EXTRA = {"extra": "forbid"}


@dataclass(frozen=True, slots=True, kw_only=True)
class Agents:
    """The agents of a run: how many, their names, and how fast their software ticks."""

    __pydantic_config__ = FORBID_EXTRA

    count: Annotated[int, Ge(1), Le(AGENTS_MAX)]
    """Number of agents."""
    tick_hz: Annotated[float, Gt(0), Le(10_000)] = 10.0
    """Rate of every agent's loop, Hz."""
    names: tuple[str, ...] = ()
    """Names, one an agent; empty for agent-01, agent-02, ..."""
    phase: Literal["staggered", "aligned"] = "staggered"
    """Spread the agents' ticks over the period, or let all tick at one instant."""
    per_process: Annotated[int, Ge(1)] = 1
    """Agents in one process."""
    restarts_max: Annotated[int, Ge(0), Le(100)] = 0
    """How often an agent that died is started again (with on_agent_loss: continue)."""

    def resolved_names(self) -> tuple[str, ...]:
        """Return one name an agent, in order."""
        return self.names or _numbered_names(self.count)


@functools.lru_cache(maxsize=4)
def _numbered_names(count: int) -> tuple[str, ...]:
    # Every agent holds the names of all: of thousands, a tuple of its own would be gigabytes.
    width = max(2, len(str(count)))
    return tuple(f"agent-{index:0{width}d}" for index in range(1, count + 1))


@dataclass(frozen=True, slots=True, kw_only=True)
class TimeSettings:
    """How simulated time passes."""

    __pydantic_config__ = FORBID_EXTRA

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
class Deadline:
    """The real-time budget that a run is judged by."""

    __pydantic_config__ = FORBID_EXTRA

    tolerance_ms: Annotated[float, Ge(0)] = 5.0
    """A step that ends later than this after its period is an error, before it a warning (thesis A.2.5)."""
    max_miss_ratio: Annotated[float, Ge(0), Le(1)] = 1e-3
    """Largest share of ticks that may be missed, and of ticks whose step overran the tolerance."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Network:
    """Where the host listens."""

    __pydantic_config__ = FORBID_EXTRA

    address: str = "127.0.0.1"
    """Address that the host binds and agents send to."""
    port: Annotated[int, Ge(0), Le(65535)] = 0
    """UDP port of the host; 0 lets the kernel choose a free one."""
    receive_buffer_bytes: Annotated[int, Ge(16_384)] = 4 * 1024 * 1024
    """Socket receive buffer that is asked for; a smaller one is granted with a warning."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Timeouts:
    """Every wait has an end; when it comes, the message names whom it waited for."""

    __pydantic_config__ = FORBID_EXTRA

    agents_ready_s: Annotated[float, Gt(0)] = 30.0
    """From the host's start until every agent has said hello."""
    host_setup_s: Annotated[float, Gt(0)] = 120.0
    """For the host's half of the simulation to set itself up."""
    agent_setup_s: Annotated[float, Gt(0)] = 60.0
    """From sending the initial data until every agent is ready to run."""
    start_lead_s: Annotated[float, Ge(0.05)] = 0.5
    """From the order to start until T0."""
    silence_s: Annotated[float, Gt(0.2)] = 2.5
    """An agent or a host that says nothing for this long is lost."""
    complete_s: Annotated[float, Gt(0)] = 10.0
    """From the end of the simulated time until every agent has reported it complete."""
    shutdown_s: Annotated[float, Gt(0)] = 10.0
    """For shutdown: the last reports, and flushing of records."""
    tick_s: Annotated[float, Gt(0)] = 30.0
    """time.mode lockstep: wall time for one tick of all agents of a process, or one call of the host's half."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Scheduling:
    """What is asked of the kernel for a loop; what it grants is recorded."""

    __pydantic_config__ = FORBID_EXTRA

    policy: Literal["auto", "fifo", "normal"] = "auto"
    """auto: SCHED_FIFO where permitted, and a note where not; fifo: a refusal is a warning."""
    priority: Annotated[int, Ge(1), Le(80)] = 10
    """SCHED_FIFO priority of agents; the host runs one above."""
    cpu_affinity: tuple[Annotated[int, Ge(0)], ...] = ()
    """Processors the agents may use; empty for all."""
    timer_slack_ns: Annotated[int, Ge(1)] = 1
    """Timer slack of a loop that runs without SCHED_FIFO, ns."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Recording:
    """How records reach the disk."""

    __pydantic_config__ = FORBID_EXTRA

    flush_interval_s: Annotated[float, Gt(0), Le(60)] = 0.25
    """The most that a killed process loses, s."""
    sync_interval_s: Annotated[float, Ge(0), Le(600)] | None = None
    """Time between syncs to the disk, s: what a power cut costs at most; 0 leaves it to the kernel. Not given: 5 on other machines, 0 on this one."""
    buffer_bytes: Annotated[int, Ge(65_536)] = 4 * 1024 * 1024
    """Bound of the buffer between loop and disk; what does not fit is dropped and counted."""
    verbosity: Annotated[int, Ge(0), Le(5)] = 3
    """0 nothing, 1 critical, 2 error, 3 warning, 4 info, 5 debug: the thesis's VERBOSITY (table A.1)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Health:
    """State of health, sampled beside the loops."""

    __pydantic_config__ = FORBID_EXTRA

    period_s: Annotated[float, Ge(0.1)] = 5.0
    """Time between samples, s."""
    stress_workers: Annotated[int, Ge(0), Le(256)] = 0
    """Processes that factorise primes on each agent machine beside the run (thesis A.2.7, run_benchmark)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ExecutorSettings:
    """Who does the host's long work."""

    __pydantic_config__ = FORBID_EXTRA

    kind: str = "process"
    """process, thread, dask, or module:callable that returns a concurrent.futures.Executor."""
    workers: Annotated[int, Ge(1), Le(1024)] = 1
    """Workers: N_p of the thesis's inequalities; of a cluster, how many jobs it is given at once."""
    address: str = ""
    """dask: the scheduler, such as tcp://10.0.0.1:8786; empty for a cluster of our own on this machine."""


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
    """Folder of the scenario file: relative files in parameters are found from here."""
    agents: Agents
    time: TimeSettings = field(default_factory=TimeSettings)
    deadline: Deadline = field(default_factory=Deadline)
    network: Network = field(default_factory=Network)
    timeouts: Timeouts = field(default_factory=Timeouts)
    scheduling: Scheduling = field(default_factory=Scheduling)
    recording: Recording = field(default_factory=Recording)
    health: Health = field(default_factory=Health)
    executor: ExecutorSettings = field(default_factory=ExecutorSettings)
    on_agent_loss: Literal["abort", "continue"] = "abort"
    seed: Annotated[int, Ge(0), Le(SEED_MAX)] = 0
    parameters: Mapping[str, Any] = field(default_factory=dict)
    """The simulation's own, already validated, defaults filled in."""


@dataclass(frozen=True, slots=True, kw_only=True)
class HostLaunch:
    """First line of the host's standard input. Holds the run key: never argv, environment or disk."""

    config: RunConfig
    run_key_hex: Annotated[str, MinLen(64)] = field(repr=False)
    session_hex: str
    directory: str
    """Where the host records (host/ of the run directory)."""
    is_detached: bool = False
    """The operator leaves while the run goes on: the end of standard input is no end."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AgentLaunch:
    """First line of an agent supervisor's standard input: which agents this machine runs, and where the host is."""

    config: RunConfig
    run_key_hex: Annotated[str, MinLen(64)] = field(repr=False)
    session_hex: str
    machine: str
    """Name of this machine in the inventory."""
    agents: tuple[str, ...]
    """Names of the agents to run here."""
    host_address: str
    host_port: int
    directory: str
    """The run directory here; agents record in agents/<name>/, the machine's health in machines/<machine>/."""
    is_detached: bool = False
    """The operator leaves while the run goes on: the end of standard input is no end."""
    life: Annotated[int, Ge(1)] = 1
    """Which supervisor of this machine this is: more than 1 when the machine was lost and has returned."""
    first_incarnations: Mapping[str, int] = field(default_factory=dict)
    """The number that an agent's first process here gets; 1 where none is named."""

    def first_incarnation(self, agents: Iterable[str]) -> int:
        """Return the number of the first process of *agents*: their others were of an earlier supervisor."""
        return max(self.first_incarnations.get(agent, 1) for agent in agents)


def to_mapping(value: Any) -> dict[str, Any]:
    """Return a dataclass of this module as plain mappings, lists and scalars."""
    return typing.cast("dict[str, Any]", _plain(value))


def _plain(value: Any) -> Any:
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {f.name: _plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return value


def from_mapping(cls: type[T], mapping: Mapping[str, Any], where: str = "") -> T:
    """
    Build a dataclass from plain mappings, as the peer's `to_mapping` wrote them.

    Checks names, presence and plain types, not bounds: those were checked where the file was read.

    Raises:
        ConfigurationError: A key is unknown or missing, or a value has another type; the message
            gives the dotted path.
    """
    value = _build(cls, mapping, where or cls.__name__)
    return typing.cast("T", value)


def _build(expected: Any, value: Any, where: str) -> Any:
    origin = typing.get_origin(expected)
    if origin is Annotated:
        return _build(typing.get_args(expected)[0], value, where)
    if dataclasses.is_dataclass(expected):
        return _build_dataclass(typing.cast("type", expected), value, where)
    if origin in (typing.Union, types.UnionType):
        return _build_union(expected, value, where)
    if origin is Literal:
        if value not in typing.get_args(expected):
            raise ConfigurationError(
                f"{where}: expected one of {typing.get_args(expected)}, got {value!r}"
            )
        return value
    if origin in (tuple, list):
        item = typing.get_args(expected)[0]
        if not isinstance(value, list | tuple):
            raise ConfigurationError(f"{where}: expected a list, got {value!r}")
        return origin(_build(item, v, f"{where}[{i}]") for i, v in enumerate(value))
    if expected is Any:
        return value
    plain = origin or expected
    if expected is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if not isinstance(value, plain) or (isinstance(value, bool) and plain is int):
        raise ConfigurationError(f"{where}: expected {plain.__name__}, got {value!r}")
    return value


def _build_union(expected: Any, value: Any, where: str) -> Any:
    failures = []
    for option in typing.get_args(expected):
        if option is type(None):
            if value is None:
                return None
            continue
        try:
            return _build(option, value, where)
        except ConfigurationError as error:
            failures.append(str(error))
    raise ConfigurationError("; or ".join(failures) or f"{where}: unexpected {value!r}")


def _build_dataclass(cls: type, value: Any, where: str) -> Any:
    if not isinstance(value, Mapping):
        raise ConfigurationError(f"{where}: expected a mapping, got {value!r}")
    hints = typing.get_type_hints(cls, include_extras=True)
    fields = {f.name: f for f in dataclasses.fields(cls)}
    unknown = sorted(set(value) - set(fields))
    if unknown:
        raise ConfigurationError(f"{where}: unknown {', '.join(unknown)}")
    missing = [
        name
        for name, f in fields.items()
        if name not in value
        and f.default is dataclasses.MISSING
        and f.default_factory is dataclasses.MISSING
    ]
    if missing:
        raise ConfigurationError(f"{where}: missing {', '.join(missing)}")
    return cls(**{k: _build(hints[k], v, f"{where}.{k}") for k, v in value.items()})
