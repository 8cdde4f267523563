"""From an inventory on disk to its machines."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cosmos_cli.errors import Fault, InputError
from cosmos_cli.models.inventory.groups import Group
from cosmos_cli.models.inventory.machine import Machine
from cosmos_cli.models.inventory.reader import Entry, Reader
from cosmos_cli.models.inventory.sources import read_inventory_document, read_variables_document
from cosmos_cli.models.inventory.variable_files import inventory_files, variable_files
from cosmos_cli.models.inventory.variables import without_secrets
from cosmos_cli.models.limit import select_machines
from cosmos_cli.models.provision_steps import ProvisionStep

LOCAL_CONNECTIONS = ("local", "ansible.builtin.local")


@dataclass(frozen=True, slots=True, kw_only=True)
class Inventory:
    """All machines of an inventory, and the names of all its groups."""

    machines: tuple[Machine, ...]
    """In the order of the file."""
    groups: tuple[str, ...]
    """Also those without machines."""

    def select(self, pattern: str | None) -> tuple[Machine, ...]:
        """
        Return the machines that a --limit pattern means, in the order of the file; all for None.

        Raises:
            InputError: It names what there is not, or means no machine.
        """
        if pattern is None:
            return self.machines
        return select_machines(self.machines, pattern, groups=self.groups)


def load_machines(path: Path, limit: str | None = None) -> tuple[Machine, ...]:
    """
    Read an inventory and return the machines that --limit leaves of it.

    Raises:
        InputError: With every fault found; or the pattern names what there is not, or means no machine.
    """
    return read_inventory(path).select(limit)


def read_inventory(path: Path) -> Inventory:
    """
    Read an inventory: a file, or a folder of files, with the group_vars and host_vars beside it.

    Raises:
        InputError: With every fault found, in the order of the file.
    """
    folder = path if path.is_dir() else path.parent
    reader = Reader(folder)
    for file in inventory_files(path):
        with reader.gathering():
            reader.read(read_inventory_document(file))
    if not reader.machines and not reader.all_faults():
        text = "expected at least one machine under hosts"
        reader.faults.append(Fault(text=text, file=str(path), line=1, column=1))
    reader.finish()
    _read_variable_files(reader, folder)
    faults = reader.all_faults()
    if faults:
        raise InputError(faults=without_secrets(faults))
    return Inventory(machines=tuple(_machines(reader)), groups=tuple(reader.tree.groups))


def _read_variable_files(reader: Reader, folder: Path) -> None:
    targets: tuple[tuple[str, Mapping[str, Group] | Mapping[str, Entry]], ...] = (
        ("group_vars", reader.tree.groups),
        ("host_vars", reader.machines),
    )
    for name, entities in targets:
        files, faults = variable_files(folder / name, entities)
        reader.faults += faults
        for entity, paths in files.items():
            for path in paths:
                with reader.gathering():
                    document = read_variables_document(path)
                    if document is not None:
                        reader.read_variables(document, entities[entity].file_variables)


@dataclass(frozen=True, slots=True)
class _Wants:
    """What one group or machine asks for itself, beside what others ask for."""

    packages: tuple[str, ...]
    requirements: tuple[str, ...]
    provision: tuple[ProvisionStep, ...]

    @classmethod
    def of(cls, entity: Group | Entry, folder: Path) -> _Wants:
        values = entity.variables | entity.file_variables
        steps = [
            ProvisionStep.model_validate_json(json.dumps(step), strict=True)
            for step in values.get("cosmos_provision") or ()
        ]
        return cls(
            tuple(values.get("cosmos_packages") or ()),
            tuple(values.get("cosmos_requirements") or ()),
            tuple(step.with_source_in(folder) for step in steps),
        )


def _machines(reader: Reader) -> Iterator[Machine]:
    groups = reader.tree.groups
    memberships = reader.tree.memberships()
    positions: dict[str, dict[str, int]] = {name: {} for name in reader.machines}
    for group in groups:
        for index, machine in enumerate(reader.tree.machines_of(group)):
            positions[machine][group] = index
    wants = {name: _Wants.of(group, reader.folder) for name, group in groups.items()}
    for name, entry in reader.machines.items():
        own = [wants[group.name] for group in memberships[name]]
        own.append(_Wants.of(entry, reader.folder))
        variables: dict[str, Any] = {}
        for layer in _layers(entry, memberships[name]):
            variables |= layer
        is_local = variables.get("ansible_connection") in LOCAL_CONNECTIONS
        yield Machine(
            name=name,
            address=variables.get("ansible_ssh_host") or variables.get("ansible_host") or name,
            connection="local" if is_local else "ssh",
            groups=tuple(group.name for group in memberships[name]),
            variables=variables,
            packages=_union(want.packages for want in own),
            requirements=_union(want.requirements for want in own),
            provision=tuple(step for want in own for step in want.provision),
            positions=positions[name],
        )


def _union(lists: Iterable[tuple[str, ...]]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(item for items in lists for item in items))


def _layers(entry: Entry, groups: list[Group]) -> Iterator[Mapping[str, Any]]:
    """Yield variables in Ansible's order: files of variables win over every group in the inventory itself."""
    yield from (group.variables for group in groups)
    yield from (group.file_variables for group in groups)
    yield entry.variables
    yield entry.file_variables
