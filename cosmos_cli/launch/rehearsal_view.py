"""`cosmos run --check` as it is shown: the plan, one line per machine, what stands in the way, and what `up` would do."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from cosmos_cli.errors import CosmosError, ExitCode
from cosmos_cli.fleet.connection import Connection
from cosmos_cli.fleet.fleet import Fleet
from cosmos_cli.fleet.helper import Helper
from cosmos_cli.fleet.liveness import SilenceWatch
from cosmos_cli.fleet.outcome import Outcome, failure_teller
from cosmos_cli.fleet.target import target_of
from cosmos_cli.launch.capacity import Capacity, predict_capacity
from cosmos_cli.launch.capacity_view import computers_of
from cosmos_cli.launch.feasibility import Feasibility, Resources
from cosmos_cli.launch.plan import LaunchPlan
from cosmos_cli.launch.plan_view import (
    LOCKSTEP_WORDS,
    broken_words,
    demand_of,
    feasibility_of,
    latency_of,
    resources_of,
    show_feasibility,
    show_placement,
)
from cosmos_cli.launch.rehearsal import (
    MachineRehearsal,
    Obstacle,
    Rehearsal,
    unready,
)
from cosmos_cli.provision import HELPER_PARTS, up_table
from cosmos_cli.provision.udp_echo import Echo
from cosmos_cli.provision.up import FleetUp, UpOptions
from cosmos_cli.provision.up_view import UpView
from cosmos_cli.ui.console import Column, Console
from cosmos_cli.ui.plural import counted
from cosmos_cli.ui.sizes import size_words
from madns_runtime.errors import MadnsError

COLUMNS = (
    Column("machine"),
    Column("agents", is_number=True),
    Column("ssh ms", is_number=True),
    Column("arch"),
    Column("python"),
    Column("packages"),
    Column("code"),
    Column("free", is_number=True),
    Column("udp ms", is_number=True),
    Column("lives"),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Asked:
    """Arguments as they were typed, for the commands that are named."""

    scenario: Path
    inventory: tuple[str, ...]
    limit: str | None
    host: str | None

    @property
    def up_command(self) -> str:
        """Return the `cosmos up` that makes this run's machines ready."""
        words = ["cosmos", "up", *(word for source in self.inventory for word in ("-i", source))]
        words += ["--limit", self.limit] if self.limit else []
        words += ["--host", self.host] if self.host else []
        words += [] if self.inventory else ["-i", "INVENTORY"]
        return shlex.join([*words, str(self.scenario)])


def check_run(console: Console, rehearsal: Rehearsal, asked: Asked) -> int:
    """
    Ask and show what the run would meet.

    Returns:
        0 if it can start, 2 for what is wrong here, 3 when a machine is unreachable or not ready.
    """
    here = rehearsal.obstacles_here()
    outcomes = rehearsal.machines(failure_teller(console.say), console.say)
    there = unready(outcomes, asked.up_command)
    planned = _up_lines(console, rehearsal, asked, outcomes)
    rows = [_row(outcome.machine, outcome.value) for outcome in outcomes if outcome.value]
    pace = pace_of(rehearsal, outcomes)
    for note in rehearsal.plan.notes:
        console.warn(note)
    show_placement(console, rehearsal.plan)
    pace.show(console)
    if rows:
        console.table(COLUMNS, rows)
    if planned:
        is_needed = any(o.value and not o.value.has_environment for o in outcomes)
        need = "is needed first" if is_needed else "is not needed, for a run sends code itself"
        console.data(f"{asked.up_command}\n{need}; it would do on")
    for line in planned:
        console.data(f"  {line}")
    for obstacle in here:
        console.data(f"this computer: {obstacle}")
    for machine, obstacles in there.items():
        for obstacle in obstacles:
            console.data(f"{machine}: {obstacle}")
    exit_code = ExitCode.MACHINES if there else ExitCode.BAD_INPUT if here else ExitCode.OK
    console.data(_verdict(rehearsal.plan, here, there, pace))
    console.print_json(
        {
            "plan": rehearsal.plan.to_mapping(),
            "feasibility": pace.feasibility.to_mapping() if pace.feasibility else None,
            "capacity": pace.capacity.to_mapping() if pace.capacity else None,
            "warnings": list(pace.warnings),
            "here": [asdict(obstacle) for obstacle in here],
            "machines": [_mapping(outcome, there) for outcome in outcomes],
            "up": {"command": asked.up_command, "steps": planned} if planned else None,
            "exit_code": int(exit_code),
        }
    )
    return int(exit_code)


def _up_lines(
    console: Console,
    rehearsal: Rehearsal,
    asked: Asked,
    outcomes: Sequence[Outcome[MachineRehearsal]],
) -> list[str]:
    """Return what `cosmos up` would do on the machines that answered, as its --check shows it."""
    answered = {outcome.machine for outcome in outcomes if outcome.is_ok}
    machines = tuple(m for m in rehearsal.plan.elsewhere if m.name in answered)
    if not machines:
        return []
    fleet = Fleet(
        targets=tuple(map(target_of, machines)),
        forks=rehearsal.forks,
        options=rehearsal.options,
        load=lambda: machines,
    )
    host = rehearsal.plan.host.name if rehearsal.plan.host else None
    options = UpOptions(is_check=True, host=host if host in answered else None)
    quiet = Console(json=console.json, quiet=True)
    try:
        with Echo() as echo, UpView(quiet, [machine.name for machine in machines]) as view:
            fleet_up = FleetUp(fleet, [asked.scenario], options, echo=echo, view=view)

            def plan_one(connection: Connection) -> up_table.MachineResult | None:
                watch = SilenceWatch(connection)
                with Helper.start(connection, HELPER_PARTS, watch=watch) as helper:
                    return fleet_up.bring(connection, helper)

            results = [up_table.result_of(outcome) for outcome in fleet.each_target(plan_one)]
    except CosmosError as error:
        console.warn(f"what `cosmos up` would do is not known: {error}")
        return []
    return list(up_table.plan_lines(results, has_diffs=False))


def _row(machine: str, told: MachineRehearsal) -> tuple[str, ...]:
    udp = "-" if not told.is_udp_tried else "none"
    return (
        machine,
        f"{told.agents}{' + host' if told.is_host else ''}",
        f"{told.opening_ms:.1f}",
        told.facts.board.machine,
        ".".join(map(str, told.facts.python.version)),
        "ready" if told.has_environment else "MISSING",
        f"{counted(told.files_missing, 'file')} to send" if told.files_missing else "there",
        size_words(told.facts.disk.free_bytes),
        udp if told.round_trip_ms is None else f"{told.round_trip_ms:.2f}",
        ", ".join(told.living),
    )


def _mapping(
    outcome: Outcome[MachineRehearsal], there: dict[str, list[Obstacle]]
) -> dict[str, Any]:
    obstacles = [asdict(obstacle) for obstacle in there.get(outcome.machine, ())]
    found = outcome.value.to_mapping() if outcome.value else {}
    return outcome.to_mapping({"is_ready": not obstacles, "obstacles": obstacles, **found})


def _verdict(
    plan: LaunchPlan,
    here: Sequence[Obstacle],
    there: dict[str, list[Obstacle]],
    pace: RehearsedPace,
) -> str:
    agents = sum(len(names) for names in plan.agents_by_machine.values())
    machines = len(plan.elsewhere)
    where = f"on {counted(machines, 'machine')}" if machines else "on this computer"
    what = f"{counted(agents, 'agent')} {where}"
    if not here and not there:
        doubt = "".join(f", but {warning}" for warning in pace.warnings)
        return f"READY: {what}{doubt}; nothing was changed"
    parts = [counted(len(there), "machine")] if there else []
    parts += ["this computer"] if here else []
    return f"NOT READY: {what}: {' and '.join(parts)} would fail; nothing was changed"


@dataclass(frozen=True, slots=True, kw_only=True)
class RehearsedPace:
    """
    Whether the run could keep real time: the four inequalities, with datagrams as they were measured.

    A broken one is a warning. `cosmos run` starts such a run as well, and its verdict tells what it reached.
    """

    feasibility: Feasibility | None = None
    """None in lockstep, and where it is not known."""
    capacity: Capacity | None = None
    """Prediction of processors and buffers as well; None where there is no feasibility."""
    resources: Resources
    latency_source: str
    is_lockstep: bool
    unknown: str = ""
    """Why it is not known, if the simulation was asked in vain."""

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings for a person before the run."""
        if self.unknown:
            return (f"whether it keeps real time is not known: {self.unknown}",)
        if self.feasibility is None:
            return ()
        if not self.feasibility.holds:
            told = broken_words(self.feasibility)
            return (
                f"it cannot keep real time ({told}; `cosmos plan` shows up to how many agents)",
            )
        if self.capacity is not None and self.feasibility.agents > self.capacity.agents:
            fewer = f"up to {self.capacity.agents:.0f} agents are predicted, by {self.capacity.binding.name}"
            return (f"it may not keep real time ({fewer}; `cosmos bench capacity` tells)",)
        return ()

    def show(self, console: Console) -> None:
        """Print them."""
        if self.is_lockstep:
            console.data(LOCKSTEP_WORDS)
        elif not self.unknown:
            show_feasibility(
                console,
                self.feasibility,
                self.resources,
                self.latency_source,
                capacity=self.capacity,
            )


def pace_of(rehearsal: Rehearsal, outcomes: Sequence[Outcome[MachineRehearsal]]) -> RehearsedPace:
    """Hold the plan's agents against what the slowest machine's datagrams took, over a link of 1 Gbit/s."""
    trips_ms = [
        outcome.value.round_trip_ms
        for outcome in outcomes
        if outcome.value and outcome.value.round_trip_ms is not None
    ]
    if trips_ms:
        latency_s, source = max(trips_ms) / 2e3, "measured"
    else:
        given_ms = rehearsal.scenario.scenario.plan.latency_ms
        latency_s, source = latency_of(rehearsal.plan, given_ms=given_ms)
    resources = resources_of(rehearsal.scenario, rehearsal.plan, latency_s)
    feasibility, capacity, unknown = None, None, ""
    if not rehearsal.plan.is_lockstep:
        try:
            demand = demand_of(rehearsal.scenario)
            if demand is not None:
                feasibility = feasibility_of(rehearsal.scenario, resources, demand)
                computers = computers_of(rehearsal.plan)
                scenario = rehearsal.scenario.scenario
                capacity = predict_capacity(scenario, demand, computers, resources)
        except (CosmosError, MadnsError) as error:
            unknown = str(error)  # a run does not ask it
    return RehearsedPace(
        feasibility=feasibility,
        capacity=capacity,
        resources=resources,
        latency_source=source,
        is_lockstep=rehearsal.plan.is_lockstep,
        unknown=unknown,
    )
