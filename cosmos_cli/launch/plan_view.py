"""Plan and feasibility of a run, as `cosmos plan` and `cosmos run --check` show them."""

from __future__ import annotations

import dataclasses
import math
import socket
import statistics
import time
from collections.abc import Sequence
from typing import Any

from cosmos_cli.launch.capacity import Capacity
from cosmos_cli.launch.feasibility import (
    BITS_PER_BYTE,
    Feasibility,
    Inequality,
    Resources,
    finite,
    judge,
    sendings_of,
)
from cosmos_cli.launch.plan import LaunchPlan
from cosmos_cli.models.loading import ScenarioFile
from cosmos_cli.models.planning import Planning
from cosmos_cli.ui.console import Column, Console
from cosmos_cli.ui.plural import counted
from madns_runtime.config import DeviceLaunch
from madns_runtime.lockstep.partition import processors_here
from madns_runtime.plugin.api import Demand, Flow

LATENCY_MS_UNKNOWN = 0.5
"""One way over a switch: the thesis's 1 ms is a bound, its own network was quicker."""
BANDWIDTH_MBIT_DEFAULT = 1000.0
PROBES = 64
PROBE_TIMEOUT_S = 0.05
FRAMEWORK_FLOWS = (
    Flow(name="ping", message_bytes=250, rate_hz=4.0),
    Flow(name="pong", message_bytes=40, rate_hz=4.0),
    Flow(name="acknowledgements", message_bytes=1, rate_hz=4.0),
)
"""Signs of life with telemetry and clock exchange, and datagrams that acknowledge and hold nothing else: those that find
no message to travel with, which are no more than there are pings where messages go both ways."""
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
FLOWS = (
    Column("of one agent"),
    Column("bytes on the wire", is_number=True),
    Column("Hz", is_number=True),
    Column("within s", is_number=True),
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


def demand_of(scenario_file: ScenarioFile) -> Demand | None:
    """
    Return what is asked of host and network for one agent, the framework's own messages as well.

    What the scenario's section `plan` gives takes the place of what the simulation says; None if neither says anything.
    """
    given = scenario_file.scenario.plan
    if given.says_all:
        return given.applied_to(None)
    if not scenario_file.has_demand:
        return None
    demand = scenario_file.demand()
    demand = dataclasses.replace(demand, flows=(*demand.flows, *FRAMEWORK_FLOWS))
    return given.applied_to(demand)


def resources_of(
    scenario_file: ScenarioFile, launch_plan: LaunchPlan, latency_s: float
) -> Resources:
    """Return what host and network offer by the scenario, over a link of BANDWIDTH_MBIT_DEFAULT if it names none."""
    scenario, given = scenario_file.scenario, scenario_file.scenario.plan
    host = launch_plan.host
    is_here = (host is None or host.connection == "local") and not scenario.executor.address
    return Resources(
        workers=given.workers or scenario.executor.workers,
        bandwidth_bytes_s=(given.bandwidth_mbit or BANDWIDTH_MBIT_DEFAULT) * 1e6 / BITS_PER_BYTE,
        latency_s=latency_s,
        maneuvers_at_once=given.maneuvers_at_once,
        has_headers=given.has_headers,
        processors=processors_here() if is_here else None,
    )


def feasibility_of(
    scenario_file: ScenarioFile, resources: Resources, demand: Demand
) -> Feasibility:
    """Hold a scenario's agents against what its simulation asks for."""
    agents = scenario_file.scenario.agents
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


def show_flows(console: Console, demand: Demand, resources: Resources) -> None:
    """Print what travels for one agent, and the sizes of states, batches and buffer."""
    console.data("")
    rows = [
        (each.name, f"{each.wire_bytes:g}", f"{each.rate_hz:.4g}", f"{each.within_s:.4g}")
        for each in sendings_of(demand, resources)
    ]
    console.table(FLOWS, rows)
    sizes = (
        ("a state", demand.state_bytes),
        ("S_a", demand.buffer_bytes),
        ("S_b", demand.batch_bytes),
        ("S_sync", demand.sync_bytes),
    )
    told = ", ".join(f"{name} = {size:,} B" for name, size in sizes if size)
    times = (("T_p(S_b)", demand.batch_compute_s), ("T_p(S_sync)", demand.sync_compute_s))
    told_s = ", ".join(f"{name} = {time_s * 1e3:.3g} ms" for name, time_s in times if time_s)
    if told or told_s:
        console.data("; ".join(text for text in (told, told_s) if text))


def buffer_words(given: Planning, demand: Demand) -> str | None:
    """Say that a given S_a holds no batch; None if it does, or none is given: a simulation's own fits its batches."""
    if not given.buffer_bytes or demand.batch_bytes <= given.buffer_bytes:
        return None
    return (
        f"plan.buffer_bytes: a buffer of {given.buffer_bytes:,} B (S_a) does not hold a batch of {demand.batch_bytes:,} B (S_b),"
        f" so that no agent can go on for T_bi = {demand.buffer_s:g} s; correct buffer_bytes, or batch_bytes and buffer_s"
    )


def demand_mapping(demand: Demand, resources: Resources) -> dict[str, Any]:
    """Return a demand as plain values, its flows as they travel and maneuvers among them; null stands for infinity."""
    figures = {
        field.name: getattr(demand, field.name)
        for field in dataclasses.fields(demand)
        if field.name != "flows"
    }
    flows = [
        {
            "name": each.name,
            "wire_bytes": each.wire_bytes,
            "rate_hz": each.rate_hz,
            "within_s": finite(each.within_s),
            "senders_max": finite(each.senders_max),
        }
        for each in sendings_of(demand, resources)
    ]
    return {
        **{name: finite(value) for name, value in figures.items()},
        "measured": demand.measured,
        "flows": flows,
    }


def show_feasibility(  # noqa: PLR0913 - what is printed, and two more by name
    console: Console,
    feasibility: Feasibility | None,
    resources: Resources,
    latency_source: str,
    *,
    missing: Sequence[str] = tuple(Planning().missing),
    capacity: Capacity | None = None,
) -> None:
    """Print the four inequalities, and what comes of them; None for a simulation without a demand: what is *missing* then."""
    if feasibility is None:
        console.data(
            "inequalities: this simulation does not say what it asks for (demand); the scenario's section plan"
            f" can, with {', '.join(missing)}"
        )
        return
    console.data("")
    console.table(INEQUALITIES, [_row(item) for item in feasibility.inequalities])
    compute = _compute_words(feasibility)
    fewer = (
        f" (of {resources.workers} workers: no more run at once on {counted(feasibility.workers, 'processor')})"
        if feasibility.workers < resources.workers
        else ""
    )
    console.data(
        f"N_p = {feasibility.workers}{fewer}, T_n = {resources.latency_s * 1e3:.3g} ms ({latency_source}), "
        f"B_n = {resources.bandwidth_bytes_s * BITS_PER_BYTE / 1e6:g} Mbit/s, compute times {compute}"
    )
    console.data(verdict_words(feasibility, capacity))


def _compute_words(feasibility: Feasibility) -> str:
    """Say where compute times are from, and T_p(S_b) of how many agents at once: it is less of each of more."""
    if not feasibility.measured:
        return "declared"
    has_batches = any(item.number == "2.7" and item.applies for item in feasibility.inequalities)
    of = f", T_p(S_b) with {counted(feasibility.agents, 'agent')} at once" if has_batches else ""
    return f"measured here{of}"


def verdict_words(feasibility: Feasibility, capacity: Capacity | None = None) -> str:
    """Say whether the agents keep real time, and what limits their number; *capacity* is the prediction, if there is one."""
    agents, binding = counted(feasibility.agents, "agent"), feasibility.binding
    if not feasibility.holds:
        return f"{agents} cannot keep real time: {broken_words(feasibility)}"
    if capacity is not None and feasibility.agents > capacity.agents:
        return (
            f"{agents} may not keep real time: the inequalities hold, but up to {capacity.agents:.0f} are predicted, by"
            f" {capacity.binding.name}; `cosmos bench capacity` tells"
        )
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
