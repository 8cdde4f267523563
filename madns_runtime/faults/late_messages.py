"""Messages that a fault holds back, and the order in which they go on. Pure."""

from __future__ import annotations

import heapq
import math
from collections import Counter
from collections.abc import Callable, Iterator
from typing import Any, Final, NamedTuple

from madns_runtime.protocol.messages import Service

LATE_MAX: Final = 65_536
"""Messages held back at a time in one run; further ones are lost, and counted."""
_BEST: Final = int(Service.BEST)


class LateMessage(NamedTuple):
    """A message between an agent and the host's half."""

    agent: str
    direction: int
    service: int
    payload: Any
    deadline_s: float | None = None
    copies: int = 1
    """How often it goes on, one behind the other."""

    @property
    def stream(self) -> tuple[str, int, int]:
        """Those among which it keeps its place, if its class is an ordered one."""
        return self.agent, self.direction, self.service


class LateMessages:
    """Messages that are held back: BEST messages may overtake each other, the others keep the order of their class."""

    def __init__(self) -> None:
        self._heap: list[tuple[float, int, LateMessage]] = []
        self._held: dict[str, list[tuple[int, LateMessage]]] = {}
        self._last_s: dict[tuple[str, int, int], float] = {}
        """When the last of each ordered class goes on; infinite while one waits for its link."""
        self._last_known_s: dict[tuple[str, int, int], float] = {}
        """The same of those that wait for no link."""
        self._waiting: Counter[tuple[str, int, int]] = Counter()
        """Messages of each ordered class that have not gone on."""
        self._serial = 0

    def __len__(self) -> int:
        return len(self._heap) + sum(map(len, self._held.values()))

    def must_wait(self, agent: str, direction: int, service: int) -> bool:
        """Tell whether one of an ordered class waits for others before it, also for those whose time has just come."""
        return self._waiting[agent, direction, service] > 0

    def put(self, message: LateMessage, due_s: float) -> bool:
        """Hold a message back until *due_s*, infinite for until its link is up; return False if there is no room."""
        if len(self) >= LATE_MAX:
            return False
        self._serial += 1
        if message.service != _BEST:
            stream = message.stream
            due_s = self._last_s[stream] = max(due_s, self._last_s.get(stream, -math.inf))
            self._waiting[stream] += 1
            if due_s < math.inf:
                self._last_known_s[stream] = due_s
        if due_s == math.inf:
            self._held.setdefault(message.agent, []).append((self._serial, message))
        else:
            heapq.heappush(self._heap, (due_s, self._serial, message))
        return True

    def resume(self, agent: str, now_s: float, late_s: Callable[[int], float]) -> None:
        """
        Let go on what waits for an agent's link, each by *late_s* of its number later than *now_s*.

        None overtakes those of its class that were late already when the link went down.
        """
        held = self._held.pop(agent, [])
        for _, message in held:
            self._waiting[message.stream] -= 1
            self._last_s[message.stream] = self._last_known_s.get(message.stream, -math.inf)
        for number, (_, message) in enumerate(held):
            self.put(message, now_s + late_s(number))

    def next_s(self) -> float | None:
        """Return when the first of them goes on; None for never."""
        return self._heap[0][0] if self._heap else None

    def due(self, now_s: float) -> Iterator[LateMessage]:
        """Yield whose time has come, in the order of their times, each forgotten when it is yielded: others wait for it until then."""
        while self._heap and self._heap[0][0] <= now_s:
            message = heapq.heappop(self._heap)[2]
            if message.service != _BEST:
                self._waiting[message.stream] -= 1
            yield message
