"""
The software that a rerun flies: the run's own copy, put into a fresh folder, or today's, held against what was flown.

A copy is flown only as what run.json says: each file by its name within the folder, its size and its hash. It is
written anew into a private folder among the user's caches: what flies leaves no traces in the evidence.
"""

from __future__ import annotations

import hashlib
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import metadata
from pathlib import Path
from typing import Final

from cosmos_cli.cache import cache_folder
from cosmos_cli.errors import InputError
from cosmos_cli.evidence.flown_files import FOLDER, FlownFile, FlownFiles, read_flown_files
from cosmos_cli.evidence.run_directory import RunDirectory, installed_versions
from cosmos_cli.launch.flown_copy import hashed_file, names_in
from cosmos_cli.ui.foreign_text import clean_line
from madns_runtime.bounded_files import read_regular_file
from madns_runtime.plain_values import first_few
from madns_runtime.plugin.registry import is_file, is_shipped

SHOWN_MAX: Final = 20
FILE_MODE, PROGRAM_MODE = 0o444, 0o555
OTHERWISE: Final = "name a copy of the scenario's folder as it was with --as-recorded-from DIR"


def flown_files_of(run: RunDirectory) -> FlownFiles | None:
    """
    Return what a run flew; None of one that was recorded before runs kept that.

    Raises:
        InputError: Its list was changed into what no run writes.
    """
    try:
        return read_flown_files(run.read_json(run.run_json) or {})
    except ValueError as error:
        raise InputError(f"{run.run_json}: {error}; {OTHERWISE}") from error


@contextmanager
def recorded_software(run: RunDirectory, today: Path | None) -> Iterator[Path]:
    """
    Give a folder with what a run flew; it is removed afterwards.

    Args:
        run: The run.
        today: The scenario's folder; files that were too large for the copy are taken from there if they are the same.

    Raises:
        InputError: The run keeps no copy, or it is not whole or not what was flown; the text says what to do.
    """
    flown = flown_files_of(run)
    if flown is None:
        raise InputError(
            f"{run.name} keeps no copy of what it flew: it was recorded before runs did; put the software back as it"
            f" was, say by git, and leave --as-recorded out, or {OTHERWISE}"
        )
    place = cache_folder() / FOLDER
    try:
        place.mkdir(mode=0o700, parents=True, exist_ok=True)
        private = tempfile.TemporaryDirectory(prefix=f"{run.name}-", dir=place)
    except OSError as error:
        raise InputError(
            f"{place}: cannot put the copy there: {error.strerror or error}"
        ) from error
    with private:
        folder = Path(private.name, FOLDER)
        _fill(run, flown, folder, today)
        yield folder


@contextmanager
def told_as_gap(run: RunDirectory, folder: Path) -> Iterator[None]:
    """
    Name what a run's copy lacks, where what is made of the copy has faults: a folder that is removed helps nobody.

    Args:
        run: The run.
        folder: What is flown; if that is no copy of a run, faults stay as they are.

    Raises:
        InputError: As within.
    """
    try:
        yield
    except InputError as error:
        is_copy = folder.is_relative_to((cache_folder() / FOLDER).resolve())
        flown = flown_files_of(run) if is_copy else None
        if flown is None or flown.is_whole or not flown.left_out:
            raise
        lacking = first_few([clean_line(each) for each in flown.left_out], SHOWN_MAX, "; ")
        faults = [f"{each.path}: {each.text}" for each in error.all_faults] or [str(error)]
        why = first_few(faults, SHOWN_MAX, "; ").replace(f"{folder}{os.sep}", "")
        raise InputError(
            f"{run.name}: its copy is not whole, and cannot be flown: {lacking} ({why}); {OTHERWISE}"
        ) from error


def _fill(run: RunDirectory, flown: FlownFiles, folder: Path, today: Path | None) -> None:
    """
    Put all files into a folder.

    Raises:
        InputError: One is not there, or not what was flown.
    """
    faults: list[str] = []
    try:
        folder.mkdir(mode=0o700)
        faults += filter(
            None, (_put(run, name, one, folder, today) for name, one in flown.files.items())
        )
    except OSError as error:
        raise InputError(
            f"{folder}: cannot put the copy there: {error.strerror or error}"
        ) from error
    if faults:
        told = first_few(faults, SHOWN_MAX, "; ")
        raise InputError(f"{run.name}: its copy cannot be flown: {told}; {OTHERWISE}")


def _put(run: RunDirectory, name: str, one: FlownFile, folder: Path, today: Path | None) -> str:
    """Put one file into the folder; return what is wrong with it."""
    top = (run.path / FOLDER) if one.is_copied else today
    if top is None or not os.path.isdir(top):
        return f"{clean_line(name)}: {top or 'the scenario folder'} is not there"
    source = top / name
    if one.is_copied and source.resolve() != run.path.resolve() / FOLDER / name:
        return f"{clean_line(name)}: a link that leads elsewhere"
    try:
        content = read_regular_file(source, bytes_max=one.size_bytes)
    except OSError as error:
        why = error.strerror or error
        return f"{clean_line(name)}: {why}" + ("" if one.is_copied else f" in {top}")
    if hashlib.sha256(content).hexdigest() != one.sha256:
        where = f"{FOLDER}/ is not" if one.is_copied else f"{clean_line(str(top))} is not"
        return f"{clean_line(name)}: what lies in {where} what was flown"
    target = folder / name
    try:
        target.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        with target.open("xb") as stream:
            stream.write(content)
        target.chmod(PROGRAM_MODE if one.is_program else FILE_MODE)
    except (FileExistsError, NotADirectoryError):
        return f"{clean_line(name)}: another file has its name, or that of its folder"
    return ""


def software_remarks(run: RunDirectory, folder: Path, which: str) -> tuple[str, ...]:
    """
    Say how the software of a folder, and what is installed, differ from what a run flew.

    Args:
        run: The run.
        folder: What flies now.
        which: How the software there is called.

    Raises:
        InputError: The run's list was changed into what no run writes.
    """
    found = list(version_remarks(run))
    flown = flown_files_of(run)
    if flown is None:
        return (
            *found,
            f"{run.name} kept no hashes of what it flew: whether {which} flight software is the same is not known",
        )
    differing, new = differing_files(flown, folder), new_files(flown, folder)
    if differing:
        found.append(f"{which} flight software differs: {first_few(differing, SHOWN_MAX)}")
    if new:
        found.append(
            f"{which} flight software has new files beside it: {first_few(new, SHOWN_MAX)}"
        )
    return tuple(found)


def differing_files(flown: FlownFiles, folder: Path) -> list[str]:
    """Return the flown files that a folder has not as they were flown, by name; gone ones are told so."""
    found = []
    for name, one in flown.files.items():
        try:
            now = hashed_file(folder / name, one.size_bytes)
        except FileNotFoundError:
            found.append(f"{clean_line(name)} (gone)")
            continue
        except OSError:  # longer than it was, or no file any more
            now = None
        if now is None or (now.sha256, now.is_program) != (one.sha256, one.is_program):
            found.append(clean_line(name))
    return found


def new_files(flown: FlownFiles, folder: Path) -> list[str]:
    """Return the files of a folder that were not there, by name: software may read them, or they are none of its own."""
    if not flown.is_whole:
        return []
    return [clean_line(name) for name in names_in(folder) if name not in flown.files]


def version_remarks(run: RunDirectory) -> tuple[str, ...]:
    """Say what is installed in another version than when a run was flown: no copy holds that."""
    recorded = (run.read_json(run.run_json) or {}).get("versions")
    if not isinstance(recorded, dict):
        return ()
    now = {package: _version(package) for package in recorded} | installed_versions()
    return tuple(
        f"{clean_line(package)} is {now[package]}, was {clean_line(str(recorded[package]))}"
        for package in sorted(recorded)
        if now[package] not in (None, recorded[package])
    )


def _version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except (metadata.PackageNotFoundError, ValueError):  # as of the system, or no name at all
        return None


def installed_remarks(simulation: str) -> tuple[str, ...]:
    """Say of a simulation that is neither shipped nor a file of the scenario's folder that no copy of it is flown."""
    if is_shipped(simulation) or is_file(simulation):
        return ()
    return (
        f"the simulation {simulation} is a package that is installed here, and flown as it is today: no run keeps a copy",
    )
