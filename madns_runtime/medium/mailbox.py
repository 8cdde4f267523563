"""
An agent's side of messages between agents: stamps what it sends, and holds what comes until its time. Pure, bounded.

Messages bear the time of the sender's newest tick, not a clock's: an agent that is given the same sends the same,
whatever computer it runs on.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Callable, Sequence
from typing import Any, Final

from madns_runtime.errors import PluginError
from madns_runtime.medium.outcomes import EVERYBODY
from madns_runtime.plain_values import is_whole, shown
from madns_runtime.protocol.messages import Delivery, Service, Transmission

HELD_MAX: Final = 4096
"""Messages held at a time; further ones are dropped and counted."""
TIME_EPSILON_S: Final = 1e-9
"""Rounding of tick times: what arrives at a tick's own time is received in it."""
NUMBER_END: Final = 2**62
"""Numbers that senders give themselves lie below: what counts on from one fits 64 bits, as chance by number must."""
NUMBERS_PER_INCARNATION: Final = 2**32
"""Messages of an agent's process after it, started anew, are numbered from the next multiple of this."""
WHAT_TO_DECLARE: Final = (
    "this simulation declares no medium for messages between agents: give its descriptor"
    ' medium=":function", a function of (host half, HostContext) that returns one, such as'
    " madns_runtime.medium.links.LinkMedium"
)


class Mailbox:
    """
    Messages of one agent: on their way out, and held in the order of (arrival, sender, time sent).

    Args:
        name: The agent's.
        agents: Names of all agents.
        has_medium: Whether the simulation declares one.
        post: Sends to the host.
        incarnation: Which incarnation of the agent this is, from 1.
    """

    def __init__(
        self,
        name: str,
        agents: Sequence[str],
        *,
        has_medium: bool,
        post: Callable[[Transmission], None],
        incarnation: int = 1,
    ) -> None:
        self._receivers = {*agents, EVERYBODY} - {name}
        self._has_medium = has_medium
        self._post = post
        self._number = (incarnation - 1) * NUMBERS_PER_INCARNATION
        self.tick_s = -math.inf
        """Time of the newest tick, which what is sent bears; none has begun before."""
        self._taken_s = -math.inf
        """Time of the newest tick whose messages were received."""
        self._serial = 0
        self._held: list[tuple[float, str, float, int, Delivery]] = []
        self._received = self._late = self._refused = 0

    def send(
        self, to: Any, message: Any, service: Service = Service.RELIABLE, deadline_s: Any = None
    ) -> int:
        """
        Send to another agent, or to all; see `plugin.api.AgentContext.send`.

        Raises:
            PluginError: There is no such agent, or messages to agents cannot be sent so, or now.
        """
        if not isinstance(to, str) or to not in self._receivers:
            raise PluginError(
                f"expected a receiver ('host', another agent's name, or '{EVERYBODY}' for all that"
                f" hear it), got {to!r:.80}"
            )
        if service is not Service.RELIABLE or deadline_s is not None:
            raise PluginError(
                f"to {to!r}: expected Service.RELIABLE and no deadline, got {service!r}: the medium alone"
                " decides what becomes of messages between agents, and when they arrive"
            )
        return self.transmit(to, message)

    def transmit(self, to: str, message: Any, *, number: int | None = None) -> int:
        """
        Hand a message to the medium; see `plugin.api.AgentContext.transmit`.

        Raises:
            PluginError: The simulation declares no medium, no tick has begun, or the receiver is no name or the
                number none.
        """
        if not self._has_medium:
            raise PluginError(f"to {to!r:.80}: {WHAT_TO_DECLARE}")
        if self.tick_s == -math.inf:
            raise PluginError(
                f"to {to!r:.80}: there is no time before the first tick; send to agents in step()"
            )
        if not isinstance(to, str):
            raise PluginError(f"expected a receiver's name, got {to!r:.80}")
        if number is None:
            number = self._number
        elif not is_whole(number) or not -NUMBER_END < number < NUMBER_END:
            raise PluginError(
                f"number: expected a whole number of less than 2**62, got {shown(number)}"
            )
        else:
            number = int(number)
        self._post(Transmission(to, number, self.tick_s, message))
        self._number = max(self._number, number + 1)
        return number

    def add(self, delivery: Delivery) -> None:
        """Take a message whose time is to come, or has come already: the latter is counted late."""
        if len(self._held) >= HELD_MAX:
            self._refused += 1
            return
        is_over = delivery.arrives_s <= self._taken_s + TIME_EPSILON_S
        # None is received in its own tick.
        self._late += is_over and delivery.sent_s < self._taken_s
        self._serial += 1
        entry = (delivery.arrives_s, delivery.sender, delivery.sent_s, self._serial, delivery)
        heapq.heappush(self._held, entry)

    def begin(self, t_s: float) -> None:
        """Take *t_s* for the time of the newest tick, though what is received in it is asked for later; nothing before the first."""
        if self.tick_s > -math.inf:
            self.tick_s = t_s

    def due(self, t_s: float) -> Sequence[Delivery]:
        """Begin the tick at *t_s*: return what is received in it, in order, and forget it."""
        self.tick_s = self._taken_s = t_s
        held = self._held
        if not held:  # as in most ticks
            return ()
        found, own = [], []
        while held and held[0][0] <= t_s + TIME_EPSILON_S:
            entry = heapq.heappop(held)
            if entry[2] < t_s:
                found.append(entry[-1])
            else:  # sent in this tick, and nearer than a rounding
                own.append(entry)
        for entry in own:
            heapq.heappush(held, entry)
        self._received += len(found)
        return found

    def counts(self) -> dict[str, int]:
        """Return how many messages were received, are held, came late (of both), and found no room."""
        return {
            "received": self._received,
            "held": len(self._held),
            "late": self._late,
            "no_room": self._refused,
        }
