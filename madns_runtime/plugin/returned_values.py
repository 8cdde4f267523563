"""Values that a simulation's functions and halves return: checks, demands, declared streams, used channels, tabulated rows."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

from madns_runtime.recording.records import Field

if TYPE_CHECKING:
    import numpy as np  # 0.2 s of import time that `cosmos validate` has no use for
    from numpy.typing import NDArray


@dataclass(frozen=True, slots=True, kw_only=True)
class Check:
    """One line of a verdict. In a summary it stands as a plain mapping with these keys."""

    name: str
    limit: float
    got: float
    """A finite number; NaN and None are told as not measured, and break the check."""
    passed: bool
    worst: str | None = None
    """Source of *got*; None for the maker of the check. Of all agents' checks of a name the worst counts."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Flow:
    """Messages of one kind that every agent exchanges with the host."""

    name: str
    message_bytes: int
    """Encoded size of one message, without datagram overhead."""
    rate_hz: float
    within_s: float | None = None
    """How long a message may be on its way, s; None for until the next one."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Demand:
    """Demands of a simulation on host and network: the terms of the thesis's inequalities 2.7-2.10."""

    flows: tuple[Flow, ...]
    """S_Di and R_Di of every planned flow, a single agent's."""
    buffer_s: float
    """T_bi: how long an agent can go on from what it holds; infinity if it needs nothing."""
    batch_bytes: int
    """S_b: encoded size of one asynchronous batch, of one agent."""
    batch_compute_s: float
    """T_p(S_b): host time to make one agent's batch."""
    sync_bytes: int
    """S_sync: encoded size of one synchronous batch; 0 without maneuvers."""
    sync_compute_s: float
    """T_p(S_sync)."""
    sync_rate_hz: float
    """N_sync: synchronous exchanges a second, of one agent, at worst."""
    lead_s: float
    """T_m - T_s: how far ahead of its execution a maneuver is commanded; infinity if none ever is."""
    measured: bool
    """Whether the compute times were measured on this machine (else they are declared)."""
    state_bytes: int = 0
    """Encoded size of one state in a batch; 0 if there are no batches."""
    buffer_bytes: int = 0
    """S_a: size of the states that an agent holds after a refill."""
    step_s: float = 0.0
    """Processor time of one step of an agent's half, beside what the framework takes for a tick."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Tabulated:
    """Rows of one agent, in order of time; an agent's rows may come in several parts, one after the other."""

    agent: str
    fields: tuple[Field, ...]
    """Of the columns; times stand for themselves and have none."""
    times_s: NDArray[np.float64]
    columns: Mapping[str, NDArray[np.float64]]
    """By the fields' names; NaN where nothing is on record."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DeclaredStream:
    """A record stream that a simulation may open: what report, comparison and live view can count on."""

    role: Literal["host", "agent"]
    """Half that opens it."""
    name: str
    fields: tuple[Field, ...]
    is_open: bool = False
    """Whether further fields may follow these, known only in the run."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DeviceUse:
    """A channel of a device that an agent's half uses by the scenario's parameters: checked before a run."""

    agent: str
    field: str
    """Dotted name of the parameter that says so."""
    device: str
    channel: str
    direction: Literal["in", "out"] = "in"
    size: int | None = None
    """Numbers that its values must have; None for any."""
    unit: str | None = None
    """Unit that the channel's must convert to, such as rad/s or Hz; None for any."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PlaceUse:
    """Place of its machine that an agent's half takes for itself alone by the scenario's parameters: checked before a run."""

    agent: str
    field: str
    """Dotted name of the parameter that says so."""
    place: str
    """Such as serial port /dev/ttyUSB0: two agents of one machine cannot have the same."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Rerun:
    """How a simulation flies a recorded run again, in lockstep and with its devices played back."""

    parameters: Any
    """An instance of the descriptor's parameters class."""
    remarks: tuple[str, ...] = ()
    """Sentences on what is flown otherwise than it was, such as software that cannot be stepped."""
    unlike: tuple[str, ...] = ()
    """Streams, their fields as stream.field, or outputs as device.NAME.CHANNEL (globs), that depend on computers and
    networks: of a run in real time lockstep has them otherwise, or not at all. They are told and not judged."""
