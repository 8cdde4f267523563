"""The agent's half: one car's driver. What it knows of the car ahead it heard by radio."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from madns_runtime.plugin.api import (
    EVERYBODY,
    HOST,
    AgentContext,
    AgentSimulation,
    Delivery,
    Tick,
    TransmissionRefusal,
)
from ring_cars.car_following import acceleration_m_s2
from ring_cars.streams import DRIVE, HEARD, REFUSED


class Car(AgentSimulation):
    """Follows the car ahead."""

    def setup(self, context: AgentContext, initial: Mapping[str, Any]) -> None:
        """Take the start from the host."""
        self._context = context
        self._own: list[float] = list(initial["own"])
        self._ahead: list[float] = list(initial["ahead"])
        self._sent = self._heard = self._heard_ahead = self._refused = 0
        self._tick = -1
        place = context.agents.index(context.name)
        self._leader = context.agents[place - 1]
        self._behind = context.agents[(place + 1) % len(context.agents)]
        self._round_m = 0.0 if place else context.parameters.ring_m
        """The first car follows the last, one round ahead."""
        context.open_stream("drive", DRIVE)
        context.open_stream("heard", HEARD)
        context.open_stream("refused", REFUSED)

    def receive(self, message: Any) -> None:
        """Remember the newest measurement."""
        self._own = message["own"]

    def hear(self, delivery: Delivery) -> None:
        """Follow the word of the car ahead; what others say is merely recorded."""
        driven_m, speed_m_s = delivery.payload
        self._heard += 1
        self._context.record("heard", (self._tick + 1, delivery.sender, driven_m))
        if delivery.sender == self._leader:
            self._ahead = [driven_m + self._round_m, speed_m_s]
            self._heard_ahead += 1

    def refused(self, refusal: TransmissionRefusal) -> None:
        """Note that a message reached nobody."""
        self._refused += 1
        self._context.record("refused", (refusal.number, refusal.reason))

    def step(self, tick: Tick) -> None:
        """Command an acceleration, and say by radio where this car is: to all in reach, and to the car behind."""
        self._tick = tick.index
        driven_m, speed_m_s = self._own
        parameters = self._context.parameters
        gap_m = self._ahead[0] - driven_m - parameters.car_m
        wanted = acceleration_m_s2(parameters.driver, speed_m_s, speed_m_s - self._ahead[1], gap_m)
        self._context.record("drive", (tick.index, speed_m_s, gap_m, wanted))
        self._context.send(HOST, {"acceleration_m_s2": wanted})
        self._context.send(EVERYBODY, [driven_m, speed_m_s])
        self._context.send(self._behind, [driven_m, speed_m_s])
        self._sent += 2

    def finish(self) -> Mapping[str, Any]:
        """Return what was sent, heard of all and of the car ahead, and refused."""
        return {
            "sent": self._sent,
            "heard": self._heard,
            "heard_ahead": self._heard_ahead,
            "refused": self._refused,
        }
