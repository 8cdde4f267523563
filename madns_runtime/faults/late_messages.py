"""Messages that a fault holds back, and the order in which they go on. Pure."""

from __future__ import annotations

import heapq
import math
from collections.abc import Callable
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
    is_copy: bool = False
    """Whether it is the second of a message that comes twice."""


class LateMessages:
    """What is held back: BEST messages may overtake each other, the others keep the order of their class."""

    def __init__(self) -> None:
        self._heap: list[tuple[float, int, LateMessage]] = []
        self._held: dict[str, list[tuple[int, LateMessage]]] = {}
        self._last_s: dict[tuple[str, int, int], float] = {}
        """When the last of each ordered class goes on."""
        self._serial = 0

    def __len__(self) -> int:
        return len(self._heap) + sum(map(len, self._held.values()))

    @property
    def messages(self) -> int:
        """Messages held back; one that comes twice is one."""
        waiting = [message for _, _, message in self._heap]
        for held in self._held.values():
            waiting += [message for _, message in held]
        return sum(not message.is_copy for message in waiting)

    def must_wait(self, agent: str, direction: int, service: int, now_s: float) -> bool:
        """Tell whether one of an ordered class waits for others before it."""
        return self._last_s.get((agent, direction, service), -math.inf) > now_s

    def put(self, message: LateMessage, due_s: float) -> bool:
        """Hold a message back until *due_s*, infinite for until its link is up; return False if there is no room."""
        if len(self) >= LATE_MAX:
            return False
        self._serial += 1
        if message.service != _BEST:
            stream = (message.agent, message.direction, message.service)
            due_s = self._last_s[stream] = max(due_s, self._last_s.get(stream, -math.inf))
        if due_s == math.inf:
            self._held.setdefault(message.agent, []).append((self._serial, message))
        else:
            heapq.heappush(self._heap, (due_s, self._serial, message))
        return True

    def resume(self, agent: str, now_s: float, late_s: Callable[[int], float]) -> None:
        """Let go on what waits for an agent's link, each by *late_s* of its number later than *now_s*."""
        held = self._held.pop(agent, [])
        for _, message in held:
            stream = (message.agent, message.direction, message.service)
            self._last_s[stream] = -math.inf
        for number, (_, message) in enumerate(held):
            self.put(message, now_s + late_s(number))

    def next_s(self) -> float | None:
        """Return when the first of them goes on; None for never."""
        return self._heap[0][0] if self._heap else None

    def due(self, now_s: float) -> list[LateMessage]:
        """Return whose time has come, in the order of their times, and forget them."""
        found = []
        while self._heap and self._heap[0][0] <= now_s:
            found.append(heapq.heappop(self._heap)[2])
        return found
