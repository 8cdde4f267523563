"""One `cosmos run` from a checked scenario to a judged run directory."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cosmos_cli.errors import CosmosError, ExitCode, InputError
from cosmos_cli.evidence.run_directory import (
    RunDirectory,
    alone,
    begin_run,
    create_run,
    discard_run,
    note_interruption,
)
from cosmos_cli.evidence.run_documents import EXPECTATIONS, Problem
from cosmos_cli.fleet.connection import ConnectOptions
from cosmos_cli.fleet.pool import FORKS_DEFAULT
from cosmos_cli.launch.access import chosen_access, with_access
from cosmos_cli.launch.device_plan import plan_devices
from cosmos_cli.launch.flown_copy import copy_flown
from cosmos_cli.launch.machines import RETURN_TIMEOUT_S, RemoteMachine, close_machines
from cosmos_cli.launch.operator import Operator
from cosmos_cli.launch.place_plan import check_places
from cosmos_cli.launch.plan import LaunchPlan, make_plan
from cosmos_cli.launch.preparation import (
    host_config,
    inventory_text,
    places_of,
    plan_mapping,
    reach,
)
from cosmos_cli.launch.request import (
    LaunchOutcome,
    LaunchRequest,
    View,
    make_session,
    with_manual_agents,
)
from cosmos_cli.launch.signals import OperatorSignals
from cosmos_cli.models.agent_labels import AgentLabels
from cosmos_cli.models.inventory import Machine
from cosmos_cli.models.inventory.machine import LOOPBACK
from cosmos_cli.models.loading import ScenarioFile
from cosmos_cli.models.yaml_source import yaml_text
from cosmos_cli.system.import_turn import IMPORT_TURN
from cosmos_cli.ui.foreign_text import clean_line
from cosmos_cli.ui.name_ranges import compact
from cosmos_cli.ui.plural import counted
from madns_runtime.config import DeviceLaunch, to_mapping
from madns_runtime.lockstep.partition import processors_here
from madns_runtime.processes import register
from madns_runtime.recording.access import Access, access_applied

if TYPE_CHECKING:
    from cosmos_cli.collect.finish import RunSummary

COLLECTOR_PATIENCE_S = 10.0
"""Wait for another command that holds the run at its end."""
OPERATOR_NICE = 5
"""Niceness of the operator: its drawing and collecting can wait; agents on the same processors cannot."""


class CollectionInterrupted(CosmosError):
    """The run is over, but its operator did not wait for the verdict."""

    exit_code = ExitCode.INTERRUPTED
    kind = "interrupted"


@dataclass(frozen=True, slots=True, kw_only=True)
class RunOptions:
    """Options of a run."""

    runs: Path
    """Folder of all runs."""
    manual: tuple[str, ...] = ()
    """Agents that a person starts by hand."""
    has_report: bool = True
    machines: tuple[Machine, ...] = (LOOPBACK,)
    """Machines that its agents may run on."""
    host: str | None = None
    """The machine that runs the host; None for this computer."""
    is_detached: bool = False
    """Whether the run goes on without its operator, once it runs."""
    forks: int = FORKS_DEFAULT
    connecting: ConnectOptions = ConnectOptions()


@dataclass(frozen=True, slots=True)
class Detached:
    """A run that goes on without its operator."""

    run: RunDirectory

    @property
    def words(self) -> str:
        """Account in words, for a person."""
        number = self.run.number or self.run.name
        return (
            f"detached: run {self.run.name} goes on;"
            f" see cosmos ps, cosmos down {number}, cosmos collect {number}"
        )

    def to_mapping(self) -> dict[str, Any]:
        """Return what --json prints."""
        return {
            "run": self.run.name,
            "status": "running",
            "is_detached": True,
            "directory": str(self.run.path),
            "exit_code": int(ExitCode.OK),
        }


def execute(
    scenario: ScenarioFile,
    options: RunOptions,
    make_view: Callable[[str, float, AgentLabels], View],
    say: Callable[[str], None] = lambda text: None,
) -> RunSummary | Detached:
    """
    Run a scenario and judge it, or leave it to itself once it runs.

    Args:
        scenario: What to run.
        options: How, and where.
        make_view: Called with the run's name, simulated time, s, and second names of agents; returns where talk goes.
        say: Where talk goes before there is a run.

    Raises:
        InputError: An option does not fit the scenario, or no run directory can be made.
        MachinesError: Not all machines could be reached; nothing was started.
        CollectionInterrupted: What is on disk can be collected again.
    """
    access = chosen_access(scenario.scenario.recording)
    plan = plan_of(scenario, options)
    manual = tuple(manual_agents(options, plan, scenario.labels))
    options = dataclasses.replace(options, manual=manual)
    remote = reach(plan, scenario, options=options.connecting, forks=options.forks, say=say)
    try:
        with access_applied(access):
            prepared = _prepare(scenario, options, plan, remote, access=access)
            return _execute(prepared, options, make_view)
    finally:
        close_machines(tuple(remote.values()))


def plan_of(scenario: ScenarioFile, options: RunOptions) -> LaunchPlan:
    """
    Return who runs where.

    Raises:
        InputError: An option does not fit the scenario.
    """
    plan = make_plan(
        scenario.scenario,
        options.machines,
        host=options.host,
        fault_at=scenario.fault,
        processors=processors_here(),
        labels=scenario.labels,
    )
    manual_agents(options, plan, scenario.labels)
    check_places(scenario, plan)
    plan_devices(scenario, plan)  # what is wrong with them is told before any machine is reached
    return plan


@dataclass(frozen=True, slots=True)
class _Prepared:
    run: RunDirectory
    plan: LaunchPlan
    request: LaunchRequest
    remote: Mapping[str, RemoteMachine]
    labels: AgentLabels


def _prepare(
    scenario: ScenarioFile,
    options: RunOptions,
    plan: LaunchPlan,
    remote: Mapping[str, RemoteMachine],
    *,
    access: Access,
) -> _Prepared:
    run = create_run(options.runs, scenario.scenario.name, access)
    try:
        request = _begin(scenario, options, plan, remote, run=run, access=access)
    except BaseException:  # whatever it was: nothing was started
        discard_run(run)
        raise
    return _Prepared(run, plan, request, remote, scenario.labels)


def _begin(  # noqa: PLR0913 - all that a run is made of; two by name
    scenario: ScenarioFile,
    options: RunOptions,
    plan: LaunchPlan,
    remote: Mapping[str, RemoteMachine],
    *,
    run: RunDirectory,
    access: Access,
) -> LaunchRequest:
    """Write what is known before a run's start, and return what its operator is to do."""
    devices = plan_devices(scenario, plan)
    session_hex = make_session()
    config = with_manual_agents(scenario.run_config(run.name), options.manual)
    places = places_of(plan, remote, config, run=run, session_hex=session_hex)
    config = with_access(host_config(config, places), access)
    mapping = plan_mapping(plan, places, session_hex, is_detached=options.is_detached)
    try:
        flown = copy_flown(scenario.base_directory, run, access).to_mapping()
        begin_run(run, config, {**mapping, **_declared(scenario), **_named(devices)}, flown)
        (run.path / "scenario.yaml").write_text(scenario_text(scenario), encoding="utf-8")
        if options.machines != (LOOPBACK,):
            (run.path / "inventory.yaml").write_text(inventory_text(plan), encoding="utf-8")
    except OSError as error:
        raise InputError(f"{run.path}: cannot write there: {error.strerror or error}") from error
    return LaunchRequest(
        config=config,
        devices=devices,
        directory=run.path,
        machines=plan.agents_by_machine,
        places=places,
        host_machine=plan.host.name if plan.host and plan.host.name in remote else None,
        manual=options.manual,
        labels=scenario.labels,
        is_detached=options.is_detached,
        nice=OPERATOR_NICE,
        session_hex=session_hex,
    )


def _named(devices: Mapping[str, tuple[DeviceLaunch, ...]]) -> dict[str, Any]:
    """Return what plan.json keeps of the devices: by machine, the full names of those that must be accounted for."""
    named = {machine: [each.full_name for each in there] for machine, there in devices.items()}
    return {"devices": named} if any(named.values()) else {}


def _declared(scenario: ScenarioFile) -> dict[str, Any]:
    """Return what plan.json keeps of the simulation's own words, for whoever reads the records without it."""
    found: dict[str, Any] = {}
    if scenario.streams is not None:
        found["streams"] = [to_mapping(stream) for stream in scenario.streams]
    if scenario.agent_streams:
        found["agent_streams"] = [to_mapping(each) for each in scenario.agent_streams]
    if scenario.expectations:
        found[EXPECTATIONS] = to_mapping({"": scenario.expectations})[""]
    if scenario.labels.names:
        found["labels"] = to_mapping(scenario.labels)
    return found


def _execute(
    prepared: _Prepared, options: RunOptions, make_view: Callable[[str, float, AgentLabels], View]
) -> RunSummary | Detached:
    run, request = prepared.run, prepared.request
    with OperatorSignals() as signals, register(run.name, "operator", "operator", run.path) as own:
        view = make_view(run.name, request.config.time.duration_s, prepared.labels)
        try:
            view.say(_greeting(prepared))
            for text in (*prepared.plan.notes, own.problem):
                if text is not None:
                    view.say(text, "warning")
            outcome = Operator(request, view, signals, prepared.remote).run()
            if outcome.is_detached:
                return Detached(run)
            if outcome.interruption != "no":
                note_interruption(run)  # also where collecting is cut off
            signals.raise_from_now()
            return _finish(prepared, outcome, options, view=view)
        except KeyboardInterrupt:
            raise CollectionInterrupted(
                "interrupted while collecting; what was recorded is kept, here or where it was; go on with:"
                f" cosmos collect {run.shell_path}"
            ) from None
        finally:
            view.close()


def scenario_text(scenario: ScenarioFile) -> str:
    """Return the scenario as it was run: the file itself, or with all that changed it and defaults filled in."""
    if not scenario.overrides and len(scenario.files) == 1:
        return scenario.text
    told = [f"{scenario.path.name}, with its defaults and:"]
    told += [f"  extends {file}" for file in scenario.files[1:]]
    told += [f"  --set {override}" for override in scenario.overrides]
    # A value may have several lines, and a comment has one.
    comments = "".join(f"# {clean_line(text, length_max=None)}\n" for text in told)
    return comments + yaml_text(scenario.to_written())


def _finish(
    prepared: _Prepared, outcome: LaunchOutcome, options: RunOptions, *, view: View
) -> RunSummary:
    # Imported late: the tables' library is large, and the run need not wait for it.
    with IMPORT_TURN:
        from cosmos_cli.collect.finish import finish_run
        from cosmos_cli.evidence.completeness import ExpectedRecords

    view.state("COLLECTING")
    is_patient = outcome.interruption != "at once"
    # This command made the folder, whatever owner a mounted file system tells.
    with alone(prepared.run, patience_s=COLLECTOR_PATIENCE_S, must_own=False):
        missing = _retrieve(prepared, options, view, is_wanted=is_patient)
        return finish_run(
            prepared.run,
            outcome.host_result or prepared.run.read_left_result(),
            ExpectedRecords.of(prepared.request.config, prepared.plan.agents_by_machine),
            interrupted=outcome.interruption != "no",
            problems=(*outcome.problems, *missing),
            has_report=options.has_report and is_patient,
            progress=view.work,
        )


def _retrieve(
    prepared: _Prepared, options: RunOptions, view: View, *, is_wanted: bool
) -> tuple[Problem, ...]:
    """Bring what machines recorded here, and return whose records have not come."""
    if not prepared.remote:
        return ()
    if not is_wanted:
        fetch = f"fetch them with: cosmos collect {prepared.run.shell_path}"
        view.say(f"records on {compact(prepared.remote)} were not fetched; {fetch}", "warning")
        text = f"its records were not fetched; {fetch}"
        return tuple(Problem(text=text, machine=name, step="collect") for name in prepared.remote)
    # Imported late: agents run meanwhile on the same processors, and a run on this computer needs none of it.
    with IMPORT_TURN:
        from cosmos_cli.collect.retrieve import Retrieval, kept_copies, problems_of

    retrieval = Retrieval(
        prepared.run,
        # Who is connected still is not asked again; who is not has been looked for already.
        options=dataclasses.replace(options.connecting, timeout_s=RETURN_TIMEOUT_S),
        forks=options.forks,
        progress=view.work,
        connections={name: machine.connection for name, machine in prepared.remote.items()},
        say=lambda text: view.say(text, "warning"),
    )
    with retrieval:
        outcomes = retrieval.fetch()
    for remark in kept_copies(outcomes):
        view.say(remark, "warning")
    problems = problems_of(outcomes)
    for problem in problems:
        view.say(f"{problem.machine}: {problem.text}", "error")
    return problems


def manual_agents(options: RunOptions, plan: LaunchPlan, labels: AgentLabels) -> list[str]:
    """Return the agents that --manual means, by name or label; it may be a glob."""
    manual = options.manual
    if manual and plan.is_lockstep:
        raise InputError(
            "--manual: in lockstep the host starts its agents itself; leave it out, or run in real"
            " time with --set time.mode=realtime"
        )
    if manual and options.is_detached:
        raise InputError("--manual and --detach: a hand-started agent needs its operator")
    names = [name for agents in plan.agents_by_machine.values() for name in agents]
    unknown = [name for name in manual if not labels.like(name, names)]
    if unknown:
        shown = ", ".join(names[:10]) + (", ..." if len(names) > 10 else "")
        raise InputError(f"--manual {', '.join(unknown)}: no such agent; there are {shown}")
    for planned in plan.machines:
        there = labels.like_any(manual, planned.agents)
        if there and planned.machine.connection != "local":
            raise InputError(
                f"--manual {', '.join(there)}: placed on {planned.name}, and only an agent on this"
                " computer can be started by hand; place it there, or leave out the inventory"
            )
    return labels.like_any(manual, names)


def _greeting(prepared: _Prepared) -> str:
    config, run = prepared.request.config, prepared.run
    where = f" on {counted(len(prepared.plan.machines), 'machine')}" if prepared.remote else ""
    how = " in lockstep" if config.time.is_lockstep else ""
    return (
        f"{run.name}: {counted(config.agents.count, 'agent')}{where} at {config.agents.tick_hz:g} Hz for"
        f" {config.time.duration_s:g} s{how}; records go to {run.path}"
    )
