"""
The four inequalities of a real-time run (thesis 2.5.4, equations 2.7-2.10), with margins and limits. Pure.

Three things differ from the thesis's own figures. Sizes are encoded sizes in bytes, and what travels is
counted with the datagrams' overhead: its table 2.2 gives S_b as 100 x 6 x 64 bits, which is 4,800
bytes and not the 38,400 of table 2.3. Inequality 2.8 is taken for several maneuvers that reach
the host at once, by default one of every agent: as written, for one alone, it has no limit in agents.
And 2.10 holds for every interval, down to the shortest in which something must arrive (`busiest_interval`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

from cosmos_cli.launch.busiest_interval import ROUNDING, Sending, busiest_interval
from madns_runtime.plugin.api import Demand
from madns_runtime.protocol.datagram import FRAGMENT_BYTES_MAX, FRAME_BYTES, OVERHEAD_BYTES

DATAGRAM_OVERHEAD_BYTES = OVERHEAD_BYTES + FRAME_BYTES
"""Header and keyed MAC of a datagram, and the header of the one frame in it."""
IP_UDP_BYTES = 28
BITS_PER_BYTE = 8
COUNT_MAX = 2.0**53
"""The most agents that are computed with: above, a floating-point number and the next are the same."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Resources:
    """Resources of host and network."""

    workers: int
    """N_p: processes that propagate, as many as are asked for."""
    bandwidth_bytes_s: float
    """B_n: of the host's own link, one direction taken for both."""
    latency_s: float
    """T_n: one way."""
    maneuvers_at_once: int | None = None
    """Maneuvers that reach the host at one instant at worst; None for one of every agent."""
    has_headers: bool = True
    """Whether sizes are of messages, to which headers come; else all is counted in them already."""
    processors: int | None = None
    """Processors that those workers share; None where nobody knows, or a cluster's workers have their own."""

    def workers_for(self, demand: Demand) -> int:
        """Return N_p as it counts: where a worker's time was measured, no more work at once than there are processors."""
        if not demand.measured or self.processors is None:
            return self.workers
        return min(self.workers, self.processors)


@dataclass(frozen=True, slots=True, kw_only=True)
class Inequality:
    """One inequality at the planned number of agents."""

    number: str
    """Number of the equation in the thesis."""
    name: str
    formula: str
    left: float
    relation: Literal["<=", ">="]
    right: float
    unit: str
    breaks_at: float
    """The smallest number of agents at which it does not hold; infinity if it always does."""
    applies: bool = True
    """Whether the simulation has what it is about, such as maneuvers; else its sides mean nothing."""

    @property
    def holds(self) -> bool:
        """Whether it is fulfilled, or does not apply."""
        return not self.applies or is_within(*self._sides)

    @property
    def margin(self) -> float:
        """Margin, in the unit of both sides; negative if the inequality does not hold, 0 at its limit."""
        used, allowed = self._sides
        return max(0.0, allowed - used) if is_within(used, allowed) else allowed - used

    @property
    def load(self) -> float:
        """The smaller side's share of the larger allowed one: 1 is the limit, 0 no load."""
        used, allowed = self._sides
        if used == 0:
            return 0.0
        return used / allowed if allowed > 0 else math.inf

    @property
    def _sides(self) -> tuple[float, float]:
        """The side that must be the smaller one, and the other."""
        return (self.left, self.right) if self.relation == "<=" else (self.right, self.left)

    def to_mapping(self) -> dict[str, Any]:
        """Return plain values; null stands for infinity, and for the sides of one that does not apply."""
        left, right = (self.left, self.right) if self.applies else (math.inf, math.inf)
        return {
            "equation": self.number,
            "name": self.name,
            "formula": self.formula,
            "applies": self.applies,
            "left": finite(left),
            "relation": self.relation,
            "right": finite(right),
            "unit": self.unit,
            "margin": finite(self.margin) if self.applies else None,
            "holds": self.holds,
            "breaks_at_agents": finite(self.breaks_at) if self.applies else None,
        }


@dataclass(frozen=True, slots=True, kw_only=True)
class Feasibility:
    """All four, for one number of agents."""

    agents: int
    inequalities: tuple[Inequality, ...]
    measured: bool
    """Whether compute times were measured on this machine; else they are declared."""
    workers: int
    """N_p as it was counted: those asked for, or the processors where they are fewer and times were measured."""

    @property
    def holds(self) -> bool:
        """Whether all are fulfilled."""
        return all(item.holds for item in self.inequalities)

    @property
    def binding(self) -> Inequality:
        """The one that limits the number of agents first; among equals the one with the highest load."""
        applying = [item for item in self.inequalities if item.applies]
        return min(applying, key=lambda item: (item.holds, item.breaks_at, -item.load))

    def to_mapping(self) -> dict[str, Any]:
        """Return plain values for --json."""
        return {
            "agents": self.agents,
            "holds": self.holds,
            "binding": self.binding.number,
            "compute_times": "measured" if self.measured else "declared",
            "workers": self.workers,
            "inequalities": [item.to_mapping() for item in self.inequalities],
        }


def judge(demand: Demand, resources: Resources, *, agents: int, tick_hz: float) -> Feasibility:
    """
    Evaluate the four inequalities.

    Args:
        demand: What the simulation asks for, a single agent's.
        resources: What host and network offer.
        agents: N_a.
        tick_hz: R_a.
    """
    workers = resources.workers_for(demand)
    resources = replace(resources, workers=workers)
    return Feasibility(
        agents=agents,
        inequalities=(
            _asynchronous(demand, resources, agents),
            _synchronous(demand, resources, agents),
            _lead(demand, tick_hz),
            _bandwidth(demand, resources, agents),
        ),
        measured=demand.measured,
        workers=workers,
    )


def has_batches(demand: Demand) -> bool:
    """Tell whether the host computes anything ahead for an agent: without, there is no buffer to outlast."""
    return demand.batch_bytes != 0 or demand.batch_compute_s != 0


def has_maneuvers(demand: Demand) -> bool:
    """Tell whether an agent may command anything that the host must answer before its time."""
    return demand.sync_bytes != 0 or demand.sync_compute_s != 0 or demand.sync_rate_hz != 0


def _asynchronous(demand: Demand, resources: Resources, agents: int) -> Inequality:
    def left_s(count: int) -> float:
        return demand.batch_compute_s * count / resources.workers + resources.latency_s

    return Inequality(
        number="2.7",
        name="asynchronous: every agent's batch within its buffer",
        formula="T_p(S_b) N_a / N_p + T_n <= T_bi",
        left=left_s(agents),
        relation="<=",
        right=demand.buffer_s,
        unit="s",
        breaks_at=_first_beyond(left_s, demand.buffer_s),
        applies=has_batches(demand),
    )


def _synchronous(demand: Demand, resources: Resources, agents: int) -> Inequality:
    at_once = resources.maneuvers_at_once

    def left_s(rounds: int) -> float:
        return demand.sync_compute_s * rounds + 2 * resources.latency_s

    rounds_beyond = _first_beyond(left_s, demand.lead_s)
    agents_beyond = (rounds_beyond - 1) * resources.workers + 1
    if at_once is not None and agents_beyond > at_once:
        agents_beyond = math.inf
    return Inequality(
        number="2.8",
        name="synchronous: a maneuver's states before it begins",
        formula="T_p(S_sync) ceil(n / N_p) + 2 T_n <= T_m - T_s",
        left=left_s(math.ceil(min(at_once or agents, agents) / resources.workers)),
        relation="<=",
        right=demand.lead_s,
        unit="s",
        breaks_at=agents_beyond,
        applies=has_maneuvers(demand),
    )


def _lead(demand: Demand, tick_hz: float) -> Inequality:
    period_s = 1 / tick_hz
    return Inequality(
        number="2.9",
        name="synchronous: a maneuver at least a tick ahead",
        formula="T_m - T_s >= 1 / R_a",
        left=demand.lead_s,
        relation=">=",
        right=period_s,
        unit="s",
        breaks_at=math.inf if is_within(period_s, demand.lead_s) else 1,
        applies=has_maneuvers(demand),
    )


def sendings_of(demand: Demand, resources: Resources) -> list[Sending]:
    """Return all that travels for one agent, maneuvers as well, with what of it must be there by when."""

    def on_wire(message_bytes: int) -> float:
        return wire_bytes(message_bytes) if resources.has_headers else message_bytes

    sendings = [
        Sending(
            name=flow.name,
            wire_bytes=on_wire(flow.message_bytes),
            rate_hz=flow.rate_hz,
            within_s=1.0 / flow.rate_hz if flow.within_s is None else flow.within_s,
        )
        for flow in demand.flows
        if flow.rate_hz > 0.0
    ]
    if demand.sync_rate_hz > 0.0 and demand.sync_bytes > 0:
        at_once = resources.maneuvers_at_once
        maneuver = Sending(
            name="maneuvers",
            wire_bytes=on_wire(demand.sync_bytes),
            rate_hz=demand.sync_rate_hz,
            within_s=demand.lead_s if math.isfinite(demand.lead_s) else 1.0 / demand.sync_rate_hz,
            senders_max=math.inf if at_once is None else at_once,
        )
        sendings.append(maneuver)
    return sendings


def _bandwidth(demand: Demand, resources: Resources, agents: int) -> Inequality:
    sendings = sendings_of(demand, resources)
    found = busiest_interval(sendings, agents)
    length = "over a long time" if math.isinf(found.length_s) else f"in {found.length_s:.4g} s"
    return Inequality(
        number="2.10",
        name=f"network: all messages of the busiest interval, {length}",
        formula="N_a max over any dT of (sum S_Di R_Di + N_sync S_sync) <= B_n dT",
        left=found.bytes_s,
        relation="<=",
        right=resources.bandwidth_bytes_s,
        unit="B/s",
        breaks_at=_first_too_busy(sendings, resources.bandwidth_bytes_s),
    )


def _first_too_busy(sendings: Sequence[Sending], bandwidth_bytes_s: float) -> float:
    """Return the smallest number of agents whose busiest interval is too busy; infinity below COUNT_MAX."""

    def is_too_busy(agents: int) -> bool:
        return not is_within(busiest_interval(sendings, agents).bytes_s, bandwidth_bytes_s)

    # In proportion to the agents as long as each may maneuver at the worst instant: look there first.
    one = busiest_interval(sendings, 1).bytes_s
    if one <= 0.0 or math.isinf(bandwidth_bytes_s) or bandwidth_bytes_s / one >= COUNT_MAX:
        return math.inf
    low = max(0, math.floor(bandwidth_bytes_s / one) - 1)
    step = 2
    while not is_too_busy(low + step):
        low, step = low + step, 2 * step
        if low >= COUNT_MAX:
            return math.inf
    high = low + step
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if is_too_busy(middle) else (middle, high)
    return high


def wire_bytes(message_bytes: int) -> int:
    """Return the bytes that a message of so many encoded bytes costs on the wire, all headers included."""
    datagrams = max(1, math.ceil(message_bytes / FRAGMENT_BYTES_MAX))
    return message_bytes + datagrams * (DATAGRAM_OVERHEAD_BYTES + IP_UDP_BYTES)


def largest(fits: Callable[[int], bool]) -> float:
    """Return the largest number of agents that fits, where fewer do, too; 0 if none does, infinity if COUNT_MAX does."""
    low, high = 0, 1
    while fits(high):
        low, high = high, 2 * high
        if low >= COUNT_MAX:
            return math.inf
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if fits(middle) else (low, middle)
    return low


def _first_beyond(left: Callable[[int], float], allowed: float) -> float:
    """Return the smallest n >= 1 at which a left side that grows with n is beyond; infinity if none is below COUNT_MAX."""
    return largest(lambda count: is_within(left(count), allowed)) + 1


def is_within(used: float, allowed: float) -> bool:
    """Tell whether the one is at most the other, but for ROUNDING; neither is negative: 3 x 0.1 s are 0.3 s."""
    return used <= allowed * (1.0 + ROUNDING)


def finite(value: float) -> float | None:
    """Return *value*, or None for infinity, which JSON does not know."""
    return value if math.isfinite(value) else None
