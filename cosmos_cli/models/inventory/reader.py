"""Walks the documents of an inventory and collects who is in which group, with what variables, and every fault."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeGuard

from cosmos_cli.errors import FAULTS_SHOWN_MAX, Fault, InputError
from cosmos_cli.models.document import Document, did_you_mean, kind_of
from cosmos_cli.models.document import Path as ValuePath
from cosmos_cli.models.inventory.devices import DEVICES
from cosmos_cli.models.inventory.groups import UNGROUPED, GroupTree, InventoryGroup
from cosmos_cli.models.inventory.machine import (
    GROUP_KEYS,
    PRIORITY,
    PROVISION,
    variable_faults,
)
from cosmos_cli.models.inventory.names import (
    GROUP_NAME,
    MACHINES_MAX,
    expand,
    listed_machine,
    split_port,
)


@dataclass(slots=True)
class MachineEntry:
    """Variables and groups of one machine while the inventory is read."""

    first: Fault
    """An empty fault at the place where it is named first."""
    variables: dict[str, Any] = field(default_factory=dict)
    """Of the inventory itself."""
    file_variables: dict[int, dict[str, Any]] = field(default_factory=dict)
    """Of host_vars by the number of their source, which win."""
    folders: dict[int | None, Path] = field(default_factory=dict)
    """Folders, as of a group."""
    device_folders: dict[int | None, Path] = field(default_factory=dict)
    """Folders, as of a group."""


@dataclass(slots=True)
class Reader:
    """Collects groups and machines from one document after the other."""

    folder: Path = Path()
    """Of the source that is being read, from which the files that its steps name are found."""
    source: int | None = None
    """Number of the source whose group_vars and host_vars are being read; None while inventories themselves are."""
    tree: GroupTree = field(default_factory=GroupTree)
    machines: dict[str, MachineEntry] = field(default_factory=dict)
    """In the order of the file."""
    faults: list[Fault] = field(default_factory=list)
    omitted: int = 0
    """Number of further faults of files that could not be read at all."""
    scalar_faults: list[Fault] = field(default_factory=list)
    """Of single scalars: other faults at their places follow from them."""

    @contextlib.contextmanager
    def gathering(self) -> Iterator[None]:
        """Keep the faults of a file that cannot be read at all, so that the others are read, too."""
        try:
            yield
        except InputError as error:
            self.faults += error.all_faults
            self.omitted += error.omitted

    def read(self, document: Document) -> None:
        """Take over the groups of a document."""
        self.scalar_faults += document.faults
        for name, value in document.value.items():
            if name == "plugin" and value:
                text = "inventory plug-ins are not run: write what it prints to a file in YAML"
                self.faults.append(document.fault((name,), text, at_key=True))
            else:
                self._group(document, name, value, (name,))

    def read_list(self, source: str) -> None:
        """Take over a list of machines, `pi01,pi02:2222,`; as in Ansible, one that is known already stays as it is."""
        for text in filter(None, map(str.strip, source.split(","))):
            first = Fault(text="", file=f"-i {source}")
            try:
                name, port = listed_machine(text)
                if name in self.machines:
                    _expect_port(self.machines[name], port)
                else:
                    self._enlist(UNGROUPED, first, ([name], port, {}))
            except ValueError as error:
                self.faults.append(dataclasses.replace(first, text=str(error)))

    def read_variables(self, document: Document, entity: InventoryGroup | MachineEntry) -> None:
        """Take over the variables of a file of group_vars or host_vars."""
        self.scalar_faults += document.faults
        self.faults += variable_faults(document, (), document.value, self.folder)
        self._keep(entity, document.value)

    def all_faults(self) -> list[Fault]:
        """Return every fault once, file by file in the order they were read, and from top to bottom."""
        told = {_place(fault) for fault in self.scalar_faults}
        faults = self.scalar_faults + [f for f in self.faults if _place(f) not in told]
        files: dict[str, int] = {}
        for fault in faults:
            files.setdefault(fault.file, len(files))
        return sorted(dict.fromkeys(faults), key=lambda f: (files[f.file], *_place(f)[1:]))

    def finish(self) -> None:
        """Look at what only the whole can tell, and settle the groups."""
        for name, entry in self.machines.items():
            if name in self.tree.groups:
                text = f"{name} is a group, too; give one of them another name"
                self.faults.append(dataclasses.replace(entry.first, text=text))
        self.tree.settle(self.machines)

    def _group(
        self, document: Document, name: str, value: Any, path: ValuePath, parent: str | None = None
    ) -> None:
        if not GROUP_NAME.fullmatch(name):
            text = f"expected letters, digits, '_', '-' or '.' in a group's name, got {name!r}"
            self.faults.append(document.fault(path, text, at_key=True))
            return
        if not (value is None or self._is_mapping(value, document, path)):
            return
        try:
            self.tree.add(name)
        except ValueError as error:
            raise InputError(faults=[document.fault(path, str(error), at_key=True)]) from None
        if parent is not None:
            try:
                self.tree.link(parent, name)
            except ValueError as error:
                self.faults.append(document.fault(path, str(error), at_key=True))
        for key, content in (value or {}).items():
            if key == "vars":
                self._variables(document, name, content, (*path, key))
            elif key == "children":
                self._children(document, name, content, (*path, key))
            elif key == "hosts":
                self._hosts(document, name, content, (*path, key))
            else:
                is_shown = len(self.faults) < 2 * FAULTS_SHOWN_MAX
                hint = did_you_mean(key, GROUP_KEYS) if is_shown else ""
                self.faults.append(document.fault((*path, key), f"unknown key{hint}", at_key=True))

    def _variables(self, document: Document, group: str, value: Any, path: ValuePath) -> None:
        if not self._is_mapping(value, document, path):
            return
        variables = dict(value)
        if PRIORITY in variables:
            priority = variables.pop(PRIORITY)
            if type(priority) is int:
                self.tree.groups[group].priority = priority
            else:
                text = f"expected a whole number, got {kind_of(priority)}"
                self.faults.append(document.fault((*path, PRIORITY), text))
        self.faults += variable_faults(document, path, variables, self.folder)
        self._keep(self.tree.groups[group], variables)

    def _children(self, document: Document, group: str, value: Any, path: ValuePath) -> None:
        children = {value: None} if isinstance(value, str) else value
        if not self._is_mapping(children, document, path):
            return
        for child, content in children.items():
            self._group(document, child, content, (*path, child), parent=group)

    def _hosts(self, document: Document, group: str, value: Any, path: ValuePath) -> None:
        hosts = {value: None} if isinstance(value, str) else value
        if not self._is_mapping(hosts, document, path):
            return
        for pattern, content in hosts.items():
            inner = (*path, pattern)
            variables: dict[str, Any] = {}
            if self._is_mapping(content, document, inner):
                variables |= content
                self.faults += variable_faults(document, inner, variables, self.folder)
            try:
                names, port = split_port(pattern)
                first = document.fault(inner, "", at_key=True)
                self._enlist(group, first, (expand(names), port, variables))
            except ValueError as error:
                self.faults.append(document.fault(inner, str(error), at_key=True))

    def _enlist(
        self, group: str, first: Fault, said: tuple[list[str], int | None, Mapping[str, Any]]
    ) -> None:
        """Put machines into a group; a port counts where a machine is named first, and nowhere else."""
        names, port, variables = said
        for name in names:
            is_new = name not in self.machines
            if is_new and len(self.machines) >= MACHINES_MAX:
                text = f"expected at most {MACHINES_MAX} machines"
                raise InputError(faults=[dataclasses.replace(first, text=text)])
            entry = self.machines.setdefault(name, MachineEntry(first))
            if port is not None and is_new:
                entry.variables["ansible_port"] = port
            else:
                _expect_port(entry, port)
            self._keep(entry, variables)
            self.tree.groups[group].machines[name] = None

    def _keep(self, entity: InventoryGroup | MachineEntry, variables: Mapping[str, Any]) -> None:
        """Add variables to those of a group or a machine, and remember where the files of its steps are."""
        kept = entity.variables
        if self.source is not None:
            kept = entity.file_variables.setdefault(self.source, {})
        kept.update(variables)
        if PROVISION in variables:
            entity.folders[self.source] = self.folder
        if DEVICES in variables:
            entity.device_folders[self.source] = self.folder

    def _is_mapping(
        self, value: Any, document: Document, path: ValuePath
    ) -> TypeGuard[dict[str, Any]]:
        if value is not None and not isinstance(value, dict):
            text = f"expected a mapping, got {kind_of(value)}"
            if isinstance(value, list):
                text += ": write `name:` instead of `- name`"
            self.faults.append(document.fault(path, text))
        return isinstance(value, dict)


def _expect_port(entry: MachineEntry, port: int | None) -> None:
    """
    Refuse a port at a machine that was named before.

    Raises:
        ValueError: It is another than what is known.
    """
    if port is not None and entry.variables.get("ansible_port") != port:
        first = (
            entry.first.file
            if entry.first.line is None
            else f"{entry.first.file}:{entry.first.line}"
        )
        raise ValueError(f"Ansible ignores the port here: write it in {first}, which is first")


def _place(fault: Fault) -> tuple[str, int, int]:
    return fault.file, fault.line or 0, fault.column or 0
