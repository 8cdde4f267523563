"""
Slot keeping of which some lie to their neighbours: a liar keeps its own slot, and tells each side another story.

From `lies_from_s` on, all phases that it tells the neighbours of one side, its own and hearsay, are `lie_deg` too
large, and of the other side as much too small, each as if measured just now: what a plain ring believes, as the
newest news wins. So the ring parts into two halves that pull in opposite directions.

flight.settings: those of `slot_keeping`, and

    liars          satellites that lie; the others are as honest as `slot_keeping`
    lies_from_s    when it begins, s (0)
    lie_deg        deg (2)
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from slot_keeping import SlotKeeping

from madns_runtime.simulations.constellation.flight.api import FlightContext, Readings
from madns_runtime.simulations.constellation.flight.gossip import ENTRY


class LyingSlotKeeping(SlotKeeping):
    """One satellite of the ring, to be trusted or not."""

    def setup(self, context: FlightContext) -> None:
        """Speak to the radio by way of the forger, if it is a liar."""
        lies = context.satellite in context.settings.get("liars", ())
        self._forger = Forger(context) if lies else None
        super().setup(context if self._forger is None else self._forger)

    def step(self, t_s: float, readings: Readings) -> None:
        """Tell the forger the time, and keep the slot."""
        if self._forger is not None:
            self._forger.t_s = t_s
        super().step(t_s, readings)


class Forger:
    """
    A flight context whose messages are forged.

    Args:
        context: The vehicle's own.
    """

    def __init__(self, context: FlightContext) -> None:
        self.t_s = 0.0
        self._context = context
        settings = context.settings
        self._from_s = float(settings.get("lies_from_s", 0.0))
        self._lie_rad = math.radians(float(settings.get("lie_deg", 2.0)))

    def __getattr__(self, name: str) -> Any:
        return getattr(self._context, name)

    def send(self, to: str, payload: Any) -> int:
        """Send a message by radio, with other entries if it is time."""
        if self.t_s >= self._from_s:
            payload = payload | {"entries": self._forged(to, payload["entries"])}
        return self._context.send(to, payload)

    def _forged(self, to: str, entries: bytes) -> bytes:
        forged = np.frombuffer(entries, dtype=ENTRY).copy()
        agents = self._context.agents
        ahead = (agents.index(to) - self._context.index) % len(agents)
        sign = 1.0 if ahead <= len(agents) // 2 else -1.0
        turned = forged["phase_rad"] + sign * self._lie_rad
        forged["phase_rad"] = (turned + math.pi) % math.tau - math.pi
        forged["age"] = 0
        return forged.tobytes()
