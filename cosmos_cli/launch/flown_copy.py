"""
A run's own copy of what it flies: the files of the scenario's folder, by the rules of the tree that machines are sent.

Made before anything is started, on this computer, whichever machines fly. What cannot be copied costs no run: it is
left out and named.
"""

from __future__ import annotations

import errno
import hashlib
import itertools
import os
import stat
from collections import deque
from collections.abc import Iterator
from pathlib import Path

from cosmos_cli.evidence.flown_files import (
    COPY_BYTES_MAX,
    FILE_BYTES_MAX,
    FILES_MAX,
    FOLDER,
    HASHED_BYTES_MAX,
    FlownFile,
    FlownFiles,
    fault_of_name,
)
from cosmos_cli.evidence.run_directory import RunDirectory
from cosmos_cli.provision.tree_rules import is_folder_of_tree, is_link_of_no_tree, is_name_of_tree
from cosmos_cli.ui.foreign_text import clean_line
from madns_runtime.bounded_files import open_regular_file, read_regular_file
from madns_runtime.recording.access import Access, file_mode, folder_mode

FOLDERS_MAX = 1_000
MEGABYTE = 1024 * 1024


def copy_flown(folder: Path, run: RunDirectory, access: Access) -> FlownFiles:
    """
    Copy the files of a scenario's folder into a run.

    Args:
        folder: Of the scenario.
        run: A fresh run directory.
        access: Who may read the copy.

    Returns:
        What was copied, for run.json, with what was left out and why.

    Raises:
        OSError: The run's directory cannot be written into.
    """
    top = run.path / FOLDER
    top.mkdir(mode=folder_mode(access))
    left_out: list[str] = []
    found = _found(folder, left_out)
    is_whole = not left_out
    files: dict[str, FlownFile] = {}
    left_bytes, hashed_bytes = COPY_BYTES_MAX, HASHED_BYTES_MAX
    for size, name, path in sorted(found):
        try:
            if size > min(FILE_BYTES_MAX, left_bytes):
                left_out.append(_too_large(name, size))
                if size <= hashed_bytes:
                    files[name] = hashed_file(path, hashed_bytes)
                    hashed_bytes -= files[name].size_bytes
                else:
                    is_whole = False
                continue
            content = read_regular_file(path, bytes_max=min(FILE_BYTES_MAX, left_bytes))
            is_program = bool(path.stat().st_mode & stat.S_IXUSR)
        except OSError as error:
            left_out.append(f"{clean_line(name)}: cannot be read: {error.strerror or error}")
            is_whole = False
            continue
        left_bytes -= len(content)
        _write(top / name, content, access)
        files[name] = FlownFile(
            size_bytes=len(content),
            sha256=hashlib.sha256(content).hexdigest(),
            is_program=is_program,
        )
    return FlownFiles(
        files=dict(sorted(files.items())), left_out=tuple(left_out), is_whole=is_whole
    )


def names_in(folder: Path) -> list[str]:
    """Return the names of the files in a folder that a copy of it would hold or leave out."""
    return [name for _, name, _ in _found(folder, [])]


def hashed_file(path: Path, bytes_max: int) -> FlownFile:
    """
    Return what is known of a file that is not copied.

    Raises:
        OSError: It cannot be read, or is longer than *bytes_max*.
    """
    digest, size = hashlib.sha256(), 0
    with os.fdopen(open_regular_file(path), "rb") as stream:
        is_program = bool(os.fstat(stream.fileno()).st_mode & stat.S_IXUSR)
        while piece := stream.read(MEGABYTE):
            size += len(piece)
            if size > bytes_max:
                raise OSError(errno.EFBIG, f"longer than {bytes_max} bytes", str(path))
            digest.update(piece)
    return FlownFile(
        size_bytes=size, sha256=digest.hexdigest(), is_program=is_program, is_copied=False
    )


def _found(folder: Path, left_out: list[str]) -> list[tuple[int, str, Path]]:
    """Return size, name and path of the files that belong to the copy; the uppermost, when there are too many."""
    found: list[tuple[int, str, Path]] = []
    for path in _walk(folder, left_out):
        name = path.relative_to(folder).as_posix()
        fault = fault_of_name(name)
        if fault:
            left_out.append(f"{clean_line(name)} was left out for its name: {fault}")
            continue
        if len(found) == FILES_MAX:
            left_out.append(
                f"{clean_line(str(folder))}: more than {FILES_MAX} files, of which the rest is not looked at;"
                " give the scenario and what it needs a folder of their own"
            )
            break
        try:
            found.append((path.stat().st_size, name, path))
        except OSError as error:
            left_out.append(f"{clean_line(name)}: cannot be read: {error.strerror or error}")
    return found


def _walk(folder: Path, left_out: list[str]) -> Iterator[Path]:
    """Yield the files of a tree, those of upper folders first; links only to what is within."""
    top = folder.resolve()
    waiting: deque[tuple[Path, tuple[Path, ...]]] = deque([(folder, ())])
    count = 0
    while waiting:
        here, above = waiting.popleft()
        if (real := here.resolve()) in above:  # a link to where it lies in
            continue
        count += 1
        if count > FOLDERS_MAX:
            left_out.append(f"{clean_line(str(folder))}: more than {FOLDERS_MAX} folders")
            return
        try:
            with os.scandir(here) as scanned:
                entries = sorted(itertools.islice(scanned, FILES_MAX + 1), key=lambda e: e.name)
        except OSError as error:
            left_out.append(f"{clean_line(str(here))}: cannot be read: {error.strerror or error}")
            continue
        if len(entries) > FILES_MAX:
            left_out.append(f"{clean_line(str(here))}: more than {FILES_MAX} entries in one folder")
        for entry in entries:
            path = here / entry.name
            try:
                kind = _kind(entry, path, top)
            except OSError as error:  # such as a link to itself
                kind = f"cannot be read: {error.strerror or error}"
            if kind == "file":
                yield path
            elif kind == "folder":
                waiting.append((path, (*above, real)))
            elif kind:
                left_out.append(f"{clean_line(str(path))}: {kind}")


def _kind(entry: os.DirEntry[str], path: Path, top: Path) -> str:
    """
    Return file or folder, empty for what belongs to no tree, or why it cannot be copied.

    Raises:
        OSError: It cannot be looked at.
    """
    if not is_name_of_tree(entry.name) or (entry.is_symlink() and is_link_of_no_tree(path)):
        return ""
    if entry.is_symlink() and not Path(os.path.realpath(path)).is_relative_to(top):
        return "a link that leads out of the folder"
    if entry.is_dir():
        return "folder" if is_folder_of_tree(path) else ""
    return "file" if entry.is_file() else "neither a file nor a folder"


def _too_large(name: str, size: int) -> str:
    return (
        f"{clean_line(name)} was too large and left out: {size / MEGABYTE:.1f} MB; a copy has at most"
        f" {FILE_BYTES_MAX // MEGABYTE} MB per file and {COPY_BYTES_MAX // MEGABYTE} MB in all"
    )


def _write(path: Path, content: bytes, access: Access) -> None:
    path.parent.mkdir(mode=folder_mode(access), parents=True, exist_ok=True)
    descriptor = os.open(
        path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, file_mode(access)
    )
    with os.fdopen(descriptor, "wb") as stream:
        stream.write(content)
