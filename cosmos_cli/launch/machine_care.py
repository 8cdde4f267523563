"""What is done about a machine of a run that is lost, and about one that returns."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from cosmos_cli.launch.children import Child
from cosmos_cli.launch.crew import Crew
from cosmos_cli.launch.loop import Loop
from cosmos_cli.launch.machines import RemoteMachine
from cosmos_cli.launch.outcome import LaunchRequest, Life
from cosmos_cli.launch.reaper import Reaper
from cosmos_cli.launch.roll import Roll
from cosmos_cli.launch.talk import Talk
from cosmos_cli.launch.watch import MachineWatch

LIFE_LINE_S = 30.0
"""A supervisor that hears no ping for this long ends by itself (`madns_runtime.reactor.lines`)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Decisions:
    """What only the operator decides or does."""

    is_open: Callable[[], bool]
    """Whether agents may still join the run."""
    agents_lost: Callable[[tuple[str, ...], str], None]
    """Tells the host who is gone and why."""
    host_lost: Callable[[], None]
    start_supervisor: Callable[[str, tuple[str, ...], Life], None]


@dataclass(frozen=True, slots=True)
class Company:
    """Whom it works with."""

    loop: Loop
    crew: Crew
    roll: Roll
    reaper: Reaper
    talk: Talk


class MachineCare:
    """
    Answers what `MachineWatch` finds.

    Args:
        request: The run.
        remote: The machines that are other computers.
        company: Its neighbours in the operator's loop.
        decisions: The operator's.
    """

    def __init__(
        self,
        request: LaunchRequest,
        remote: Mapping[str, RemoteMachine],
        company: Company,
        decisions: Decisions,
    ) -> None:
        self._request = request
        self._crew = company.crew
        self._roll = company.roll
        self._reaper = company.reaper
        self._talk = company.talk
        self._decisions = decisions
        self._unreachable: set[str] = set()
        directories = {name: request.place_of(name).directory for name in remote}
        self.watch = MachineWatch(remote, directories, company.loop, self)

    def supervisor_ended(self, machine: str) -> None:
        """Look for a machine whose supervisor ended before its time: it may be starting anew."""
        if self.is_wanted(machine):
            self.watch.revive(machine)

    def machine_lost(self, machine: str, why: str) -> None:
        """Give up what runs there, and tell the host whose agents they were."""
        text = f"machine {machine} is lost: {why}"
        self._talk.problem(text, machine)
        is_host_lost = False
        for child in self._crew.on(machine):
            if not self._reaper.has_ended(child):
                is_host_lost = is_host_lost or child is self._crew.host
                self._crew.mark_exited(child)
                self._reaper.forget(child)
                child.close()
        if is_host_lost:
            self._decisions.host_lost()
        self._decisions.agents_lost(self._roll.left_on(machine), text)

    def supervisor_silent(self, machine: str, child: Child) -> None:
        """End a supervisor that hangs beside a host that does not."""
        self._reaper.kill(child, "gives no sign of life")

    def machine_slow(self, machine: str, took_s: float) -> None:
        """Say that a machine was nearly lost."""
        text = f"{machine} answered only after {took_s:.1f} s; is its link or its processor overloaded?"
        self._talk.say(text, "warning")

    def is_wanted(self, machine: str) -> bool:
        """Tell whether a lost machine that returns would be given its agents again."""
        return self._decisions.is_open() and bool(self._roll.restartable_on(machine))

    def machine_back(self, machine: str) -> None:
        """Give a returned machine its agents again, if the run still goes on."""
        agents = self._roll.restartable_on(machine)
        if not self.is_wanted(machine):
            self._talk.say(f"{machine} answers; nothing of the run lives there any more")
        else:
            text = f"{machine} has returned; its agents {', '.join(agents)} rejoin"
            self._talk.say(text, "warning")
            self._decisions.start_supervisor(machine, agents, self._roll.next_life_on(machine))

    def machine_gone(self, machine: str) -> None:
        """Say of a machine that nothing can be done there, once."""
        if machine not in self._unreachable:
            self._unreachable.add(machine)
            timeouts = self._request.config.timeouts
            limit_s = max(LIFE_LINE_S, timeouts.silence_s) + 2 * timeouts.shutdown_s
            text = f"{machine} cannot be reached; its agents end by themselves within"
            self._talk.say(f"{text} {math.ceil(limit_s)} s", "warning")
