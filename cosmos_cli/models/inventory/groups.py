"""
The groups of an inventory: who is inside whom, and whose variables are stronger. Pure.

The order is Ansible's: `all` first, then by depth (the longest way down from `all`), then by
ansible_group_priority, then by name; what comes later wins.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

ALL = "all"
UNGROUPED = "ungrouped"
GROUPS_MAX = 2000


@dataclass(slots=True)
class InventoryGroup:
    """One group while the inventory is read."""

    name: str
    priority: int = 1
    variables: dict[str, Any] = field(default_factory=dict)
    """Of the inventory itself."""
    file_variables: dict[int, dict[str, Any]] = field(default_factory=dict)
    """Of group_vars by the number of their source; they win over those of every group in the inventory itself."""
    folders: dict[int | None, Path] = field(default_factory=dict)
    """Folder from which the files of its steps are found: for `variables` under None, `file_variables` under their source's number."""
    device_folders: dict[int | None, Path] = field(default_factory=dict)
    """Folder of the files of its devices, likewise."""
    children: dict[str, None] = field(default_factory=dict)
    parents: dict[str, None] = field(default_factory=dict)
    machines: dict[str, None] = field(default_factory=dict)
    """Machines directly under its `hosts`; a dictionary, because their order counts."""


class GroupTree:
    """All groups; `all` and `ungrouped` are always there."""

    def __init__(self) -> None:
        self.groups: dict[str, InventoryGroup] = {}
        self._depths: Mapping[str, int] = {}
        for name in (ALL, UNGROUPED):
            self.add(name)
        self.link(ALL, UNGROUPED)

    def add(self, name: str) -> InventoryGroup:
        """
        Return the group, made if it is new.

        Raises:
            ValueError: There are GROUPS_MAX groups already.
        """
        if name not in self.groups:
            if len(self.groups) >= GROUPS_MAX:
                raise ValueError(f"expected at most {GROUPS_MAX} groups")
            self.groups[name] = InventoryGroup(name)
        return self.groups[name]

    def link(self, parent: str, child: str) -> None:
        """
        Put one group into another; both are there.

        Raises:
            ValueError: The child holds the parent, or one of them is special.
        """
        if child == ALL:
            raise ValueError("all holds every group and is inside none")
        if parent == UNGROUPED or (child == UNGROUPED and parent != ALL):
            raise ValueError("ungrouped holds the machines of no other group, and no groups")
        if child in self.above([parent]):
            raise ValueError(f"group {child} is inside itself")
        self.groups[parent].children[child] = None
        self.groups[child].parents[parent] = None

    def above(self, names: Iterable[str]) -> set[str]:
        """Return these groups and every group that they are inside of."""
        found: set[str] = set()
        waiting = list(names)
        while waiting:
            name = waiting.pop()
            if name not in found:
                found.add(name)
                waiting += self.groups[name].parents
        return found

    def settle(self, machines: Iterable[str]) -> None:
        """Put groups that are inside none into `all`, machines that are in none into `ungrouped`; count depths."""
        for group in self.groups.values():
            if group.name != ALL and not group.parents:
                self.link(ALL, group.name)
        grouped = {
            machine
            for group in self.groups.values()
            if group.name not in (ALL, UNGROUPED)
            for machine in group.machines
        }
        named = self.groups[UNGROUPED].machines
        kept = [machine for machine in named if machine not in grouped]
        rest = [machine for machine in machines if machine not in grouped]
        self.groups[UNGROUPED].machines = dict.fromkeys([*kept, *rest])
        self._depths = self._count_depths()

    def _count_depths(self) -> Mapping[str, int]:
        depths: dict[str, int] = {}
        parents_left = {name: len(group.parents) for name, group in self.groups.items()}
        waiting = [ALL]
        # A group comes up when the last of its parents is counted: there is no circle.
        while waiting:
            group = self.groups[waiting.pop()]
            depths[group.name] = max((depths[name] + 1 for name in group.parents), default=0)
            for child in group.children:
                parents_left[child] -= 1
                if not parents_left[child]:
                    waiting.append(child)
        return depths

    def memberships(self) -> dict[str, list[InventoryGroup]]:
        """Return the groups of each machine, the weakest first."""
        direct: dict[str, list[str]] = {}
        for group in self.groups.values():
            for machine in group.machines:
                direct.setdefault(machine, []).append(group.name)
        found = {
            names: sorted(
                (self.groups[name] for name in self.above([*names, ALL])),
                key=lambda group: (self._depths[group.name], group.priority, group.name),
            )
            for names in {tuple(names) for names in direct.values()}
        }
        return {machine: found[tuple(names)] for machine, names in direct.items()}

    def machines_of(self, name: str) -> list[str]:
        """Return the machines of a group in Ansible's order: its own, then its children's, level by level."""
        found: dict[str, None] = {}
        seen, level = {name}, [name]
        while level:
            following: dict[str, None] = {}
            for group in level:
                found |= self.groups[group].machines
                following |= self.groups[group].children
            level = [child for child in following if child not in seen]
            seen.update(level)
        return list(found)
