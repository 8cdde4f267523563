"""Messages of a device's process to the agents that use it: in order, and behind what waits for room."""

from __future__ import annotations

import math
import socket
from collections import deque
from collections.abc import Mapping
from time import monotonic
from typing import Any, Final

from madns_runtime.hardware import messages
from madns_runtime.hardware.count_table import CELLS_MAX, MISSED, CountTable, missed_name
from madns_runtime.reactor.reactor import Reactor

WAITING_MAX: Final = 10_000
"""Messages that may wait for room at one agent; the oldest is given up beyond, and counted."""
PERIOD_S: Final = 0.02
"""Between two looks for room."""
USERS_NAMED_MAX: Final = CELLS_MAX // 5
"""Agents of which each has a count of its own; of more they are counted together, as a device's own counts need room."""


class UserOutbox:
    """
    Sends to all users of a device, and never waits.

    Args:
        users: The device's ends of its pairs, by agent.
        reactor: The loop of its process.
        counts: Where what is given up is counted by agent, for the first USERS_NAMED_MAX agents to read.
    """

    def __init__(
        self, users: Mapping[str, socket.socket], reactor: Reactor, counts: CountTable
    ) -> None:
        self._users: list[tuple[str, socket.socket, deque[list[Any]]]] = [
            (
                missed_name(agent) if place < USERS_NAMED_MAX else MISSED,
                end,
                deque(maxlen=WAITING_MAX),
            )
            for place, (agent, end) in enumerate(users.items())
        ]
        self._counts = counts
        self._timer = reactor.call_at(math.inf, self._send_waiting)

    def send(self, message: list[Any]) -> int:
        """Send a message to all, and return how many of them have to do without one."""
        lost = 0
        for name, end, waiting in self._users:
            if waiting:
                if len(waiting) == WAITING_MAX:
                    lost += 1
                    self._counts.add(name)
                waiting.append(message)
            elif not messages.send(end, message):
                waiting.append(message)
                self._timer.reschedule(monotonic() + PERIOD_S)
        return lost

    def _send_waiting(self) -> None:
        for _, end, waiting in self._users:
            while waiting and messages.send(end, waiting[0]):
                waiting.popleft()
        is_empty = not any(waiting for *_, waiting in self._users)
        self._timer.reschedule(math.inf if is_empty else monotonic() + PERIOD_S)
