"""Reports to flight software, in values that are the same for every protocol. Pure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from madns_runtime.simulations.constellation.flight.api import Reading
from madns_runtime.simulations.constellation.messages import (
    CommandResult,
    Delivery,
    TransmissionRefusal,
)


@dataclass(frozen=True, slots=True, kw_only=True)
class SetupReport:
    """Report to flight software before the first tick."""

    name: str
    satellite: str
    agents: tuple[str, ...]
    index: int
    tick_hz: float
    """Of the vehicle."""
    rate_hz: float
    """Of its own steps, and so of the reports."""
    duration_s: float
    epoch_utc: str
    frame: str
    input: str
    """measurements or truth."""
    first_number: int
    seed: int
    settings: Mapping[str, Any]
    clock: str = "stepped"
    """stepped or own."""
    is_kept: bool = False
    """Whether software that begins to listen later finds it all the same: its first hello asks for nothing more."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TickReport:
    """Report to flight software of one tick."""

    t_s: float
    readings: Mapping[str, Reading] = field(default_factory=dict)
    messages: Sequence[Delivery] = ()
    results: Sequence[CommandResult] = ()
    refusals: Sequence[TransmissionRefusal] = ()
