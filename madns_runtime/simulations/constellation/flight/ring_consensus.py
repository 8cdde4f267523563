"""
A satellite's knowledge of its ring: its own place, and through its neighbours everybody else's.

Shared by the flight software that keeps slots. Nobody is in charge and nobody hears all others: each exchange,
a satellite tells its neighbours where it is and what it has heard of the others, see `gossip`. With the rates
that belong to their heights it carries on what is old, and takes the ring's common phase and semi-major axis for
the averages over all that it knows of. So a chain of satellites, or a ring with a gap, agrees as surely as a
closed ring, and after as many exchanges as neighbours lie between its ends.

Phases are measured in a frame that turns with the design orbit, so that they stand nearly still. Pure.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal, Self

import numpy as np

from madns_runtime.simulations.constellation.flight.api import TRUTH, FlightContext, Reading
from madns_runtime.simulations.constellation.flight.entry_screening import (
    SPREAD_M_MIN,
    SPREAD_RAD_MIN,
    EntryGate,
    near_median,
)
from madns_runtime.simulations.constellation.flight.gossip import (
    CANDIDATES_MAX,
    MEMBERS_MAX,
    SILENT_ROUNDS,
    Gossip,
    Known,
    Neighbourhood,
)
from madns_runtime.simulations.constellation.messages import Delivery
from madns_runtime.simulations.constellation.orbit.constants import EGM_96
from madns_runtime.simulations.constellation.orbit.mean_elements import (
    CircularElements,
    mean_from_state,
    secular_rates,
    wrapped,
)

Slots = Literal["even", "kept"]
GNSS = "gnss"
KEYS: Mapping[str, type] = {"round": int, "asks": bool, "entries": bytes}
"""Of a message between members, with their types."""
HELLO_KEYS = frozenset(("t_s", "lam", "a", "normal"))
"""kept: what the first message, to everybody in view, has besides."""
PLANE_NUMBERS = 3
"""Of a plane's normal."""
HIGHER_M = 100.0
"""Over which the rate's slope is taken."""
FULL_TURN_DEG = 360.0
SPACING_DEG = 1e-6
"""Rounding of a full turn."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RingSettings:
    """Settings of a ring's flight software, read from flight.settings."""

    slots: Slots = "even"
    """even: equally spaced, in the agents' order; kept: the phases of the start, in each plane."""
    spacing_deg: float | None = None
    """even: from one slot to the next, deg; none for all around. Less than that is a chain: its ends are no
    neighbours."""
    altitude_km: float
    """Of the design orbit: mean semi-major axis minus the Earth's radius, km."""
    inclination_deg: float
    exchange_s: float = 120.0
    """Between two messages to each neighbour, s."""
    plane_deg: float = 4.0
    """kept: angle between the planes of satellites that take each other for neighbours, deg."""
    sma_km: float = 5.0
    """kept: difference of their mean semi-major axes, km."""
    patience_exchanges: float = SILENT_ROUNDS
    """Without a word, after which a neighbour is silent."""
    repairs: bool = True
    """Whether others are asked in the place of a neighbour that is silent, and it is heard again when it speaks;
    false: it is left for good, as a chain of fixed neighbours would, for comparison."""
    screens: bool = False
    """Whether entries that cannot be are refused, and members far from the median are left out: `entry_screening`."""

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
        switches = {
            name: _switch(settings, name) for name in ("repairs", "screens") if name in settings
        }
        known = [
            name for name in cls.__slots__ if name in settings and name not in ("slots", *switches)
        ]
        missing = {"altitude_km", "inclination_deg"} - set(known)
        if missing:
            raise ValueError(f"flight.settings: expected {' and '.join(sorted(missing))}")
        numbers: dict[str, Any] = {name: _number(settings, name) for name in known}
        found = cls(slots=slots, **numbers, **switches)
        if found.exchange_s <= 0.0:
            raise ValueError(f"flight.settings.exchange_s: expected > 0, got {found.exchange_s:g}")
        if found.patience_exchanges < 1.0:
            raise ValueError(
                f"flight.settings.patience_exchanges: expected >= 1, got {found.patience_exchanges:g}"
            )
        if found.spacing_deg is not None and not 0.0 < found.spacing_deg <= FULL_TURN_DEG:
            raise ValueError(
                f"flight.settings.spacing_deg: expected > 0 and <= 360, got {found.spacing_deg:g}"
            )
        return found

    @property
    def design(self) -> CircularElements:
        """The design orbit's mean elements."""
        return CircularElements(
            a_m=EGM_96.radius_m + 1e3 * self.altitude_km,
            ex=0.0,
            ey=0.0,
            i_rad=math.radians(self.inclination_deg),
            raan_rad=0.0,
            lam_rad=0.0,
        )


class RingMember:
    """
    One satellite's knowledge of its ring.

    Args:
        context: To send through; its settings are `RingSettings`.
        follows_sma: Whether the ring's semi-major axis is followed while it changes, as under drag;
            else it is the average of the first ones, which burns do not disturb.

    Raises:
        ValueError: The settings are not as described.
    """

    def __init__(self, context: FlightContext, *, follows_sma: bool) -> None:
        self.settings = RingSettings.from_mapping(context.settings)
        self.design = self.settings.design
        self.rate_rad_s = secular_rates(self.design, EGM_96).lam_rad_s
        higher = replace(self.design, a_m=self.design.a_m + HIGHER_M)
        rate_rad_s = secular_rates(higher, EGM_96).lam_rad_s
        self._drift_rad_s_m = (rate_rad_s - self.rate_rad_s) / HIGHER_M
        self.mean: CircularElements | None = None
        """Newest mean elements."""
        self.sent = 0
        self.next_s = 0.0
        """Time of the next exchange."""
        self.members = 0
        """Of the ring that it knows of, itself included."""
        self.slot_error_rad = 0.0
        """Distance ahead of its slot that it believes in, rad; zero as long as it knows nothing."""
        self.sma_ring_m = self.design.a_m
        """Belief of the ring's mean semi-major axis, m."""
        self._context, self._agents = context, frozenset(context.agents)
        self._follows_sma = follows_sma
        count = len(context.agents)
        if count > MEMBERS_MAX:
            raise ValueError(f"a ring: expected at most {MEMBERS_MAX} agents, got {count}")
        self.slot_rad = context.index * self._spacing_rad(count)
        """Its slot, from the first one's; kept: its place at the start."""
        # News of the farthest one in a chain takes as many rounds as there are members, more where it is lost.
        gate = None
        if self.settings.screens:
            gate = EntryGate(drift_rad_s_m=self._drift_rad_s_m, exchange_s=self.settings.exchange_s)
        self._gossip = Gossip(count, context.index, rounds_max=2 * count + 24, gate=gate)
        self._neighbourhood: Neighbourhood | None = None
        self._spoken_to: tuple[str, ...] = ()
        # The newest message of each member, since the last exchange; and the first words of those in view.
        self._heard: dict[str, Mapping[str, Any]] = {}
        self._hellos: dict[str, Mapping[str, Any]] = {}

    @property
    def neighbours(self) -> tuple[str, ...]:
        """Neighbours of the last exchange."""
        return self._spoken_to

    @property
    def refused(self) -> int:
        """Entries that were not believed."""
        return self._gossip.refused

    def hear(self, message: Delivery) -> None:
        """Take a message by radio; one that is not of the ring's is none of its business."""
        payload = message.payload
        if message.sender not in self._agents or not isinstance(payload, Mapping):
            return
        if all(type(payload.get(key)) is kind for key, kind in KEYS.items()):
            self._heard[message.sender] = payload
            if _is_hello(payload):
                self._hellos[message.sender] = payload

    def exchange(self, reading: Reading) -> None:
        """
        Work out where one is, take in what was heard, tell the neighbours; due at `next_s`.

        Args:
            reading: Position and velocity, m and m/s, six numbers or more.
        """
        x, y, z, vx, vy, vz = reading.values[:6]
        self.mean = mean = mean_from_state((x, y, z), (vx, vy, vz), EGM_96)
        now = int(reading.t_s / self.settings.exchange_s + 1e-6)
        self.next_s = (now + 1) * self.settings.exchange_s
        turned_rad = wrapped(mean.lam_rad - self.rate_rad_s * reading.t_s)
        if not self.members and self.settings.slots == "kept":
            self.slot_rad = turned_rad
        place_rad = wrapped(turned_rad - self.slot_rad)
        self._gossip.enter(now, place_rad, mean.a_m - self.design.a_m)
        for name, said in self._heard.items():
            if self._neighbourhood is None or self._neighbourhood.listens_to(name):
                self._gossip.hear(name, said["round"], said["entries"], now)
        self._judge(place_rad, now)
        self._speak(mean, reading.t_s, now)

    def known_members(self, now: int) -> Known:
        """Return what is known of members in this round, itself included."""
        return self._gossip.known(now)

    def _judge(self, place_rad: float, now: int) -> None:
        """Take the ring for the average of all that is known, carried on to now."""
        known = self.known_members(now)
        self.members = len(known.ages)
        # Under drag all fall on while news is on its way.
        fallen_m = known.change_m * known.ages if self._follows_sma else 0.0 * known.ages
        drift_rad_s = self._drift_rad_s_m * (known.smas_m + 0.5 * fallen_m)
        moved_rad = drift_rad_s * known.ages * self.settings.exchange_s
        ahead_rad = known.phases_rad + moved_rad - place_rad
        around_rad = (ahead_rad + math.pi) % math.tau - math.pi
        smas_m = known.smas_m + fallen_m if self._follows_sma else known.first_smas_m
        if self.settings.screens:
            around_rad = around_rad[near_median(around_rad, SPREAD_RAD_MIN)]
            smas_m = smas_m[near_median(smas_m, SPREAD_M_MIN)]
        self.slot_error_rad = -float(np.mean(around_rad))
        self.sma_ring_m = self.design.a_m + float(np.mean(smas_m))

    def _speak(self, mean: CircularElements, t_s: float, now: int) -> None:
        """Tell the neighbours; in a ring whose order nobody knows yet, everybody in view."""
        if self._neighbourhood is None:
            if self.settings.slots == "kept" and not self.sent:
                # No entries: who hears it may be of another plane, whose phases are none of this ring's.
                hello: dict[str, Any] = {"round": now, "asks": False, "entries": b""}
                hello |= {"t_s": t_s, "lam": mean.lam_rad, "a": mean.a_m, "normal": _normal(mean)}
                self._context.broadcast(hello)
                self.sent += 1
                return
            self._neighbourhood = self._neighbours_of(mean, t_s, now)
        for name, said in self._heard.items():
            self._neighbourhood.hear(name, said["asks"], now)
        self._heard.clear()
        chosen = self._neighbourhood.choose(now)
        for name, asks in chosen.items():
            self._context.send(name, self._message(name, now, asks=asks))
        self.sent += len(chosen)
        self._spoken_to = tuple(chosen)

    def _message(self, to: str, now: int, *, asks: bool) -> dict[str, Any]:
        """Return what a neighbour is told."""
        return {"round": now, "asks": asks, "entries": self._gossip.tell(to, now)}

    def _spacing_rad(self, count: int) -> float:
        """
        Return the angle from one slot to the next.

        Raises:
            ValueError: So many slots do not fit.
        """
        spacing_deg = self.settings.spacing_deg
        if spacing_deg is None:
            return math.tau / count
        if count * spacing_deg > FULL_TURN_DEG + SPACING_DEG:
            raise ValueError(
                f"flight.settings.spacing_deg: expected at most {FULL_TURN_DEG / count:g} for {count} "
                f"agents, got {spacing_deg:g}"
            )
        return math.radians(spacing_deg)

    def _neighbours_of(self, mean: CircularElements, t_s: float, now: int) -> Neighbourhood:
        """Return who may be one's neighbour on either side."""
        chosen_by: dict[str, Any] = {
            "now": now,
            "patience": int(self.settings.patience_exchanges),
            "repairs": self.settings.repairs,
        }
        if self.settings.slots == "kept":
            beside = self._beside_in_plane(mean, t_s)
            ahead = [name for angle, name in sorted(beside) if angle >= 0.0]
            behind = [name for angle, name in sorted(beside, reverse=True) if angle < 0.0]
            return Neighbourhood(ahead, behind, **chosen_by)
        agents, index = self._context.agents, self._context.index
        # Half a ring at most: who is nearest one way round is not nearest the other way.
        reach = range(1, min(CANDIDATES_MAX, len(agents) // 2) + 1)
        spacing_rad = self._spacing_rad(len(agents))
        if math.tau - len(agents) * spacing_rad < math.radians(SPACING_DEG):
            around = len(agents)
            ahead = [agents[(index + step) % around] for step in reach]
            behind = [agents[(index - step) % around] for step in reach]
        else:
            ahead = list(agents[index + 1 : index + 1 + CANDIDATES_MAX])
            behind = list(reversed(agents[max(0, index - CANDIDATES_MAX) : index]))
        return Neighbourhood(ahead, behind, **chosen_by)

    def _beside_in_plane(self, mean: CircularElements, t_s: float) -> list[tuple[float, str]]:
        """Return those who said hello in one's own plane and height, and how far ahead they are, rad."""
        normal, cosine = _normal(mean), math.cos(math.radians(self.settings.plane_deg))
        beside: list[tuple[float, str]] = []
        for name, heard in self._hellos.items():
            if sum(p * q for p, q in zip(normal, heard["normal"], strict=True)) < cosine:
                continue
            if abs(heard["a"] - mean.a_m) <= 1e3 * self.settings.sma_km:
                moved = heard["lam"] + self.rate_rad_s * (t_s - heard["t_s"])
                beside.append((wrapped(moved - mean.lam_rad), name))
        return beside


def position_reading(readings: Mapping[str, Reading]) -> Reading | None:
    """Return the newest position and velocity, from truth or GNSS, whichever the scenario gives."""
    return readings.get(TRUTH) or readings.get(GNSS)


def _switch(settings: Mapping[str, Any], name: str) -> bool:
    """
    Return a setting that is true or false.

    Raises:
        ValueError: It is something else.
    """
    value = settings[name]
    if not isinstance(value, bool):
        raise ValueError(f"flight.settings.{name}: expected true or false, got {value!r}")
    return value


def _number(settings: Mapping[str, Any], name: str) -> float:
    """
    Return a setting that is a number.

    Raises:
        ValueError: It is something else, such as a text of digits, which whoever judges slots takes for nothing.
    """
    value = settings[name]
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError(f"flight.settings.{name}: expected a number, got {value!r:.80}")
    return float(value)


def _is_hello(payload: Mapping[str, Any]) -> bool:
    """Tell whether a message has all that a first one has: numbers, and a plane's normal of three."""
    if not payload.keys() >= HELLO_KEYS:
        return False
    normal = payload["normal"]
    if not isinstance(normal, list | tuple) or len(normal) != PLANE_NUMBERS:
        return False
    numbers = (payload["t_s"], payload["lam"], payload["a"], *normal)
    return all(isinstance(one, float) and math.isfinite(one) for one in numbers)


def _normal(mean: CircularElements) -> list[float]:
    """Return the unit normal of the plane, three numbers."""
    sine = math.sin(mean.i_rad)
    return [
        sine * math.sin(mean.raan_rad),
        -sine * math.cos(mean.raan_rad),
        math.cos(mean.i_rad),
    ]
