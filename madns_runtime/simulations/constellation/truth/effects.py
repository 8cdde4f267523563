"""
What commands do to truth: changes of velocity, arcs of thrust and torque, and of the ballistic coefficient. Pure.

An effect is what an actuator really gives, errors included; its frame is resolved when truth is propagated,
since the directions at that time depend on what was done before.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

from madns_runtime.simulations.constellation.messages import CommandFrame
from madns_runtime.simulations.constellation.thrust import Thrust, Vector

EffectKind = Literal["impulse", "thrust", "torque", "ballistic"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Effect:
    """One change of a vehicle's truth."""

    number: int
    """Place among the effects of its vehicle in the order in which they were taken."""
    kind: EffectKind
    at_s: float
    """T_m: when its frame is resolved; the middle of a thrust arc."""
    start_s: float
    """From when truth is another one."""
    end_s: float
    """Until when it acts; start_s for an impulse and for a ballistic coefficient."""
    vector: Vector
    """impulse and thrust: change of velocity, m/s; torque: N m, body; ballistic: m^2/kg and two zeros."""
    frame: CommandFrame = "inertial"
    burnt: float = 0.0
    """Share of the vehicle's mass that a thrust arc burns."""

    @property
    def is_arc(self) -> bool:
        """Whether it takes time."""
        return self.end_s > self.start_s

    @property
    def order(self) -> tuple[float, int]:
        """Sorts effects: by time, those of one time as they were taken."""
        return self.start_s, self.number


class Timeline:
    """The effects of one vehicle that truth may still depend on, in order."""

    def __init__(self, ballistic_m2_kg: float) -> None:
        self.ballistic_m2_kg = ballistic_m2_kg
        """Ballistic coefficient before the first effect held."""
        self.wheels_n_m_s: Vector = (0.0, 0.0, 0.0)
        """Momentum that wheels had taken up before the first effect held, body axes, N m s."""
        self.effects: tuple[Effect, ...] = ()
        self.thrusts: dict[int, Thrust] = {}
        """Of the thrust arcs that truth already holds, by the effect's number."""

    def add(self, effect: Effect) -> None:
        """Put an effect where its time belongs."""
        self.effects = tuple(sorted((*self.effects, effect), key=lambda e: e.order))

    def from_time(self, t_s: float) -> tuple[Effect, ...]:
        """Return those that act at *t_s* or begin after it; what acts once at *t_s* is in its state already."""
        return tuple(e for e in self.effects if e.start_s > t_s or e.end_s > t_s)

    def between(self, t0_s: float, t1_s: float) -> tuple[Effect, ...]:
        """Return those that act within (t0_s, t1_s]."""
        return tuple(e for e in self.from_time(t0_s) if e.start_s <= t1_s)

    def ballistic_at(self, t_s: float) -> float:
        """Return the ballistic coefficient from *t_s* on, m^2/kg."""
        value = self.ballistic_m2_kg
        for effect in self.effects:
            if effect.kind == "ballistic" and effect.start_s <= t_s:
                value = effect.vector[0]
        return value

    def wheels_at(self, t_s: float) -> Vector:
        """Return the momentum that wheels have taken up until *t_s*, body axes, N m s."""
        taken = [self.wheels_n_m_s]
        for effect in self.effects:
            if effect.kind == "torque" and effect.start_s < t_s:
                taken.append(scaled(effect.vector, effect.start_s - min(t_s, effect.end_s)))
        return total(taken)

    def forget_before(self, t_s: float) -> None:
        """Drop what is over before *t_s*."""
        if not self.effects or self.effects[0].start_s >= t_s:
            return
        over = tuple(e for e in self.effects if e.end_s < t_s)
        kept = tuple(e for e in self.effects if e.end_s >= t_s)
        self.effects = over
        self.ballistic_m2_kg, self.wheels_n_m_s = self.ballistic_at(t_s), self.wheels_at(t_s)
        self.effects = kept
        held = {e.number for e in self.effects}
        self.thrusts = {n: thrust for n, thrust in self.thrusts.items() if n in held}


def total(vectors: Iterable[Vector]) -> Vector:
    """Return the sum of vectors; zero for none."""
    x = y = z = 0.0
    for a, b, c in vectors:
        x, y, z = x + a, y + b, z + c
    return x, y, z


def scaled(vector: Vector, factor: float) -> Vector:
    """Return *factor* times a vector."""
    return vector[0] * factor, vector[1] * factor, vector[2] * factor
