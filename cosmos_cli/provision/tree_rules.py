"""
Rules of what in a scenario's folder belongs to a tree: its files, but for what is hidden, caches, environments and runs.

The same rules hold for what machines are sent, for a run's copy of what it flies and for where tests are looked for.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

from cosmos_cli.cache import cache_folder
from cosmos_cli.errors import InputError
from cosmos_cli.evidence.run_directory import BUNDLE_SUFFIX, RUN_NAME, runs_root
from madns_runtime.bounded_files import real_path
from madns_runtime.processes import state_directory

FOLDERS_MAX = 5_000
"""Folders that are looked into; a link to a folder counts as one, and links to folders with links multiply."""
CACHE_FOLDERS = ("__pycache__", "node_modules")
CACHE_SUFFIXES = (".pyc", ".egg-info")


def entries_in(folder: Path) -> list[os.DirEntry[str]]:
    """
    Return what lies in a folder, by name.

    Raises:
        InputError: It cannot be read.
    """
    try:
        return sorted(os.scandir(folder), key=lambda entry: entry.name)
    except OSError as error:
        raise InputError(f"{folder}: cannot be read: {error.strerror or error}") from error


def walk(top: Path) -> Iterator[tuple[Path, str]]:
    """
    Yield the files of a folder that belong to a tree, each with its path within *top*.

    Raises:
        InputError: Something cannot be read, there are more than FOLDERS_MAX folders, or a link leads outside.
    """
    waiting: list[tuple[Path, tuple[Path, ...]]] = [(top, ())]
    count = 0
    while waiting:
        folder, above = waiting.pop()
        above = (*above, folder.resolve())
        count += 1
        if count > FOLDERS_MAX:
            raise InputError(
                f"{top}: expected a scenario's folder of at most {FOLDERS_MAX} folders, found more; do links lead to"
                " folders with links? Give the scenario and what it needs a folder of their own"
            )
        for entry in entries_in(folder):
            path = folder / entry.name
            if not is_name_of_tree(entry.name):
                continue
            if not entry.name.isprintable():
                raise InputError(f"{str(path)!r}: expected a file name of printable characters")
            if entry.is_symlink():
                if is_link_of_no_tree(path):
                    continue
                _refuse_outside(path, top)
            try:
                kind = _kind(entry, path, above)
            except OSError as error:  # such as a link to itself
                raise InputError(f"{path}: cannot be read: {error.strerror}; remove it") from error
            if kind == "link":
                raise InputError(f"{path}: a link that leads nowhere; remove it")
            if kind == "folder":
                waiting.append((path, above))
            elif kind:
                yield path, path.relative_to(top).as_posix()


def _kind(entry: os.DirEntry[str], path: Path, above: tuple[Path, ...]) -> str:
    """Return what an entry is: a folder or file that belongs to the tree, a link to nothing, or empty for the rest."""
    if entry.is_dir():
        return "folder" if real_path(path) not in above and is_folder_of_tree(path) else ""
    if entry.is_file():
        return "file"
    return "link" if entry.is_symlink() else ""


def is_name_of_tree(name: str) -> bool:
    """Tell whether what has this name may belong to a tree: no hidden file, no cache, no package of a run."""
    is_bundle = name.endswith(BUNDLE_SUFFIX) and RUN_NAME.match(name) is not None
    return not (name.startswith(".") or name.endswith(CACHE_SUFFIXES) or is_bundle)


def is_folder_of_tree(path: Path) -> bool:
    """Tell whether a folder belongs to a tree: no cache, virtual environment or run, nor what COSMoS itself keeps there."""
    return not (
        _is_run(path)
        or path.name in CACHE_FOLDERS
        or os.path.exists(path / "pyvenv.cfg")
        or _is_own(path)
    )


def is_link_of_no_tree(link: Path) -> bool:
    """Tell whether a link leads to a folder that is left out, wherever that lies: by its own name or that folder's, or the runs'."""
    real = real_path(link)
    if not real.is_dir():
        return False
    is_folder = is_folder_of_tree(link) and is_folder_of_tree(real)
    return not is_folder or real == real_path(runs_root()) or _has_only_runs(real)


def _is_own(path: Path) -> bool:
    """Tell whether a folder is where this computer's state or cache is kept: it changes with every run."""
    register = state_directory()
    kept = (register, register.parent, cache_folder())
    return os.path.realpath(path) in map(os.path.realpath, kept)


def _is_run(path: Path) -> bool:
    """Tell whether a folder is a run's: by its name and part of what it holds, or renamed, as a copy is, by all of it."""
    is_planned = os.path.exists(path / "plan.json")  # of a folder that may not be entered: False
    has_records = os.path.isdir(path / "host") and os.path.isdir(path / "agents")
    is_named = RUN_NAME.match(path.name) is not None
    return (is_planned or has_records) if is_named else (is_planned and has_records)


def _has_only_runs(folder: Path) -> bool:
    """Tell whether nothing in a folder belongs to a tree but for runs and their packages."""
    try:
        with os.scandir(folder) as entries:
            return all(
                not is_name_of_tree(entry.name) or _is_run(folder / entry.name) for entry in entries
            )
    except OSError:
        return False


def _refuse_outside(path: Path, top: Path) -> None:
    real = real_path(path)
    if not real.is_relative_to(top.resolve()):
        raise InputError(
            f"{path}: a link that leads out of the scenario's folder, to {real}; machines are sent"
            f" {top} and no more, so copy into it what the scenario needs"
        )
