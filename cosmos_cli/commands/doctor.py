"""`cosmos doctor`: what spoils real time or a run, on every machine and here, each with its cure."""

from __future__ import annotations

import dataclasses
import os
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from cosmos_cli.commands.fleet_options import AcceptHostKeysOption, ForksOption, LimitOption
from cosmos_cli.console import Column, Console, JsonOption, QuietOption, SetOption
from cosmos_cli.counted import counted
from cosmos_cli.doctor.case import Wants
from cosmos_cli.doctor.finding import HERE, Finding, Level, grouped
from cosmos_cli.doctor.judge import judge
from cosmos_cli.doctor.probe import ask, ask_here, case_of
from cosmos_cli.doctor.responder import Responder
from cosmos_cli.errors import ExitCode
from cosmos_cli.fleet.connection import Connection
from cosmos_cli.fleet.fleet import Fleet, fleet_of
from cosmos_cli.fleet.local import LocalConnection
from cosmos_cli.fleet.outcome import Outcome, failed
from cosmos_cli.fleet.pool import for_each
from cosmos_cli.fleet.target import Target
from cosmos_cli.models.inventory import Machine

FORKS_DEFAULT = 100
"""All at once: a machine is measured for some seconds, in which there is nothing to do here."""
COLUMNS = (
    Column("level"),
    Column("check"),
    Column("machines"),
    Column("found"),
    Column("cure"),
)
HERE_ADDRESS = "127.0.0.1"
LATENCY_S_UNKNOWN = 0.5e-3

Told = dict[str, Any]


def doctor(
    scenario: Annotated[
        Path | None,
        typer.Argument(metavar="[SCENARIO]", help="Scenario file: its wants are held against."),
    ] = None,
    inventory: Annotated[
        Path | None,
        typer.Option(
            "--inventory",
            "-i",
            metavar="FILE",
            envvar="COSMOS_INVENTORY",
            help="Inventory; without one this computer alone is looked at.",
        ),
    ] = None,
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
    fleet = fleet_of(inventory, limit, forks, accept_new_host_keys) if inventory else None
    examination = _Examination(console, fleet, scenario, set_ or ())
    console.say(f"measuring {_who(examination.wants.machines)}, some seconds each")
    outcomes = examination.outcomes()
    findings = {o.machine: examination.judge(o.machine, o.value) for o in outcomes if o.value}
    told = [finding for machine in findings.values() for finding in machine]
    _show(console, told, outcomes, is_all=all_)
    exit_code = _exit_code(told, outcomes, is_strict=strict)
    console.data(_verdict(told, outcomes, time.monotonic() - start_s))
    console.print_json(
        {
            "scenario": examination.wants.scenario,
            "machines": [_mapping(o, findings.get(o.machine, ())) for o in outcomes],
            "levels": {level.value: _count(told, level) for level in Level},
            "exit_code": int(exit_code),
        }
    )
    return int(exit_code)


class _Examination:
    """Asks every machine at once, and then this computer, which has nothing else to do by then."""

    def __init__(
        self,
        console: Console,
        fleet: Fleet | None,
        scenario: Path | None,
        overrides: Sequence[str],
    ) -> None:
        self._console = console
        self._fleet = fleet and _remote_part(fleet)
        self._scenario_file: Any = None
        self.wants = Wants(machines=len(self._fleet.targets) if self._fleet else 0)
        machines = fleet.machines if fleet else ()
        if scenario is not None:
            self._read_scenario(scenario, overrides, machines)
        affinity = _affinity(machines, self._scenario_file)
        self.wants = dataclasses.replace(self.wants, affinity=affinity)

    def _read_scenario(
        self, path: Path, overrides: Sequence[str], machines: Sequence[Machine]
    ) -> None:
        from cosmos_cli.models.loading import load_scenario  # pydantic models take a while
        from cosmos_cli.plan import LOOPBACK, make_plan

        file = self._scenario_file = load_scenario(path, overrides)
        plan = make_plan(file.scenario, machines or (LOOPBACK,), fault_at=file.fault)
        agents: dict[str, int] = {}
        for planned in plan.machines:
            name = HERE if planned.connection == "local" else planned.name
            agents[name] = agents.get(name, 0) + len(planned.agents)
        self.wants = Wants.of(file.scenario, agents, machines=self.wants.machines)

    def outcomes(self) -> list[Outcome[Told]]:
        """Return what every machine told, this computer first."""
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
                    return ask(connection, self.wants, responder, host_address=machine.host_address)

                outcomes = self._fleet.each(task)
        return [self._ask_here(own_addresses, outcomes), *outcomes]

    def judge(self, machine: str, told: Told) -> list[Finding]:
        """Return the findings of one machine."""
        return judge(case_of(machine, told, self.wants))

    def _ask_here(
        self, own_addresses: set[str], outcomes: Sequence[Outcome[Told]]
    ) -> Outcome[Told]:
        from cosmos_cli.doctor.here import interface_of, look_here
        from cosmos_cli.rundir import runs_root
        from madns_runtime.processes import state_directory

        target = Target(name=HERE, address=HERE_ADDRESS, connection="local", python=sys.executable)

        def task(target: Target) -> Told:
            interface = interface_of(min(own_addresses)) if own_addresses else "lo"
            told = ask_here(
                LocalConnection(target),
                self.wants,
                runs=os.path.abspath(runs_root()),
                state=str(state_directory().parent),
                interface=interface,
            )
            living = [entry["run_directory"] for entry in told["cosmos"]["living"]]
            told["here"] = look_here(living) | {"feasibility": self._feasibility(outcomes)}
            return told

        return for_each([target], task)[0]

    def _feasibility(self, outcomes: Sequence[Outcome[Told]]) -> dict[str, Any] | None:
        """Hold the four inequalities against the network as it was measured; None without a demand."""
        if self._scenario_file is None:
            return None
        from cosmos_cli.commands.plan import feasibility_of
        from cosmos_cli.feasibility import BITS_PER_BYTE, Resources

        trips_ms = [
            trip["p50_ms"]
            for outcome in outcomes
            if outcome.value and (trip := outcome.value["round_trips"]) and trip["p50_ms"]
        ]
        latency_s = max(trips_ms) / 2e3 if trips_ms else LATENCY_S_UNKNOWN
        resources = Resources(
            workers=self._scenario_file.scenario.executor.workers,
            bandwidth_bytes_s=1e9 / BITS_PER_BYTE,
            latency_s=latency_s,
        )
        found = feasibility_of(self._scenario_file, resources)
        return None if found is None else found.to_mapping()


def _affinity(machines: Sequence[Machine], scenario_file: Any) -> dict[str, tuple[int, ...]]:
    """Return the processors that agents are to use on each machine that has agents, where anybody says it."""
    common = scenario_file.scenario.scheduling.cpu_affinity if scenario_file else ()
    found: dict[str, tuple[int, ...]] = {} if machines else {HERE: common}
    for machine in machines:
        name = HERE if machine.connection == "local" else machine.name
        own = machine.cpu_affinity or common
        found[name] = tuple(sorted({*found.get(name, ()), *own}))
    return found


def _remote_part(fleet: Fleet) -> Fleet:
    """Return the fleet without this computer, which is looked at anyway."""
    targets = tuple(target for target in fleet.targets if target.connection != "local")
    return dataclasses.replace(fleet, targets=targets)


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
        if is_all or group.level != Level.OK
    ]
    if rows:
        console.table(COLUMNS, rows)


def _exit_code(
    findings: Sequence[Finding], outcomes: Sequence[Outcome[Told]], *, is_strict: bool
) -> ExitCode:
    if failed(outcomes):
        return ExitCode.MACHINES
    bad = {Level.ERROR, Level.WARNING} if is_strict else {Level.ERROR}
    return ExitCode.RUN_FAILED if any(f.level in bad for f in findings) else ExitCode.OK


def _verdict(
    findings: Sequence[Finding], outcomes: Sequence[Outcome[Told]], duration_s: float
) -> str:
    parts = [
        counted(number, level.value)
        for level in (Level.ERROR, Level.WARNING, Level.NOTE)
        if (number := len([g for g in grouped(findings) if g.level == level]))
    ]
    bad = len(failed(outcomes))
    parts += [f"{bad} failed"] if bad else []
    who = _who(len(outcomes) - 1)
    return f"{who}: {', '.join(parts) or 'nothing to cure'} in {duration_s:.1f} s"


def _who(machines: int) -> str:
    return f"{counted(machines, 'machine')} and {HERE}" if machines else HERE


def _count(findings: Sequence[Finding], level: Level) -> int:
    return sum(finding.level == level for finding in findings)


def _mapping(outcome: Outcome[Told], findings: Sequence[Finding]) -> dict[str, Any]:
    return outcome.to_mapping(
        {"findings": [finding.to_mapping() for finding in findings], "probed": outcome.value}
    )
