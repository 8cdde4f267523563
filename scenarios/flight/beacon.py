"""
A satellite that says it is there: to its neighbours, to the ground, and when the ground asks.

It does not know where the stations are: most of its status messages meet no station, as the scenario's
stream "links" tells, and those within a pass come down.

flight.settings:

    status_s    between two status messages to the ground, s (60)
    beacon_s    between two broadcasts to neighbours, s (30)
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from madns_runtime.simulations.constellation.flight.api import (
    FlightContext,
    FlightSoftware,
    Readings,
)
from madns_runtime.simulations.constellation.messages import GROUND, Delivery

NEIGHBOUR_BEACONS = 3
"""Beacons after which a neighbour that was not heard any more is none."""


class Beacon(FlightSoftware):
    """One satellite."""

    def setup(self, context: FlightContext) -> None:
        """Read the settings; satellites do not all speak in the same tick."""
        self.context = context
        self._status_s = float(context.settings.get("status_s", 60.0))
        self._beacon_s = float(context.settings.get("beacon_s", 30.0))
        share = context.index / len(context.agents)
        self._next_status_s, self._next_beacon_s = share * self._status_s, share * self._beacon_s
        self._heard_s: dict[str, float] = {}
        self._orders = 0
        self._delay_s_max = 0.0

    def step(self, t_s: float, readings: Readings) -> None:
        """Speak when it is time to."""
        if t_s >= self._next_beacon_s:
            self._next_beacon_s = following_s(self._next_beacon_s, self._beacon_s, t_s)
            self.context.broadcast({"beacon": self.context.satellite})
        if t_s >= self._next_status_s:
            self._next_status_s = following_s(self._next_status_s, self._status_s, t_s)
            self.context.send(GROUND, self._status(t_s))
            self.context.estimate({"neighbours": float(self._neighbours(t_s))})

    def receive(self, message: Delivery) -> None:
        """Note a neighbour, or answer the station that asks."""
        self._delay_s_max = max(self._delay_s_max, message.arrives_s - message.sent_s)
        if not message.sender.startswith(f"{GROUND}:"):
            self._heard_s[message.sender] = message.arrives_s
            return
        self._orders += 1
        answer = self._status(message.arrives_s) | {"order": message.payload}
        self.context.send(message.sender, answer)

    def finish(self) -> Mapping[str, Any]:
        """Return who was heard."""
        return {
            "vehicles_heard": len(self._heard_s),
            "orders": self._orders,
            "delay_s_max": self._delay_s_max,
        }

    def _neighbours(self, t_s: float) -> int:
        since_s = t_s - NEIGHBOUR_BEACONS * self._beacon_s
        return sum(heard_s >= since_s for heard_s in self._heard_s.values())

    def _status(self, t_s: float) -> dict[str, Any]:
        return {"satellite": self.context.satellite, "neighbours": self._neighbours(t_s)}


def following_s(due_s: float, period_s: float, now_s: float) -> float:
    """Return when something is due again; a satellite that was away does not make up for what it left out."""
    return due_s + period_s if due_s + period_s > now_s else now_s + period_s
