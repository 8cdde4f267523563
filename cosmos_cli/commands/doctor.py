"""`cosmos doctor`: what spoils real time or a run, on every machine and here, each with its cure."""

from __future__ import annotations

import dataclasses
import os
import re
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from cosmos_cli.commands.fleet_command import (
    AcceptHostKeysOption,
    ForksOption,
    LimitOption,
    SomeInventoryOption,
)
from cosmos_cli.doctor.case import AgentBound, Case, Wants
from cosmos_cli.doctor.finding import HERE, Finding, Severity, grouped
from cosmos_cli.doctor.here import interface_of, look_here
from cosmos_cli.doctor.judge import judge
from cosmos_cli.doctor.probe import DoctorNeeds, Responder, ask, ask_here
from cosmos_cli.errors import ExitCode, InputError
from cosmos_cli.evidence.run_directory import runs_root
from cosmos_cli.fleet.connection import Connection
from cosmos_cli.fleet.fleet import Fleet, fleet_of
from cosmos_cli.fleet.local import LocalConnection, this_computer
from cosmos_cli.fleet.outcome import Outcome, failed, failure_teller
from cosmos_cli.fleet.pool import for_each
from cosmos_cli.fleet.retry_file import offer_retry
from cosmos_cli.fleet.target import Target
from cosmos_cli.launch.capacity import ComputerFacts, predict_capacity, processor_limits
from cosmos_cli.launch.capacity_view import computers_of
from cosmos_cli.launch.device_sampling import missing_for
from cosmos_cli.launch.plan import LaunchPlan, make_plan
from cosmos_cli.launch.plan_view import demand_of, feasibility_of, latency_of, resources_of
from cosmos_cli.models.inventory import Machine
from cosmos_cli.models.inventory.devices import driven_devices
from cosmos_cli.models.inventory.machine import LOOPBACK
from cosmos_cli.models.inventory_arguments import refuse_stray_limit
from cosmos_cli.models.loading import ScenarioFile, load_scenario
from cosmos_cli.models.planning import NOTHING
from cosmos_cli.ui import invocation
from cosmos_cli.ui.console import Column, Console, JsonOption, QuietOption, SetOption
from cosmos_cli.ui.plural import counted
from madns_runtime.plugin.api import Demand
from madns_runtime.processes import state_directory

FORKS_DEFAULT = 100
"""All at once: a machine is measured for some seconds, in which there is nothing to do here."""
COLUMNS = (
    Column("level"),
    Column("check"),
    Column("machines"),
    Column("found"),
    Column("cure"),
)
OF_MACHINES = re.compile(r"^(`cosmos (?:up|reboot|wipe))(?: -i INVENTORY)?(?=[ `])")
"""A command that is the cure itself, and wants an inventory; one behind a line of the inventory names none."""

Told = dict[str, Any]


def doctor(
    scenario: Annotated[
        Path | None,
        typer.Argument(metavar="[SCENARIO]", help="Scenario file: its wants are held against."),
    ] = None,
    inventory: SomeInventoryOption = None,
    limit: LimitOption = None,
    all_: Annotated[bool, typer.Option("--all", help="Show what is well, too.")] = False,
    strict: Annotated[bool, typer.Option("--strict", help="Warnings fail as errors do.")] = False,
    set_: SetOption = None,
    forks: ForksOption = FORKS_DEFAULT,
    accept_new_host_keys: AcceptHostKeysOption = False,
    json: JsonOption = False,
    quiet: QuietOption = False,
) -> int:
    """
    Find what spoils real time or a run, on every machine and on this computer, and say what cures it.

    Ends with 3 when machines failed, with 1 when an error was found (--strict: or a warning).
    """
    console = Console(json=json, quiet=quiet)
    start_s = time.monotonic()
    if not inventory:
        refuse_stray_limit(limit)
    if set_ and scenario is None:
        raise InputError(
            f"--set {set_[0]}: there is no scenario whose value it could replace; name one"
        )
    fleet = fleet_of(inventory, limit, forks, accept_new_host_keys) if inventory else None
    examination = _Examination(console, fleet, scenario, set_ or ())
    console.say(f"measuring {_who(examination.wants.machines)}, some seconds each")
    outcomes = examination.outcomes()
    wants = examination.wants
    findings = {
        o.machine: with_machines(judge(Case.of(o.machine, o.value, wants)))
        for o in outcomes
        if o.value
    }
    told = [finding for machine in findings.values() for finding in machine]
    _show(console, told, outcomes, is_all=all_)
    exit_code = _exit_code(told, outcomes, is_strict=strict)
    names = [outcome.machine for outcome in failed(outcomes) if outcome.machine != HERE]
    retry = None
    if (
        fleet and scenario is None
    ):  # of a scenario, those that failed alone would be measured for all of its agents
        retry = offer_retry(console, fleet.sources, failed=names, count=len(fleet.targets))
    console.data(_verdict(told, outcomes, time.monotonic() - start_s))
    console.print_json(
        {
            "scenario": examination.wants.scenario,
            "machines": [
                outcome.to_mapping(
                    {
                        "findings": [
                            each.to_mapping() for each in findings.get(outcome.machine, ())
                        ],
                        "probed": outcome.value,
                    }
                )
                for outcome in outcomes
            ],
            "levels": {
                level.value: sum(finding.level == level for finding in told) for level in Severity
            },
            "retry": retry,
            "exit_code": int(exit_code),
        }
    )
    return int(exit_code)


def with_machines(findings: Sequence[Finding]) -> list[Finding]:
    """Return findings whose cures name the inventory that was given: the checks know of none."""
    options = invocation.current().machine_options

    def cured(each: Finding) -> Finding:
        cure = OF_MACHINES.sub(lambda found: f"{found[1]}{options}", each.remark.cure)
        cure = cure.replace(" -i INVENTORY", options)
        return dataclasses.replace(each, remark=dataclasses.replace(each.remark, cure=cure))

    return [cured(each) for each in findings]


class _Examination:
    """Asks every machine at once, and then this computer, which has nothing else to do by then."""

    def __init__(
        self,
        console: Console,
        fleet: Fleet | None,
        scenario: Path | None,
        overrides: Sequence[str],
    ) -> None:
        machines = fleet.machines if fleet else ()
        self._console = console
        self._devices = _devices(machines)
        self._fleet = fleet and fleet.elsewhere()
        self._scenario_file = (
            None if scenario is None else load_scenario(scenario, overrides, warn=console.warn)
        )
        self._needs = DoctorNeeds(machines, self._scenario_file)
        self._plan = _plan_of(self._scenario_file, machines)
        count = len(self._fleet.targets) if self._fleet else 0
        self._demand: Demand | None = None
        self.wants = _wants(self._scenario_file, self._plan, machines, count)

    def outcomes(self) -> list[Outcome[Told]]:
        """Return what every machine told, this computer first, and learn what their processors bear."""
        outcomes: list[Outcome[Told]] = []
        own_addresses: set[str] = set()
        if self._fleet and self._fleet.targets:
            with Responder(self.wants.port) as responder:
                if responder.is_port_taken:
                    self._console.warn(
                        f"UDP port {self.wants.port} of the scenario is taken here; "
                        f"round trips are tried at port {responder.port}"
                    )

                def task(connection: Connection, machine: Machine) -> Told:
                    own_addresses.add(connection.own_address)
                    return ask(
                        connection,
                        self.wants,
                        responder,
                        machine=machine,
                        needs=self._needs,
                    )

                outcomes = self._fleet.each(task, failure_teller(self._console.say))
        outcomes = [self._ask_here(own_addresses, outcomes), *outcomes]
        self.wants = dataclasses.replace(self.wants, bounds=self._bounds(outcomes))
        return outcomes

    def _ask_here(
        self, own_addresses: set[str], outcomes: Sequence[Outcome[Told]]
    ) -> Outcome[Told]:
        target = this_computer(HERE)

        def task(target: Target) -> Told:
            seen = own_addresses - {""}  # a ProxyCommand shows none
            interface = interface_of(min(seen)) if seen else "lo"
            told = ask_here(
                LocalConnection(target),
                self.wants,
                runs=os.path.abspath(runs_root()),
                state=str(state_directory().parent),
                interface=interface,
            )
            living = [entry["run_directory"] for entry in told["cosmos"]["living"]]
            told["here"] = look_here(living) | self._pace(outcomes) | {"devices": self._devices}
            return told

        return for_each([target], task)[0]

    def _pace(self, outcomes: Sequence[Outcome[Told]]) -> dict[str, Any]:
        """
        Hold the four inequalities against the network as it was measured, and predict how many agents fit.

        Both are None in lockstep, and without a demand.
        """
        unknown: dict[str, Any] = {"feasibility": None, "capacity": None}
        if self._scenario_file is None or self._plan is None or self._plan.is_lockstep:
            return unknown

        self._demand = demand_of(self._scenario_file)
        if self._demand is None:
            return unknown

        trips_ms = [
            trip["p50_ms"]
            for outcome in outcomes
            if outcome.value
            and (trip := outcome.value["round_trips"])
            and trip.get("p50_ms") is not None
        ]
        if trips_ms:
            latency_s = max(trips_ms) / 2e3
        else:
            given_ms = self._scenario_file.scenario.plan.latency_ms
            latency_s, _ = latency_of(self._plan, given_ms=given_ms)
        resources = resources_of(self._scenario_file, self._plan, latency_s)
        feasibility = feasibility_of(self._scenario_file, resources, self._demand)
        capacity = predict_capacity(
            self._scenario_file.scenario, self._demand, computers_of(self._plan), resources
        )
        return {"feasibility": feasibility.to_mapping(), "capacity": capacity.to_mapping()}

    def _bounds(self, outcomes: Sequence[Outcome[Told]]) -> dict[str, AgentBound]:
        """Return how many agents each machine's processors are predicted to bear in real time; this computer is the host."""
        if self._scenario_file is None or self._plan is None or self._plan.is_lockstep:
            return {}

        bounds: dict[str, AgentBound] = {}
        for outcome in outcomes:
            processors = outcome.value and outcome.value["limits"].get("usable_processors")
            if not processors:
                continue
            name = outcome.machine
            computer = ComputerFacts(name=name, processors=processors, is_host=name == HERE)
            one_process, whole = processor_limits(
                self._scenario_file.scenario, self._demand or NOTHING, computer
            )
            bounds[name] = AgentBound(
                agents=min(one_process.agents, whole.agents),
                is_of_process=one_process.agents < whole.agents,
            )
        return bounds


def _devices(machines: Sequence[Machine]) -> list[dict[str, Any]]:
    """Return what devices of this computer need and is missing."""
    return [
        {
            "device": f"{machine.name}/{device.name}",
            "missing": [
                {"found": found, "cure": cure}
                for found, _, cure in (
                    text.rpartition(": ") for text in missing_for(machine, device)
                )
            ],
        }
        for machine in machines
        if machine.connection == "local"
        for device in driven_devices(machine.variables.cosmos_devices or ()).values()
    ]


def _plan_of(file: ScenarioFile | None, machines: Sequence[Machine]) -> LaunchPlan | None:
    """Return who would run where; None without a scenario."""
    if file is None:
        return None
    return make_plan(
        file.scenario, machines or (LOOPBACK,), fault_at=file.fault, labels=file.labels
    )


def _wants(
    file: ScenarioFile | None, plan: LaunchPlan | None, machines: Sequence[Machine], count: int
) -> Wants:
    """Return what a scenario asks for of these machines, *count* of which are others than this computer."""
    affinity = _affinity(machines, file)
    if file is None or plan is None:
        return Wants(machines=count, affinity=affinity)
    agents: Counter[str] = Counter()
    for planned in plan.machines:
        name = HERE if planned.machine.connection == "local" else planned.name
        agents[name] += len(planned.agents)
    return dataclasses.replace(Wants.of(file.scenario, agents, machines=count), affinity=affinity)


def _affinity(
    machines: Sequence[Machine], scenario_file: ScenarioFile | None
) -> dict[str, tuple[int, ...]]:
    """Return the processors that agents are to use on each machine that has agents, where anybody says it."""
    common = scenario_file.scenario.scheduling.cpu_affinity if scenario_file else ()
    found: dict[str, tuple[int, ...]] = {} if machines else {HERE: common}
    for machine in machines:
        name = HERE if machine.connection == "local" else machine.name
        own = machine.variables.cosmos_cpu_affinity or common
        found[name] = tuple(sorted({*found.get(name, ()), *own}))
    return found


def _show(
    console: Console,
    findings: Sequence[Finding],
    outcomes: Sequence[Outcome[Told]],
    *,
    is_all: bool,
) -> None:
    rows = [
        ("failed", failure.kind.value, outcome.machine, failure.text, failure.advice)
        for outcome in outcomes
        if (failure := outcome.failure)
    ]
    rows += [
        (group.level.value, group.check, group.names, group.found, group.cure)
        for group in grouped(findings)
        if is_all or group.level != Severity.OK
    ]
    if rows:
        console.table(COLUMNS, rows)


def _exit_code(
    findings: Sequence[Finding], outcomes: Sequence[Outcome[Told]], *, is_strict: bool
) -> ExitCode:
    if failed(outcomes):
        return ExitCode.MACHINES
    bad = {Severity.ERROR, Severity.WARNING} if is_strict else {Severity.ERROR}
    return ExitCode.RUN_FAILED if any(f.level in bad for f in findings) else ExitCode.OK


def _verdict(
    findings: Sequence[Finding], outcomes: Sequence[Outcome[Told]], duration_s: float
) -> str:
    parts = [
        counted(number, level.value)
        for level in (Severity.ERROR, Severity.WARNING, Severity.NOTE)
        if (number := len([g for g in grouped(findings) if g.level == level]))
    ]
    bad = len(failed(outcomes))
    parts += [f"{bad} failed"] if bad else []
    who = _who(len(outcomes) - 1)
    return f"{who}: {', '.join(parts) or 'nothing to cure'} in {duration_s:.1f} s"


def _who(machines: int) -> str:
    return f"{counted(machines, 'machine')} and {HERE}" if machines else HERE
