"""`cosmos plan`: show who would run where, and whether it can keep real time."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Annotated

import typer

from cosmos_cli.commands.fleet_options import (
    HostOption,
    LimitOption,
    SomeInventoryOption,
    some_machines,
)
from cosmos_cli.console import Column, Console, JsonOption, SetOption
from cosmos_cli.counted import counted
from cosmos_cli.errors import ExitCode
from cosmos_cli.feasibility import BITS_PER_BYTE, Feasibility, Inequality, Resources, judge
from cosmos_cli.models.loading import ScenarioFile, load_scenario
from cosmos_cli.plan import LaunchPlan, make_plan
from madns_runtime.lockstep.shares import processors_here
from madns_runtime.plugin.api import Flow
from madns_runtime.plugin.questions import ask_demand

LATENCY_MS_UNKNOWN = 0.5
"""One way over a switch: the thesis's 1 ms is a bound, its own network was quicker."""
PROBES = 64
PROBE_TIMEOUT_S = 0.05
FRAMEWORK_FLOWS = (
    Flow(name="ping", message_bytes=250, rate_hz=4.0),
    Flow(name="pong", message_bytes=40, rate_hz=4.0),
)
"""Signs of life and clock exchange, which every agent needs beside the simulation's own messages."""
LOCKSTEP_WORDS = (
    "lockstep: the host runs the agents in these processes here, as fast as they allow;"
    " the inequalities of real time do not apply"
)
PLACEMENT = (
    Column("machine"),
    Column("address"),
    Column("agents", is_number=True),
    Column("processes", is_number=True),
    Column("names"),
)
INEQUALITIES = (
    Column("eq."),
    Column("left", is_number=True),
    Column(""),
    Column("right", is_number=True),
    Column("unit"),
    Column("margin", is_number=True),
    Column("holds"),
    Column("breaks at agents", is_number=True),
    Column("what"),
)


def plan(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="Scenario file.")],
    inventory: SomeInventoryOption = None,
    limit: LimitOption = None,
    host: HostOption = None,
    set_: SetOption = None,
    bandwidth_mbit: Annotated[
        float, typer.Option(min=0.001, help="Bandwidth of the host's link, Mbit/s (B_n).")
    ] = 1000.0,
    latency_ms: Annotated[
        float | None,
        typer.Option(min=0.0, help="One-way time of a datagram, ms (T_n); measured on loopback."),
    ] = None,
    workers: Annotated[
        int | None,
        typer.Option(min=1, help="Workers that propagate (N_p), instead of the scenario's."),
    ] = None,
    maneuvers_at_once: Annotated[
        int | None,
        typer.Option(min=1, help="Maneuvers at one instant at worst; one of every agent."),
    ] = None,
    json: JsonOption = False,
) -> None:
    """Show which machine runs which agents, and the four inequalities of real time."""
    console = Console(json=json)
    scenario_file = load_scenario(file, set_ or ())
    launch_plan = make_plan(
        scenario_file.scenario,
        some_machines(inventory, limit, host),
        host=host,
        fault_at=scenario_file.fault,
        processors=processors_here(),
    )
    latency_s, latency_source = _latency(latency_ms, launch_plan)
    resources = Resources(
        workers=workers or scenario_file.scenario.executor.workers,
        bandwidth_bytes_s=bandwidth_mbit * 1e6 / BITS_PER_BYTE,
        latency_s=latency_s,
        maneuvers_at_once=maneuvers_at_once,
    )
    is_lockstep = launch_plan.is_lockstep
    feasibility = None if is_lockstep else feasibility_of(scenario_file, resources)
    _show_placement(console, launch_plan)
    if is_lockstep:
        console.data(LOCKSTEP_WORDS)
    else:
        _show_feasibility(console, feasibility, resources, latency_source)
    console.print_json(
        {
            "plan": launch_plan.to_mapping(),
            "resources": dataclasses.asdict(resources) | {"latency_source": latency_source},
            "feasibility": feasibility.to_mapping() if feasibility else None,
        }
    )
    if feasibility and not feasibility.holds:
        raise typer.Exit(ExitCode.BUDGET_BROKEN)


def feasibility_of(scenario_file: ScenarioFile, resources: Resources) -> Feasibility | None:
    """Return None for a simulation that does not tell what it asks for."""
    simulation, agents = scenario_file.simulation, scenario_file.scenario.agents
    if simulation.demand is None:
        return None
    demand = ask_demand(
        simulation.demand,
        scenario_file.base_directory,
        parameters=scenario_file.parameters,
        agents=agents.count,
        tick_hz=agents.tick_hz,
    )
    demand = dataclasses.replace(demand, flows=(*demand.flows, *FRAMEWORK_FLOWS))
    return judge(demand, resources, agents=agents.count, tick_hz=agents.tick_hz)


def _latency(latency_ms: float | None, launch_plan: LaunchPlan) -> tuple[float, str]:
    if latency_ms is not None:
        return latency_ms / 1e3, "given"
    measured_s = measure_loopback_s() if launch_plan.is_local else None
    if measured_s is not None:
        return measured_s, "measured on loopback"
    return LATENCY_MS_UNKNOWN / 1e3, "assumed"


def measure_loopback_s() -> float | None:
    """Return the median time of a datagram from socket to socket on this computer; None if none came."""
    import socket
    import statistics
    import time

    times: list[float] = []
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender,
    ):
        try:
            receiver.bind(("127.0.0.1", 0))
            receiver.settimeout(PROBE_TIMEOUT_S)
            for _ in range(PROBES):
                start_s = time.perf_counter()
                sender.sendto(b"probe", receiver.getsockname())
                receiver.recv(16)
                times.append(time.perf_counter() - start_s)
        except OSError:
            return None
    return statistics.median(times)


def _show_placement(console: Console, launch_plan: LaunchPlan) -> None:
    rows = [
        (
            machine.name,
            machine.address,
            str(len(machine.agents)),
            str(len(machine.processes)),
            _ends(machine.agents),
        )
        for machine in launch_plan.machines
    ]
    console.table(PLACEMENT, rows)
    if launch_plan.host:
        console.data(f"the host runs on {launch_plan.host.name}")
    if launch_plan.idle:
        console.data(f"without an agent: {', '.join(launch_plan.idle)}")
    for note in launch_plan.notes:
        console.say(f"note: {note}")


def _ends(names: tuple[str, ...]) -> str:
    return ", ".join(names) if len(names) <= 3 else f"{names[0]} ... {names[-1]}"


def _show_feasibility(
    console: Console, feasibility: Feasibility | None, resources: Resources, latency_source: str
) -> None:
    if feasibility is None:
        console.data("inequalities: this simulation does not say what it asks for (demand)")
        return
    console.data("")
    console.table(INEQUALITIES, [_row(item) for item in feasibility.inequalities])
    compute = "measured here" if feasibility.measured else "declared"
    console.data(
        f"N_p = {resources.workers}, T_n = {resources.latency_s * 1e3:.3g} ms ({latency_source}), "
        f"B_n = {resources.bandwidth_bytes_s * BITS_PER_BYTE / 1e6:g} Mbit/s, compute times {compute}"
    )
    console.data(_verdict(feasibility))


def _verdict(feasibility: Feasibility) -> str:
    agents, binding = counted(feasibility.agents, "agent"), feasibility.binding
    if not feasibility.holds:
        broken = ", ".join(item.number for item in feasibility.inequalities if not item.holds)
        return f"{agents} cannot keep real time: inequality {broken} is broken"
    limit = f"binds first, at {binding.breaks_at:g} agents"
    if math.isinf(binding.breaks_at):
        limit = "is the closest, and sets no limit in agents"
    verb = "keeps" if feasibility.agents == 1 else "keep"
    return f"{agents} {verb} real time; {binding.number} {limit}"


def _row(item: Inequality) -> tuple[str, ...]:
    return (
        item.number,
        f"{item.left:.4g}",
        item.relation,
        f"{item.right:.4g}",
        item.unit,
        f"{item.margin:.4g}",
        "yes" if item.holds else "NO",
        "never" if math.isinf(item.breaks_at) else f"{item.breaks_at:.0f}",
        item.name,
    )
