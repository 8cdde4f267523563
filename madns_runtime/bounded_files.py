"""
Reads files that a user names: only regular ones, and never more of one than its reader can use.

A path may lead anywhere: to a FIFO that nobody writes to, to a device without an end, to a file that grows
while it is read. None of these is waited for or kept in memory.
"""

from __future__ import annotations

import contextlib
import errno
import os
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import Final

PIECE_BYTES: Final = 1024 * 1024
KINDS: Final = (
    (stat.S_ISDIR, errno.EISDIR, "a folder"),
    (stat.S_ISFIFO, errno.EINVAL, "a pipe: write what it carries to a file"),
    (stat.S_ISSOCK, errno.EINVAL, "a socket"),
    (stat.S_ISCHR, errno.EINVAL, "a device"),
    (stat.S_ISBLK, errno.EINVAL, "a block device"),
)


class FileRefused(OSError):
    """A file that is not read: `strerror` says what was expected and what is there, the text names the file as well."""

    def __str__(self) -> str:
        return f"{self.filename}: {self.strerror}"


class NotARegularFile(FileRefused):
    """The path leads to a folder, a pipe, a socket or a device."""


class FileTooLarge(FileRefused):
    """The file is longer than its reader can use."""


def real_path(path: str | os.PathLike[str]) -> Path:
    """Return where a path leads; unlike `Path.resolve` no error for a link to itself or a NUL in it, of which its reader tells."""
    try:
        return Path(os.path.realpath(path))
    except ValueError:
        return Path(path)


def read_regular_file(path: str | os.PathLike[str], *, bytes_max: int) -> bytes:
    """
    Return the content of a regular file.

    Args:
        path: Where it is; links are followed.
        bytes_max: The most that is read.

    Raises:
        NotARegularFile: It is a folder, a pipe, a socket or a device.
        FileTooLarge: It is longer than *bytes_max*.
        OSError: It is missing or cannot be read.
    """
    with _opened(path, bytes_max) as descriptor:
        pieces: list[bytes] = []
        # One byte more shows that the file has grown, or tells no true size as in /proc.
        left = bytes_max + 1
        while left and (piece := os.read(descriptor, min(left, PIECE_BYTES))):
            pieces.append(piece)
            left -= len(piece)
    if not left:
        raise _too_large(path, bytes_max, "more")
    return b"".join(pieces)


def check_regular_file(path: str | os.PathLike[str], *, bytes_max: int) -> None:
    """
    See that a file can be read as `read_regular_file` does, for a reader who opens it by its name.

    Raises:
        NotARegularFile: It is a folder, a pipe, a socket or a device.
        FileTooLarge: It is longer than *bytes_max*.
        OSError: It is missing or cannot be opened.
    """
    with _opened(path, bytes_max):
        pass


@contextlib.contextmanager
def _opened(path: str | os.PathLike[str], bytes_max: int) -> Iterator[int]:
    descriptor = open_regular_file(path)
    try:
        size = os.fstat(descriptor).st_size
        if size > bytes_max:
            raise _too_large(path, bytes_max, str(size))
        yield descriptor
    finally:
        os.close(descriptor)


def open_regular_file(path: str | os.PathLike[str]) -> int:
    """
    Open a regular file for reading, without waiting; the caller closes the descriptor.

    Raises:
        NotARegularFile: It is a folder, a pipe, a socket or a device.
        OSError: It is missing or cannot be opened.
    """
    if "\0" in os.fspath(path):
        raise FileRefused(errno.EINVAL, "expected a path without NUL characters", os.fspath(path))
    _expect_regular(path, os.stat(path).st_mode)  # to open a device can do something already
    flags = os.O_RDONLY | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC
    descriptor = os.open(path, flags)
    try:
        _expect_regular(path, os.fstat(descriptor).st_mode)  # another file may stand there by now
    except BaseException:
        os.close(descriptor)
        raise
    return descriptor


def _expect_regular(path: str | os.PathLike[str], mode: int) -> None:
    if stat.S_ISREG(mode):
        return
    number, kind = next(((n, kind) for is_it, n, kind in KINDS if is_it(mode)), (errno.EINVAL, ""))
    raise NotARegularFile(
        number, f"expected a file, got {kind or 'something else'}", os.fspath(path)
    )


def _too_large(path: str | os.PathLike[str], bytes_max: int, got: str) -> FileTooLarge:
    text = f"expected at most {bytes_max} bytes, got {got}"
    return FileTooLarge(errno.EFBIG, text, os.fspath(path))
