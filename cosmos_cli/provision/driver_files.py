"""Drivers of devices that are files beside an inventory, as a tree that machines are sent."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from cosmos_cli.errors import InputError
from cosmos_cli.models.device_needs import MachineNeeds
from cosmos_cli.models.inventory import Machine
from cosmos_cli.provision.tree_rules import entries_in
from cosmos_cli.provision.trees import FILES_MAX, Tree, read_tree_file, tree_of

PACKAGE_MARK = "__init__.py"


@dataclass(frozen=True, slots=True, kw_only=True)
class DriverFiles:
    """Drivers of one machine, and from where in them their names are found."""

    tree: Tree
    inner: str
    """Path within the tree that stands for the folder of the inventory."""

    def directory(self, tree_folder: str) -> str:
        """Return the folder on a machine from which the drivers' names are found."""
        return os.path.normpath(os.path.join(tree_folder, self.inner))


def driver_files(
    machine: Machine,
    needs: MachineNeeds,
    sent: Sequence[Path],
) -> DriverFiles | None:
    """
    Return the files of a machine's own drivers; None if it has none, or all of them are sent already.

    Those are the named files, the Python files beside them, and packages there; nothing else of the folder of an
    inventory is sent, which may hold what is nobody's business.

    Args:
        machine: Which.
        needs: Of its devices.
        sent: Folders that it is sent as they are: the scenario's.

    Raises:
        InputError: A driver has an absolute path, or there are too many files.
    """
    folder = machine.devices_folder.resolve()
    if not needs.driver_files or any(folder.is_relative_to(each.resolve()) for each in sent):
        return None
    places = [kind.rpartition(":")[0] for kind in needs.driver_files]
    for place in places:
        if os.path.isabs(place):
            raise InputError(
                f"{machine.name}: {place}: expected a path from the inventory's folder, as in ./driver.py:NAME:"
                " machines are sent what is named so"
            )
    homes = list(dict.fromkeys(Path(os.path.normpath(folder / place)).parent for place in places))
    top = Path(os.path.commonpath([folder, *homes]))
    found = []
    for path in dict.fromkeys(path for home in homes for path in _python_files(home)):
        found.append(read_tree_file(path, path.relative_to(top).as_posix()))
        if len(found) > FILES_MAX:
            text = f"more than {FILES_MAX} Python files beside the drivers of {machine.name}"
            raise InputError(f"{top}: {text}: give the drivers a folder of their own")
    tree = tree_of(f"drivers {folder.name}", found)
    return DriverFiles(tree=tree, inner=folder.relative_to(top).as_posix())


def drivers_by_machine(
    machines: Sequence[Machine],
    needs: Callable[[str], MachineNeeds],
    sent: Sequence[Path] = (),
) -> dict[str, DriverFiles]:
    """Return the drivers of those machines that have any, by name; read once where machines have the same."""
    known: dict[tuple[Path, tuple[str, ...]], DriverFiles | None] = {}
    found = {}
    for machine in machines:
        key = (machine.devices_folder, needs(machine.name).driver_files)
        if key not in known:
            known[key] = driver_files(machine, needs(machine.name), sent)
        if (drivers := known[key]) is not None:
            found[machine.name] = drivers
    return found


def _python_files(folder: Path) -> Iterator[Path]:
    """Yield the Python files of a folder, and of the packages in it."""
    for entry in entries_in(folder):
        path = folder / entry.name
        if entry.name.startswith(".") or not entry.name.isprintable():
            continue
        if entry.is_dir(follow_symlinks=False):
            if os.path.isfile(path / PACKAGE_MARK):  # of a folder that may not be entered: False
                yield from _python_files(path)
        elif entry.name.endswith(".py") and os.path.isfile(path):  # a link to itself: False
            yield path
