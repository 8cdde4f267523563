"""
Fates of messages under the faults in force: decided by rules, by chance under the seed. Pure.

Chance is drawn for names and numbers, not in turn: which fault, whose message, in which direction, and its number since
the fault began. The same messages have the same fate in real time, in lockstep, and in whatever order the host knows of them.
"""

from __future__ import annotations

import math
import struct
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from hashlib import blake2b
from typing import Any, Final

from madns_runtime.protocol.messages import Service
from madns_runtime.timeline import fault_kinds as words

UP: Final = -1
"""From an agent to the host's half, where an index of a receiver would stand."""
DOWN: Final = -2
PLACE: Final = -3
"""A sender or receiver that is no agent, such as a ground station."""
RESEND_S: Final = 0.1
"""From a loss to the first resend, s; each further one waits twice as long as that before it."""
RESEND_S_MAX: Final = 1.6
RESENDS_MAX: Final = 64
"""Losses of one message in a row; what comes through then was late by 100 s."""
_KEY: Final = struct.Struct("<5q")
_CHANCES: Final = float(2**64)
_BEST: Final = int(Service.BEST)


@dataclass(frozen=True, slots=True, kw_only=True)
class MessageRule:
    """One fault of messages that is in force."""

    number: int
    """The action's."""
    chance: int
    """The action's: what is drawn for it hangs on no other."""
    word: str
    agents: frozenset[str]
    parameters: Mapping[str, Any]
    until_s: float = math.inf
    """Simulated time of its end, s: a message that is sent again after it comes through."""

    def is_of(self, traffic: str) -> bool:
        """Tell whether it concerns messages with_host, or between_agents."""
        if self.word == words.PARTITION:
            return traffic == "between_agents"
        return self.parameters.get("traffic", "all") in ("all", traffic)


@dataclass(slots=True)
class Fate:
    """Fate of one message."""

    is_lost: bool = False
    late_s: float = 0.0
    is_held: bool = False
    """Whether it waits until its agent's link is up again."""
    is_doubled: bool = False

    @property
    def is_plain(self) -> bool:
        """Whether no fault touches it."""
        return not (self.is_lost or self.late_s or self.is_held or self.is_doubled)


class MessageRules:
    """
    The faults of messages in force.

    Args:
        agents: Names of all agents.
        seed: The run's.
    """

    def __init__(self, agents: Sequence[str], seed: int) -> None:
        self._index = {name: number for number, name in enumerate(agents)}
        self._key = blake2b(f"faults {seed}".encode(), digest_size=16).digest()
        self._rules: dict[int, MessageRule] = {}
        self._with_host: dict[str, tuple[MessageRule, ...]] = {}
        self._between: tuple[MessageRule, ...] = ()
        self._numbers: dict[int, Counter[tuple[str, int]]] = {}
        """By rule how many messages of each agent it was shown, by direction: other rules have no part in its chance."""

    def add(self, rule: MessageRule) -> None:
        """Put a rule in force."""
        self._rules[rule.number] = rule
        self._numbers[rule.number] = Counter()
        self._sort()

    def remove(self, number: int) -> MessageRule | None:
        """Lift a rule, and return it; None if it is not in force."""
        rule = self._rules.pop(number, None)
        self._numbers.pop(number, None)
        self._sort()
        return rule

    @property
    def are_in_force(self) -> bool:
        """Whether there is any."""
        return bool(self._rules)

    def is_down(self, agent: str) -> bool:
        """Tell whether an agent's link to the host's half is down."""
        return any(rule.word == words.LINK_DOWN for rule in self._with_host.get(agent, ()))

    def concern(self, agent: str) -> bool:
        """Tell whether a fault may touch messages between an agent and the host's half."""
        return agent in self._with_host

    def of_host(self, agent: str, direction: int, service: int, now_s: float = 0.0) -> Fate:
        """
        Return the fate of the next message between an agent and the host's half.

        Args:
            agent: The agent.
            direction: UP or DOWN.
            service: Its class of service: what is not BEST arrives, late.
            now_s: Simulated time at which it is sent, s.
        """
        fate, index = Fate(), self._index[agent]
        for rule in self._with_host[agent]:
            numbers = self._numbers[rule.number]
            numbers[agent, direction] += 1
            number = numbers[agent, direction]
            draw = _Draws(self._key, (rule.chance, index, direction, number))
            _apply(rule, fate, draw, left_s=None if service == _BEST else rule.until_s - now_s)
        return fate

    def of_way(self, sender: str, receiver: str, number: int) -> Fate:
        """
        Return the fate of a message on its way between two agents, or between an agent and a place.

        Args:
            sender: An agent's name, or a place's.
            receiver: The same.
            number: The sender's own of the message.
        """
        fate = Fate()
        ends = (self._index.get(sender, PLACE), self._index.get(receiver, PLACE))
        for rule in self._between:
            is_from, is_to = sender in rule.agents, receiver in rule.agents
            if rule.word == words.PARTITION:
                # A place is on every side: which of two sides is named makes no difference.
                fate.is_lost = fate.is_lost or (is_from != is_to and PLACE not in ends)
            elif is_from or is_to:
                _apply(rule, fate, _Draws(self._key, (rule.chance, *ends, number)), left_s=None)
        return fate

    def up_again_s(self, agent: str, number: int) -> float:
        """Return after how long a message that a link held comes, once that is up: its resend's time, s."""
        return RESEND_S * _Draws(self._key, (-1, self._index[agent], 0, number))()

    def _sort(self) -> None:
        rules = [self._rules[number] for number in sorted(self._rules)]
        of_host = [rule for rule in rules if rule.is_of("with_host")]
        self._with_host = {
            name: own
            for name in self._index
            if (own := tuple(rule for rule in of_host if name in rule.agents))
        }
        self._between = tuple(rule for rule in rules if rule.is_of("between_agents"))


class _Draws:
    """Numbers within [0, 1) for one message and one rule, one after the other."""

    __slots__ = ("_count", "_key", "_name")

    def __init__(self, key: bytes, name: tuple[int, int, int, int]) -> None:
        self._key = key
        self._name = name
        self._count = 0

    def __call__(self) -> float:
        name = _KEY.pack(*self._name, self._count)
        self._count += 1
        drawn = blake2b(name, digest_size=8, key=self._key).digest()
        return int.from_bytes(drawn, "little") / _CHANCES


def _apply(
    rule: MessageRule, fate: Fate, draw: Callable[[], float], *, left_s: float | None
) -> None:
    """Let one rule touch a message; one that must arrive, in *left_s* at the latest, is late where another is lost."""
    value, is_best = rule.parameters, left_s is None
    match rule.word:
        case words.LINK_DOWN:
            fate.is_lost = fate.is_lost or is_best
            fate.is_held = fate.is_held or not is_best
        case words.LOSE:
            if left_s is None:
                fate.is_lost = fate.is_lost or draw() < value["probability"]
            else:
                fate.late_s += _resent_after_s(value["probability"], draw, left_s)
        case words.DELAY:
            fate.late_s += value["delay_s"] + value["jitter_s"] * draw()
        case words.REORDER:
            if draw() < value["probability"]:
                fate.late_s += value["within_s"] * draw()
        case words.DUPLICATE:
            fate.is_doubled = fate.is_doubled or draw() < value["probability"]
        case _:
            raise ValueError(f"expected a fault of messages, got {rule.word!r}")


def _resent_after_s(probability: float, draw: Callable[[], float], left_s: float) -> float:
    """Return how late a message is that is sent again until it comes through, at once after *left_s*, s."""
    late_s, wait_s = 0.0, RESEND_S
    for _ in range(RESENDS_MAX):
        if late_s >= left_s or draw() >= probability:
            break
        late_s += wait_s * (0.5 + 0.5 * draw())
        wait_s = min(2.0 * wait_s, RESEND_S_MAX)
    return late_s
