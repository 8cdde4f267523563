"""
Signs of life of a run's machines, and the way back of one that was lost.

Each supervisor on another machine answers pings from its loop. Where none has answered yet, or only the
host lives, whose loop may wait for a plug-in, the connection itself is asked.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Protocol

from cosmos_cli.fleet.failure import MachineFailure
from cosmos_cli.launch.children import Child
from cosmos_cli.launch.loop import Loop
from cosmos_cli.launch.machines import RemoteMachine
from cosmos_cli.launch.pulse import PING_INTERVAL_S, SILENCE_S, SLOW_S, Pulse

CHECK_INTERVAL_S = 0.25
RETURN_INTERVAL_S = 2.0
"""Between two tries to reach a lost machine again."""
RETURN_TRIES_MAX = 2000
"""More than an hour of them; a longer run has its machine back, or it has none."""
CLEAN_S = 3.0
FORCED_S = 3.0
"""For what a lost machine's earlier life has left there."""


class Owner(Protocol):
    """Who is told; all in the loop."""

    def machine_lost(self, machine: str, why: str) -> None:
        """A machine gives no sign of life any more."""

    def supervisor_silent(self, machine: str, child: Child) -> None:
        """A supervisor gives no sign of life, while its machine also runs the host, which does."""

    def machine_slow(self, machine: str, took_s: float) -> None:
        """A machine answered, but late."""

    def machine_back(self, machine: str) -> None:
        """A lost machine answers again, and nothing of its earlier life lives."""

    def machine_gone(self, machine: str) -> None:
        """A lost machine was looked for in vain, and is not looked for again."""

    def is_wanted(self, machine: str) -> bool:
        """Tell whether a lost machine that returns would be given its agents again."""


@dataclass(slots=True)
class _Watched:
    machine: RemoteMachine
    supervisors: dict[str, tuple[Child, Pulse]] = field(default_factory=dict)
    host: tuple[Child, Pulse] | None = None
    is_asked: bool = False
    """Whether its connection is being asked for a sign of life."""
    asked_s: float = float("-inf")
    is_lost: bool = False
    tries: int = 0
    is_tried: bool = False
    """Whether a try to reach it is under way."""
    is_waiting: bool = False
    """Whether the next try is due later."""

    @property
    def children(self) -> list[tuple[Child, Pulse]]:
        return [*self.supervisors.values(), *([self.host] if self.host else [])]

    def forget(self) -> None:
        self.supervisors.clear()
        self.host = None
        self.tries = 0


class MachineWatch:
    """
    Watches the machines of a run.

    Args:
        machines: Those on other computers.
        directories: The run's directory on each.
        loop: The operator's.
        owner: Who is told.
    """

    def __init__(
        self,
        machines: Mapping[str, RemoteMachine],
        directories: Mapping[str, str],
        loop: Loop,
        owner: Owner,
    ) -> None:
        self._watched = {name: _Watched(machine) for name, machine in machines.items()}
        self._directories = directories
        self._loop = loop
        self._owner = owner
        self._is_seeking = True
        self._are_ending = False
        if machines:
            self._check_later()

    def add(self, machine: str, child: Child, *, is_host: bool) -> None:
        """Watch a child that was started on another machine; those here need none."""
        watched = self._watched.get(machine)
        if watched is None:
            return
        watched.is_lost = False
        if is_host:
            watched.host = (child, Pulse())
        else:
            watched.supervisors[child.name] = (child, Pulse())

    def remove(self, machine: str, child: Child) -> None:
        """Watch a child no more: it has ended."""
        watched = self._watched.get(machine)
        if watched is not None:
            watched.supervisors.pop(child.name, None)
            if watched.host is not None and watched.host[0] is child:
                watched.host = None

    def pong(self, machine: str, name: str, number: int) -> None:
        """Note an answer."""
        watched = self._watched.get(machine)
        if watched is None:
            return
        if name in watched.supervisors:
            took_s = watched.supervisors[name][1].pong(number, time.monotonic())
            if took_s >= SLOW_S:
                self._owner.machine_slow(machine, took_s)
        elif watched.host is not None:
            watched.host[1].pong(number, time.monotonic())

    def lose(self, machine: str, why: str) -> None:
        """Take a machine for lost, and look for it; once each time it is."""
        watched = self._watched[machine]
        if watched.is_lost:
            return
        watched.is_lost = True
        watched.forget()
        self._owner.machine_lost(machine, why)
        self._try(machine)

    def revive(self, machine: str) -> None:
        """Look for a machine whose supervisor ended before its time: it may be starting anew."""
        watched = self._watched.get(machine)
        # What is ended there before it gets its agents again must not be the host.
        if watched is not None and not watched.is_lost and watched.host is None:
            watched.is_lost = True
            watched.forget()
            self._try_later(machine)

    @property
    def is_trying(self) -> bool:
        """Whether a lost machine is being reached for just now; that has an end soon."""
        return any(watched.is_tried for watched in self._watched.values())

    def stop_seeking(self) -> None:
        """Look for lost machines no more: the run ends."""
        self._is_seeking = False
        for name, watched in self._watched.items():
            if watched.is_waiting:
                watched.is_waiting = False
                self._loop.deadlines.cancel(f"return {name}")
                self._owner.machine_gone(name)

    def expect_ends(self) -> None:
        """Ask the connections from now on: a supervisor that closes its records leaves its loop before it ends."""
        self._are_ending = True

    # Signs of life --------------------------------------------------------------------------------

    def _check_later(self) -> None:
        at_s = time.monotonic() + CHECK_INTERVAL_S
        self._loop.deadlines.set("pulse", at_s, self._check)

    def _check(self) -> None:
        now_s = time.monotonic()
        for name, watched in self._watched.items():
            if not watched.is_lost and watched.children:
                self._check_machine(name, watched, now_s)
        self._check_later()

    def _check_machine(self, name: str, watched: _Watched, now_s: float) -> None:
        for child, pulse in watched.children:
            if pulse.is_due(now_s):
                child.send({"command": "ping", "n": pulse.ping(now_s)})
        for child, pulse in tuple(watched.supervisors.values()):
            if self._are_ending or not pulse.is_lost(now_s):
                continue
            if watched.host is None:
                self.lose(name, f"no sign of life for {SILENCE_S:g} s")
                return
            del watched.supervisors[child.name]
            self._owner.supervisor_silent(name, child)
        is_heard = any(pulse.was_heard for _, pulse in watched.supervisors.values())
        is_heard = is_heard and not self._are_ending
        if not is_heard and not watched.is_asked and now_s - watched.asked_s >= PING_INTERVAL_S:
            watched.is_asked, watched.asked_s = True, now_s
            self._loop.background.submit(watched.machine.is_alive, partial(self._answered, name))

    def _answered(self, name: str, is_alive: bool | None, failure: MachineFailure | None) -> None:
        watched = self._watched[name]
        watched.is_asked = False
        if not is_alive and not watched.is_lost and watched.children:
            self.lose(name, failure.text if failure else "it does not answer")

    # The way back ---------------------------------------------------------------------------------

    def _try_later(self, name: str) -> None:
        self._watched[name].is_waiting = True
        at_s = time.monotonic() + RETURN_INTERVAL_S
        self._loop.deadlines.set(f"return {name}", at_s, partial(self._try, name))

    def _try(self, name: str) -> None:
        """Reach for a lost machine: to give it its agents again, or at least to end what lives there."""
        watched = self._watched[name]
        watched.tries += 1
        watched.is_tried, watched.is_waiting = True, False
        attempt = partial(
            watched.machine.return_to,
            self._directories[name],
            clean_s=CLEAN_S,
            forced_s=FORCED_S,
        )
        self._loop.background.submit(attempt, partial(self._tried, name))

    def _tried(self, name: str, value: None, failure: MachineFailure | None) -> None:
        watched = self._watched[name]
        watched.is_tried = False
        is_hopeless = watched.tries >= RETURN_TRIES_MAX
        if failure is None:
            self._owner.machine_back(name)
        elif not self._is_seeking or is_hopeless or not self._owner.is_wanted(name):
            self._owner.machine_gone(name)
        else:
            self._try_later(name)
