"""Plan and feasibility of a run, as `cosmos plan` and `cosmos run --check` show them."""

from __future__ import annotations

import dataclasses
import math
import socket
import statistics
import time
from collections.abc import Sequence

from cosmos_cli.launch.feasibility import BITS_PER_BYTE, Feasibility, Inequality, Resources, judge
from cosmos_cli.launch.plan import LaunchPlan
from cosmos_cli.models.loading import ScenarioFile
from cosmos_cli.ui.console import Column, Console
from cosmos_cli.ui.plural import counted
from madns_runtime.config import DeviceLaunch
from madns_runtime.plugin.api import Flow

LATENCY_MS_UNKNOWN = 0.5
"""One way over a switch: the thesis's 1 ms is a bound, its own network was quicker."""
BANDWIDTH_MBIT_DEFAULT = 1000.0
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


def feasibility_of(scenario_file: ScenarioFile, resources: Resources) -> Feasibility | None:
    """Return None for a simulation that does not tell what it asks for."""
    if not scenario_file.has_demand:
        return None
    agents, demand = scenario_file.scenario.agents, scenario_file.demand()
    demand = dataclasses.replace(demand, flows=(*demand.flows, *FRAMEWORK_FLOWS))
    return judge(demand, resources, agents=agents.count, tick_hz=agents.tick_hz)


def latency_of(launch_plan: LaunchPlan, *, given_ms: float | None = None) -> tuple[float, str]:
    """Return the one-way time of a datagram, s, and where it is from: given, measured here, or assumed."""
    if given_ms is not None:
        return given_ms / 1e3, "given"
    measured_s = measure_loopback_s() if not launch_plan.elsewhere else None
    if measured_s is not None:
        return measured_s, "measured on loopback"
    return LATENCY_MS_UNKNOWN / 1e3, "assumed"


def measure_loopback_s() -> float | None:
    """Return the median time of a datagram from socket to socket on this computer; None if none came."""
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


def show_placement(
    console: Console, launch_plan: LaunchPlan, devices: Sequence[DeviceLaunch] = ()
) -> None:
    """Print who runs where, and who uses which device; the plan's notes are left to the caller."""
    rows = [
        (
            machine.name,
            machine.machine.address,
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
    for device in devices:
        console.data(f"{device.full_name} ({device.kind}): {', '.join(device.users)}")


def show_feasibility(
    console: Console, feasibility: Feasibility | None, resources: Resources, latency_source: str
) -> None:
    """Print the four inequalities, and what comes of them; None for a simulation without a demand."""
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
    console.data(verdict_words(feasibility))


def verdict_words(feasibility: Feasibility) -> str:
    """Say whether the agents keep real time, and what limits their number."""
    agents, binding = counted(feasibility.agents, "agent"), feasibility.binding
    if not feasibility.holds:
        return f"{agents} cannot keep real time: {broken_words(feasibility)}"
    limit = (
        "is the closest, and sets no limit in agents"
        if math.isinf(binding.breaks_at)
        else f"binds first, at {binding.breaks_at:g} agents"
    )
    verb = "keeps" if feasibility.agents == 1 else "keep"
    return f"{agents} {verb} real time; {binding.number} {limit}"


def broken_words(feasibility: Feasibility) -> str:
    """Name the inequalities that are broken: inequality 2.10 is broken; inequalities 2.8 and 2.9 are broken."""
    *others, last = [item.number for item in feasibility.inequalities if not item.holds]
    if not others:
        return f"inequality {last} is broken"
    return f"inequalities {', '.join(others)} and {last} are broken"


def _ends(names: tuple[str, ...]) -> str:
    return ", ".join(names) if len(names) <= 3 else f"{names[0]} ... {names[-1]}"


def _row(item: Inequality) -> tuple[str, ...]:
    if not item.applies:
        return (item.number, "", item.relation, "", item.unit, "", "does not apply", "", item.name)
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
