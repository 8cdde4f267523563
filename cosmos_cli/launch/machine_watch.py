"""
Signs of life of a run's machines, the lines to what runs there, and the tries to reach one that was lost. Pure.

Each supervisor on another machine answers pings from its loop. Where none has answered yet, or only the
host lives, whose loop may wait for a plug-in, the connection itself is asked. A child whose line broke waits
for another one as long as its operator tries to make one; nothing is asked of it meanwhile.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from functools import partial

from cosmos_cli.launch.actions import Agenda, AskMachine, ReachMachine, Reattach, Send
from cosmos_cli.launch.child_commands import ping
from cosmos_cli.launch.children import HOST, ChildRecord, Children
from cosmos_cli.launch.run_events import (
    LineBroke,
    MachineAsked,
    MachineReached,
    Reattached,
    ReattachFailed,
)
from madns_runtime.config import Timeouts

REATTACH_INTERVAL_S = 0.2
"""Time between two tries to make a new line to a child."""
PING_INTERVAL_S = 1.0
SILENCE_S = 2.5
"""Silence after which a process counts as lost."""
SLOW_S = 1.5
"""An answer that took this long is worth a warning."""
LIFE_LINE_S = 30.0
"""A supervisor that hears no ping for this long ends by itself (`madns_runtime.reactor.operator_link`)."""
UNANSWERED_MAX = 64
CHECK_INTERVAL_S = 0.25
LOOK_S_MAX = 2 * CHECK_INTERVAL_S
"""The most that counts of the time between two looks: an operator that did not look was itself kept from it, and what
came meanwhile waits to be read."""
RETURN_INTERVAL_S = 2.0
"""Time between two tries to reach a lost machine again."""
RETURN_TRIES_MAX = 2000
"""Tries of more than an hour; by then a run has its machine back, or will not get it back."""


class Pulse:
    """
    Questions to one process, and the time at which it was last heard.

    Only what was asked and not answered counts as silence, in time in which the operator looked (`WatchedTime`):
    one that was itself stopped for a while, also with a question under way, blames nobody.
    """

    def __init__(self) -> None:
        self._number = 0
        self._asked_s = float("-inf")
        self._heard_s: float | None = None
        self._unanswered: deque[tuple[int, float]] = deque(maxlen=UNANSWERED_MAX)

    @property
    def was_heard(self) -> bool:
        """Whether it has answered at all: before, it may still be starting."""
        return self._heard_s is not None

    def is_due(self, now_s: float) -> bool:
        """Tell whether it is time to ask again."""
        return now_s - self._asked_s >= PING_INTERVAL_S

    def ping(self, now_s: float) -> int:
        """Note a question and return its number."""
        self._number += 1
        self._asked_s = now_s
        self._unanswered.append((self._number, now_s))
        return self._number

    def pong(self, number: int, now_s: float) -> float:
        """Note the answer to question *number*, and to all before it; return how long the oldest took, s."""
        if self._heard_s is None:
            self._unanswered.clear()  # they waited for the process to start
        self._heard_s = now_s
        took_s = 0.0
        while self._unanswered and self._unanswered[0][0] <= number:
            took_s = max(took_s, now_s - self._unanswered.popleft()[1])
        return took_s

    def silent_s(self, now_s: float) -> float:
        """Return for how long it has said nothing although it was asked; 0 while it starts."""
        if self._heard_s is None or not self._unanswered:
            return 0.0
        waited_s = now_s - self._unanswered[0][1]
        return min(now_s - self._heard_s, waited_s + PING_INTERVAL_S)

    def is_lost(self, now_s: float) -> bool:
        """Tell whether it has been silent for too long."""
        return self.silent_s(now_s) >= SILENCE_S


class WatchedTime:
    """The time in which the operator looked for signs of life, s."""

    def __init__(self) -> None:
        self._counted_s = 0.0
        self._looked_s = -math.inf

    def at(self, now_s: float) -> float:
        """Return the time watched, at a moment after the newest look."""
        return self._counted_s + min(now_s - self._looked_s, LOOK_S_MAX)

    def look(self, now_s: float) -> float:
        """Return the time watched until now, and count from here."""
        self._counted_s = self.at(now_s)
        self._looked_s = now_s
        return self._counted_s


@dataclass(slots=True)
class _Watched:
    pulses: dict[str, Pulse] = field(default_factory=dict)
    """Signs of life by child; the host is one of them."""
    cut: set[str] = field(default_factory=set)
    """Children whose line broke."""
    is_asked: bool = False
    """Whether its connection is being asked for a sign of life."""
    asked_s: float = float("-inf")
    is_lost: bool = False
    tries: int = 0
    is_tried: bool = False
    """Whether a try to reach it is under way."""
    is_waiting: bool = False
    """Whether the next try is due later."""
    why_not: str = ""
    """Why no connection could be made anew, the last time that this was tried."""

    @property
    def supervisors(self) -> list[tuple[str, Pulse]]:
        return [(name, pulse) for name, pulse in self.pulses.items() if name != HOST]

    def lose(self) -> None:
        self.is_lost = True
        self.pulses.clear()
        self.cut.clear()
        self.tries = 0


class MachineWatch:
    """
    Watches the machines of a run that are other computers; all others are none of its business.

    Args:
        machines: Their names.
        children: Of the run.
        agenda: The supervision's.
        timeouts: The run's.
        lost: Called with the machine of a child that got no other line in time, and why its line broke.
    """

    def __init__(
        self,
        machines: Iterable[str],
        children: Children,
        agenda: Agenda,
        *,
        timeouts: Timeouts,
        lost: Callable[[str, str], None],
    ) -> None:
        self._watched = {name: _Watched() for name in machines}
        self._time = WatchedTime()
        self._children = children
        self._agenda = agenda
        self._wait_s = timeouts.silence_s
        # A supervisor that hears nothing any more has its agents shut down, and kills those that do not.
        self._end_s = max(LIFE_LINE_S, timeouts.silence_s) + 2 * timeouts.shutdown_s
        self._lost = lost
        self._unreachable: set[str] = set()
        self._is_seeking = True
        self._are_ending = False

    def check_later(self, check: Callable[[], None]) -> None:
        """Let signs of life be looked for in a moment, if any machine is watched."""
        if self._watched:
            self._agenda.after("pulse", CHECK_INTERVAL_S, check)

    def add(self, machine: str | None, child: str) -> None:
        """Watch a child that was started."""
        if (watched := self._watched.get(machine or "")) is not None:
            watched.is_lost = False
            watched.pulses[child] = Pulse()
            watched.cut.discard(child)

    def remove(self, machine: str | None, child: str) -> None:
        """Watch a child no more: it has ended."""
        if (watched := self._watched.get(machine or "")) is not None:
            watched.pulses.pop(child, None)
            watched.cut.discard(child)

    def pong(self, machine: str | None, child: str, number: int) -> None:
        """Note an answer; warn of a machine that was nearly lost."""
        watched = self._watched.get(machine or "")
        if watched is None or child not in watched.pulses:
            return
        took_s = watched.pulses[child].pong(number, self._time.at(self._agenda.now_s))
        if took_s >= SLOW_S and child != HOST:
            text = f"{machine} answered only after {took_s:.1f} s; is its link or its processor overloaded?"
            self._agenda.say(text, "warning")

    def expect_ends(self) -> None:
        """Ask the connections from now on: a supervisor that closes its records leaves its loop before it ends."""
        self._are_ending = True

    def check(self) -> Iterator[tuple[str, str | None]]:
        """Ask for signs of life; yield a machine that is silent, or a machine and a child that hangs beside a host."""
        now_s = self._time.look(self._agenda.now_s)
        for name, watched in self._watched.items():
            if not watched.is_lost and watched.pulses:
                yield from self._check_machine(name, watched, now_s)

    def _check_machine(
        self, name: str, watched: _Watched, now_s: float
    ) -> Iterator[tuple[str, str | None]]:
        for child, pulse in watched.pulses.items():
            if pulse.is_due(now_s):
                self._agenda.do(Send(child, ping(pulse.ping(now_s))))
        for child, pulse in watched.supervisors:
            if self._are_ending or not pulse.is_lost(now_s):
                continue
            if HOST not in watched.pulses and HOST not in watched.cut:
                yield name, None
                return
            del watched.pulses[child]
            yield name, child
        is_heard = any(pulse.was_heard for _, pulse in watched.supervisors)
        is_heard = is_heard and not self._are_ending
        if not is_heard and not watched.is_asked and now_s - watched.asked_s >= PING_INTERVAL_S:
            watched.is_asked, watched.asked_s = True, now_s
            self._agenda.do(AskMachine(name))

    def asked(self, event: MachineAsked) -> tuple[str, ...]:
        """Note the end of a question; return the children to which there is no line any more by it."""
        watched = self._watched[event.machine]
        watched.is_asked = False
        return () if event.is_alive or watched.is_lost else tuple(watched.pulses)

    # Lines that broke -----------------------------------------------------------------------------

    def broke(self, event: LineBroke) -> None:
        """Ask for a new line, once; until there is one, no signs of life are expected."""
        child = self._children[event.name]
        watched = self._watched[child.machine or ""]
        if child.has_exited or child.name in watched.cut:
            return
        watched.pulses.pop(child.name, None)
        watched.cut.add(child.name)
        self._agenda.after(
            f"cut {child.name}", self._wait_s, partial(self._stayed_cut, child, event.why)
        )
        self._agenda.do(Reattach(child.name))

    def _stayed_cut(self, child: ChildRecord, why: str) -> None:
        """Give up a machine to one of whose children no line could be made anew in time."""
        machine = child.machine or ""
        why_not = self._watched[machine].why_not
        self._lost(machine, f"{why}, and none could be made anew: {why_not}" if why_not else why)

    def reattach_failed(self, event: ReattachFailed) -> None:
        """Let the next try follow after a moment."""
        child = self._children[event.name]
        self._watched[child.machine or ""].why_not = event.why
        if not child.has_exited:
            self._agenda.after(
                f"again {event.name}",
                REATTACH_INTERVAL_S,
                partial(self._agenda.do, Reattach(event.name)),
            )

    def reattached(self, event: Reattached) -> None:
        """Watch the child again."""
        child = self._children[event.name]
        if child.has_exited:
            return
        self.forget_line(child)
        self.add(child.machine, child.name)
        self._watched[child.machine or ""].why_not = ""
        text = f"the connection to {child.machine} broke; {child.name} goes on over another one"
        self._agenda.say(text, "warning")

    def forget_line(self, child: ChildRecord) -> None:
        """Expect no line to a child any more."""
        self._agenda.cancel(f"cut {child.name}", f"again {child.name}")

    # Lost machines --------------------------------------------------------------------------------

    def lose(self, machine: str) -> bool:
        """Take a machine for lost; False if it is already."""
        watched = self._watched[machine]
        if watched.is_lost:
            return False
        watched.lose()
        return True

    def reach(self, machine: str) -> None:
        """Reach for a lost machine: to give it its agents again, or at least to end what lives there."""
        watched = self._watched[machine]
        watched.tries += 1
        watched.is_tried, watched.is_waiting = True, False
        self._agenda.do(ReachMachine(machine))

    def reach_later(self, machine: str) -> None:
        """Let the next try follow after a while; say why the first one failed."""
        watched = self._watched[machine]
        if watched.tries == 1 and watched.why_not:
            text = f"{machine} is tried again every {RETURN_INTERVAL_S:g} s: {watched.why_not}"
            self._agenda.say(text, "warning")
        watched.is_waiting = True
        self._agenda.after(f"return {machine}", RETURN_INTERVAL_S, partial(self.reach, machine))

    def reached(self, event: MachineReached) -> bool:
        """Note the end of a try; True if another one may follow."""
        watched = self._watched[event.machine]
        watched.is_tried, watched.why_not = False, event.why
        return self._is_seeking and watched.tries < RETURN_TRIES_MAX

    def revive(self, machine: str) -> None:
        """Look for a machine whose supervisor ended before its time: it may be starting anew."""
        watched = self._watched.get(machine)
        # What is ended there before it gets its agents again must not be the host.
        if (
            watched is not None
            and not watched.is_lost
            and HOST not in {*watched.pulses, *watched.cut}
        ):
            watched.lose()
            self.reach_later(machine)

    @property
    def is_trying(self) -> bool:
        """Whether a lost machine is being reached for just now; that has an end soon."""
        return any(watched.is_tried for watched in self._watched.values())

    def stop_seeking(self) -> None:
        """Look for lost machines no more."""
        self._is_seeking = False
        for name, watched in self._watched.items():
            if watched.is_waiting:
                watched.is_waiting = False
                self._agenda.cancel(f"return {name}")
                self.give_up(name)

    def give_up(self, machine: str) -> None:
        """Say of a machine that nothing can be done there, once."""
        if machine not in self._unreachable:
            self._unreachable.add(machine)
            text = f"{machine} cannot be reached; its agents end by themselves within"
            why_not = self._watched[machine].why_not
            why = f" (the last try: {why_not})" if why_not else ""
            self._agenda.say(f"{text} {math.ceil(self._end_s)} s{why}", "warning")
