"""
The children of a run, and their end: SIGTERM, then SIGKILL to the whole process group, then proof that none of it lives.

A child has ended when its group is empty, not merely when its leader has: a dead leader may leave
agents and workers behind. Pure.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

from cosmos_cli.launch.actions import Agenda, CloseChild, Kill, LookAtGroup, Send, Terminate
from cosmos_cli.launch.run_events import ChildStarted, GroupKilled, GroupSeen, LastCallFound

HOST = "host"
TERM_GRACE_S = 3.0
"""Time from SIGTERM to SIGKILL."""
GROUP_GRACE_S = 5.0
"""Time for what a dead child has left in its group: agents and workers end by themselves within it."""
KILL_WAIT_S = 5.0
"""Time for the kernel to carry out a SIGKILL; a process that hangs in a device outlives it."""
GROUP_ANSWER_S = 30.0
"""Time beyond that for a busy machine to answer who of the group lives."""
GROUP_CHECK_S = 0.1


@dataclass(slots=True)
class ChildRecord:
    """One child as far as the supervision knows it."""

    name: str
    machine: str | None
    pid: int | None
    doing: str = ""
    """Use of the plug-in's code by the child before it can be heard again; empty once that is done."""
    has_exited: bool = False
    """Whether the end of the group's leader is known."""
    has_ended: bool = False
    """Whether none of its group lives, or nothing more can be done about it."""
    is_killed: bool = False
    group_until_s: float = math.inf

    def __str__(self) -> str:
        return self.name if self.pid is None else f"{self.name} (pid {self.pid})"

    @property
    def meanwhile(self) -> str:
        """` while ...` of a child that was last heard of when it loaded the plug-in; else nothing."""
        return f" while {self.doing}" if self.doing else ""


class Children:
    """
    All children, by name; a machine that returns gets another one beside the first.

    Args:
        agenda: The supervision's.
    """

    def __init__(self, agenda: Agenda) -> None:
        self._agenda = agenda
        self._children: dict[str, ChildRecord] = {}

    def __getitem__(self, name: str) -> ChildRecord:
        return self._children[name]

    def __iter__(self) -> Iterator[ChildRecord]:
        return iter(tuple(self._children.values()))

    def started(self, event: ChildStarted) -> None:
        """Take a child in that was started."""
        self._children[event.name] = ChildRecord(event.name, event.machine, event.pid)

    def find(self, name: str) -> ChildRecord | None:
        """Return a child; None for an agent that was started by hand."""
        return self._children.get(name)

    @property
    def host(self) -> ChildRecord | None:
        """The host, if it was started."""
        return self._children.get(HOST)

    @property
    def living(self) -> list[ChildRecord]:
        """The children of whose group something lives, and may still be ended."""
        return [child for child in self if not child.has_ended]

    @property
    def supervisors(self) -> list[ChildRecord]:
        """All but the host."""
        return [child for child in self if child.name != HOST]

    def tell_host(self, command: Mapping[str, Any]) -> None:
        """Send the host a command, if it is there to take it."""
        if self.host is not None and not self.host.has_exited:
            self._agenda.do(Send(HOST, command))

    # Their end ------------------------------------------------------------------------------------

    def expect_end(self, child: ChildRecord, wait_s: float, late: str) -> None:
        """End the child by force if it lives after *wait_s*; *late* says what it failed to do."""
        self._agenda.after(f"end {child.name}", wait_s, partial(self.end, child, late))

    def end(self, child: ChildRecord, late: str) -> None:
        """SIGTERM now, SIGKILL after a grace; *late* says what it failed to do. What a dead leader has left has its own."""
        if child.has_exited:
            return
        self._agenda.problem(f"{child} {late}: it is being ended", child.machine)
        self._agenda.do(Terminate(child.name))
        unheeded = partial(self.kill, child, f"did not heed SIGTERM for {TERM_GRACE_S:g} s")
        self._agenda.after(f"end {child.name}", TERM_GRACE_S, unheeded)

    def kill(self, child: ChildRecord, why: str) -> None:
        """SIGKILL to the whole group, now."""
        child.is_killed = True
        self._agenda.do(Kill(child.name, why))
        self._agenda.after(f"end {child.name}", KILL_WAIT_S, partial(self._give_up, child))

    def killed(self, event: GroupKilled) -> None:
        """Say whom a SIGKILL met."""
        if event.pids:
            child, pids = self[event.name], ", ".join(map(str, event.pids))
            self._agenda.problem(
                f"{child} {event.why}: killed with SIGKILL ({pids})", child.machine
            )

    def last_call_found(self, event: LastCallFound) -> None:
        """Say in which call of the plug-in a host has ended, or stands."""
        child = self[event.name]
        if event.how:
            how = event.how + (event.where or child.meanwhile)
            self._agenda.problem(f"{child} {how} before the run was over", child.machine)
        elif event.where:
            self._agenda.problem(f"{child} stands{event.where}", child.machine)

    def _give_up(self, child: ChildRecord) -> None:
        """Take a child for ended that even SIGKILL has not ended."""
        child.has_ended = True

    def leader_ended(self, child: ChildRecord) -> None:
        """Watch what a dead leader has left until it has ended too, or kill it."""
        child.has_exited = True
        child.group_until_s = self._agenda.now_s + GROUP_GRACE_S
        self._agenda.do(LookAtGroup(child.name))

    def group_seen(self, event: GroupSeen) -> None:
        """Take a child for ended of whose group none lives; kill what stays too long."""
        child = self[event.name]
        if not event.pids:
            child.has_ended = True
            self._agenda.cancel(f"end {child.name}")
            return
        if not child.is_killed and (known := self._stayed(child, event.age_s)) is not None:
            self.kill(
                child, f"left {len(event.pids)} running that should have ended with it{known}"
            )
        if not child.has_ended:
            self._agenda.after(
                f"group {child.name}",
                GROUP_CHECK_S,
                partial(self._agenda.do, LookAtGroup(child.name)),
            )

    def _stayed(self, child: ChildRecord, age_s: float) -> str | None:
        """Tell whether somebody has stayed too long, by an answer asked since then or by none in time; None if not."""
        over_s = self._agenda.now_s - child.group_until_s
        if over_s >= age_s:
            return ""
        return f", as known {age_s:.0f} s ago" if over_s >= GROUP_ANSWER_S else None

    def abandon(self, child: ChildRecord) -> None:
        """Take a child for ended: its machine is lost, and nothing can be done from here."""
        child.has_exited = child.has_ended = True
        self._agenda.cancel(f"end {child.name}", f"group {child.name}")
        self._agenda.do(CloseChild(child.name))
