"""`cosmos plan`: show who would run where, and whether it can keep real time."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from cosmos_cli.commands.fleet_command import (
    HostOption,
    LimitOption,
    SomeInventoryOption,
    some_machines,
)
from cosmos_cli.errors import ExitCode, InputError
from cosmos_cli.launch.capacity import Capacity, predict_capacity
from cosmos_cli.launch.capacity_view import computers_of, show_capacity
from cosmos_cli.launch.device_plan import plan_devices
from cosmos_cli.launch.feasibility import BITS_PER_BYTE, Feasibility, Resources
from cosmos_cli.launch.place_plan import check_places
from cosmos_cli.launch.plan import LaunchPlan, make_plan
from cosmos_cli.launch.plan_view import (
    LOCKSTEP_WORDS,
    buffer_words,
    demand_mapping,
    demand_of,
    feasibility_of,
    latency_of,
    resources_of,
    show_feasibility,
    show_flows,
    show_placement,
)
from cosmos_cli.models.loading import ScenarioFile, load_scenario
from cosmos_cli.models.planning import COUNT_MAX
from cosmos_cli.ui.console import Console, JsonOption, SetOption
from madns_runtime.config import DeviceLaunch
from madns_runtime.lockstep.partition import processors_here
from madns_runtime.plugin.api import Demand

FileArgument = Annotated[Path, typer.Argument(metavar="FILE", help="Scenario file.")]
BandwidthOption = Annotated[
    float | None,
    typer.Option(min=0.001, help="Bandwidth of the host's link, Mbit/s (B_n); 1000."),
]
LatencyOption = Annotated[
    float | None,
    typer.Option(min=0.0, help="One-way time of a datagram, ms (T_n); measured on loopback."),
]
WorkersOption = Annotated[
    int | None,
    typer.Option(
        min=1, max=COUNT_MAX, help="Workers that propagate (N_p), instead of the scenario's."
    ),
]
ManeuversOption = Annotated[
    int | None,
    typer.Option(
        min=1, max=COUNT_MAX, help="Maneuvers at one instant at worst; one of every agent."
    ),
]


def plan(
    file: FileArgument,
    inventory: SomeInventoryOption = None,
    limit: LimitOption = None,
    host: HostOption = None,
    set_: SetOption = None,
    bandwidth_mbit: BandwidthOption = None,
    latency_ms: LatencyOption = None,
    workers: WorkersOption = None,
    maneuvers_at_once: ManeuversOption = None,
    json: JsonOption = False,
) -> None:
    """Show which machine runs which agents, the four inequalities of real time, and how many agents fit."""
    console = Console(json=json)
    scenario_file = load_scenario(file, set_ or (), warn=console.warn)
    launch_plan = make_plan(
        scenario_file.scenario,
        some_machines(inventory, limit, host),
        host=host,
        fault_at=scenario_file.fault,
        processors=processors_here(),
        labels=scenario_file.labels,
    )
    check_places(scenario_file, launch_plan)
    given_here = {bandwidth_mbit, latency_ms, workers, maneuvers_at_once}
    if launch_plan.is_lockstep and given_here != {None}:
        raise InputError(
            "--bandwidth-mbit, --latency-ms, --workers and --maneuvers-at-once say what real time has to"
            " bear; in lockstep none of it applies"
        )
    given = scenario_file.scenario.plan
    latency_s, latency_source = latency_of(
        launch_plan, given_ms=given.latency_ms if latency_ms is None else latency_ms
    )
    offered = resources_of(scenario_file, launch_plan, latency_s)
    resources = dataclasses.replace(
        offered,
        workers=workers or offered.workers,
        maneuvers_at_once=maneuvers_at_once or offered.maneuvers_at_once,
        bandwidth_bytes_s=offered.bandwidth_bytes_s
        if bandwidth_mbit is None
        else bandwidth_mbit * 1e6 / BITS_PER_BYTE,
    )
    outlook = _Outlook.of(scenario_file, launch_plan, resources, latency_source)
    if outlook.demand is not None and (words := buffer_words(given, outlook.demand)):
        console.warn(words)
    devices = list(itertools.chain(*plan_devices(scenario_file, launch_plan).values()))
    _show(console, launch_plan, devices, outlook, missing=given.missing)
    if outlook.feasibility and not outlook.feasibility.holds:
        raise typer.Exit(ExitCode.BUDGET_BROKEN)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Outlook:
    """The load of real time on a plan's computers, and whether they can bear it; nothing is asked in lockstep."""

    resources: Resources
    latency_source: str
    demand: Demand | None = None
    feasibility: Feasibility | None = None
    capacity: Capacity | None = None

    @classmethod
    def of(
        cls,
        scenario_file: ScenarioFile,
        launch_plan: LaunchPlan,
        resources: Resources,
        latency_source: str,
    ) -> _Outlook:
        """Judge a plan."""
        demand = None if launch_plan.is_lockstep else demand_of(scenario_file)
        if demand is None:
            return cls(resources=resources, latency_source=latency_source)
        computers = computers_of(launch_plan)
        return cls(
            resources=resources,
            latency_source=latency_source,
            demand=demand,
            feasibility=feasibility_of(scenario_file, resources, demand),
            capacity=predict_capacity(scenario_file.scenario, demand, computers, resources),
        )


def _show(
    console: Console,
    launch_plan: LaunchPlan,
    devices: Sequence[DeviceLaunch],
    outlook: _Outlook,
    *,
    missing: Sequence[str],
) -> None:
    """Print the plan, and below it what real time asks of it."""
    resources, feasibility, capacity = outlook.resources, outlook.feasibility, outlook.capacity
    show_placement(console, launch_plan, devices)
    for note in launch_plan.notes:
        console.say(f"note: {note}")
    if launch_plan.is_lockstep:
        console.data(LOCKSTEP_WORDS)
    else:
        if outlook.demand is not None and capacity is not None:
            show_flows(console, outlook.demand, resources)
            show_capacity(console, capacity)
        show_feasibility(
            console,
            feasibility,
            resources,
            outlook.latency_source,
            missing=missing,
            capacity=capacity,
        )
    source = {"latency_source": outlook.latency_source}
    console.print_json(
        {
            "plan": launch_plan.to_mapping(),
            "devices": [dataclasses.asdict(device) for device in devices],
            "resources": dataclasses.asdict(resources) | source,
            "demand": demand_mapping(outlook.demand, resources) if outlook.demand else None,
            "feasibility": feasibility.to_mapping() if feasibility else None,
            "capacity": capacity.to_mapping() if capacity else None,
        }
    )
