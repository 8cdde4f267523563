"""From an inventory on disk to its machines."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cosmos_cli.errors import FAULTS_SHOWN_MAX, Fault, InputError
from cosmos_cli.models.inventory.groups import InventoryGroup
from cosmos_cli.models.inventory.machine import (
    PROVISION,
    UNITED_NAMES,
    Machine,
    Variables,
    without_secret,
)
from cosmos_cli.models.inventory.reader import MachineEntry, Reader
from cosmos_cli.models.inventory.sources import (
    inventory_files,
    read_inventory_document,
    read_variables_document,
    variable_files,
)
from cosmos_cli.models.inventory_arguments import (
    SOURCES_MAX,
    Given,
    folder_of,
    is_machine_list,
    sources_of,
)
from cosmos_cli.models.limit import select_machines


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


def load_machines(given: Given, limit: str | None = None) -> tuple[Machine, ...]:
    """
    Read an inventory and return the machines that --limit leaves of it.

    Raises:
        InputError: With every fault found; or the pattern names what there is not, or means no machine.
    """
    return read_inventory(given).select(limit)


def read_inventory(given: Given) -> Inventory:
    """
    Read an inventory: files, folders of files with the group_vars and host_vars beside each, lists of machines.

    Of several sources the groups and machines are united and the variables merged; what comes later wins.

    Raises:
        InputError: With every fault found, in the order of the sources.
    """
    sources = sources_of(given)
    reader = Reader()
    if not sources or len(sources) > SOURCES_MAX:
        raise InputError(f"-i: expected 1 to {SOURCES_MAX} inventories, got {len(sources)}")
    for source in sources:
        _read_source(reader, source)
    if not reader.machines and not reader.all_faults():
        is_one = len(sources) == 1
        text = "expected at least one machine under hosts" + ("" if is_one else " in any of these")
        place = 1 if is_one else None
        reader.faults.append(Fault(text=text, file=", ".join(sources), line=place, column=place))
    reader.finish()
    for number, source in enumerate(sources):
        if not is_machine_list(source):
            reader.source = number
            _read_variable_files(reader, folder_of(source))
    faults = reader.all_faults()
    if faults:
        first = [without_secret(fault) for fault in faults[:FAULTS_SHOWN_MAX]]
        omitted = len(faults) - len(first) + reader.omitted
        raise InputError(faults=first, omitted=omitted)
    return Inventory(machines=tuple(_machines(reader)), groups=tuple(reader.tree.groups))


def _read_source(reader: Reader, source: str) -> None:
    """Take over one source; its faults are gathered, so that those of the others are told, too."""
    with reader.gathering():
        if not source.strip():
            raise InputError(faults=[Fault(text="expected a file, a folder or a list", file="-i")])
        if is_machine_list(source):
            reader.read_list(source)
            return
        reader.folder = folder_of(source)
        for file in inventory_files(Path(source)):
            with reader.gathering():
                reader.read(read_inventory_document(file))


def _read_variable_files(reader: Reader, folder: Path) -> None:
    reader.folder = folder
    targets: tuple[tuple[str, Mapping[str, InventoryGroup] | Mapping[str, MachineEntry]], ...] = (
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
                        reader.read_variables(document, entities[entity])


def _said_by(entity: InventoryGroup | MachineEntry) -> Variables:
    """Return what one group or machine says of the lists that add up; steps find their files from its folder."""
    values = dict(entity.variables)
    for variables in entity.file_variables.values():
        values |= variables
    said = Variables.of({name: values[name] for name in UNITED_NAMES if name in values})
    if not said.cosmos_provision:
        return said
    giving = [source for source, each in entity.file_variables.items() if PROVISION in each]
    folder = entity.folders.get(giving[-1] if giving else None, Path())
    steps = tuple(step.with_source_in(folder) for step in said.cosmos_provision)
    return said.model_copy(update={PROVISION: steps})


def _machines(reader: Reader) -> Iterator[Machine]:
    groups = reader.tree.groups
    memberships = reader.tree.memberships()
    positions: dict[str, dict[str, int]] = {name: {} for name in reader.machines}
    for group in groups:
        for index, machine in enumerate(reader.tree.machines_of(group)):
            positions[machine][group] = index
    said = {name: _said_by(group) for name, group in groups.items()}
    names = frozenset((*groups, *reader.machines))
    for name, entry in reader.machines.items():
        layers = [*(said[group.name] for group in memberships[name]), _said_by(entry)]
        raw: dict[str, Any] = {}
        for layer in _layers(entry, memberships[name]):
            raw |= layer
        united = {key: _union(layers, key) for key in UNITED_NAMES}
        variables = Variables.of(raw).model_copy(update=united)
        yield Machine(
            devices_folder=_devices_folder(entry, memberships[name]),
            name=name,
            address=variables.address or name,
            connection=variables.connection,
            groups=tuple(group.name for group in memberships[name]),
            variables=variables,
            raw_variables=raw,
            positions=positions[name],
            inventory_names=names,
        )


def _union(layers: Iterable[Variables], name: str) -> tuple[Any, ...]:
    """Return the entries of a list that adds up; of a name that several give, the first."""
    entries = [entry for layer in layers for entry in getattr(layer, name) or ()]
    is_text = all(isinstance(entry, str) for entry in entries)
    return tuple(dict.fromkeys(entries) if is_text else entries)


def _devices_folder(entry: MachineEntry, groups: list[InventoryGroup]) -> Path:
    """Return the folder of the list of devices that wins."""
    found = [entity.device_folders.get(source) for entity, source in _places(entry, groups)]
    folder = next((folder for folder in reversed(found) if folder is not None), None)
    return Path() if folder is None else folder.absolute()  # a working folder may be gone


def _layers(entry: MachineEntry, groups: list[InventoryGroup]) -> Iterator[Mapping[str, Any]]:
    """Yield variables in Ansible's order."""
    for entity, source in _places(entry, groups):
        yield entity.variables if source is None else entity.file_variables[source]


def _places(
    entry: MachineEntry, groups: list[InventoryGroup]
) -> Iterator[tuple[InventoryGroup | MachineEntry, int | None]]:
    """
    Yield where variables stand, the weakest first, as in Ansible: an entity, and its source or None for the inventory.

    Files of variables win over every group in the inventory itself. Those of `all` are the weakest of all
    sources; of the other groups a later source's win over an earlier one's, however strong the group.
    """
    yield from ((group, None) for group in groups)
    whole, *others = groups  # `all` alone has no depth
    yield from ((whole, source) for source in whole.file_variables)
    for source in sorted({source for group in others for source in group.file_variables}):
        yield from ((group, source) for group in others if source in group.file_variables)
    yield entry, None
    yield from ((entry, source) for source in entry.file_variables)
