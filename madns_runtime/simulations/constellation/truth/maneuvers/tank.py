"""
Mass of a vehicle and propellant in its tank: burns are booked as they are accepted. Pure.

By the rocket equation each multiplies the mass by a factor of its own, so that what is left after all of them is right
in whatever order they burn. Until a burn is over the tank holds what is booked for it, see `Tank.left_kg`: that depends
on the order of their times. One that is booked before others of later times lifts more mass than they leave, and they less.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from madns_runtime.simulations.constellation.equipment import Vehicle
from madns_runtime.simulations.constellation.truth.maneuvers.effects import Effect

ROUNDING_SHARE = 1e-12
"""Of a vehicle's mass: so much more than what is left may be asked for by whoever means all of it; 2e-9 m/s."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BookedBurn:
    """A burn that may not be over."""

    accepted: Effect
    flown: Effect
    """The same, or less of it if the tank runs empty."""
    kg: float
    """Propellant that is burnt in it."""

    @property
    def delta_v_m_s(self) -> float:
        """Magnitude of the change of velocity that is flown."""
        return math.hypot(*self.flown.vector)

    @property
    def is_drained(self) -> bool:
        """Whether the tank runs empty before it is over."""
        return self.flown is not self.accepted


class Tank:
    """Mass and propellant of one vehicle."""

    def __init__(self, vehicle: Vehicle) -> None:
        self.mass_kg = vehicle.mass_kg
        """Mass after all that is booked."""
        self.propellant_kg = vehicle.thruster.propellant_kg if vehicle.thruster else 0.0
        """Propellant that is not booked yet."""
        self._booked: list[BookedBurn] = []

    def book(self, effect: Effect, propellant_kg: float, *, now_s: float) -> None:
        """Take off the propellant of a burn, weighed after all others, and forget those that are over now."""
        waiting = [each for each in self._booked if each.flown.end_s > now_s]
        self._booked, own_kg = [], propellant_kg
        for each in waiting:
            # Before a later one the vehicle is still as heavy, and lighter afterwards.
            moved_kg = effect.burnt * each.kg if each.flown.start_s > effect.start_s else 0.0
            own_kg += moved_kg
            self._booked.append(replace(each, kg=each.kg - moved_kg))
        self._booked.append(BookedBurn(accepted=effect, flown=effect, kg=own_kg))
        self.burn(propellant_kg)

    def unbook_after(self, t_s: float) -> list[Effect]:
        """Put back what is booked for burns that begin after *t_s*, and return them as accepted, the first one first."""
        later = [each for each in self._booked if each.flown.start_s > t_s]
        self._booked = [each for each in self._booked if each.flown.start_s <= t_s]
        self.burn(-sum(each.kg for each in later))
        return sorted((each.accepted for each in later), key=lambda effect: effect.start_s)

    def book_again(self, effect: Effect) -> BookedBurn:
        """Take off what a burn that was unbooked burns of the present mass, or what is left for it."""
        needed_kg = effect.burnt * self.mass_kg
        kg, flown = min(needed_kg, self.propellant_kg), effect
        if needed_kg > self.propellant_kg + self.mass_kg * ROUNDING_SHARE:
            flown = effect.drained(kg / self.mass_kg)
        booked = BookedBurn(accepted=effect, flown=flown, kg=kg)
        self._booked.append(booked)
        self.burn(kg)
        return booked

    def left_kg(self, t_s: float) -> float:
        """Return what the tank holds at *t_s*, not long ago or later: what burns booked until now have not burnt by then."""
        held_kg = 0.0
        for each in self._booked:
            start_s, end_s = each.flown.start_s, each.flown.end_s
            if end_s > t_s:  # the flow of a burn is even
                held_kg += (
                    each.kg if t_s <= start_s else each.kg * (end_s - t_s) / (end_s - start_s)
                )
        return self.propellant_kg + held_kg

    def burn(self, propellant_kg: float) -> None:
        """Take propellant off; less than 0 gives back what was not burnt."""
        self.mass_kg -= propellant_kg
        self.propellant_kg = max(0.0, self.propellant_kg - propellant_kg)
