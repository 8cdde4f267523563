"""Answers of a simulation's medium, and their account. Pure."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, Protocol

from madns_runtime.protocol.messages import Transmission

DELIVERED: Final = "delivered"
LOST: Final = "lost"
OTHERS: Final = "others"
"""Under this word those are counted for which WORDS_MAX others left no room, in this channel those for which CHANNELS_MAX did."""
WORDS_MAX: Final = 256
"""Different outcomes of one channel: they are counted one by one, and told at the end."""
CHANNELS_MAX: Final = 256
"""Different channels of a run, each with an account of its own; further ones share that of OTHERS."""
NO_MEDIUM: Final = "no_medium"
"""Refused: this run of the simulation has no medium."""
EVERYBODY: Final = "*"
"""Receiver of a broadcast."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkOutcome:
    """Outcome of a message on its way to one receiver."""

    to: str
    """An agent, or a place that the medium knows; what the sender wrote if there is no such receiver."""
    outcome: str
    """delivered: it arrives; lost: by chance; any other word is why it is refused, which its sender is told."""
    arrives_s: float | None = None
    """Simulated time at which it is received, s, later than it was sent; None if it never is."""
    size_bytes: int = 0
    """Of the encoded payload, as far as the medium knows it."""
    channel: str = ""
    """Account it is entered in, where a medium has several."""


class Medium(Protocol):
    """
    Medium of a simulation's messages between agents.

    One that has a method `settled(sender, transmission, outcomes)` as well is told after `carry` what became of the message
    in the end: faults of a timeline lose what the medium let pass, delay it or deliver it twice.
    """

    def carry(self, sender: str, transmission: Transmission) -> Sequence[LinkOutcome]:
        """
        Return what becomes of a message that an agent sent, for each receiver.

        Messages of one sender come in their order. In lockstep the answer may depend on nothing but the
        message, those of the same sender before it, the seed, and what the host knows at simulated time.
        """


def between_agents(
    carried: Mapping[str, Any], counts: Iterable[Mapping[str, int]]
) -> dict[str, Any]:
    """Return a run's account of messages between agents: the host's, with what the receivers counted, summed up."""
    if not carried:
        return {}
    total: Counter[str] = Counter()
    for count in counts:
        total.update(count)
    return {**carried, "receivers": dict(total)}


@dataclass(slots=True, eq=False)
class MessageAccount:
    """Number of messages and of their outcomes: nothing is dropped without a count."""

    transmissions: int = 0
    """Messages that were handed over; a broadcast is one."""
    sent: int = 0
    """Ways of a message to one receiver, possible or not: always the sum of all outcomes."""
    outcomes: Counter[str] = field(default_factory=Counter)
    handed_over: int = 0
    """Sent on to their receivers."""
    in_flight: int = 0
    """Delivered, but not yet handed over."""
    undelivered: int = 0
    """Handed over while the receiver was lost, or took no more; or kept no longer, as too many were on their way."""
    heard_late: int = 0
    """Delivered ones that should have arrived before the host knew of them."""
    delivered_bytes: int = 0

    def enter(self, outcome: LinkOutcome, now_s: float) -> None:
        """Count one way of a message of which the host knows from *now_s* on."""
        self.sent += 1
        word, known = outcome.outcome, self.outcomes
        is_told = word in known or word in (DELIVERED, LOST) or len(known) < WORDS_MAX
        known[word if is_told else OTHERS] += 1
        if outcome.arrives_s is not None:
            self.delivered_bytes += outcome.size_bytes
            self.heard_late += outcome.arrives_s < now_s

    def to_mapping(self, outcomes: Iterable[str]) -> dict[str, int]:
        """Return all counts by name, with those of *outcomes* among them; delivered is handed_over + in_flight."""
        return {
            "transmissions": self.transmissions,
            "sent": self.sent,
            **{outcome: self.outcomes[outcome] for outcome in outcomes},
            "handed_over": self.handed_over,
            "in_flight": self.in_flight,
            "heard_late": self.heard_late,
            "delivered_bytes": self.delivered_bytes,
        }
