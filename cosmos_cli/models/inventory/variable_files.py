"""Where Ansible finds variables beside an inventory: group_vars/NAME.yml, host_vars/NAME/*, and the like."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

from cosmos_cli.errors import Fault, InputError
from cosmos_cli.models.inventory.sources import EXTENSIONS

DEPTH_MAX = 16
FILES_MAX = 10_000
IGNORED_ENDINGS = (
    *(".pyc", ".pyo", ".swp", ".bak", "~", ".rpm", ".md", ".txt", ".rst"),
    *(".orig", ".cfg", ".retry"),
)
"""Files that Ansible passes over in a folder of inventories."""
SPECIAL_FOLDERS = ("group_vars", "host_vars", "vars_plugins")


def inventory_files(path: Path) -> list[Path]:
    """
    Return the files of groups: *path* itself, or all in it and below it, by name, if it is a folder.

    Raises:
        InputError: The folder holds none, or cannot be read.
    """
    if not path.is_dir():
        return [path]
    found: list[Path] = []
    _collect_inventories(path, found, 0)
    if not found:
        text = f"expected an inventory file in this folder, such as {path / 'tower.yaml'}"
        raise InputError(faults=[Fault(text=text, file=str(path))])
    return found


def _collect_inventories(folder: Path, found: list[Path], depth: int) -> None:
    for name in _names_in(folder, depth):
        if name.startswith(".") or name in SPECIAL_FOLDERS or name.endswith(IGNORED_ENDINGS):
            continue
        path = folder / name
        if path.is_dir():
            _collect_inventories(path, found, depth + 1)
        else:
            _add(found, path)


def variable_files(folder: Path, names: Iterable[str]) -> tuple[dict[str, list[Path]], list[Fault]]:
    """
    Return the files of variables of each name that has any, in the order they are read, and faults.

    Args:
        folder: group_vars or host_vars; need not be there.
        names: Of groups, or of machines.
    """
    if not folder.is_dir():
        return {}, []
    there = set(_names_in(folder, 0))
    found: dict[str, list[Path]] = {}
    faults: list[Fault] = []
    for name in names:
        given = [name + ending for ending in ("", *EXTENSIONS) if name + ending in there]
        if given:
            found[name] = _files_at(folder / given[0], 0)
        for other in given[1:]:
            text = f"Ansible reads only {given[0]!r}, which stands beside it: put both into one"
            faults.append(Fault(text=text, file=str(folder / other)))
    return found, faults


def _files_at(path: Path, depth: int) -> list[Path]:
    if not path.is_dir():
        return [path]
    found: list[Path] = []
    for name in _names_in(path, depth):
        inner, ending = path / name, os.path.splitext(name)[1]
        if name.startswith(".") or name.endswith("~"):
            continue
        if inner.is_dir():
            if not ending:
                found += _files_at(inner, depth + 1)
        elif not ending or ending in EXTENSIONS:
            _add(found, inner)
    return found


def _names_in(folder: Path, depth: int) -> list[str]:
    if depth > DEPTH_MAX:
        text = f"expected at most {DEPTH_MAX} folders inside each other"
        raise InputError(faults=[Fault(text=text, file=str(folder))])
    try:
        return sorted(os.listdir(folder))
    except OSError as error:
        text = f"cannot be read: {error.strerror}"
        raise InputError(faults=[Fault(text=text, file=str(folder))]) from error


def _add(found: list[Path], path: Path) -> None:
    if len(found) >= FILES_MAX:
        text = f"expected at most {FILES_MAX} files"
        raise InputError(faults=[Fault(text=text, file=str(path.parent))])
    found.append(path)
