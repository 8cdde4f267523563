"""
Crosslinks, radio between vehicles, and what they share with ground stations: the outcome of a message, its record. Pure.

States come from a function, times from messages. What becomes of a message depends on the truth at the time it
was sent, on what its sender sent before, and on the seed; never on when, or after whose messages, the host hears
of it.

Transmitters, chance, messages on their way and the account of them are the framework's, `madns_runtime.medium`.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, Protocol, get_args

import numpy as np
from numpy.typing import NDArray

from madns_runtime.medium.links import Chance, Transmitter
from madns_runtime.medium.outcomes import EVERYBODY, LinkOutcome
from madns_runtime.protocol.codec import pack
from madns_runtime.protocol.messages import Transmission
from madns_runtime.simulations.constellation.orbit.visibility import (
    LIGHT_SPEED_M_S,
    coast,
    has_line_of_sight,
    have_line_of_sight,
    signal_way,
    signal_ways,
)
from madns_runtime.simulations.constellation.parameters import Crosslinks as CrosslinkSettings

Outcome = Literal[
    "delivered",
    "no_line_of_sight",
    "out_of_range",
    "no_contact",
    "lost",
    "queue_full",
    "unknown_receiver",
    "out_of_order",
    "no_truth",
]
"""delivered: it arrives; no_line_of_sight: the Earth or its atmosphere is in between; out_of_range: too far;
no_contact: no station in view; lost: by chance; queue_full: the transmitter took no more; unknown_receiver:
nobody of that name, or the sender itself; out_of_order: heard after a later one of the same sender; no_truth:
the host does not know (any more) where the vehicles were."""
OUTCOMES: tuple[Outcome, ...] = get_args(Outcome)
CROSSLINKS = "links"
TO_GROUND = "ground"
"""Channels: an account of each stands in the summary under this name."""

_ALL = -1
"""Stands for every receiver."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkEvent(LinkOutcome):
    """Outcome of a message on its way to one receiver, an agent or ground:NAME."""

    number: int
    """The sender's own; of an uplink its place in the scenario."""
    sender: str
    """An agent, or ground:NAME; "ground" for an uplink that no station could send."""
    sent_s: float
    """Time of the hand-over to the transmitter, s; it arrives when its last bit is received and processed."""
    distance_m: float | None
    """Way of the signal; None where none was computed."""

    def to_record(self) -> tuple[Any, ...]:
        """Return one value per field of streams.LINKS."""
        return (
            self.sent_s,
            self.sender,
            self.number,
            self.to,
            self.outcome,
            self.arrives_s,
            self.distance_m,
            self.size_bytes,
        )


@dataclass(frozen=True, slots=True)
class Attempt:
    """A message that a transmitter was given, on its way to become events."""

    sender: int
    """Sender that chance is drawn for: a vehicle's index, or a station's after those of all vehicles."""
    name: str
    """The sender's."""
    message: Transmission
    size_bytes: int
    """Of the encoded payload."""
    channel: str

    def failed(
        self, outcome: Outcome, to: str | None = None, distance_m: float | None = None
    ) -> LinkEvent:
        """Return why it does not arrive, at one receiver or (None) at whomever it was meant for."""
        return self._event(outcome, self.message.to if to is None else to, None, distance_m)

    def ended(self, to: str, distance_m: float, ready_s: float, *, is_lost: bool) -> LinkEvent:
        """Return that it arrives a light time after *ready_s*, unless chance had it otherwise."""
        if is_lost:
            return self.failed("lost", to, distance_m)
        return self._event("delivered", to, ready_s + distance_m / LIGHT_SPEED_M_S, distance_m)

    def _event(
        self, outcome: Outcome, to: str, arrives_s: float | None, distance_m: float | None
    ) -> LinkEvent:
        return LinkEvent(
            number=self.message.number,
            sender=self.name,
            to=to,
            sent_s=self.message.sent_s,
            arrives_s=arrives_s,
            outcome=outcome,
            distance_m=distance_m,
            size_bytes=self.size_bytes,
            channel=self.channel,
        )


class Truth(Protocol):
    """Positions of vehicles: `truth.segments.TruthStore`, or what looks like it."""

    def state(self, vehicle: int, t_s: float) -> tuple[float, ...] | None:
        """Return one vehicle's position, m, and velocity, m/s, TEME; None if not known (any more)."""

    def states(self, t_s: float) -> NDArray[np.float64] | None:
        """Return those of all, shape (N, 6)."""


def index_of_names(agents: Sequence[str], satellites: Sequence[str]) -> dict[str, int]:
    """Return who is meant by a name: an agent, or the only one that flies a satellite of that name."""
    flown = satellites[: len(agents)]
    bearers = Counter(flown)
    index = {name: number for number, name in enumerate(flown) if bearers[name] == 1}
    index.update({name: number for number, name in enumerate(agents)})
    return index


class CrosslinkMedium:
    """
    The medium between vehicles.

    Every vehicle has one transmitter, on one channel, that radiates all around: its messages wait for
    each other, and a broadcast is one transmission with many receivers. Receivers hear any number of
    messages at once; nothing interferes.
    """

    def __init__(
        self,
        settings: CrosslinkSettings,
        *,
        agents: tuple[str, ...],
        satellites: tuple[str, ...],
        random: np.random.Generator,
        truth: Truth,
    ) -> None:
        """
        Prepare the links of *agents*, each of which may also be called by its satellite's name.

        Args:
            settings: From the scenario.
            agents: Names, in the order of the vehicles' indices.
            satellites: The same, of what they fly.
            random: One number is drawn from it, now, as the seed of all chance.
            truth: Where the vehicles are at a time.
        """
        self._settings = settings
        self._agents = agents
        self._index = index_of_names(agents, satellites)
        self._range_m = settings.range_km_max * 1e3
        self._height_m = settings.atmosphere_km * 1e3
        self._chance = Chance(random)
        self._truth = truth
        self._transmitters = [Transmitter(settings.queue_max) for _ in agents]

    def carry(self, sender: int, transmission: Transmission) -> list[LinkEvent]:
        """
        Send a vehicle's message and return what becomes of it.

        Args:
            sender: Index of the vehicle.
            transmission: Messages of one sender must come in the order of (sent_s, number), as they do
                over a reliable connection; one out of order is refused.

        Returns:
            One event per receiver: for a broadcast those in view, or a single one that says why there is
            none.
        """
        sent_s = transmission.sent_s
        receiver = self._receiver(sender, transmission.to)
        payload_bytes = len(pack(transmission.payload))
        attempt = Attempt(sender, self._agents[sender], transmission, payload_bytes, CROSSLINKS)
        if not self._transmitters[sender].is_in_order(sent_s, transmission.number):
            return [attempt.failed("out_of_order")]
        if receiver is None:
            return [attempt.failed("unknown_receiver")]
        states = self._states_of(sender, receiver, sent_s)
        if states is None:
            return [attempt.failed("no_truth")]
        return self._transmit(attempt, receiver, states)

    def _receiver(self, sender: int, to: str) -> int | None:
        """Return whom a message is for, _ALL for everybody, None for nobody."""
        if to == EVERYBODY:
            return _ALL
        receiver = self._index.get(to)
        return None if receiver == sender else receiver

    def _states_of(self, sender: int, receiver: int, t_s: float) -> NDArray[np.float64] | None:
        """Return the states of a sender and its receiver, in this order, or of all vehicles."""
        if receiver == _ALL:
            return self._truth.states(t_s)
        start, end = self._truth.state(sender, t_s), self._truth.state(receiver, t_s)
        return None if start is None or end is None else np.array((start, end))

    def _transmit(
        self, attempt: Attempt, receiver: int, states: NDArray[np.float64]
    ) -> list[LinkEvent]:
        """Let a message wait for its turn and leave; the radio does not know whether anybody hears it."""
        sent_s = attempt.message.sent_s
        transmitter = self._transmitters[attempt.sender]
        leaves_s = transmitter.leaves_s(sent_s)
        if leaves_s is None:
            return [attempt.failed("queue_full")]
        duration_s = attempt.size_bytes * 8.0 / self._settings.rate_bit_s
        transmitter.occupy(sent_s, leaves_s, duration_s)
        ready_s = leaves_s + duration_s + self._settings.processing_s
        if receiver == _ALL:
            return self._to_all(attempt, coast(states, leaves_s - sent_s), ready_s)
        if leaves_s > sent_s:
            states = coast(states, leaves_s - sent_s)
        start, end = states.tolist()
        distance_m, meets_m = signal_way(start, end)
        if not has_line_of_sight(start, meets_m, self._height_m):
            return [attempt.failed("no_line_of_sight", self._agents[receiver], distance_m)]
        if distance_m > self._range_m:
            return [attempt.failed("out_of_range", self._agents[receiver], distance_m)]
        return [self._radiate(attempt, receiver, distance_m, ready_s)]

    def _to_all(
        self, attempt: Attempt, states: NDArray[np.float64], ready_s: float
    ) -> list[LinkEvent]:
        """Broadcast: whoever is in view and range hears it after a light time of its own."""
        start = states[attempt.sender, :3]
        distances_m, meets_m = signal_ways(start, states)
        in_view = have_line_of_sight(start, meets_m, self._height_m)
        in_view[attempt.sender] = False
        in_range = in_view & (distances_m <= self._range_m)
        if not in_range.any():
            outcome: Outcome = "out_of_range" if in_view.any() else "no_line_of_sight"
            return [attempt.failed(outcome)]
        return [
            self._radiate(attempt, receiver, float(distances_m[receiver]), ready_s)
            for receiver in np.flatnonzero(in_range).tolist()
        ]

    def _radiate(
        self, attempt: Attempt, receiver: int, distance_m: float, ready_s: float
    ) -> LinkEvent:
        """Bring a message to a receiver in view, unless chance has it otherwise."""
        number, loss = attempt.message.number, self._settings.loss
        is_lost = loss > 0.0 and self._chance.draw(attempt.sender, number, receiver) < loss
        return attempt.ended(self._agents[receiver], distance_m, ready_s, is_lost=is_lost)
