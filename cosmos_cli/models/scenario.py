"""
The scenario: what to simulate. Its sections are the runtime's own dataclasses, validated here.

A setting thus has one home, `madns_runtime.config`; what a single field cannot say is in `cross_faults`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from cosmos_cli.models.agent_labels import AgentLabels
from cosmos_cli.models.check_rules import CHECKS_MAX, CheckRule
from cosmos_cli.models.placement import PlacementRule, claim_agents
from cosmos_cli.models.planning import Planning
from cosmos_cli.models.scenario_test import ScenarioTest, faults_of_test
from cosmos_cli.models.text_forms import NAME_PATTERN, RECORDED_NAME, ScenarioRequirement
from cosmos_cli.models.timeline_rules import ENTRIES_MAX
from madns_runtime.agent_parameters import AgentParameters
from madns_runtime.config import (
    SEED_MAX,
    Agents,
    Deadline,
    ExecutorSettings,
    HardwareSettings,
    Health,
    Network,
    Recording,
    RunConfig,
    Scheduling,
    Timeouts,
    TimeSettings,
)
from madns_runtime.timeline.entries import ScheduledEntry

RESERVED_NAMES = ("host",)
EXECUTOR_KINDS = ("process", "thread", "dask")

OF_AUTHORS = ("extends", "root", "vars")
"""Keys that have done their part when a scenario is read: nothing is left of them in what results."""

SectionFault = tuple[tuple[str | int, ...], str]
"""The path within the scenario, and what is wrong there."""


class Scenario(BaseModel):
    """Scenario: the simulation and its agents. Machines are the inventory's; `placement` says what belongs where."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    extends: str = ""
    """Another scenario, by its path from this file's folder: what this file does not say comes from there."""
    root: Literal[".", "..", "../.."] = "."
    """The folder that travels to machines and from which relative files are found, from this file's: it holds all that the scenario needs."""
    vars: dict[str, str | int | float | bool | None] = {}
    """Values by name, for ${name} elsewhere in the scenario; --set vars.NAME=VALUE gives another."""
    name: Annotated[str, Field(pattern=NAME_PATTERN, max_length=64)]
    """Name of the scenario; runs are named after it: lower-case letters, digits and hyphens."""
    description: str = ""
    """Purpose of the scenario, in a sentence."""
    simulation: Annotated[str, Field(min_length=1)]
    """A registered simulation, module:attribute, or ./file.py:attribute from the scenario's root, its own folder if it names none."""
    agents: Agents
    """Number of agents, their names and their rate."""
    time: TimeSettings = TimeSettings()
    """Passing of simulated time, and its duration."""
    deadline: Deadline = Deadline()
    """The real-time budget that a run is judged by."""
    network: Network = Network()
    """Address of the host, and what its sockets ask for."""
    timeouts: Timeouts = Timeouts()
    """The end of every wait."""
    scheduling: Scheduling = Scheduling()
    """Requests to the kernel for the loops."""
    recording: Recording = Recording()
    """Settings of the records and of their way to the disk."""
    health: Health = Health()
    """State of health of the machines."""
    executor: ExecutorSettings = ExecutorSettings()
    """The executor of the host's long work."""
    hardware: HardwareSettings = HardwareSettings()
    """Devices in the loop: which agents use what, whether outputs may move, what a loss means."""
    on_agent_loss: Literal["abort", "continue"] = "abort"
    """Whether the run ends when an agent is lost, or goes on without it."""
    seed: Annotated[int, Field(ge=0, le=SEED_MAX)] = 0
    """Seed of every random number in the run."""
    requirements: tuple[ScenarioRequirement, ...] = ()
    """Python packages that the simulation needs on the agents' machines, as pip names them; or ./paths of wheels or of sources, which need no index."""
    placement: tuple[PlacementRule, ...] = ()
    """Machines of agents, rule by rule; the rest is spread evenly over all."""
    timeline: Annotated[tuple[dict[str, Any], ...], Field(max_length=ENTRIES_MAX)] = ()
    """Events of the run, and when each is to happen: actions of the framework, faults, and those that the simulation declares."""
    checks: Annotated[tuple[CheckRule, ...], Field(max_length=CHECKS_MAX)] = ()
    """Expectations of the recorded values, judged after the run beside the framework's own checks."""
    plan: Planning = Planning()
    """Terms of the inequalities of real time, for `cosmos plan` alone."""
    test: ScenarioTest = ScenarioTest()
    """The scenario as a test, for `cosmos test` alone."""
    parameters: dict[str, Any] = {}
    """The simulation's own settings."""
    agent_parameters: tuple[AgentParameters, ...] = ()
    """Rules for agents whose parameters differ: the first that names an agent holds for it."""

    def run_config(
        self,
        *,
        run: str,
        base_directory: Path,
        parameters: Mapping[str, Any] | None = None,
        agent_parameters: tuple[AgentParameters, ...] = (),
        timeline: tuple[ScheduledEntry, ...] = (),
    ) -> RunConfig:
        """
        Return what host and agents are told.

        Args:
            run: Name of the run, such as 0007-iridium10.
            base_directory: Folder of the scenario file.
            parameters: The simulation's parameters with defaults filled in; those of the file if None.
            agent_parameters: Whole parameters of agents for which others hold.
            timeline: Resolved among agents and actions.
        """
        return RunConfig(
            run=run,
            scenario=self.name,
            simulation=self.simulation,
            base_directory=str(base_directory),
            agents=self.agents,
            time=self.time,
            deadline=self.deadline,
            network=self.network,
            timeouts=self.timeouts,
            scheduling=self.scheduling,
            recording=self.recording,
            health=self.health,
            executor=self.executor,
            hardware=self.hardware,
            on_agent_loss=self.on_agent_loss,
            seed=self.seed,
            parameters=dict(self.parameters if parameters is None else parameters),
            agent_parameters=agent_parameters,
            timeline=timeline,
        )


def cross_faults(
    scenario: Scenario,
    *,
    skip: frozenset[str],
    labels: AgentLabels | None,
) -> list[SectionFault]:
    """
    Return what no single field can know to be wrong.

    Args:
        scenario: The scenario.
        skip: Top-level keys with faults of their own: checks that need them are left out.
        labels: Second names of agents; None if they are not known, and then placement is not judged.
    """
    faults = [
        fault
        for needed, check in _CHECKS
        if not skip.intersection(needed)
        for fault in check(scenario)
    ]
    if labels is not None and not skip.intersection(("agents", "placement")):
        faults += _placement(scenario, labels)
    return faults


def _names(scenario: Scenario) -> Iterator[SectionFault]:
    agents = scenario.agents
    if agents.names and len(agents.names) != agents.count:
        text = f"expected {agents.count} names (agents.count), got {len(agents.names)}"
        yield ("agents", "names"), text
    seen: dict[str, int] = {}
    for index, name in enumerate(agents.names):
        path = ("agents", "names", index)
        if name.lower() in RESERVED_NAMES:
            yield path, f"{name!r} is reserved; give the agent another name"
        elif not RECORDED_NAME.fullmatch(name):
            text = "expected letters, digits, '.', '_' or '-' (a folder is named after the agent)"
            yield path, f"{text}, got {name!r}"
        elif name.lower() in seen:
            yield (
                path,
                f"expected unique names, got {name!r} again (first at [{seen[name.lower()]}])",
            )
        seen.setdefault(name.lower(), index)


def _processes(scenario: Scenario) -> Iterator[SectionFault]:
    agents = scenario.agents
    if agents.per_process > agents.count:
        text = f"expected <= agents.count ({agents.count}), got {agents.per_process}"
        yield ("agents", "per_process"), text


def _duration(scenario: Scenario) -> Iterator[SectionFault]:
    period_s = 1 / scenario.agents.tick_hz
    if scenario.time.duration_s < period_s:
        text = f"expected at least one tick ({period_s:g} s at {scenario.agents.tick_hz:g} Hz)"
        yield ("time", "duration_s"), f"{text}, got {scenario.time.duration_s:g}"


def _restarts(scenario: Scenario) -> Iterator[SectionFault]:
    if scenario.agents.restarts_max and scenario.on_agent_loss == "abort":
        text = f"expected 0 with on_agent_loss: abort, got {scenario.agents.restarts_max}"
        yield ("agents", "restarts_max"), f"{text}; say on_agent_loss: continue"
    is_alone = scenario.agents.per_process == 1 or scenario.time.is_lockstep
    # In lockstep its half is made anew, no process.
    if scenario.agents.restarts_max and not is_alone:
        text = f"expected 0 with agents.per_process: {scenario.agents.per_process}"
        why = "an agent that shares its process cannot be started again alone"
        yield ("agents", "restarts_max"), f"{text}, got {scenario.agents.restarts_max}: {why}"


def _test(scenario: Scenario) -> Iterator[SectionFault]:
    for path, text in faults_of_test(scenario.test):
        yield ("test", *path), text


def _executor(scenario: Scenario) -> Iterator[SectionFault]:
    kind = scenario.executor.kind
    module, _, attribute = kind.partition(":")
    is_path = attribute.isidentifier() and all(part.isidentifier() for part in module.split("."))
    if kind not in EXECUTOR_KINDS and not is_path:
        text = f"expected process, thread, dask or module:callable, got {kind!r}"
        yield ("executor", "kind"), text
    if scenario.executor.address and kind != "dask":
        yield ("executor", "address"), f"expected nothing with executor.kind {kind}; say kind: dask"


def _placement(scenario: Scenario, labels: AgentLabels) -> Iterator[SectionFault]:
    names = scenario.agents.resolved_names()
    if len(names) != scenario.agents.count:
        return  # told already, and what the names mean is open
    for path, text in claim_agents(names, scenario.placement, labels).faults:
        yield ("placement", *path), text


_CHECKS: tuple[tuple[frozenset[str], Callable[[Scenario], Iterator[SectionFault]]], ...] = (
    (frozenset({"agents"}), _names),
    (frozenset({"agents"}), _processes),
    (frozenset({"agents", "time"}), _duration),
    (frozenset({"agents", "on_agent_loss"}), _restarts),
    (frozenset({"executor"}), _executor),
    (frozenset({"test"}), _test),
)
