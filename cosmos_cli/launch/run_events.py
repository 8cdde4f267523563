"""
Events of a run as its operator meets them: of children, machines, agents started by hand, and signals.

Plain values; what a child says comes inside `ChildSaid` (see `cosmos_cli.launch.events`).
"""

from __future__ import annotations

import signal
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from cosmos_cli.launch import events


@dataclass(frozen=True, slots=True)
class Begun:
    """The run is to begin."""


@dataclass(frozen=True, slots=True)
class ChildStarted:
    """A program was started; its process number on another machine comes later."""

    name: str
    machine: str | None
    pid: int | None = None


@dataclass(frozen=True, slots=True)
class StartFailed:
    """A program could not be started here."""

    name: str
    machine: str | None
    why: str


@dataclass(frozen=True, slots=True)
class ChildSaid:
    """A child, or an agent started by hand, said something."""

    name: str
    event: events.Event


@dataclass(frozen=True, slots=True)
class ChildExited:
    """A child's leader has ended, and all that it said was heard before."""

    name: str
    how: str
    code: int | None = None
    """Negative for a signal; None if nobody knows."""
    result: Mapping[str, Any] | None = None
    """Result that a host left beside its records."""


@dataclass(frozen=True, slots=True)
class ChildLost:
    """The line to a child broke, and its machine does not answer."""

    name: str
    why: str


@dataclass(frozen=True, slots=True)
class LineBroke:
    """The line to a child broke; it waits for another one."""

    name: str
    why: str


@dataclass(frozen=True, slots=True)
class Reattached:
    """There is a new line to a child."""

    name: str


@dataclass(frozen=True, slots=True)
class ReattachFailed:
    """No new line to a child could be made."""

    name: str
    why: str = ""


@dataclass(frozen=True, slots=True)
class GroupSeen:
    """The living members of a child's process group."""

    name: str
    pids: tuple[int, ...]
    age_s: float = 0.0
    """How long ago that was asked; what a machine has not answered yet is told as it was known last."""


@dataclass(frozen=True, slots=True)
class GroupKilled:
    """A child's process group was sent SIGKILL."""

    name: str
    why: str
    pids: tuple[int, ...]
    """Members of the group until then."""


@dataclass(frozen=True, slots=True)
class LastCallFound:
    """The plug-in's call in which a host has ended, or stands, in words or empty."""

    name: str
    how: str
    """As of `FindLastCall`."""
    where: str


@dataclass(frozen=True, slots=True)
class MachineAsked:
    """The end of a question for a sign of life."""

    machine: str
    is_alive: bool
    why: str = "it does not answer"


@dataclass(frozen=True, slots=True)
class MachineReached:
    """The end of a try to reach a lost machine; nothing of the run lives there if it succeeded."""

    machine: str
    is_reached: bool
    why: str = ""
    """Why it was not."""


@dataclass(frozen=True, slots=True)
class SignalUndelivered:
    """A signal could not be brought to a machine."""

    machine: str


@dataclass(frozen=True, slots=True)
class ManualAgentJoined:
    """An agent that was started by hand is connected."""

    agent: str


@dataclass(frozen=True, slots=True)
class ManualAgentLeft:
    """The connection of an agent that was started by hand has ended."""

    agent: str


@dataclass(frozen=True, slots=True)
class FaultOrdered:
    """Somebody wants a fault inserted around a device."""

    number: int
    """Number of the order: its answer carries it."""
    target: str
    action: str
    value: float | None


@dataclass(frozen=True, slots=True)
class Signalled:
    """The operator received a signal that asks for the end."""

    number: signal.Signals


RunEvent = (
    Begun
    | ChildStarted
    | StartFailed
    | ChildSaid
    | ChildExited
    | ChildLost
    | LineBroke
    | Reattached
    | ReattachFailed
    | GroupSeen
    | GroupKilled
    | LastCallFound
    | MachineAsked
    | MachineReached
    | SignalUndelivered
    | ManualAgentJoined
    | ManualAgentLeft
    | FaultOrdered
    | Signalled
)
