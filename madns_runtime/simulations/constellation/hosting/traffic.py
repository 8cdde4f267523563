"""Radio on the host: what vehicles say goes through crosslinks and ground stations and comes out elsewhere."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from datetime import datetime
from typing import Any

from madns_runtime.errors import PluginError
from madns_runtime.plugin.api import HostContext
from madns_runtime.protocol.messages import Service
from madns_runtime.simulations.constellation.messages import (
    Delivery,
    Refusal,
    Transmission,
    is_for_ground,
)
from madns_runtime.simulations.constellation.parameters import ConstellationParameters
from madns_runtime.simulations.constellation.truth.contacts import CONTACT_FIELDS
from madns_runtime.simulations.constellation.truth.links import Crosslinks
from madns_runtime.simulations.constellation.truth.medium import LINK_FIELDS, REFUSED, LinkEvent
from madns_runtime.simulations.constellation.truth.segments import TruthStore
from madns_runtime.simulations.constellation.truth.stations import GroundSegment

STEP_S = 0.001
"""Least time between two calls of the timer."""


class Traffic:
    """
    Crosslinks and ground stations of a run.

    Args:
        context: Through which deliveries are sent.
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
        self.deliveries = 0
        self._crosslinks = (
            Crosslinks(
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
        context.open_stream("links", LINK_FIELDS)
        context.open_stream("contacts", CONTACT_FIELDS)

    def receive(self, vehicle: int, transmission: Transmission) -> None:
        """
        Take what a vehicle says; what is heard soon is handed on at once, and what is refused is told.

        Raises:
            PluginError: The scenario has no crosslinks and it is not for the ground.
        """
        now_s = self._context.now_s()
        if is_for_ground(transmission.to):
            self._answer(vehicle, transmission, self._ground.send(vehicle, transmission, now_s))
            return
        if self._crosslinks is None:
            to = transmission.to
            raise PluginError(f"constellation: {to!r} cannot be reached without crosslinks")
        self._answer(vehicle, transmission, self._crosslinks.send(vehicle, transmission, now_s))
        self._deliver(self._crosslinks.due(now_s))
        if (next_s := self._crosslinks.next_s()) is not None:
            self._context.wake(max(next_s, now_s + STEP_S))

    def timer(self, t_s: float) -> float | None:
        """Hand on what is heard soon, record passes, and return when to come back."""
        if self._crosslinks is not None:
            self._deliver(self._crosslinks.due(t_s))
        self._deliver(self._ground.due(t_s))
        self._record(self._ground.uplink_events())
        for contact in self._ground.contacts(t_s):
            self._context.record("contacts", contact.to_record())
        times_s = [self._ground.next_s()]
        if self._crosslinks is not None:
            times_s.append(self._crosslinks.next_s())
        next_s = min((s for s in times_s if s is not None), default=None)
        return None if next_s is None else max(next_s, t_s + STEP_S)

    def finish(self) -> Mapping[str, Any]:
        """Return the accounts of those that there are."""
        links = {} if self._crosslinks is None else {"links": dict(self._crosslinks.summary())}
        return links | {"ground": dict(self._ground.summary())}

    def _deliver(self, due: Iterable[tuple[int, Delivery]]) -> None:
        for vehicle, delivery in due:
            agent = self._context.agents[vehicle]
            self._context.send(agent, delivery.to_message(), Service.RELIABLE)
            self.deliveries += 1

    def _answer(self, vehicle: int, transmission: Transmission, events: list[LinkEvent]) -> None:
        """Record what became of a message, and tell its sender if it was refused."""
        self._record(events)
        for event in events:
            if event.outcome in REFUSED:
                refusal = Refusal(
                    number=transmission.number,
                    to=transmission.to,
                    sent_s=transmission.sent_s,
                    reason=event.outcome,
                )
                agent = self._context.agents[vehicle]
                self._context.send(agent, refusal.to_message(), Service.RELIABLE)

    def _record(self, events: Iterable[LinkEvent]) -> None:
        for event in events:
            self._context.record("links", event.to_record())
