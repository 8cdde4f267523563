"""The disk here: what is on it, what has reached it for good, and its failures in words."""

from __future__ import annotations

import contextlib
import errno
import hashlib
import os
import shutil
from collections.abc import Iterable, Iterator
from pathlib import Path

from cosmos_cli.fleet.failure import FailureKind, MachineFailure
from cosmos_cli.ui.sizes import size_words

READ_BYTES = 1_048_576
SPARE_BYTES = 16 * 1024 * 1024
"""Room that is left on the disk for the run's summary and tables."""


@contextlib.contextmanager
def local_disk(folder: Path) -> Iterator[None]:
    """
    Translate what the disk here refuses: it is not the machine's fault, but its data cannot come.

    Raises:
        MachineFailure: DISK_FULL, READ_ONLY or STEP; the text says that it is here.
    """
    try:
        yield
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            raise no_room(folder, error.strerror) from error
        kind = FailureKind.READ_ONLY if error.errno == errno.EROFS else FailureKind.STEP
        raise MachineFailure(
            kind, f"cannot write here: {error.filename or folder}: {error.strerror}"
        ) from error


def check_room(folder: Path, needed_bytes: int) -> None:
    """
    See that so much has room here.

    Raises:
        MachineFailure: DISK_FULL.
    """
    free_bytes = shutil.disk_usage(folder).free
    if needed_bytes > 0 and needed_bytes + SPARE_BYTES > free_bytes:
        needed, free = size_words(needed_bytes + SPARE_BYTES), size_words(free_bytes)
        raise no_room(folder, f"{needed} needed, {free} free")


def no_room(folder: Path, what: str | None) -> MachineFailure:
    """Return the failure of a full disk here."""
    return MachineFailure(
        FailureKind.DISK_FULL, f"no room on the disk here: {folder}: {what}", "make room here"
    )


def hash_of(path: Path, size_bytes: int) -> str | None:
    """Return the SHA-256 of a file of this size; None if there is none, or it is a link or has another size."""
    try:
        if path.is_symlink() or not path.is_file() or path.stat().st_size != size_bytes:
            return None
    except (FileNotFoundError, NotADirectoryError):
        return None
    with path.open("rb", buffering=0) as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def begins_with(path: Path, beginning: Path) -> bool:
    """Tell whether a file begins with the whole content of another."""
    with path.open("rb") as long, beginning.open("rb") as short:
        while expected := short.read(READ_BYTES):
            if long.read(len(expected)) != expected:
                return False
    return True


def write_whole(descriptor: int, data: bytes) -> None:
    """Write all of *data*: a disk that fills takes a part of it first."""
    view = memoryview(data)
    while view:
        view = view[os.write(descriptor, view) :]


def sync_files(paths: Iterable[Path]) -> None:
    """Return when the content of every file is on the disk for good."""
    descriptors = []
    try:
        for path in paths:
            descriptors.append(os.open(path, os.O_RDONLY | os.O_CLOEXEC))
            # Starts writing without waiting, so that one commit of the file system serves many files.
            if hasattr(os, "posix_fadvise"):
                os.posix_fadvise(descriptors[-1], 0, 0, os.POSIX_FADV_DONTNEED)
        for descriptor in descriptors:
            os.fsync(descriptor)
    finally:
        for descriptor in descriptors:
            os.close(descriptor)


def sync_folders(folders: Iterable[Path], top: Path) -> None:
    """Return when the names in these folders, and those of the folders up to *top*, are on the disk for good."""
    wanted = {top}
    for folder in folders:
        wanted.update(each for each in (folder, *folder.parents) if each.is_relative_to(top))
    for folder in sorted(wanted):
        descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
