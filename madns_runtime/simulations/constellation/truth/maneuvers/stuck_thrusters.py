"""
Thrusters that are stuck open: they burn at their thrust, arc by arc, until closed off, mended or without propellant. Pure.

When a burn will end is not known while it goes on, so truth is given one short arc after the other, each a little
ahead of its time. What was given too much is cut off again: the arc under way keeps its acceleration and ends sooner.
Along the axes of a body that turns an arc is cut into several, each along the direction of its own middle.

Burns that were accepted before and are yet to come have no claim to propellant: they burn after the arcs, of what is left.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Literal

from madns_runtime.simulations.constellation.equipment import Vehicle
from madns_runtime.simulations.constellation.messages import Command, CommandFrame
from madns_runtime.simulations.constellation.thrust import Vector
from madns_runtime.simulations.constellation.truth.maneuvers.actuators import exhaust_m_s
from madns_runtime.simulations.constellation.truth.maneuvers.effects import (
    ARC_S_MIN,
    Effect,
    Timeline,
    scaled,
    snap,
)
from madns_runtime.simulations.constellation.truth.maneuvers.tank import (
    BookedBurn,
    Tank,
)

ARC_S = 5.0
"""Length of an arc: its direction is that of its middle, 0.15 deg from where it begins in LEO."""
ARC_TURN_RAD = 0.3
"""Most that a body turns in one arc along its axes: the arc gives 0.4 % more than the mean of a push that turns as far."""
TURNED_ARC_S_MIN = 0.05
"""Shortest arc that turning asks for, s."""
AHEAD_S = 2.0
"""Before the end of an arc the next one is given."""
STUCK_NUMBER_FIRST = 2**31
"""Arcs count from here on, effects of commands from 0."""

RAN_EMPTY = "the tank ran empty: the thruster was stuck open before"
"""Reason in the result of a burn that was accepted and gave less."""

BurnState = Literal["open", "closed", "empty", "mended"]


@dataclass(frozen=True, slots=True, kw_only=True)
class StuckDirection:
    """Force of a thruster that is stuck open."""

    thrust_n: float
    direction: Vector
    """Of the push, length 1."""
    frame: CommandFrame


@dataclass(slots=True)
class StuckBurn:
    """One thruster that is stuck open."""

    vehicle: int
    push: StuckDirection
    exhaust_m_s: float
    begins_s: float
    given_until_s: float
    """Until when truth is given, arcs and what lies between them."""
    ends_s: float = math.inf
    """Until when it burns; infinity while no end is known."""
    ends_as: BurnState = "open"
    """How it ends."""
    delta_v_m_s: float = 0.0
    """Given by all arcs."""
    propellant_kg: float = 0.0
    """Burnt by all arcs."""
    arcs: list[tuple[Effect, float]] = field(default_factory=list)
    """Those that may be cut yet, with the vehicle's mass at their beginning, kg."""

    def state(self, t_s: float) -> BurnState:
        """Return whether it burns at *t_s*, or why not any more."""
        return "open" if t_s < self.ends_s else self.ends_as

    @property
    def flow_kg_s(self) -> float:
        """Propellant burnt in a second."""
        return self.push.thrust_n / self.exhaust_m_s

    def arc_of(self, effect: Effect, mass_kg: float, end_s: float) -> Effect:
        """Return an arc with another end, at the same thrust."""
        burnt = self.flow_kg_s * (end_s - effect.start_s) / mass_kg
        delta_v_m_s = -self.exhaust_m_s * math.log1p(-burnt)
        return replace(
            effect, end_s=end_s, burnt=burnt, vector=scaled(self.push.direction, delta_v_m_s)
        )


def is_closure(command: Command) -> bool:
    """Return whether a command closes a thruster off: no change of velocity; of one that is not stuck open it is refused."""
    return command.kind == "delta_v" and not any(command.vector)


class StuckThrusters:
    """
    All vehicles' thrusters that are stuck open, at most one each.

    Args:
        vehicles: What they are like.
        timelines: What is done to each; arcs are put there.
        tanks: What is left in each.
        knot_s: Time between knots of truth.
        duration_s: The run's: no arc lies behind it.
    """

    def __init__(
        self,
        vehicles: Sequence[Vehicle],
        timelines: Sequence[Timeline],
        tanks: Sequence[Tank],
        *,
        knot_s: float,
        duration_s: float,
    ) -> None:
        self.burns: dict[int, StuckBurn] = {}
        """By vehicle, those whose failure is in force."""
        self.drained: dict[tuple[int, int], BookedBurn] = {}
        """By vehicle and number, burns that were accepted and for which too little propellant is left."""
        self._vehicles = vehicles
        self._timelines = timelines
        self._tanks = tanks
        self._knot_s = knot_s
        self._duration_s = duration_s
        self._count = 0

    def open(self, vehicle: int, push: StuckDirection, begins_s: float) -> StuckBurn:
        """Let a vehicle's thruster burn from *begins_s* on; it must have one, and not be stuck already."""
        thruster = self._vehicles[vehicle].thruster
        assert thruster is not None and vehicle not in self.burns
        begins_s = snap(begins_s, self._knot_s)
        burn = StuckBurn(
            vehicle=vehicle,
            push=push,
            exhaust_m_s=exhaust_m_s(thruster),
            begins_s=begins_s,
            given_until_s=begins_s,
        )
        self.burns[vehicle] = burn
        return burn

    def extend(self, burn: StuckBurn, t_s: float, turn_rad_s: float = 0.0) -> float | None:
        """
        Give what is due by *t_s*; return from when truth has changed, None if it has not.

        Args:
            burn: One of the burns.
            t_s: The time.
            turn_rad_s: Rate at which the axes of its push turn.
        """
        changed_s = None
        last_s = min(burn.ends_s, self._duration_s)
        while burn.given_until_s < last_s and t_s >= burn.given_until_s - AHEAD_S:
            start_s, end_s = self._free(burn)
            end_s = min(end_s, burn.ends_s)
            later = self._tanks[burn.vehicle].unbook_after(start_s)
            left_s = self._tanks[burn.vehicle].propellant_kg / burn.flow_kg_s
            if left_s < end_s - start_s:
                end_s = last_s = burn.ends_s = start_s + left_s
                burn.ends_as = "empty"
            if end_s - start_s >= ARC_S_MIN:
                for edges_s in pairwise(self._arc_edges_s(start_s, end_s, turn_rad_s)):
                    self._give(burn, *edges_s)
                changed_s = start_s if changed_s is None else changed_s
            self._book_again(burn.vehicle, later)
            burn.given_until_s = max(end_s, start_s)
        burn.arcs = [arc for arc in burn.arcs if arc[0].end_s > t_s]
        return changed_s

    def close(self, vehicle: int, at_s: float, ends_as: BurnState) -> float | None:
        """End a burn at *at_s* if it does not end sooner; return from when truth has changed, None if it has not."""
        burn = self.burns[vehicle]
        at_s = max(snap(at_s, self._knot_s), burn.begins_s)
        if burn.ends_s <= at_s:
            return None
        burn.ends_s, burn.ends_as = at_s, ends_as
        if burn.given_until_s <= at_s:
            return None
        burn.given_until_s = at_s
        later = self._tanks[vehicle].unbook_after(at_s)
        is_cut = self._cut(burn, at_s)
        self._book_again(vehicle, later)
        return at_s if is_cut else None

    def fault(self, vehicle: int, command: Command) -> str:
        """Return why a thruster that is stuck open does not do what is commanded; empty if it does."""
        burn = self.burns.get(vehicle)
        if burn is None or command.kind != "delta_v":
            return ""
        if math.isfinite(burn.ends_s):
            return f"the thruster was stuck open and is {burn.ends_as} from {burn.ends_s:.3f} s on"
        if not is_closure(command):
            return "the thruster is stuck open; a change of velocity of 0 m/s closes it off"
        return ""

    def lift(self, vehicle: int) -> None:
        """Let the thruster be as it was; its burn is closed, or over."""
        self.burns.pop(vehicle, None)

    def left_kg(self, vehicle: int, t_s: float) -> float:
        """Return what is left in a vehicle's tank at *t_s*, whether its thruster is stuck open or not."""
        burn = self.burns.get(vehicle)
        return self._tanks[vehicle].left_kg(t_s) if burn is None else self.propellant_kg(burn, t_s)

    def propellant_kg(self, burn: StuckBurn, t_s: float) -> float:
        """Return what is left in the tank at *t_s*, of which arcs to come are taken off already."""
        ahead_s = sum(max(0.0, arc.end_s - max(arc.start_s, t_s)) for arc, _ in burn.arcs)
        return self._tanks[burn.vehicle].left_kg(t_s) + burn.flow_kg_s * ahead_s

    def delta_v_m_s(self, burn: StuckBurn, t_s: float) -> float:
        """Return what the burn has given by *t_s*."""
        ahead_m_s = 0.0
        for arc, mass_kg in burn.arcs:
            done_s = min(max(t_s, arc.start_s), arc.end_s)
            done = burn.arc_of(arc, mass_kg, done_s)
            ahead_m_s += math.hypot(*arc.vector) - math.hypot(*done.vector)
        return burn.delta_v_m_s - ahead_m_s

    def _free(self, burn: StuckBurn) -> tuple[float, float]:
        """Return the next time that no burn has which was commanded before: from when on, until when."""
        commanded = [
            each
            for each in self._timelines[burn.vehicle].effects
            if each.kind in ("thrust", "impulse") and each.number < STUCK_NUMBER_FIRST
        ]
        start_s = burn.given_until_s
        for other in commanded:
            if other.start_s <= start_s < other.end_s:
                start_s = other.end_s
        knot_s = math.floor((start_s + ARC_S) / self._knot_s + 1e-9) * self._knot_s
        end_s = knot_s if knot_s - start_s >= ARC_S / 2.0 else start_s + ARC_S
        return start_s, min([end_s, *(o.start_s for o in commanded if o.start_s > start_s)])

    def _arc_edges_s(self, start_s: float, end_s: float, turn_rad_s: float) -> list[float]:
        """Return where arcs begin and end that are short enough for axes that turn."""
        span_s = end_s - start_s
        count = min(math.ceil(turn_rad_s * span_s / ARC_TURN_RAD), int(span_s / TURNED_ARC_S_MIN))
        inner = (snap(start_s + span_s * n / count, self._knot_s) for n in range(1, count))
        return [start_s, *inner, end_s]

    def _give(self, burn: StuckBurn, start_s: float, end_s: float) -> None:
        tank = self._tanks[burn.vehicle]
        bare = Effect(
            number=STUCK_NUMBER_FIRST + self._count,
            kind="thrust",
            at_s=start_s + (end_s - start_s) / 2.0,
            start_s=start_s,
            end_s=end_s,
            vector=(0.0, 0.0, 0.0),
            frame=burn.push.frame,
        )
        self._count += 1
        arc = burn.arc_of(bare, tank.mass_kg, end_s)
        burn.arcs.append((arc, tank.mass_kg))
        self._timelines[burn.vehicle].add(arc)
        self._take(burn, end_s - start_s, math.hypot(*arc.vector))

    def _cut(self, burn: StuckBurn, at_s: float) -> bool:
        """Take back what was given after *at_s*; tell whether anything was."""
        kept, is_cut = [], False
        timeline = self._timelines[burn.vehicle]
        for arc, mass_kg in burn.arcs:
            if arc.end_s <= at_s:
                kept.append((arc, mass_kg))
                continue
            is_cut = True
            # What is too short for an arc was none.
            end_s = at_s if at_s - arc.start_s >= ARC_S_MIN else arc.start_s
            shorter = burn.arc_of(arc, mass_kg, end_s)
            lost_m_s = math.hypot(*shorter.vector) - math.hypot(*arc.vector)
            self._take(burn, end_s - arc.end_s, lost_m_s)
            timeline.exchange(arc, shorter if end_s > arc.start_s else None)
            if end_s > arc.start_s:
                kept.append((shorter, mass_kg))
        burn.arcs = kept
        return is_cut

    def _book_again(self, vehicle: int, later: Sequence[Effect]) -> None:
        """Let burns that are yet to come burn what the arcs leave, the first one first."""
        for effect in later:
            booked = self._tanks[vehicle].book_again(effect)
            self._timelines[vehicle].exchange(effect, booked.flown)
            self.drained.pop((vehicle, effect.number), None)
            if booked.is_drained:
                self.drained[vehicle, effect.number] = booked

    def _take(self, burn: StuckBurn, duration_s: float, delta_v_m_s: float) -> None:
        """Take off what an arc burns, or give back what one that is cut does not."""
        kg = burn.flow_kg_s * duration_s
        self._tanks[burn.vehicle].burn(kg)
        burn.propellant_kg += kg
        burn.delta_v_m_s += delta_v_m_s
