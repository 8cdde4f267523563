"""
What crosslinks and ground stations have in common.

A transmitter's queue, chance, messages on their way, and the account of what became of each. Pure: no
clock, and chance is drawn for names, not in turn.
"""

from __future__ import annotations

import heapq
import math
import struct
from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass
from hashlib import blake2b
from typing import Any, Literal, Protocol, get_args

import numpy as np
from numpy.typing import NDArray

from madns_runtime.errors import PluginError
from madns_runtime.recording.records import Field
from madns_runtime.simulations.constellation.messages import Delivery, Transmission

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
REFUSED = frozenset(OUTCOMES) - {"delivered", "lost"}
"""Of these the sender is told: its radio took no more, or found nobody to speak to. A loss it cannot notice."""

LEAD_S = 1.0
"""How long before their arrival messages are handed out, s: far more than a network takes."""

_KEY = struct.Struct("<3q")
_CHANCES = float(2**64)


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkEvent:
    """What became of a message on its way to one receiver."""

    number: int
    """The sender's own; of an uplink its place in the scenario."""
    sender: str
    """An agent, or ground:NAME; "ground" for an uplink that no station could send."""
    to: str
    """An agent or ground:NAME; what the sender wrote if there is no such receiver."""
    sent_s: float
    """When it was handed to the transmitter, s."""
    arrives_s: float | None
    """When its last bit is received and processed, s; None if it never is."""
    outcome: Outcome
    distance_m: float | None
    """Way of the signal; None where none was computed."""
    size_bytes: int = 0
    """Of the encoded payload."""

    def to_record(self) -> tuple[Any, ...]:
        """Return one value for each of LINK_FIELDS."""
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


LINK_FIELDS = (
    Field("sent_s", "s"),
    Field("sender", "", "str"),
    Field("number", "", "int"),
    Field("to", "", "str"),
    Field("outcome", "", "str"),
    Field("arrives_s", "s"),
    Field("distance_m", "m"),
    Field("size_bytes", "B", "int"),
)
"""Stream "links": one record a LinkEvent."""


@dataclass(frozen=True, slots=True)
class Attempt:
    """A message that a transmitter was given, on its way to become events."""

    sender: int
    """What chance is drawn for: a vehicle's index, or a station's after those of all vehicles."""
    name: str
    """The sender's."""
    message: Transmission
    size_bytes: int
    """Of the encoded payload."""

    def failed(
        self, outcome: Outcome, to: str | None = None, distance_m: float | None = None
    ) -> LinkEvent:
        """Return why it does not arrive, at one receiver or (None) at whomever it was meant for."""
        return self._event(outcome, self.message.to if to is None else to, None, distance_m)

    def delivered(self, to: str, distance_m: float, arrives_s: float) -> LinkEvent:
        """Return that it arrives."""
        return self._event("delivered", to, arrives_s, distance_m)

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
        )


class Truth(Protocol):
    """Where vehicles are: `truth.segments.TruthStore`, or what looks like it."""

    def state(self, vehicle: int, t_s: float) -> tuple[float, ...] | None:
        """Return one vehicle's position, m, and velocity, m/s, TEME; None if not known (any more)."""

    def states(self, t_s: float) -> NDArray[np.float64] | None:
        """Return those of all, shape (N, 6)."""


class Transmitter:
    """
    A queue of messages that leave one after the other.

    One message is on the air, at most `queue_max` wait. Messages must be given in the order of their
    times: what is computed for one then never depends on later ones.
    """

    __slots__ = ("_free_s", "_last", "_queue_max", "_waiting")

    def __init__(self, queue_max: int) -> None:
        self._queue_max = queue_max
        self._free_s = float("-inf")
        self._waiting: deque[float] = deque()
        """When those that still wait will leave; grows with every entry."""
        self._last = (float("-inf"), -1)

    def is_in_order(self, sent_s: float, number: int) -> bool:
        """Return whether a message follows all before it, and remember it if so."""
        if (sent_s, number) <= self._last:
            return False
        self._last = (sent_s, number)
        return True

    def leaves_s(self, sent_s: float) -> float | None:
        """Return when a message handed over at *sent_s* would begin to leave; None: the queue is full."""
        waiting = self._waiting
        while waiting and waiting[0] <= sent_s:
            waiting.popleft()
        if self._free_s <= sent_s:
            return sent_s
        return None if len(waiting) >= self._queue_max else self._free_s

    def occupy(self, sent_s: float, leaves_s: float, duration_s: float) -> None:
        """Take a message that leaves at *leaves_s*, as `leaves_s` said, for *duration_s*."""
        if leaves_s > sent_s:
            self._waiting.append(leaves_s)
        self._free_s = leaves_s + duration_s


class Chance:
    """
    Random numbers that belong to names, not to turns.

    A number depends on the seed and on whom it is drawn for, never on how many were drawn before: the
    outcome of a message is the same in whatever order the host hears of messages.
    """

    __slots__ = ("_key",)

    def __init__(self, random: np.random.Generator) -> None:
        """Take one number from *random*, now, as the seed."""
        self._key = random.bytes(16)

    def draw(self, sender: int, number: int, receiver: int) -> float:
        """Return a number within [0, 1)."""
        drawn = blake2b(_KEY.pack(sender, number, receiver), digest_size=8, key=self._key)
        return int.from_bytes(drawn.digest(), "little") / _CHANCES


class InFlight:
    """Messages that will arrive, by time of arrival; those due are handed out ahead of it."""

    __slots__ = ("_heap", "handed_over", "lead_s")

    def __init__(self, lead_s: float) -> None:
        self.lead_s = lead_s
        self.handed_over = 0
        self._heap: list[tuple[float, int, int, int, Delivery]] = []
        # Bounded by senders, their queues and the receivers: a message waits at most for its queue.

    def __len__(self) -> int:
        return len(self._heap)

    def add(self, sender: int, number: int, receiver: int, delivery: Delivery) -> None:
        """Take a delivery; ties of time are handed out by sender, number and receiver."""
        heapq.heappush(self._heap, (delivery.arrives_s, sender, number, receiver, delivery))

    def due(self, t_s: float) -> list[tuple[int, Delivery]]:
        """Return receivers and deliveries that arrive up to `lead_s` after *t_s*, in order."""
        result = []
        heap = self._heap
        # As `next_s` rounds it: what it promises is there.
        while heap and heap[0][0] - self.lead_s <= t_s:
            _, _, _, receiver, delivery = heapq.heappop(heap)
            result.append((receiver, delivery))
        self.handed_over += len(result)
        return result

    def next_s(self) -> float | None:
        """Return when the next is due, which may be over already; None: nothing is on its way."""
        return self._heap[0][0] - self.lead_s if self._heap else None


class Account:
    """How many messages there were and what became of each: nothing is dropped without a count."""

    __slots__ = ("_counts", "_delivered_bytes", "_heard_late", "sent", "transmissions")

    def __init__(self) -> None:
        self.transmissions = 0
        """Messages that were handed over; a broadcast is one."""
        self.sent = 0
        """Ways of a message to one receiver, possible or not: always the sum of all outcomes."""
        self._counts: Counter[Outcome] = Counter()
        self._delivered_bytes = 0
        self._heard_late = 0

    def enter(self, event: LinkEvent, now_s: float) -> None:
        """Count one way of a message that the host hears of at *now_s*."""
        self.sent += 1
        self._counts[event.outcome] += 1
        if event.arrives_s is not None:
            self._delivered_bytes += event.size_bytes
            self._heard_late += event.arrives_s < now_s

    def to_summary(self, in_flight: InFlight) -> dict[str, int]:
        """
        Return all counts by name.

        delivered = handed_over + in_flight; heard_late are those delivered that should have arrived
        before the host heard of them: they reach their receiver late.
        """
        counts: dict[str, int] = {"transmissions": self.transmissions, "sent": self.sent}
        counts.update({outcome: self._counts[outcome] for outcome in OUTCOMES})
        counts["handed_over"] = in_flight.handed_over
        counts["in_flight"] = len(in_flight)
        counts["heard_late"] = self._heard_late
        counts["delivered_bytes"] = self._delivered_bytes
        return counts


def checked_sent_s(transmission: Transmission) -> float:
    """
    Return when a message was sent.

    Raises:
        PluginError: That is no time.
    """
    if not math.isfinite(transmission.sent_s):
        raise PluginError(
            f"constellation: expected a transmission's time in s, got {transmission.sent_s!r}"
        )
    return transmission.sent_s


def index_of_names(agents: Sequence[str], satellites: Sequence[str]) -> dict[str, int]:
    """Return who is meant by a name: an agent, or the one that flies the satellite of that name."""
    index = {name: number for number, name in enumerate(satellites[: len(agents)])}
    index.update({name: number for number, name in enumerate(agents)})
    return index
