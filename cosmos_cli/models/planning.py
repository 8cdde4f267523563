"""
Section `plan` of a scenario: figures that `cosmos plan` is given instead of asking for them. Pure.

A run ignores it. With it a simulation that does not exist yet can be planned, or the figures of a paper be typed in.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, Any

from annotated_types import Ge, Gt, Le, MinLen

from madns_runtime.plain_values import FORBID_EXTRA
from madns_runtime.plugin.api import Demand, Flow

AMOUNT_MAX = 1e18
COUNT_MAX = 1_000_000
"""Of workers and of maneuvers: more has nobody."""

Bytes = Annotated[int, Ge(0), Le(10**18)]
Seconds = Annotated[float, Ge(0), Le(AMOUNT_MAX)]
Hertz = Annotated[float, Ge(0), Le(AMOUNT_MAX)]


@dataclass(frozen=True, slots=True, kw_only=True)
class PlannedFlow:
    """Messages of one kind that every agent exchanges with the host."""

    __pydantic_config__ = FORBID_EXTRA

    name: Annotated[str, MinLen(1)]
    """Name of the flow."""
    message_bytes: Bytes
    """S_Di: size of one message."""
    rate_hz: Hertz
    """R_Di: messages of one agent, Hz."""
    within_s: Annotated[float, Gt(0), Le(AMOUNT_MAX)] | None = None
    """How long a message may be on its way, s; none for until the next one."""

    def to_flow(self) -> Flow:
        """Return it as simulations give theirs."""
        return Flow(
            name=self.name,
            message_bytes=self.message_bytes,
            rate_hz=self.rate_hz,
            within_s=self.within_s,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Planning:
    """Terms of the inequalities of real time, for `cosmos plan` alone; what is not given is asked or measured."""

    __pydantic_config__ = FORBID_EXTRA

    batch_bytes: Bytes | None = None
    """S_b: size of one asynchronous batch of one agent."""
    batch_compute_s: Seconds | None = None
    """T_p(S_b): time to make it on the host, s."""
    buffer_s: Seconds | None = None
    """T_bi: how long an agent can go on from what it holds, s."""
    state_bytes: Bytes | None = None
    """Size of one state in a batch."""
    buffer_bytes: Bytes | None = None
    """S_a: size of an agent's buffer."""
    sync_bytes: Bytes | None = None
    """S_sync: size of one synchronous batch."""
    sync_compute_s: Seconds | None = None
    """T_p(S_sync): time to make it, s."""
    sync_rate_hz: Hertz | None = None
    """N_sync: synchronous exchanges of one agent at worst, Hz."""
    lead_s: Seconds | None = None
    """T_m - T_s: how far ahead of its execution a maneuver is commanded, s."""
    step_s: Seconds | None = None
    """Processor time of one step of an agent's half, s."""
    flows: tuple[PlannedFlow, ...] | None = None
    """All that travels at fixed rates, the framework's own messages as well."""
    has_headers: bool = True
    """Whether headers come to the sizes, or are counted in them already."""
    workers: Annotated[int, Ge(1), Le(COUNT_MAX)] | None = None
    """N_p, instead of executor.workers."""
    bandwidth_mbit: Annotated[float, Gt(0), Le(1e12)] | None = None
    """B_n: bandwidth of the host's link, Mbit/s; 1000 if nobody says."""
    latency_ms: Annotated[float, Ge(0), Le(1e9)] | None = None
    """T_n: one-way time of a datagram, ms."""
    maneuvers_at_once: Annotated[int, Ge(1), Le(COUNT_MAX)] | None = None
    """Maneuvers at one instant at worst; none for one of every agent."""

    @property
    def says_all(self) -> bool:
        """Whether nobody else needs to be asked for a demand."""
        return not self.missing

    @property
    def missing(self) -> list[str]:
        """Return what would still have to be given for a simulation that has no demand of its own."""
        return [name for name in (*REQUIRED, "flows") if getattr(self, name) is None]

    def applied_to(self, demand: Demand | None) -> Demand:
        """Return a simulation's demand with what is given here in its place; None for a simulation without one."""
        given: dict[str, Any] = {
            name: value for name in FIGURES if (value := getattr(self, name)) is not None
        }
        if "batch_compute_s" in given or "sync_compute_s" in given:
            given["measured"] = False
        if self.flows is not None:
            given["flows"] = tuple(flow.to_flow() for flow in self.flows)
        return replace(NOTHING if demand is None else demand, **given)


REQUIRED = ("batch_bytes", "batch_compute_s", "buffer_s", "sync_bytes", "sync_compute_s", "lead_s")
FIGURES = (*REQUIRED, "sync_rate_hz", "state_bytes", "buffer_bytes", "step_s")
"""Fields that a Demand has, too."""
NOTHING = Demand(
    flows=(),
    buffer_s=0.0,
    batch_bytes=0,
    batch_compute_s=0.0,
    sync_bytes=0,
    sync_compute_s=0.0,
    sync_rate_hz=0.0,
    lead_s=0.0,
    measured=False,
)
