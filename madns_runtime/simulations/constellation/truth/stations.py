"""
Ground stations: passes over them, and messages that pass between them and vehicles.

Pure: states come from a function, times from the caller.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any, Literal

import numpy as np

from madns_runtime.recording.records import Field
from madns_runtime.simulations.constellation.messages import Delivery, Transmission
from madns_runtime.simulations.constellation.parameters import GroundStation, Uplink
from madns_runtime.simulations.constellation.truth.links import LinkEvent, States

CONTACT_FIELDS = (
    Field("event", "", "str"),
    Field("agent", "", "str"),
    Field("station", "", "str"),
    Field("rise_s", "s"),
    Field("set_s", "s"),
    Field("elevation_deg_max", "deg"),
)
"""Stream "contacts": one record when a pass begins, one when it ends."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Contact:
    """A vehicle in view of a station."""

    event: Literal["rise", "set"]
    agent: str
    station: str
    rise_s: float
    """When it rose above the mask, s; of one in view from the start, the start."""
    set_s: float | None = None
    """When it set; None at its rise."""
    elevation_deg_max: float | None = None
    """Highest it stood; None at its rise."""

    def to_record(self) -> tuple[Any, ...]:
        """Return one value for each of CONTACT_FIELDS."""
        return (
            self.event,
            self.agent,
            self.station,
            self.rise_s,
            self.set_s,
            self.elevation_deg_max,
        )


class GroundSegment:
    """All ground stations."""

    def __init__(
        self,
        stations: Sequence[GroundStation],
        uplinks: Sequence[Uplink],
        *,
        agents: tuple[str, ...],
        satellites: tuple[str, ...],
        epoch_utc: datetime,
        random: np.random.Generator,
        states: States,
    ) -> None:
        raise NotImplementedError

    def send(self, sender: int, transmission: Transmission, now_s: float) -> list[LinkEvent]:
        """Send a vehicle's message to the ground and return what becomes of it."""
        raise NotImplementedError

    def due(self, t_s: float) -> list[tuple[int, Delivery]]:
        """Return vehicles and what they hear from the ground soon after *t_s*; each once."""
        raise NotImplementedError

    def events(self) -> list[LinkEvent]:
        """Return what became of uplinks since the call before."""
        raise NotImplementedError

    def contacts(self, t_s: float) -> list[Contact]:
        """Return the passes that began or ended until *t_s* and were not returned before."""
        raise NotImplementedError

    def next_s(self) -> float | None:
        """Return when `due` and `contacts` are to be called next."""
        raise NotImplementedError

    def summary(self) -> Mapping[str, int]:
        """Return the account."""
        raise NotImplementedError
