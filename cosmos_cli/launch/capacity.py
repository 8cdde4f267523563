"""
How many agents fit: the largest number that each limit allows, predicted. Pure.

    capacity = predict_capacity(scenario, demand, computers, resources)
    capacity.agents, capacity.binding.name

Limits are of processors (the host's loop and workers, what one process of agents can do, each machine), of the network
and the buffers (inequalities 2.7, 2.8, 2.10), and of the socket that takes the burst of all agents. Agents are thought
to be spread evenly over the machines, in processes of `agents.per_process`. What a tick costs was measured on a 2-core
x86-64 virtual machine (`TickCosts`); another machine's speed is a factor, 1 if nobody has measured it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from cosmos_cli.launch.feasibility import (
    IP_UDP_BYTES,
    Resources,
    finite,
    has_maneuvers,
    is_within,
    judge,
    largest,
)
from cosmos_cli.models.scenario import Scenario
from madns_runtime.plugin.api import Demand
from madns_runtime.timing.pack_split import PACK_AGENTS_MAX

SHARE_USABLE = 0.8
"""Usable share of a processor: above, ticks wait for each other more often than budgets of missed ticks allow."""
SKB_OVERHEAD_BYTES, SKB_TAIL_BYTES, SKB_HEADER_BYTES = 256, 320, 64
"""Bytes that Linux adds to a datagram that waits in a socket; it rounds up to powers of two."""
TICK_BYTES = 64
"""An agent's best-effort message, where the simulation names no flow."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TickCosts:
    """Processor time on the machine that was measured, s: hot ticks, and wake-ups as dear as on a busy machine."""

    tick_s: float = 35e-6
    """An agent's tick with its message, beside the simulation's own step."""
    wake_up_s: float = 190e-6
    """Both wake-ups of a process from sleep, for a pack's ticks and for what comes back, once per period."""
    exchange_s: float = 30e-6
    """On the host: a message taken, and one answered."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ComputerFacts:
    """A computer that runs agents, the host, or both."""

    name: str
    processors: int = 1
    speed: float = 1.0
    """Speed of one processor; that of the machine of TickCosts is 1."""
    has_agents: bool = True
    is_host: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class Limit:
    """The largest number of agents that one thing allows."""

    name: str
    agents: float
    """Infinity if it sets no limit, 0 if not even one fits."""
    why: str

    def to_mapping(self) -> dict[str, Any]:
        """Return plain values; null stands for no limit."""
        return {"name": self.name, "agents": finite(self.agents), "why": self.why}


@dataclass(frozen=True, slots=True, kw_only=True)
class Capacity:
    """All limits at one tick rate."""

    tick_hz: float
    limits: tuple[Limit, ...]

    @property
    def binding(self) -> Limit:
        """The limit that comes first."""
        return min(self.limits, key=lambda limit: limit.agents)

    @property
    def agents(self) -> float:
        """The largest number of agents that all limits allow; infinity if there is none."""
        return self.binding.agents

    def to_mapping(self) -> dict[str, Any]:
        """Return plain values for --json."""
        return {
            "tick_hz": self.tick_hz,
            "agents": finite(self.agents),
            "binding": self.binding.name,
            "limits": [limit.to_mapping() for limit in self.limits],
        }


def predict_capacity(  # noqa: PLR0913 - all but four by name
    scenario: Scenario,
    demand: Demand,
    computers: Sequence[ComputerFacts],
    resources: Resources,
    *,
    receive_buffer_bytes: int | None = None,
    costs: TickCosts | None = None,
) -> Capacity:
    """
    Return the predicted largest number of agents by each limit.

    Args:
        scenario: Gives the tick rate and agents.per_process; its number of agents does not count.
        demand: What the simulation asks for, a single agent's; its compute times as they were measured for some number.
        computers: At least one with agents, and exactly one that is the host.
        resources: As for the four inequalities.
        receive_buffer_bytes: Of the host's socket as it was granted, as getsockopt tells it (twice what is asked);
            None for what the scenario asks for.
        costs: Of ticks, if they were measured anew.

    Raises:
        ValueError: No computer has agents, or not exactly one is the host.
    """
    if not any(each.has_agents for each in computers) or sum(c.is_host for c in computers) != 1:
        raise ValueError("expected computers with agents, and one of them or another as the host")
    costs, tick_hz = costs or TickCosts(), scenario.agents.tick_hz
    load = _ProcessorLoad(
        costs,
        demand,
        tick_hz,
        scenario.agents.per_process,
        list(computers),
        resources.workers_for(demand),
    )
    granted = receive_buffer_bytes or 2 * scenario.network.receive_buffer_bytes
    limits = [load.host_loop(), load.all_workers(), load.maneuvers(resources.maneuvers_at_once)]
    limits.append(load.one_process())
    limits += map(load.whole, computers)
    limits += _inequalities(demand, resources, tick_hz)
    limits.append(_burst(demand, granted))
    return Capacity(tick_hz=tick_hz, limits=tuple(limits))


def processor_limits(
    scenario: Scenario, demand: Demand, computer: ComputerFacts
) -> tuple[Limit, Limit]:
    """Return what the agents of one computer are limited to: by the thread of one process, and by all its processors."""
    agents = scenario.agents
    costs, workers = TickCosts(), scenario.executor.workers
    load = _ProcessorLoad(costs, demand, agents.tick_hz, agents.per_process, [computer], workers)
    return load.one_process(), load.whole(computer)


@dataclass(frozen=True, slots=True)
class _ProcessorLoad:
    costs: TickCosts
    demand: Demand
    tick_hz: float
    per_process: int
    computers: list[ComputerFacts]
    workers: int

    @property
    def host(self) -> ComputerFacts:
        return next(each for each in self.computers if each.is_host)

    def share(self, agents: int, computer: ComputerFacts) -> int:
        """Return how many of the agents run there: of an uneven deal the larger part."""
        if not computer.has_agents:
            return 0
        return math.ceil(agents / sum(each.has_agents for each in self.computers))

    def agents_s(self, agents: int, per_process: int) -> float:
        """Return the processor time of agents on one machine, s per second, at speed 1."""
        full, rest = divmod(agents, per_process)
        packs = full * math.ceil(per_process / PACK_AGENTS_MAX) + math.ceil(rest / PACK_AGENTS_MAX)
        ticks_s = agents * (self.costs.tick_s + self.demand.step_s)
        return (packs * self.costs.wake_up_s + ticks_s) * self.tick_hz

    @property
    def batches_s(self) -> float:
        """Processor time of the host's workers for an agent's batches, s per second, at speed 1."""
        demand = self.demand
        return demand.batch_compute_s / demand.buffer_s if demand.buffer_s > 0.0 else 0.0

    @property
    def maneuvers_s(self) -> float:
        """The same for an agent's maneuvers over a long time."""
        return self.demand.sync_rate_hz * self.demand.sync_compute_s

    def host_loop(self) -> Limit:
        each_s = self.costs.exchange_s * self.tick_hz / self.host.speed
        return Limit(
            name="host's loop",
            agents=math.floor(SHARE_USABLE / each_s),
            why=f"{self.costs.exchange_s * 1e6 / self.host.speed:.0f} us per agent and tick, in one thread",
        )

    def all_workers(self) -> Limit:
        """Return the limit of the host's workers: all batches, and maneuvers at their rate over a long time."""
        each = (self.batches_s + self.maneuvers_s) / self.host.speed
        maneuvers_hz = self.demand.sync_rate_hz
        what = f"batches and {maneuvers_hz:.3g} maneuvers a second" if maneuvers_hz else "batches"
        return Limit(
            name="host's workers",
            agents=largest(lambda agents: is_within(agents * each, self.workers)),
            why=f"{each:.2g} of a worker per agent for {what}, N_p = {self.workers}",
        )

    def one_process(self) -> Limit:
        """Return the limit of a process's single thread: none, or that its agents are too many for any run."""
        slowest = min(each.speed for each in self.computers if each.has_agents)

        def fits(agents: int) -> bool:
            together = min(agents, self.per_process)
            return self.agents_s(together, together) / slowest <= SHARE_USABLE

        return Limit(
            name="process of agents",
            agents=largest(fits),
            why=f"agents.per_process {self.per_process}, one thread each",
        )

    def used_s(self, agents: int, computer: ComputerFacts) -> float:
        """Return what all of them cost a machine but for the truth of maneuvers, s per second, at speed 1."""
        used = self.agents_s(self.share(agents, computer), self.per_process)
        if computer.is_host:
            used += agents * (self.costs.exchange_s * self.tick_hz + self.batches_s)
        return used

    def maneuvers(self, at_once: int | None) -> Limit:
        """Return the limit of maneuvers of one instant: their truth within the lead, by what ticks leave of the host's processors."""
        host, demand, name = self.host, self.demand, "maneuvers of one instant"
        if not has_maneuvers(demand):
            return Limit(name=name, agents=math.inf, why="none is commanded")

        def fits(agents: int) -> bool:
            ticks = self.used_s(agents, host) / host.speed
            left = max(0.0, min(self.workers, host.processors - ticks))
            truth_s = min(at_once or agents, agents) * demand.sync_compute_s / host.speed
            return is_within(truth_s, left * demand.lead_s)

        count = "one of each agent" if at_once is None else f"{at_once} at most"
        return Limit(
            name=name,
            agents=largest(fits),
            why=f"{count} within {demand.lead_s:g} s, by what ticks leave of the host's processors",
        )

    def whole(self, computer: ComputerFacts) -> Limit:
        """Return the limit of all processors of a machine together."""

        def used_s(agents: int) -> float:
            maneuvers_s = agents * self.maneuvers_s if computer.is_host else 0.0
            return self.used_s(agents, computer) + maneuvers_s

        allowed_s = SHARE_USABLE * computer.processors * computer.speed
        does = " and ".join(
            word
            for word, holds in (("agents", computer.has_agents), ("host", computer.is_host))
            if holds
        )
        return Limit(
            name=f"processors of {computer.name}",
            agents=largest(lambda agents: used_s(agents) <= allowed_s),
            why=f"{does} on {computer.processors} of speed {computer.speed:g}",
        )


def _inequalities(demand: Demand, resources: Resources, tick_hz: float) -> list[Limit]:
    found = judge(demand, resources, agents=1, tick_hz=tick_hz)
    return [
        Limit(
            name=f"inequality {item.number}",
            agents=item.breaks_at - 1 if item.applies else math.inf,
            why=item.formula,
        )
        for item in found.inequalities
    ]


def _burst(demand: Demand, granted_bytes: int) -> Limit:
    """Return how many agents' messages of one instant fit into the host's socket; what is reliable waits for room."""
    ticks = [flow.message_bytes for flow in demand.flows if flow.rate_hz > 0.0]
    each = kernel_bytes(max([TICK_BYTES, *(size for size in ticks if size <= 1400)]))
    return Limit(
        name="receive buffer of the host",
        agents=float(granted_bytes // each),
        why=f"a burst of all agents: {each} of {granted_bytes} bytes each",
    )


def kernel_bytes(message_bytes: int) -> int:
    """Return the bytes that Linux books for a waiting datagram of one message (its truesize)."""
    room = message_bytes + IP_UDP_BYTES + SKB_HEADER_BYTES + SKB_TAIL_BYTES
    return SKB_OVERHEAD_BYTES + int(2 ** math.ceil(math.log2(room)))
