"""
Slot keeping that closes its thruster off where it is stuck open: the tank's gauge tells it.

Propellant that goes from one reading of the gauge to the next without a burn of one's own is the thruster's. After
`readings_min` such falls in a row a change of velocity of nothing is commanded, which closes the thruster off, and
again every `again_s` as long as it goes on.

flight.settings: those of `slot_keeping`, and

    closes          whether it is done; false: the gauge is not looked at (true)
    readings_min    falls in a row (3)
    again_s         s (10)
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from slot_keeping import SlotKeeping

from madns_runtime.simulations.constellation.flight.api import (
    FlightContext,
    Readings,
)
from madns_runtime.simulations.constellation.messages import CommandResult

FALL_KG_MIN = 1e-6
"""Least fall of propellant that is one."""


class ClosingSlotKeeping(SlotKeeping):
    """One satellite of the ring that watches its tank."""

    def setup(self, context: FlightContext) -> None:
        """Read the settings."""
        super().setup(context)
        settings = context.settings
        self._closes = settings.get("closes", True)
        if not isinstance(self._closes, bool):
            raise ValueError(
                f"flight.settings.closes: expected true or false, got {self._closes!r}"
            )
        self._readings_min = int(settings.get("readings_min", 3))
        self._again_s = float(settings.get("again_s", 10.0))
        self._propellant_kg = math.inf
        self._falls, self._closings, self._has_burnt = 0, 0, False
        self._next_closing_s = 0.0

    def step(self, t_s: float, readings: Readings) -> None:
        """Look at the gauge, and keep the slot."""
        gauge = readings.get("mass")
        if gauge is not None:
            self._look(t_s, gauge.values[1])
        super().step(t_s, readings)

    def command_result(self, result: CommandResult) -> None:
        """Note that the next fall is of one's own burn."""
        super().command_result(result)
        self._has_burnt |= result.status == "executed" and result.delta_v_m_s > 0.0

    def finish(self) -> Mapping[str, Any]:
        """Return what it believes at the end, and how often it closed the thruster off."""
        return {**super().finish(), "closings": self._closings}

    def _look(self, t_s: float, propellant_kg: float) -> None:
        """Close the thruster off if propellant goes again and again without a burn."""
        fell = propellant_kg < self._propellant_kg - FALL_KG_MIN
        is_known = math.isfinite(self._propellant_kg)
        self._falls = self._falls + 1 if fell and is_known and not self._has_burnt else 0
        self._propellant_kg, self._has_burnt = propellant_kg, False
        if self._closes and self._falls >= self._readings_min and t_s >= self._next_closing_s:
            self.context.delta_v((0.0, 0.0, 0.0), at_s=t_s + self._lead_s)
            self._closings += 1
            self._next_closing_s = t_s + self._again_s
