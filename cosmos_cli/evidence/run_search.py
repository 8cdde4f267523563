"""
Finds a run by number, name or path, here or wherever this user started it.

What bears a run's name has to be one: in a folder that others share, anybody may lay something there.
"""

from __future__ import annotations

import os
import shlex
from pathlib import Path

from cosmos_cli.errors import InputError
from cosmos_cli.evidence.run_directory import (
    BUNDLE_SUFFIX,
    FOLDERS,
    RUN_NAME,
    RUNS_FOLDER,
    RunDirectory,
    list_runs,
)
from cosmos_cli.evidence.run_documents import newer_schema
from cosmos_cli.evidence.run_index import remembered_runs

DIGITS_MAX = 40
EXPECTED = f"expected plan.json, or the folders {', '.join(FOLDERS)}"


def find_run(root: Path, which: str, *, is_read: bool = True) -> RunDirectory:
    """
    Find a run by path, full name, number (with or without zeros) or "last".

    A run that is not in ./runs is looked for among all that were started by this user; a folder that
    was named by --runs or COSMOS_RUNS is meant alone.

    Args:
        root: Of all runs.
        which: The run.
        is_read: Whether its documents are read: those of a newer program are refused then.

    Raises:
        InputError: There is none, or several; the message lists what there is. Or a newer program wrote it.
    """
    run = _find(root, which)
    for path in (run.run_json, run.manifest_json) if is_read else ():
        if fault := newer_schema(run.read_json(path) or {}):
            raise InputError(f"{path}: {fault}")
    return run


def _find(root: Path, which: str) -> RunDirectory:
    if os.sep in which or which in (".", ".."):
        if which.endswith(BUNDLE_SUFFIX) and os.path.isfile(which):
            raise InputError(
                f"{which}: a packed run; unpack it with: tar -xf {shlex.quote(which)}, then name its folder"
            )
        if not os.path.isdir(which):
            raise InputError(f"{which}: no such run directory")
        if not _holds_run(Path(which)):
            raise InputError(f"{which}: no run directory: {EXPECTED}")
        return RunDirectory(Path(which).resolve())
    runs = [run for run in list_runs(root) if _holds_run(run.path) or _is_packed(run)]
    found = runs[-1:] if which == "last" else [run for run in runs if _is_named(run, which)]
    if len(found) == 1:
        _refuse_packed(found[0])
        return found[0]
    if found:
        raise InputError(
            f"{which}: {', '.join(run.name for run in found)} match; give the full name"
        )
    if root == Path(RUNS_FOLDER):
        elsewhere = find_elsewhere(which)
        paths = [str(run.path) for run in elsewhere]
        if _holds_run(Path(which)) and str(Path(which).resolve()) not in paths:
            paths.insert(0, os.path.join(".", which))  # as one that was unpacked
        if len(elsewhere) == len(paths) == 1:
            return elsewhere[0]
        if elsewhere:
            raise InputError(
                f"{which}: not in {root}, and several elsewhere; give the path: {', '.join(map(shlex.quote, paths))}"
            )
    _refuse_other(root, which)
    known = ", ".join(run.name for run in runs[-5:]) or "none yet"
    here = ""
    if _holds_run(Path(which)):  # as one that was unpacked
        here = f"; if the folder here is meant, name it {shlex.quote(os.path.join('.', which))}"
    raise InputError(f"{which}: no such run in {root}; the last ones are: {known}{here}")


def find_elsewhere(which: str) -> list[RunDirectory]:
    """Return the runs that this user started anywhere and that a full name or a number means."""
    return [
        run
        for run in map(RunDirectory, remembered_runs())
        if _is_meant(run, which) and not run.path.is_symlink() and _holds_run(run.path)
    ]


def _is_meant(run: RunDirectory, which: str) -> bool:
    is_number = which.isdecimal() and len(which) <= DIGITS_MAX
    return run.number == int(which) if is_number else run.name == which


def _holds_run(path: Path) -> bool:
    """Tell whether a folder is a run's; one that lost its plan or a folder is one still."""
    is_planned = os.path.isfile(path / "plan.json")
    return is_planned or all(os.path.isdir(path / folder) for folder in FOLDERS)


def _is_packed(run: RunDirectory) -> bool:
    """Tell whether only the package of a run is left."""
    return run.bundle.is_file() and not os.path.lexists(run.path)


def _is_named(run: RunDirectory, which: str) -> bool:
    """Tell whether a run is meant, a packed one by its package's name, too."""
    return _is_meant(run, which.removesuffix(BUNDLE_SUFFIX) if _is_packed(run) else which)


def _refuse_packed(run: RunDirectory) -> None:
    """
    See that a run has its folder still: another one of its number is not taken instead.

    Raises:
        InputError: Only its package is left; the message says how it is unpacked.
    """
    if _is_packed(run):
        bundle, root = shlex.quote(str(run.bundle)), shlex.quote(str(run.path.parent))
        raise InputError(
            f"{run.name}: packed, its folder is gone; unpack it with: tar -xf {bundle} -C {root}"
        )


def _refuse_other(root: Path, which: str) -> None:
    """
    See that nothing else bears the name that was given.

    Raises:
        InputError: A link does, or a folder that is no run's.
    """
    try:
        paths = sorted(path for path in root.iterdir() if RUN_NAME.match(path.name))
    except OSError:
        return
    for path in paths:
        if not os.path.isdir(path) or not _is_meant(RunDirectory(path), which):
            continue
        if path.is_symlink():
            raise InputError(
                f"{path}: a link, which is not followed; if that is meant, name the run by its path:"
                f" {path.resolve()}"
            )
        raise InputError(f"{path}: no run directory: {EXPECTED}")
