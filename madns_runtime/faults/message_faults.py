"""
The faults of messages of one run, carried out at the host: it holds an end of every conversation.

What an agent sent is touched behind the seal and before it is handed in, what the host's half sends before it is
sealed, and messages between agents where the medium hands them over. The framework's own words, by which agents live,
keep time and end, are never touched.

    seen = passed + lost + late;    late = released + left, with the host
"""

from __future__ import annotations

import dataclasses
import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Protocol

from madns_runtime.errors import MessageTooLarge
from madns_runtime.faults.late_messages import LateMessage, LateMessages
from madns_runtime.faults.message_rules import DOWN, UP, Fate, MessageRule, MessageRules
from madns_runtime.medium.outcomes import LOST, LinkOutcome
from madns_runtime.protocol.codec import pack, unpack
from madns_runtime.protocol.link_settings import SendQueueFull
from madns_runtime.protocol.messages import Service, Transmission
from madns_runtime.timeline.action import ActionRefused, TimelineAction
from madns_runtime.timeline.fault_kinds import PARTITION
from madns_runtime.written_times import later_s


class MessageSender(Protocol):
    """Sends to an agent's half; see `plugin.api.Context.send`."""

    def __call__(
        self, to: str, message: Any, service: Service, *, deadline_s: float | None
    ) -> object:
        """Send *message*."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MessageEnds:
    """Where messages go on that a fault has let go."""

    receive: Callable[[str, Any], object]
    """Hands in what an agent sent."""
    send: MessageSender
    engage: Callable[[bool], None]
    """Told whether messages are to be shown to the faults from now on."""
    held: Callable[[], None]
    """Told that something is held back: `next_s` may be earlier."""


class MessageFaults:
    """
    Carries out the faults of messages.

    Args:
        agents: Names of all agents.
        seed: The run's.
        now_s: Returns the simulated time, s.
        ends: Where messages go on.
    """

    def __init__(
        self,
        agents: Sequence[str],
        seed: int,
        *,
        now_s: Callable[[], float],
        ends: MessageEnds,
    ) -> None:
        self._agents = frozenset(agents)
        self._rules = MessageRules(agents, seed)
        self._late = LateMessages()
        self.next_s = self._late.next_s
        self._now_s = now_s
        self._ends = ends
        self._counts: dict[str, Counter[str]] = {}
        self._between: Counter[str] = Counter()
        self._is_passing_on = False

    # In force -------------------------------------------------------------------------------------

    def begin(self, action: TimelineAction) -> None:
        """
        Put a fault in force.

        Raises:
            ActionRefused: It would part nobody.
        """
        if action.word == PARTITION and self._agents.issubset(action.agents):
            raise ActionRefused("all agents are on one side: nobody is left on the other")
        # That of a condition is due before the host hears of it.
        began_s = max(action.t_s, self._now_s())
        self._rules.add(
            MessageRule(
                number=action.number,
                chance=action.chance,
                word=action.word,
                agents=frozenset(action.agents),
                parameters=action.parameters,
                until_s=math.inf if action.for_s is None else began_s + action.for_s,
            )
        )
        self._ends.engage(True)

    def end(self, action: TimelineAction) -> None:
        """Lift a fault; what waited for a link that is up again goes on."""
        rule = self._rules.remove(action.number)
        for agent in sorted(rule.agents) if rule else ():
            if not self._rules.is_down(agent):
                self._late.resume(agent, self._now_s(), partial(self._rules.up_again_s, agent))
        self._ends.held()
        self._disengage()

    def _disengage(self) -> None:
        if not self._rules.are_in_force and not len(self._late):
            self._ends.engage(False)

    # Messages with the host's half ----------------------------------------------------------------

    def take(self, agent: str, message: Any, service: Service) -> None:
        """Take what an agent sent; what no fault touches is handed in at once."""
        if isinstance(message, Transmission):  # the medium's: see `ways`
            self._ends.receive(agent, message)
            return
        for _ in range(self._judge(LateMessage(agent, UP, int(service), message))):
            self._ends.receive(agent, message)

    def send(self, to: str, message: Any, service: Service, deadline_s: float | None) -> bool:
        """
        Take what the host's half sends.

        Returns:
            Whether nothing is left to do: it is lost, or waits.

        Raises:
            UnencodableValue: A message cannot carry it.
        """
        if not self._rules.concern(to) and not len(self._late):
            return False
        if self._is_passing_on:
            return False
        # Whoever sent it may go on to change it.
        kept = unpack(pack(message))
        copies = self._judge(LateMessage(to, DOWN, int(service), kept, deadline_s))
        if copies > 1:
            self._pass_on(to, kept, service, deadline_s)
        return copies == 0

    def _pass_on(self, to: str, message: Any, service: Service, deadline_s: float | None) -> None:
        """Send what no fault is to see again."""
        self._is_passing_on = True
        try:
            self._ends.send(to, message, service, deadline_s=deadline_s)
        except (SendQueueFull, MessageTooLarge):
            self._counts[to]["not_sent"] += 1
        finally:
            self._is_passing_on = False

    def _judge(self, message: LateMessage) -> int:
        """Return how often a message is to go on now; one that is late is kept."""
        agent, direction, service = message.agent, message.direction, message.service
        now_s = self._now_s()
        must_wait = self._late.must_wait(agent, direction, service)
        if not self._rules.concern(agent):
            fate = Fate()
            if not must_wait:
                return 1
        else:
            fate = self._rules.of_host(agent, direction, service, now_s)
        counts = self._counts.setdefault(agent, Counter())
        counts["seen"] += 1
        if fate.is_lost:  # and not twice either
            counts["lost"] += 1
            return 0
        if fate.is_doubled and service == int(Service.BEST):
            counts["doubled"] += 1
        elif fate.is_doubled:
            counts["double_discarded"] += 1  # the other classes promise exactly once
            fate.is_doubled = False
        if fate.is_held or fate.late_s or must_wait:
            due_s = math.inf if fate.is_held else later_s(now_s, fate.late_s)
            is_kept = self._late.put(message._replace(copies=1 + fate.is_doubled), due_s)
            counts["late" if is_kept else "lost"] += 1
            counts["no_room"] += not is_kept
            if fate.is_doubled and not is_kept:
                counts["doubled"] -= 1
            self._ends.held()
            return 0
        counts["passed"] += 1
        return 1 + fate.is_doubled

    def release(self) -> None:
        """Let go on whatever's time has come."""
        for message in self._late.due(self._now_s()):
            agent, service = message.agent, Service(message.service)
            counts = self._counts[agent]
            counts["released"] += 1
            if message.direction == UP:
                for _ in range(message.copies):
                    self._ends.receive(agent, message.payload)
                continue
            deadline_s = message.deadline_s
            if deadline_s is not None and deadline_s < self._now_s():
                counts["deadlines_broken"] += 1
                deadline_s = None
            for _ in range(message.copies):
                self._pass_on(agent, message.payload, service, deadline_s)
        self._disengage()

    # Messages between agents ----------------------------------------------------------------------

    def ways(
        self, sender: str, transmission: Transmission, outcomes: Sequence[LinkOutcome]
    ) -> list[LinkOutcome]:
        """Return what becomes of a message that the medium has carried, for each receiver."""
        found = []
        for outcome in outcomes:
            if outcome.arrives_s is None:
                found.append(outcome)
                continue
            fate = self._rules.of_way(sender, outcome.to, transmission.number)
            self._between["seen"] += 1
            if fate.is_lost:
                self._between["lost"] += 1
                found.append(dataclasses.replace(outcome, outcome=LOST, arrives_s=None))
                continue
            self._between["late" if fate.late_s else "passed"] += 1
            self._between["doubled"] += fate.is_doubled
            arrives_s = later_s(outcome.arrives_s, fate.late_s)
            late = outcome if not fate.late_s else dataclasses.replace(outcome, arrives_s=arrives_s)
            found += [late] * (1 + fate.is_doubled)
        return found

    # The account ----------------------------------------------------------------------------------

    def to_mapping(self) -> dict[str, Any]:
        """Return the counts; without a message that a fault was shown, nothing."""
        if not self._counts and not self._between:
            return {}
        with_host: Counter[str] = sum(self._counts.values(), Counter())
        return {
            "with_host": {**with_host, "left": len(self._late)},
            "between_agents": dict(self._between),
            "agents": {agent: dict(self._counts[agent]) for agent in sorted(self._counts)},
        }
