"""
Files on their way into the run directory: in parts until they are whole, verified, and on the disk.

A part's name holds the hash of the whole file, so that a later call goes on only with the same content.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import shutil
import stat
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from cosmos_cli.collect.disk import (
    READ_BYTES,
    begins_with,
    check_room,
    hash_of,
    local_disk,
    sync_files,
    sync_folders,
    write_whole,
)
from cosmos_cli.collect.remote_manifest import INCOMING, OfferedFile
from cosmos_cli.collect.size_bound import SizedFile
from cosmos_cli.evidence.run_directory import RunDirectory
from cosmos_cli.fleet.failure import FailureKind, MachineFailure
from cosmos_cli.onboard.records import PIECE_BYTES

FILES_AT_ONCE_MAX = 200
"""Files that are brought to the disk and to their names together: their descriptors are open at once."""


@dataclass(slots=True)
class Transfer:
    """One file that is not here yet."""

    file: OfferedFile
    part: Path
    offset: int = 0
    """Bytes that are in the part."""
    resumed_bytes: int = 0
    """Bytes of those that an earlier attempt had brought."""
    digest: Any = field(default_factory=hashlib.sha256)

    @property
    def is_all_there(self) -> bool:
        """Whether every byte has come; they may be wrong."""
        return self.offset == self.file.size_bytes

    @property
    def is_whole(self) -> bool:
        """Whether every byte has come and is right."""
        return self.is_all_there and self.digest.hexdigest() == self.file.sha256


class PartialFiles:
    """
    Files that come from one machine into a run directory.

    Args:
        run: The run.
        machine: Its name.
    """

    def __init__(self, run: RunDirectory, machine: str) -> None:
        self._top = run.path
        self._folder = run.path / INCOMING / machine

    def open_transfer(self, file: OfferedFile) -> Transfer | None:
        """
        Return what is to be done for a file; None if it is here already, with that content.

        Raises:
            MachineFailure: The disk here fails.
        """
        with local_disk(self._top):
            if hash_of(self._top / file.path, file.size_bytes) == file.sha256:
                return None
            self._folder.mkdir(parents=True, exist_ok=True)
            name = hashlib.sha256(file.path.encode()).hexdigest()
            transfer = Transfer(file, self._folder / f"{name[:16]}-{file.sha256[:16]}.part")
            _take_up(transfer)
            return transfer

    def check_room(self, transfers: Sequence[Transfer]) -> None:
        """
        See that what is still to come has room here.

        Raises:
            MachineFailure: DISK_FULL.
        """
        check_room(self._top, sum(each.file.size_bytes - each.offset for each in transfers))

    def check_room_for(self, files: Sequence[SizedFile]) -> None:
        """
        See that what may have to come has room here, by sizes alone; what is here already needs none.

        Raises:
            MachineFailure: DISK_FULL.
        """
        with local_disk(self._top):
            missing = sum(
                max(0, file.size_bytes - _size_of(self._top / file.path)) for file in files
            )
            check_room(self._top, missing - sum(map(_size_of, self._folder.glob("*.part"))))

    def install(self, transfers: Sequence[Transfer]) -> list[str]:
        """
        Bring whole files to the disk and to their names; take away what came wrong.

        Returns:
            One line per file that cannot be put in its place, starting with its path.

        Raises:
            MachineFailure: The disk here fails.
        """
        faults: list[str] = []
        with local_disk(self._top):
            for each in transfers:
                if each.is_all_there and not each.is_whole:
                    each.part.unlink(missing_ok=True)
            whole = [each for each in transfers if each.is_whole]
            for start in range(0, len(whole), FILES_AT_ONCE_MAX):
                faults += self._install_some(whole[start : start + FILES_AT_ONCE_MAX])
        return faults

    def settle(self, files: Sequence[OfferedFile]) -> None:
        """
        Bring files to the disk for good that lay here before: who put them there may have been cut off.

        Raises:
            MachineFailure: The disk here fails.
        """
        with local_disk(self._top):
            paths = [self._top / file.path for file in files]
            for start in range(0, len(paths), FILES_AT_ONCE_MAX):
                sync_files(paths[start : start + FILES_AT_ONCE_MAX])
            sync_folders({path.parent for path in paths}, self._top)

    def tidy(self) -> None:
        """Take away parts that nobody will go on with."""
        shutil.rmtree(self._folder, ignore_errors=True)
        with contextlib.suppress(OSError):
            self._folder.parent.rmdir()

    def _install_some(self, whole: Sequence[Transfer]) -> list[str]:
        sync_files([each.part for each in whole])
        faults, folders = [], set()
        for each in whole:
            path = self._top / each.file.path
            if fault := self._put(each.part, path):
                faults.append(f"{each.file.path}: {fault}")
            else:
                folders.add(path.parent)
        sync_folders(folders, self._top)
        return faults

    def _put(self, part: Path, path: Path) -> str | None:
        between = [each for each in path.parents if each.is_relative_to(self._top)]
        if any(each.is_symlink() for each in between if each != self._top):
            return "a link here may lead out of the run directory"
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
        except (FileExistsError, NotADirectoryError):
            return "a file is where its folder should be"
        if path.is_symlink() or path.is_dir():
            return "a link or a folder is in its place"
        # One that has grown since it came the last time takes the place of its own beginning.
        if path.exists() and not begins_with(part, path):
            return "another file of that name is here; move it away to get this one"
        part.replace(path)
        return None


class PartWriter:
    """
    Writes pieces, one file at a time, into their parts. Use it as a context manager.

    Args:
        transfers: By the number that each piece names.
        folder: Where they lie, for messages.
    """

    def __init__(self, transfers: Sequence[Transfer], folder: Path) -> None:
        self._transfers = transfers
        self._folder = folder
        self._open: tuple[int, int] | None = None
        """Number of the file, and descriptor of its part."""

    def write(self, value: Mapping[str, Any], body: bytes) -> int:
        """
        Take one piece, and return how many bytes of its file it holds.

        Raises:
            MachineFailure: It is not what was asked for, or the disk here fails.
        """
        try:
            index, data = self._piece(value, body)
        except (LookupError, TypeError, ValueError, zlib.error):
            raise MachineFailure(
                FailureKind.DATA, f"expected a piece of a file, got {ascii(value)[:200]}"
            ) from None
        transfer = self._transfers[index]
        with local_disk(self._folder):
            write_whole(self._descriptor(index), data)
        transfer.digest.update(data)
        transfer.offset += len(data)
        return len(data)

    def __enter__(self) -> PartWriter:
        return self

    def __exit__(self, *_exception: object) -> None:
        self._close()

    def _piece(self, value: Mapping[str, Any], body: bytes) -> tuple[int, bytes]:
        index, offset, size = int(value["file"]), int(value["offset"]), int(value["bytes"])
        transfer = self._transfers[index]
        room = min(PIECE_BYTES, transfer.file.size_bytes - transfer.offset)
        if index < 0 or offset != transfer.offset or not 0 < size <= room:
            raise ValueError
        data = zlib.decompressobj().decompress(body, size) if value["packed"] else body
        if len(data) != size:
            raise ValueError
        return index, data

    def _descriptor(self, index: int) -> int:
        if self._open is None or self._open[0] != index:
            self._close()
            transfer = self._transfers[index]
            flags = os.O_WRONLY | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC
            descriptor = os.open(transfer.part, flags, 0o644)
            self._open = (index, descriptor)
            os.ftruncate(descriptor, transfer.offset)
            os.lseek(descriptor, transfer.offset, os.SEEK_SET)
        return self._open[1]

    def _close(self) -> None:
        if self._open is not None:
            os.close(self._open[1])
            self._open = None


def _size_of(path: Path) -> int:
    try:
        found = path.lstat()
    except (OSError, ValueError):
        return 0
    return found.st_size if stat.S_ISREG(found.st_mode) else 0


def _take_up(transfer: Transfer) -> None:
    """Go on where an earlier attempt ended; a part that cannot become the file is begun anew."""
    try:
        descriptor = os.open(
            transfer.part, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o644
        )
    except OSError:
        transfer.part.unlink()  # a link: not ours
        return
    with open(descriptor, "rb+", buffering=0) as part:
        if os.fstat(descriptor).st_size > transfer.file.size_bytes:
            part.truncate(0)
        while data := part.read(READ_BYTES):
            transfer.digest.update(data)
            transfer.offset += len(data)
        if transfer.is_all_there and not transfer.is_whole:
            part.truncate(0)
            transfer.digest, transfer.offset = hashlib.sha256(), 0
    transfer.resumed_bytes = transfer.offset
