"""
What a satellite knows of its ring: its own place, and through its two neighbours the ring's.

Shared by the flight software that keeps slots. No satellite knows all others: each exchange, it tells
its two neighbours where it is and what it takes the ring's common phase (and semi-major axis) to be,
and averages what it hears with what it held itself: a dynamic average consensus with momentum. Each one's value then
tends to the average over the ring, although nobody computes that.

Phases are measured in a frame that turns with the design orbit, so that they stand nearly still. Pure.

Source: Zhu and Martinez, Discrete-time dynamic average consensus, Automatica 46 (2010).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, Self

from madns_runtime.simulations.constellation.flight.api import TRUTH, FlightContext, Reading
from madns_runtime.simulations.constellation.messages import Delivery
from madns_runtime.simulations.constellation.orbit.constants import EGM_96
from madns_runtime.simulations.constellation.orbit.mean_elements import (
    CircularElements,
    mean_from_state,
    secular_rates,
    wrapped,
)

Slots = Literal["even", "kept"]
WEIGHT = 1.0 / 3.0
"""Of a neighbour's value against one's own in a ring, where everybody has two; see `weight`."""
GNSS = "gnss"
Flow = tuple[float, float]
KEYS = frozenset(("round", "t_s", "lam", "a", "phase", "phase_flow", "sma", "sma_flow", "degree"))
"""Of a message between members."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RingSettings:
    """What the flight software of a ring reads from flight.settings."""

    slots: Slots = "even"
    """even: equally spaced, in the agents' order; kept: the phases of the start, in each plane."""
    altitude_km: float
    """Of the design orbit: mean semi-major axis minus the Earth's radius, km."""
    inclination_deg: float
    exchange_s: float = 120.0
    """Between two messages to each neighbour, s."""
    plane_deg: float = 4.0
    """kept: angle between the planes of satellites that take each other for neighbours, deg."""
    sma_km: float = 5.0
    """kept: difference of their mean semi-major axes, km."""

    @classmethod
    def from_mapping(cls, settings: Mapping[str, Any]) -> Self:
        """
        Read them from the scenario's settings, of which others may be somebody else's.

        Raises:
            ValueError: A setting is missing or is not as described.
        """
        slots = settings.get("slots", "even")
        if slots not in ("even", "kept"):
            raise ValueError(f"flight.settings.slots: expected even or kept, got {slots!r}")
        known = [name for name in cls.__slots__ if name != "slots" and name in settings]
        missing = {"altitude_km", "inclination_deg"} - set(known)
        if missing:
            raise ValueError(f"flight.settings: expected {' and '.join(sorted(missing))}")
        found = cls(slots=slots, **{name: float(settings[name]) for name in known})
        if found.exchange_s <= 0.0:
            raise ValueError(f"flight.settings.exchange_s: expected > 0, got {found.exchange_s:g}")
        return found

    @property
    def design(self) -> CircularElements:
        """The design orbit's mean elements."""
        a_m = EGM_96.radius_m + 1e3 * self.altitude_km
        i_rad = math.radians(self.inclination_deg)
        return CircularElements(a_m=a_m, ex=0.0, ey=0.0, i_rad=i_rad, raan_rad=0.0, lam_rad=0.0)


class _Average:
    """
    One's value of the ring's average of something that everybody measures.

    That is one's own measurement and what has flowed in from each neighbour. Both ends of a link hold its
    flow, with opposite signs, and tell it: so the average over all stays. Where a lost message made the two
    differ, each takes back half of the difference when it hears the other again.

    Drawing towards neighbours alone, an error as long as the ring dies out over N^2 exchanges; with the
    momentum of the values before, over N: 18 instead of 650 for a ring of 93. Source: Muthukrishnan,
    Ghosh and Schultz, First- and second-order diffusive methods, Theory of Computing Systems 31 (1998).

    Args:
        first: One's own measurement.
        momentum: 0 for none, below 1.
    """

    def __init__(self, first: float, momentum: float) -> None:
        self.input = first
        self._momentum = momentum
        self._flows: dict[str, Flow] = {}

    @property
    def value(self) -> float:
        """What it takes the average to be."""
        return self.input + sum(total for total, _ in self._flows.values())

    def flow(self, name: str) -> Flow:
        """Return what has flowed in from a neighbour, all in all and in the last exchange."""
        return self._flows.get(name, (0.0, 0.0))

    def update(self, measured: float, heard: Mapping[str, tuple[float, Flow]]) -> None:
        """
        Follow one's own measurement and draw to the neighbours' values.

        Args:
            measured: One's own, new.
            heard: By neighbour, how far its value lies above one's own, weighted, and its end of the flow.
        """
        silent = [name for name in self._flows if name not in heard]
        self._flows |= {name: (self._flows[name][0], 0.0) for name in silent}
        for name, (difference, theirs) in heard.items():
            total, last = (
                0.5 * (mine - their) for mine, their in zip(self.flow(name), theirs, strict=True)
            )
            last = difference + self._momentum * (difference + last)
            self._flows[name] = total + last, last
        self.input = measured


class RingMember:
    """
    One satellite's knowledge of its ring.

    Args:
        context: To send through; its settings are `RingSettings`.
        follows_sma: Whether the ring's semi-major axis is followed while it changes, as under drag;
            else it is the average of the first ones, which burns do not disturb.
    """

    def __init__(self, context: FlightContext, *, follows_sma: bool) -> None:
        self.settings = RingSettings.from_mapping(context.settings)
        self.design = self.settings.design
        self.rate_rad_s = secular_rates(self.design, EGM_96).lam_rad_s
        self.mean: CircularElements | None = None
        """Newest mean elements."""
        self.sent = 0
        self.next_s = 0.0
        """Time of the next exchange."""
        self._context = context
        self._follows_sma = follows_sma
        self._round = -1
        self._slot_rad = math.tau * context.index / len(context.agents)
        self._neighbours: tuple[str, ...] = ()
        if self.settings.slots == "even":
            self._neighbours = _beside(context.agents, context.index)
        self._place: _Average | None = None
        self._sma: _Average | None = None
        # The newest message of each neighbour; before neighbours are known, of everybody in view.
        self._heard: dict[str, Mapping[str, Any]] = {}

    @property
    def neighbours(self) -> tuple[str, ...]:
        """Whom it speaks to."""
        return self._neighbours

    @property
    def slot_error_rad(self) -> float:
        """How far ahead of its slot it believes itself, rad; zero as long as it knows nothing."""
        return 0.0 if self._place is None else self._place.input - self._place.value

    @property
    def sma_ring_m(self) -> float:
        """What it takes the ring's mean semi-major axis to be, m."""
        return self.design.a_m if self._sma is None else self._sma.value

    def hear(self, message: Delivery) -> None:
        """Take a message by radio; one that is not of the ring's is none of its business."""
        payload = message.payload
        if isinstance(payload, Mapping) and payload.keys() >= KEYS:
            self._heard[message.sender] = payload

    def exchange(self, reading: Reading) -> None:
        """
        Work out where one is, average with what was heard, tell the neighbours; due at `next_s`.

        Args:
            reading: Position and velocity, m and m/s, six numbers or more.
        """
        x, y, z, vx, vy, vz = reading.values[:6]
        self.mean = mean = mean_from_state((x, y, z), (vx, vy, vz), EGM_96)
        self._round = int(reading.t_s / self.settings.exchange_s + 1e-6)
        self.next_s = (self._round + 1) * self.settings.exchange_s
        turned = wrapped(mean.lam_rad - self.rate_rad_s * reading.t_s)
        if self._place is None or self._sma is None:
            self._begin(turned, mean, reading.t_s)
            return
        if not self._neighbours:
            self._neighbours = self._choose(mean, reading.t_s)
        if self.settings.slots == "kept":
            self._adopt()
        degree = len(self._neighbours)
        fresh = {
            name: (weight(degree, heard["degree"]), heard)
            for name in self._neighbours
            if (heard := self._heard.get(name)) and heard["round"] == self._round - 1
        }
        place, sma = self._place, self._sma
        phase_rad, sma_m = place.value, sma.value
        place.update(
            place.input + wrapped(turned - self._slot_rad - place.input),
            {
                n: (w * wrapped(h["phase"] - phase_rad), h["phase_flow"])
                for n, (w, h) in fresh.items()
            },
        )
        sma.update(
            mean.a_m if self._follows_sma else sma.input,
            {n: (w * (h["sma"] - sma_m), h["sma_flow"]) for n, (w, h) in fresh.items()},
        )
        for name in self._neighbours:
            self._context.send(name, self._message(mean, reading.t_s, name))
            self.sent += 1

    def _begin(self, turned_rad: float, mean: CircularElements, t_s: float) -> None:
        """Take one's own values for the ring's and tell the neighbours, or everybody in view."""
        if self.settings.slots == "kept":
            self._slot_rad = turned_rad
        first = wrapped(turned_rad - self._slot_rad)
        momentum = best_momentum(len(self._context.agents))
        self._place = _Average(first, momentum)
        self._sma = _Average(mean.a_m, momentum)
        for name in self._neighbours:
            self._context.send(name, self._message(mean, t_s, name))
        if not self._neighbours:
            everybody = self._message(mean, t_s, "")
            self._context.broadcast(everybody | {"normal": list(_normal(mean))})
        self.sent += max(1, len(self._neighbours))

    def _message(self, mean: CircularElements, t_s: float, to: str) -> dict[str, Any]:
        """Return what a neighbour is told: time, mean argument of latitude (rad), mean a (m), and the ring's."""
        assert self._place is not None and self._sma is not None
        return {
            "round": self._round,
            "t_s": t_s,
            "lam": mean.lam_rad,
            "a": mean.a_m,
            "phase": self._place.value,
            "phase_flow": self._place.flow(to),
            "sma": self._sma.value,
            "sma_flow": self._sma.flow(to),
            "degree": len(self._neighbours),
        }

    def _adopt(self) -> None:
        """
        Take those for neighbours who take this one for theirs.

        The nearest one of somebody at the edge of a plane or height may have nearer ones itself. An
        average stays one only if both sides of a link draw to each other.
        """
        speaks = [name for name, heard in self._heard.items() if heard["degree"]]
        self._neighbours = tuple(dict.fromkeys((*self._neighbours, *speaks)))

    def _choose(self, mean: CircularElements, t_s: float) -> tuple[str, ...]:
        """Return the nearest one ahead and the nearest one behind of those heard in one's own plane."""
        normal, cosine = _normal(mean), math.cos(math.radians(self.settings.plane_deg))
        beside: list[tuple[float, str]] = []
        for name, heard in self._heard.items():
            theirs = heard.get("normal")
            if not theirs or sum(p * q for p, q in zip(normal, theirs, strict=True)) < cosine:
                continue
            if abs(heard["a"] - mean.a_m) <= 1e3 * self.settings.sma_km:
                moved = heard["lam"] + self.rate_rad_s * (t_s - heard["t_s"])
                beside.append((wrapped(moved - mean.lam_rad), name))
        ahead = min((item for item in beside if item[0] >= 0.0), default=None)
        behind = max((item for item in beside if item[0] < 0.0), default=None)
        return tuple(item[1] for item in (behind, ahead) if item is not None)


def weight(own_degree: int, their_degree: int) -> float:
    """
    Return the weight of a neighbour's value, the same on both sides of a link.

    Source: the Metropolis weights of Xiao, Boyd and Lall, A scheme for robust distributed sensor fusion
    based on average consensus, IPSN 2005.
    """
    return 1.0 / (1.0 + max(own_degree, their_degree))


def best_momentum(count: int) -> float:
    """Return the momentum with which a ring of *count* agrees soonest."""
    slowest = 1.0 - 2.0 * WEIGHT * (1.0 - math.cos(math.tau / max(count, 2)))
    return 2.0 / (1.0 + math.sqrt(1.0 - slowest * slowest)) - 1.0


def position_reading(readings: Mapping[str, Reading]) -> Reading | None:
    """Return the newest position and velocity, from truth or GNSS, whichever the scenario gives."""
    return readings.get(TRUTH) or readings.get(GNSS)


def _beside(agents: tuple[str, ...], index: int) -> tuple[str, ...]:
    """Return the names before and after *index* in the ring."""
    return tuple(dict.fromkeys((agents[index - 1], agents[(index + 1) % len(agents)])))


def _normal(mean: CircularElements) -> tuple[float, float, float]:
    """Return the unit normal of the plane."""
    sine = math.sin(mean.i_rad)
    return (
        sine * math.sin(mean.raan_rad),
        -sine * math.cos(mean.raan_rad),
        math.cos(mean.i_rad),
    )
