"""The children of a run: who was started on which machine, and whose end has been seen."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from cosmos_cli.launch.children import Child
from cosmos_cli.launch.starter import HOST


class Crew:
    """All children, by name; a machine that returns gets another one beside the first."""

    def __init__(self) -> None:
        self._children: dict[str, Child] = {}
        self._machines: dict[str, str] = {}
        self._exited: set[str] = set()

    def place(self, name: str, machine: str) -> None:
        """Note where a child is about to be started."""
        self._machines[name] = machine

    def add(self, child: Child) -> None:
        """Take a child in that was started."""
        self._children[child.name] = child

    def everybody(self) -> list[Child]:
        """Return all, in the order of their start."""
        return list(self._children.values())

    @property
    def host(self) -> Child | None:
        """The host, if it was started."""
        return self._children.get(HOST)

    def machine_of(self, name: str) -> str | None:
        """Return where a child is; None for a host on this computer."""
        return self._machines.get(name)

    def on(self, machine: str) -> list[Child]:
        """Return the children of a machine."""
        return [child for child in self.everybody() if self._machines.get(child.name) == machine]

    def newly_exited(self) -> list[Child]:
        """Return those whose end nobody has marked yet."""
        return [c for c in self.everybody() if c.name not in self._exited and c.has_exited()]

    def mark_exited(self, child: Child) -> None:
        """Note that a child's end has been seen to."""
        self._exited.add(child.name)

    def are_supervisors_over(self) -> bool:
        """Tell whether no supervisor is left."""
        return self._machines.keys() - {HOST} <= self._exited

    def tell_host(self, command: Mapping[str, Any]) -> None:
        """Send the host a command, if it is there to take it."""
        if self.host is not None and HOST not in self._exited:
            self.host.send(command)

    def tell_supervisors(self, command: Mapping[str, Any]) -> None:
        """Send all supervisors a command."""
        for child in self.everybody():
            if child.name != HOST:
                child.send(command)

    def push(self) -> bool:
        """Hand over what could not be sent at once; True if some of it still waits."""
        waits = [child.push() for child in self.everybody()]
        return any(waits)
