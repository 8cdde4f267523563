"""
Parts of a medium: transmitters with a queue, chance by the seed, and a whole medium made of four answers.

Pure: no clock, and chance is drawn for names, not in turn. What becomes of a message never depends on when, or after
whose messages, the host knows of it.
"""

from __future__ import annotations

import inspect
import math
import struct
from collections import deque
from collections.abc import Callable, Sequence
from functools import partial
from hashlib import blake2b
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from madns_runtime.errors import PluginError
from madns_runtime.medium.outcomes import DELIVERED, EVERYBODY, LOST, LinkOutcome
from madns_runtime.plain_values import is_real, is_whole, shown
from madns_runtime.protocol.codec import pack
from madns_runtime.protocol.messages import Transmission

if TYPE_CHECKING:
    import numpy as np  # 0.2 s of import time that `cosmos validate` has no use for

OUT_OF_ORDER: Final = "out_of_order"
"""Refused: known of after a later one of the same sender."""
QUEUE_FULL: Final = "queue_full"
"""Refused: the transmitter took no more."""
UNKNOWN_RECEIVER: Final = "unknown_receiver"
"""Refused: there is nobody of that name, or it is the sender itself."""
NOBODY_IN_REACH: Final = "nobody_in_reach"
"""Refused: a broadcast that nobody could receive."""
WAY: Final = "a function of (sender, receiver, t_s)"
"""Answer that depends on a message's way."""

_KEY = struct.Struct("<3q")
_CHANCES = float(2**64)


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
        """Times at which those that still wait will leave; grows with every entry."""
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
    outcome of a message is the same in whatever order the host knows of messages.
    """

    __slots__ = ("_key",)

    def __init__(self, random: np.random.Generator) -> None:
        """Take one number from *random*, now, as the seed."""
        self._key = random.bytes(16)

    def draw(self, sender: int, number: int, receiver: int) -> float:
        """Return a number within [0, 1)."""
        drawn = blake2b(_KEY.pack(sender, number, receiver), digest_size=8, key=self._key)
        return int.from_bytes(drawn.digest(), "little") / _CHANCES


class LinkMedium:
    """
    A medium made of four answers: reach, delay, rate and loss.

    Every agent has one transmitter: its messages leave one after the other, and a broadcast is one transmission that
    everybody in reach receives. Receivers take any number of messages at once; nothing interferes.

    Args:
        agents: Names of all agents.
        random: The host's; one number is drawn from it, now, as the seed of all chance.
        delay_s: Time from leaving to arrival, s, more than 0; or a function of (sender, receiver, t_s).
        reach: Function of (sender, receiver, t_s): None if the receiver can receive what leaves the sender at
            simulated time t_s, else why not, in a word such as out_of_range. Everybody reaches everybody without it.
        rate_byte_s: What a transmitter sends, B/s.
        loss: Share of messages that are lost on their way.
        queue_max: Messages that may wait at one transmitter; further ones are refused.

    Raises:
        PluginError: A value is none of these.
    """

    def __init__(  # noqa: PLR0913 - the answers that make a medium, each by name
        self,
        agents: Sequence[str],
        random: np.random.Generator,
        *,
        delay_s: float | Callable[[str, str, float], float],
        reach: Callable[[str, str, float], str | None] | None = None,
        rate_byte_s: float = math.inf,
        loss: float = 0.0,
        queue_max: int = 256,
    ) -> None:
        _check_answers(delay_s, reach, rate_byte_s, loss, queue_max)
        self._agents = tuple(agents)
        self._index = {name: number for number, name in enumerate(agents)}
        self._chance = Chance(random)
        self._delay_s = delay_s
        self._reach = reach
        self._rate_byte_s = rate_byte_s
        self._loss = loss
        self._transmitters = {name: Transmitter(queue_max) for name in agents}

    def carry(self, sender: str, transmission: Transmission) -> list[LinkOutcome]:
        """Return what becomes of a message, for each receiver; see `Medium.carry`."""
        to, sent_s = transmission.to, transmission.sent_s
        outcome = partial(LinkOutcome, size_bytes=len(pack(transmission.payload)))
        transmitter = self._transmitters[sender]
        if not transmitter.is_in_order(sent_s, transmission.number):
            return [outcome(to=to, outcome=OUT_OF_ORDER)]
        if to != EVERYBODY and (to == sender or to not in self._index):
            return [outcome(to=to, outcome=UNKNOWN_RECEIVER)]
        leaves_s = transmitter.leaves_s(sent_s)
        if leaves_s is None:
            return [outcome(to=to, outcome=QUEUE_FULL)]
        duration_s = outcome.keywords["size_bytes"] / self._rate_byte_s
        transmitter.occupy(sent_s, leaves_s, duration_s)
        draw, found = partial(self._chance.draw, self._index[sender]), []
        for receiver in self._agents if to == EVERYBODY else (to,):
            if receiver == sender:
                continue
            barrier: Any = self._reach(sender, receiver, leaves_s) if self._reach else None
            if barrier is not None and not _is_reason(barrier):
                raise PluginError(
                    f"reach({sender!r}, {receiver!r}, {leaves_s:g}){_of_line(self._reach)} returned {shown(barrier)}:"
                    " expected None if the receiver can receive it, else why not, in a word such as 'out_of_range'"
                    f" other than {DELIVERED!r} and {LOST!r}"
                )
            if barrier and to == EVERYBODY:
                continue
            if barrier:
                found.append(outcome(to=to, outcome=barrier))
            elif draw(transmission.number, self._index[receiver]) < self._loss:
                found.append(outcome(to=receiver, outcome=LOST))
            else:
                delay_s = self._delay_s
                if callable(delay_s):
                    delay_s = delay_s(sender, receiver, leaves_s)
                    if not _is_positive(delay_s):
                        raise PluginError(
                            f"delay_s({sender!r}, {receiver!r}, {leaves_s:g}){_of_line(self._delay_s)} returned"
                            f" {shown(delay_s)}: expected seconds, more than 0"
                        )
                # A delay may be less than what tells two times apart.
                arrives_s = max(leaves_s + duration_s + delay_s, math.nextafter(sent_s, math.inf))
                found.append(outcome(to=receiver, outcome=DELIVERED, arrives_s=arrives_s))
        return found or [outcome(to=to, outcome=NOBODY_IN_REACH)]


def _check_answers(delay_s: Any, reach: Any, rate_byte_s: Any, loss: Any, queue_max: Any) -> None:
    """
    Refuse answers that no medium has.

    Raises:
        PluginError: One is no such number.
    """
    is_share = is_real(loss) and 0 <= loss <= 1
    for name, value, is_fit, wanted in (
        (
            "delay_s",
            delay_s,
            _takes_way(delay_s) or _is_positive(delay_s),
            f"seconds, more than 0, or {WAY}",
        ),
        ("reach", reach, reach is None or _takes_way(reach), f"None or {WAY}"),
        (
            "rate_byte_s",
            rate_byte_s,
            rate_byte_s == math.inf or _is_positive(rate_byte_s),
            "bytes per second, more than 0, or math.inf",
        ),
        ("loss", loss, is_share, "a share from 0 to 1"),
        (
            "queue_max",
            queue_max,
            is_whole(queue_max) and queue_max >= 0,
            "a whole number, 0 or more",
        ),
    ):
        if not is_fit:
            raise PluginError(f"LinkMedium: {name}: expected {wanted}, got {_shown_answer(value)}")


def _takes_way(function: Any) -> bool:
    """Tell whether a value can be called with a way, or does not say what it takes."""
    try:
        inspect.signature(function).bind("", "", 0.0)
    except TypeError:
        return False
    except ValueError:  # of a built-in one
        return callable(function)
    return True


def _shown_answer(value: Any) -> str:
    """Return an answer for a message; of a function its name and what it takes."""
    name = getattr(value, "__qualname__", None)
    return f"{name}{inspect.signature(value)}" if name and callable(value) else shown(value)


def _of_line(function: Any) -> str:
    """Return " of FILE:LINE" where a function of Python is written; empty of anything else."""
    code = getattr(function, "__code__", None)
    return f" of {Path(code.co_filename).name}:{code.co_firstlineno}" if code is not None else ""


def _is_reason(value: Any) -> bool:
    """Tell whether a value says why a message is refused; that it is lost, or delivered, says the medium itself."""
    return isinstance(value, str) and value not in ("", DELIVERED, LOST)


def _is_positive(value: Any) -> bool:
    """Tell whether a value is a number of finite size above 0."""
    return is_real(value) and bool(0 < value < math.inf)
