"""
Slot keeping by burns: once an orbit, a mean semi-major axis that lets the slot error die out.

A satellite ahead of its slot goes a little higher, where it is slower: with a time constant tau,

    da = 2 a dlam / (3 n tau)

on top of the ring's mean semi-major axis, reached by two along-track burns half an orbit apart, which
leave the orbit as round as it was. Where the slot is, it learns through its two neighbours alone.

flight.settings: see `RingSettings`, and

    time_constant_h       tau, h (8)
    delta_v_m_s_min       smaller burns are left out, m/s (0.0005)
    delta_v_m_s_max       larger ones are cut, m/s (1)
    lead_s                from command to burn, s (5)
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

SAMPLES_MIN = 4
"""Samples of the mean semi-major axis before it is acted on: their mean is free of what J2^2 leaves."""


class SlotKeeping(FlightSoftware):
    """One satellite of the ring."""

    def setup(self, context: FlightContext) -> None:
        """Read the settings; the first command waits until news has come some way."""
        self.context = context
        self._ring = RingMember(context, follows_sma=False)
        settings = context.settings
        self._tau_s = 3600.0 * float(settings.get("time_constant_h", 8.0))
        self._smallest_m_s = float(settings.get("delta_v_m_s_min", 5e-4))
        self._largest_m_s = float(settings.get("delta_v_m_s_max", 1.0))
        self._lead_s = float(settings.get("lead_s", 5.0))
        self._orbit_s = math.tau / self._ring.rate_rad_s
        # Neighbours' burns are spread over the orbit, and so is their traffic.
        share = (context.index * 0.618) % 1.0
        self._next_command_s = (1.5 + share) * self._orbit_s
        self._second_s, self._second_m_s = math.inf, 0.0
        self._quiet_s = 0.0
        self._sma_sum_m, self._samples = 0.0, 0
        self._sma_wanted_m = self._ring.design.a_m
        self._delta_v_m_s, self._burns, self._refused = 0.0, 0, 0

    def step(self, t_s: float, readings: Readings) -> None:
        """Do what is due; most ticks find nothing."""
        if t_s >= self._second_s:
            self._burn(self._second_m_s, t_s)
            self._second_s = math.inf
        if t_s < self._ring.next_s or (reading := position_reading(readings)) is None:
            return
        ring = self._ring
        ring.exchange(reading)
        assert ring.mean is not None
        if reading.t_s >= self._quiet_s:
            self._sma_sum_m += ring.mean.a_m
            self._samples += 1
        if t_s >= self._next_command_s and self._samples >= SAMPLES_MIN:
            self._command(t_s)
        self.context.estimate(
            {
                "slot_error_deg": math.degrees(ring.slot_error_rad),
                "sma_mean_m": ring.mean.a_m,
                "sma_wanted_m": self._sma_wanted_m,
                "delta_v_m_s": self._delta_v_m_s,
                "messages": ring.sent,
                "members": ring.members,
            }
        )

    def receive(self, message: Delivery) -> None:
        """Hear a neighbour."""
        self._ring.hear(message)

    def command_result(self, result: CommandResult) -> None:
        """Count what was really given."""
        if result.status == "executed":
            self._delta_v_m_s += abs(result.delta_v_m_s)
        self._refused += result.status == "refused"

    def finish(self) -> Mapping[str, Any]:
        """Return what it believes at the end."""
        return {
            "slots": self._ring.settings.slots,
            "slot_error_deg": math.degrees(self._ring.slot_error_rad),
            "delta_v_m_s": self._delta_v_m_s,
            "burns": self._burns,
            "refused": self._refused,
            "messages": self._ring.sent,
            "neighbours": len(self._ring.neighbours),
            "members": self._ring.members,
            **({"entries_refused": self._ring.refused} if self._ring.settings.screens else {}),
        }

    def _command(self, t_s: float) -> None:
        """Command half of what is missing now and the other half in half an orbit."""
        ring = self._ring
        self._next_command_s += self._orbit_s
        a_m, n_rad_s = ring.sma_ring_m, ring.rate_rad_s
        ahead_rad = ring.slot_error_rad
        self._sma_wanted_m = a_m + 2.0 * a_m * ahead_rad / (3.0 * n_rad_s * self._tau_s)
        lacking_m = self._sma_wanted_m - self._sma_sum_m / self._samples
        half_m_s = 0.25 * n_rad_s * lacking_m
        if abs(half_m_s) < self._smallest_m_s:
            return
        half_m_s = min(max(half_m_s, -self._largest_m_s), self._largest_m_s)
        self._burn(half_m_s, t_s)
        self._second_s, self._second_m_s = t_s + 0.5 * self._orbit_s, half_m_s
        # What was sampled before the second burn says nothing of the orbit after it.
        self._quiet_s = self._second_s + self._lead_s + 1.0
        self._sma_sum_m, self._samples = 0.0, 0

    def _burn(self, along_m_s: float, t_s: float) -> None:
        self.context.delta_v((0.0, along_m_s, 0.0), at_s=t_s + self._lead_s, frame="rtn")
        self._burns += 1
