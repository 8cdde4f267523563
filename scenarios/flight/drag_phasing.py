"""
Slot keeping by drag alone: brake a little more than the others to fall ahead, a little less to fall behind.

Drag lowers the orbit, and a lower orbit is faster: against satellites whose ballistic coefficient is
dB = Cd A / m smaller, the argument of latitude gains

    theta'' = 3/2 rho v^2 / a dB

(Foster et al., Differential drag control scheme for large constellation of Planet satellites, 2018).
A satellite commands its coefficient by turning: high drag, low drag, or what is between once its slot
is near. It brakes in time along the parabola of a full-drag approach. Where the slot is, and how fast
the ring's phase moves, it learns through its two neighbours alone, as `slot_keeping` does.

flight.settings: see `RingSettings`, and

    ballistic_m2_kg_low     (0.01)
    ballistic_m2_kg_high    (0.06), both within the vehicle's ballistic_m2_kg_range
    density_kg_m3           at the ring's altitude, as far as known (1.5e-12)
    slot_deg                slot error below which drag is no more at its limits, deg (0.03)
    damping_h               time by which the rate is looked ahead near the slot, h (8)
    decision_s              between two commands, s (1800)
    lead_s                  from command to turn, s (30)
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from madns_runtime.simulations.constellation.flight.api import (
    FlightContext,
    FlightSoftware,
    Readings,
)
from madns_runtime.simulations.constellation.flight.ring_consensus import (
    RingMember,
    position_reading,
)
from madns_runtime.simulations.constellation.messages import CommandResult, Delivery

COMMAND_SHARE_MIN = 0.02
"""Of the range: a smaller change is not worth a turn."""
SAFETY = 0.7
"""Share of the acceleration that the approach counts on: density is known badly."""


class DragPhasing(FlightSoftware):
    """One satellite of the ring."""

    def setup(self, context: FlightContext) -> None:
        """Read the settings."""
        self.context = context
        self._ring = RingMember(context, follows_sma=True)
        settings = context.settings
        low = float(settings.get("ballistic_m2_kg_low", 0.01))
        high = float(settings.get("ballistic_m2_kg_high", 0.06))
        self._low, self._high = low, high
        self._middle, self._half = 0.5 * (low + high), 0.5 * (high - low)
        self._slot_rad = math.radians(float(settings.get("slot_deg", 0.03)))
        self._damping_s = 3600.0 * float(settings.get("damping_h", 8.0))
        self._decision_s = float(settings.get("decision_s", 1800.0))
        self._lead_s = float(settings.get("lead_s", 30.0))
        speed = self._ring.design.a_m * self._ring.rate_rad_s
        density = float(settings.get("density_kg_m3", 1.5e-12))
        self._authority = phase_acceleration(density, speed, self._ring.design.a_m, self._half)
        self._next_decision_s = self._decision_s * (1.0 + (context.index * 0.618) % 1.0)
        self._ballistic = self._middle
        self._commands, self._refused = 0, 0

    def step(self, t_s: float, readings: Readings) -> None:
        """Do what is due; most ticks find nothing."""
        if t_s < self._ring.next_s or (reading := position_reading(readings)) is None:
            return
        ring = self._ring
        ring.exchange(reading)
        assert ring.mean is not None
        if t_s >= self._next_decision_s:
            self._next_decision_s += self._decision_s
            self._decide(t_s)
        self.context.estimate(
            {
                "slot_error_deg": math.degrees(ring.slot_error_rad),
                "sma_mean_m": ring.mean.a_m,
                "sma_ring_m": ring.sma_ring_m,
                "ballistic_m2_kg": self._ballistic,
                "messages": ring.sent,
                "members": ring.members,
            }
        )

    def receive(self, message: Delivery) -> None:
        """Hear a neighbour."""
        self._ring.hear(message)

    def command_result(self, result: CommandResult) -> None:
        """Count what was not done."""
        self._refused += result.status == "refused"

    def finish(self) -> Mapping[str, Any]:
        """Return what it believes at the end."""
        return {
            "slots": self._ring.settings.slots,
            "slot_error_deg": math.degrees(self._ring.slot_error_rad),
            "commands": self._commands,
            "refused": self._refused,
            "messages": self._ring.sent,
            "neighbours": len(self._ring.neighbours),
            "members": self._ring.members,
        }

    def _decide(self, t_s: float) -> None:
        """Command the coefficient that leads to the slot."""
        ring = self._ring
        assert ring.mean is not None
        a_m = ring.sma_ring_m
        rate_rad_s = -1.5 * ring.rate_rad_s / a_m * (ring.mean.a_m - a_m)
        # Where it will be once the rate is braked away; near the slot by a fixed time, else it would swing.
        braking_s = max(0.5 * abs(rate_rad_s) / (SAFETY * self._authority), self._damping_s)
        ahead_rad = ring.slot_error_rad + rate_rad_s * braking_s
        share = min(max(-ahead_rad / self._slot_rad, -1.0), 1.0)
        wanted = min(max(self._middle + share * self._half, self._low), self._high)
        is_small = abs(wanted - self._ballistic) < 2.0 * COMMAND_SHARE_MIN * self._half
        if is_small and self._commands:
            return
        self._ballistic = wanted
        self.context.ballistic(wanted, at_s=t_s + self._lead_s)
        self._commands += 1


def phase_acceleration(
    density_kg_m3: float, speed_m_s: float, a_m: float, ballistic_m2_kg: float
) -> float:
    """Return theta'' = 3/2 rho v^2 / a dB of a difference in ballistic coefficient, rad/s^2."""
    return 1.5 * density_kg_m3 * speed_m_s**2 / a_m * ballistic_m2_kg
