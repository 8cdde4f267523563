"""
The host's side of messages between agents: keeps what is on its way, and the account. Pure.

    sent = delivered + lost + refused + in_flight + undelivered
"""

from __future__ import annotations

import dataclasses
import heapq
import math
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any, Final, Protocol

from madns_runtime.errors import MessageTooLarge, PluginError
from madns_runtime.medium.outcomes import (
    CHANNELS_MAX,
    DELIVERED,
    EVERYBODY,
    LOST,
    OTHERS,
    WORDS_MAX,
    LinkOutcome,
    Medium,
    MessageAccount,
)
from madns_runtime.plain_values import LINE_CHARACTERS_MAX, is_line, is_real, shown
from madns_runtime.protocol.link_settings import SendQueueFull
from madns_runtime.protocol.messages import Delivery, Transmission, TransmissionRefusal

LEAD_S: Final = 1.0
"""Lead of the hand-over before the arrival, s: far more than a network takes."""
OUTCOMES_MAX: Final = 65_536
"""Outcomes of one message; more is a fault of the medium."""
KEPT_MAX: Final = 2**20
"""Messages on their way that are kept at a time; further ones are not delivered, and counted."""

_MAKE: Final[dict[str, Callable[[Any], Any]]] = {"arrives_s": float, "size_bytes": int}
"""Plain kinds of an outcome's values; others are texts."""
_LINES: Final = ("outcome", "channel")
"""Those of the texts that are counted by: what a receiver is called is told to its sender alone."""
_LINE: Final = f"of at most {LINE_CHARACTERS_MAX} printable characters"


class WayFaults(Protocol):
    """Faults of messages between agents."""

    def ways(
        self, sender: str, transmission: Transmission, outcomes: Sequence[LinkOutcome]
    ) -> list[LinkOutcome]:
        """Return what becomes of a message that the medium has carried, for each receiver."""


class Carrier:
    """
    Messages between agents, from the host's knowledge of them to their receivers.

    Args:
        agents: Names of all agents.
        post: Sends to an agent; returns whether it is there.
        now_s: Returns the simulated time, s.
        end_s: Simulated time at which the run ends, s: what would be handed over later is counted and not kept.
    """

    def __init__(
        self,
        agents: Sequence[str],
        post: Callable[[str, Delivery | TransmissionRefusal], bool],
        now_s: Callable[[], float],
        *,
        end_s: float = math.inf,
    ) -> None:
        self.medium: Medium | None = None
        self.faults: WayFaults | None = None
        """Fates of messages beyond what the medium says, while faults are in force."""
        self._agents = frozenset(agents)
        self._post = post
        self._now_s = now_s
        self._end_s = end_s
        self._accounts: dict[str, MessageAccount] = {}
        self._serial = 0
        self._untold = self._unqueued = 0
        # At most KEPT_MAX: how long messages are on their way is the medium's to say.
        self._heap: list[tuple[float, str, int, int, str, Delivery, MessageAccount]] = []

    def account(self, channel: str = "") -> MessageAccount:
        """Return what became of the messages of a channel; beyond CHANNELS_MAX, of all further ones together."""
        accounts = self._accounts
        if channel not in accounts and len(accounts) >= CHANNELS_MAX:
            channel = OTHERS
        return accounts.setdefault(channel, MessageAccount())

    def enter(
        self,
        sender: str,
        transmission: Transmission,
        outcomes: Sequence[LinkOutcome],
    ) -> Sequence[LinkOutcome]:
        """
        See to what becomes of a message, of an agent or of a place such as a ground station.

        Returns:
            What becomes of it in the end, with the faults that are in force.

        Raises:
            PluginError: There is no outcome, or one is impossible.
        """
        if not isinstance(outcomes, (list, tuple)) or not all(
            isinstance(outcome, LinkOutcome) for outcome in outcomes or (None,)
        ):
            raise PluginError(f"{shown(outcomes)}: expected a list of one or more LinkOutcome")
        if len(outcomes) > OUTCOMES_MAX:
            raise PluginError(
                f"a list of {len(outcomes)} LinkOutcome of one message: expected at most {OUTCOMES_MAX}"
            )
        outcomes = [_checked(outcome, transmission) for outcome in outcomes]
        if self.faults is not None:
            outcomes = self.faults.ways(sender, transmission, outcomes)
        now_s = self._now_s()
        self.account(outcomes[0].channel).transmissions += 1
        for outcome in outcomes:
            account = self.account(outcome.channel)
            account.enter(outcome, now_s)
            if outcome.arrives_s is not None:
                self._keep(sender, transmission, outcome, account)
            elif outcome.outcome != LOST and sender in self._agents:
                number, to, sent_s = transmission.number, transmission.to, transmission.sent_s
                refusal = TransmissionRefusal(number, to, sent_s, outcome.outcome)
                self._untold += not self._send(sender, refusal)
        return outcomes

    def hand_over(self) -> None:
        """Send on what arrives up to LEAD_S from now on, in order of arrival."""
        heap, t_s = self._heap, self._now_s()
        # As `next_s` rounds it: what it promises is there.
        while heap and heap[0][0] - LEAD_S <= t_s:
            *_, to, delivery, account = heapq.heappop(heap)
            account.in_flight -= 1
            account.handed_over += 1
            account.undelivered += not self._send(to, delivery)

    def next_s(self) -> float | None:
        """Return when `hand_over` has something next, which may be over already; None: nothing is on its way."""
        return self._heap[0][0] - LEAD_S if self._heap else None

    def to_mapping(self) -> dict[str, Any]:
        """Return the account of all channels together; without a message, nothing."""
        accounts = self._accounts.values()
        outcomes: Counter[str] = sum((account.outcomes for account in accounts), Counter())
        if not outcomes:
            return {}
        delivered, lost = outcomes.pop(DELIVERED, 0), outcomes.pop(LOST, 0)
        refused = outcomes.total()
        del outcomes[OTHERS]
        told = Counter(dict(outcomes.most_common(WORDS_MAX)))
        if others := refused - told.total():  # of many channels, or of many words in one
            told[OTHERS] = others
        total = {
            name: sum(getattr(account, name) for account in accounts)
            for name in ("transmissions", "sent", "in_flight", "undelivered", "heard_late")
        }
        return {
            "transmissions": total["transmissions"],
            "sent": total["sent"],
            "delivered": delivered - total["in_flight"] - total["undelivered"],
            "lost": lost,
            "refused": refused,
            "refused_because": dict(sorted(told.items())),
            "refusals_untold": self._untold,
            "in_flight": total["in_flight"],
            "undelivered": total["undelivered"],
            "unqueued": self._unqueued,
            "known_late": total["heard_late"],
        }

    def _keep(
        self,
        sender: str,
        transmission: Transmission,
        outcome: LinkOutcome,
        account: MessageAccount,
    ) -> None:
        """Keep a message until shortly before it arrives; one for a place that is no agent has arrived there."""
        if outcome.to not in self._agents or outcome.arrives_s is None:
            return
        sent_s, arrives_s = transmission.sent_s, outcome.arrives_s
        if arrives_s - LEAD_S > self._end_s:  # on its way for the rest of the run
            account.in_flight += 1
            return
        if len(self._heap) >= KEPT_MAX:
            account.undelivered += 1
            self._unqueued += 1
            return
        delivery = Delivery(sender, sent_s, arrives_s, transmission.payload)
        self._serial += 1
        account.in_flight += 1
        entry = (
            arrives_s,
            sender,
            transmission.number,
            self._serial,
            outcome.to,
            delivery,
            account,
        )
        heapq.heappush(self._heap, entry)

    def _send(self, to: str, message: Delivery | TransmissionRefusal) -> bool:
        try:
            return self._post(to, message)
        except (SendQueueFull, MessageTooLarge):
            # The receiver is there: no loss of an agent explains this one.
            self._unqueued += isinstance(message, Delivery)
            return False


def _checked(outcome: LinkOutcome, transmission: Transmission) -> LinkOutcome:
    """Return an outcome that is possible: of plain values, and what is delivered arrives, and later than it was sent."""
    if not _is_plain(outcome):
        outcome = _plain(outcome)
    arrives_s = outcome.arrives_s
    if (outcome.outcome == DELIVERED) != (arrives_s is not None) or not (
        arrives_s is None or transmission.sent_s < arrives_s < math.inf
    ):
        raise PluginError(
            f"{shown(outcome.outcome)} with arrives_s {shown(arrives_s)}: expected a message that is {DELIVERED!r} to"
            f" arrive later than it was sent, at {transmission.sent_s:g} s, and no other to arrive"
        )
    if arrives_s is not None and outcome.to == EVERYBODY:
        raise PluginError(
            f"a LinkOutcome that delivers to {EVERYBODY!r}: expected one for each receiver, by name"
        )
    return outcome


def _is_plain(outcome: LinkOutcome) -> bool:
    """Tell whether an outcome holds what messages and accounts can: of most it is known by their types alone."""
    return (
        type(outcome.to) is type(outcome.outcome) is type(outcome.channel) is str
        and outcome.outcome.isidentifier()
        and outcome.outcome.isascii()
        and len(outcome.outcome) <= LINE_CHARACTERS_MAX
        and is_line(outcome.channel)
        and (outcome.arrives_s is None or type(outcome.arrives_s) is float)
        and type(outcome.size_bytes) is int
        and outcome.size_bytes >= 0
    )


def _plain(outcome: LinkOutcome) -> LinkOutcome:
    """
    Return an outcome with numbers and texts of other kinds, such as NumPy's, as plain ones.

    Raises:
        PluginError: A value is neither.
    """
    changed: dict[str, Any] = {}
    for name, wanted in (
        ("to", "a receiver's name"),
        ("outcome", f"{DELIVERED!r}, {LOST!r}, or a word that says why not, {_LINE}"),
        ("arrives_s", "a simulated time in seconds, or None"),
        ("size_bytes", "a number of bytes"),
        ("channel", f"a text {_LINE}"),
    ):
        value: Any = getattr(outcome, name)
        if name == "arrives_s" and value is None:
            continue
        is_fit = is_real(value) if name in _MAKE else isinstance(value, str)
        if (
            not is_fit
            or (name in _LINES and not is_line(value))
            or (name == "outcome" and not value)
        ):
            raise PluginError(f"a LinkOutcome with {name} {shown(value)}: expected {wanted}")
        try:
            changed[name] = made = _MAKE.get(name, str)(value)
            if name == "size_bytes" and made < 0:
                raise ValueError
        except Exception:  # noqa: BLE001 - of NaN, a whole number without end, or a class that may raise anything
            raise PluginError(
                f"a LinkOutcome with {name} {shown(value)}: expected {wanted}"
            ) from None
    return dataclasses.replace(outcome, **changed)
