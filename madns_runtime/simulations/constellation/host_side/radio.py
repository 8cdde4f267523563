"""Radio on the host: the medium of messages between vehicles, by crosslinks, and with ground stations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from datetime import datetime
from typing import Any

from madns_runtime.errors import PluginError
from madns_runtime.plugin.api import HostContext, LinkOutcome
from madns_runtime.protocol.messages import Transmission
from madns_runtime.simulations.constellation.messages import is_for_ground
from madns_runtime.simulations.constellation.parameters import ConstellationParameters, Uplink
from madns_runtime.simulations.constellation.streams import CONTACTS, LINKS
from madns_runtime.simulations.constellation.truth.radio.channel import (
    CROSSLINKS,
    OUTCOMES,
    TO_GROUND,
    CrosslinkMedium,
    LinkEvent,
)
from madns_runtime.simulations.constellation.truth.radio.ground_stations import GroundSegment
from madns_runtime.simulations.constellation.truth.segments import TruthStore

STEP_S = 0.001
"""Least time between two calls of the timer."""


class RadioMedium:
    """
    Crosslinks and ground stations of a run.

    Args:
        context: Where records and uplinks go.
        parameters: The scenario's.
        satellites: What the agents fly.
        epoch_utc: UTC of simulated time zero.
        store: Where the vehicles are.
    """

    def __init__(
        self,
        context: HostContext,
        parameters: ConstellationParameters,
        satellites: tuple[str, ...],
        epoch_utc: datetime,
        store: TruthStore,
    ) -> None:
        self._context = context
        self._index = {agent: number for number, agent in enumerate(context.agents)}
        self._crosslinks = (
            CrosslinkMedium(
                parameters.crosslinks,
                agents=context.agents,
                satellites=satellites,
                random=context.random,
                truth=store,
            )
            if parameters.crosslinks is not None
            else None
        )
        self._ground = GroundSegment(
            parameters.stations,
            parameters.uplinks,
            agents=context.agents,
            satellites=satellites,
            epoch_utc=epoch_utc,
            random=context.random,
            truth=store,
        )
        self.lost: frozenset[str] = frozenset()
        """Agents whose satellites are lost: they hear nothing, and nobody is told."""
        context.open_stream("links", LINKS)
        context.open_stream("contacts", CONTACTS)

    def carry(self, sender: str, transmission: Transmission) -> Sequence[LinkEvent]:
        """
        Return what becomes of a message that a vehicle sent; see `plugin.api.Medium`.

        Raises:
            PluginError: The scenario has no crosslinks and it is not for the ground.
        """
        vehicle = self._index[sender]
        if is_for_ground(transmission.to):
            events: Sequence[LinkEvent] = self._ground.carry(vehicle, transmission)
        elif self._crosslinks is not None:
            events = self._crosslinks.carry(vehicle, transmission)
        else:
            to = transmission.to
            raise PluginError(f"constellation: {to!r} cannot be reached without crosslinks")
        return self._unheard(events)

    def settled(
        self, sender: str, transmission: Transmission, outcomes: Sequence[LinkOutcome]
    ) -> None:
        """Record what became of a message that a vehicle sent, faults of the timeline included."""
        self._record(outcomes)

    def timer(self, t_s: float) -> float | None:
        """Have uplinks sent, record passes, and return when to come back."""
        for transmission, sent in self._ground.uplinks(t_s):
            (event,) = self._unheard((sent,))
            self._record(self._context.enter(event.sender, transmission, (event,)))
        for contact in self._ground.contacts(t_s):
            self._context.record("contacts", contact.to_record())
        next_s = self._ground.next_s()
        return None if next_s is None else max(next_s, t_s + STEP_S)

    def uplink(self, uplink: Uplink, station: str) -> bool:
        """Let a message wait for a station's next contact with its vehicle; False if there is no such station."""
        return self._ground.add_uplink(uplink, station)

    def darken(self, station: str, *, is_dark: bool) -> bool:
        """Have a ground station neither heard nor hear, or do both again; False if there is none of that name."""
        return self._ground.darken(station, is_dark=is_dark)

    def finish(self) -> Mapping[str, Any]:
        """Return the accounts of those that there are."""
        channels = (TO_GROUND,) if self._crosslinks is None else (CROSSLINKS, TO_GROUND)
        counts = {name: self._context.account(name).to_mapping(OUTCOMES) for name in channels}
        counts[TO_GROUND].update(self._ground.summary())
        return counts

    def _unheard(self, events: Sequence[LinkEvent]) -> Sequence[LinkEvent]:
        """Return what becomes of messages where some receivers, or the sender, are lost."""
        if not self.lost:
            return events
        return [
            replace(event, outcome="lost", arrives_s=None)
            if event.outcome == "delivered" and not self.lost.isdisjoint((event.to, event.sender))
            else event
            for event in events
        ]

    def _record(self, outcomes: Sequence[LinkOutcome]) -> None:
        for event in outcomes:
            assert isinstance(event, LinkEvent)  # as this medium made them all
            self._context.record("links", event.to_record())
