"""BEST messages: sent at once and once, numbered by channel, the newest wins."""

from __future__ import annotations

from collections import deque
from typing import Final

from madns_runtime.errors import MessageTooLarge
from madns_runtime.protocol.counters import ClassCounters
from madns_runtime.protocol.delivery import FRAGMENT_BYTES_MAX, FRAME, Received
from madns_runtime.protocol.messages import Service

BEST_BYTES_MAX: Final = FRAGMENT_BYTES_MAX
"""The longest body of a BEST message: one datagram."""

_BEST: Final = int(Service.BEST)


class BestSender:
    """Frames that wait for the next datagram; when the queue is full the oldest gives way."""

    __slots__ = ("_counters", "numbers", "queue")

    def __init__(self, queue_max: int, counters: ClassCounters) -> None:
        self._counters = counters
        self.numbers: dict[int, int] = {}
        """Number of the next message by channel, which is how many there were."""
        self.queue: deque[bytes] = deque(maxlen=queue_max)

    def push(self, body: bytes, channel: int) -> None:
        """
        Queue a message.

        Raises:
            MessageTooLarge: It does not fit one datagram.
        """
        if len(body) > BEST_BYTES_MAX:
            raise MessageTooLarge(
                f"a BEST message must fit one datagram: expected at most {BEST_BYTES_MAX} bytes, "
                f"got {len(body)}; send it RELIABLE or make it smaller"
            )
        if len(self.queue) == self.queue.maxlen:
            self._counters.dropped += 1
        number = self.numbers.get(channel, 0)
        self.numbers[channel] = number + 1
        self.queue.append(FRAME.pack(_BEST, channel, len(body), number) + body)


class BestReceiver:
    """Messages that wait for the owner, and what is missing between them."""

    __slots__ = ("_counters", "newest", "ready")

    def __init__(self, queue_max: int, counters: ClassCounters) -> None:
        self._counters = counters
        self.newest: dict[int, int] = {}
        """Number of the newest message by channel."""
        self.ready: deque[Received] = deque(maxlen=queue_max)

    def accept(self, channel: int, number: int, body: bytes) -> None:
        """Take a message if it is newer than all before it."""
        counters = self._counters
        ahead = number - self.newest.get(channel, -1)
        if ahead <= 0:
            if ahead == 0:
                counters.duplicates += 1
            else:
                # It was counted as lost when a newer one came.
                counters.late += 1
                counters.lost -= 1
            return
        counters.lost += ahead - 1
        counters.received += 1
        self.newest[channel] = number
        if len(self.ready) == self.ready.maxlen:
            counters.dropped += 1
        self.ready.append(Received(Service.BEST, channel, body))
