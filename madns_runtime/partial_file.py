"""
Files that get their name when they are whole: written anew beside it, never through a link or into another's file.

Whoever may write in a folder that is shared can lay a link under a name that is foreseen. So a partial
file is always created, exclusively, and a name that is taken is not used. Standard library only.
"""

from __future__ import annotations

import contextlib
import errno
import os
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

SUFFIX = ".part"
RANDOM_BYTES = 6
TRIES_MAX = 16
FLAGS = os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
MODE = 0o666
"""By the umask, as of any file."""
STREAM_WORD = Path("-")
"""Path that many programs take for stdout."""


def create_partial(path: Path, *, takes_over: bool) -> tuple[Path, int]:
    """
    Create a file beside *path* that nobody else has.

    Args:
        path: What it will be.
        takes_over: Whether what a killed writer left is removed first, because it may be large. For
            files of which there is one writer at a time.

    Returns:
        Its path and its descriptor.

    Raises:
        OSError: The folder takes no file.
    """
    plain = _plain_name(path)
    if takes_over:
        remove_partial(path)
        with contextlib.suppress(FileExistsError):
            return plain, os.open(plain, FLAGS, MODE)
    for _ in range(TRIES_MAX - 1):
        partial = _random_name(path)
        with contextlib.suppress(FileExistsError):
            return partial, os.open(partial, FLAGS, MODE)
    partial = _random_name(path)
    return partial, os.open(partial, FLAGS, MODE)


def remove_partial(path: Path) -> None:
    """Remove what a killed writer of *path* left; another user's, say, stays, and is not used."""
    with contextlib.suppress(OSError):
        _plain_name(path).unlink()


def refuse_stream_word(path: Path) -> None:
    """
    Refuse "-", which a person means as stdout: a file of that name would be hard to find, and to remove.

    Raises:
        OSError: It is that.
    """
    if path == STREAM_WORD:
        raise OSError(errno.EINVAL, "it is no file, and nothing goes to stdout; name a file", "-")


def check_replaceable(path: Path) -> None:
    """
    See that a file may take the place of what a person named: root's would take that of /dev/null, for everybody.

    Raises:
        OSError: There is a folder, a device, a pipe or a socket, or a link of the system to one, such as /dev/stdout;
            or it is "-".
    """
    refuse_stream_word(path)
    try:
        mode = path.stat().st_mode
    except OSError:  # nothing is there, or nothing can be written there either
        mode = stat.S_IFREG
    if stat.S_ISDIR(mode):
        raise IsADirectoryError(errno.EISDIR, "it is a folder; name a file", str(path))
    folder = path.parent.resolve()
    is_systems = folder == Path("/dev") or folder.is_relative_to("/proc")
    if not stat.S_ISREG(mode) or (is_systems and path.is_symlink()):
        why = "it is a device, a pipe or a stream, and no file; name a file"
        raise OSError(errno.EINVAL, why, str(path))


@contextlib.contextmanager
def partial_file(
    path: Path, *, mode: int | None = None, is_durable: bool = True, takes_over: bool = False
) -> Iterator[BinaryIO]:
    """
    Yield a file to write; without an exception it replaces *path* at the end, else nothing of it is left.

    Args:
        path: What it will be.
        mode: Its mode, whatever the umask; None for that of the file which it replaces, else by the umask.
        is_durable: Whether it, and its name, are on the disk afterwards.
        takes_over: As for `create_partial`.

    Raises:
        OSError: It cannot be written.
    """
    partial, descriptor = create_partial(path, takes_over=takes_over)
    try:
        with os.fdopen(descriptor, "w+b") as stream:
            wanted = _mode_of(path) if mode is None else mode
            if wanted is not None:
                os.fchmod(stream.fileno(), wanted)
            yield stream
            stream.flush()
            if is_durable:
                os.fsync(stream.fileno())
        partial.replace(path)
    except BaseException:
        with contextlib.suppress(OSError):
            partial.unlink()
        raise
    if is_durable:
        sync_folder(path.parent)


def write_whole(
    path: Path, data: bytes, *, mode: int | None = None, is_durable: bool = True
) -> None:
    """
    Replace a file so that readers, if wanted also after a power cut, see the old or the new content.

    Raises:
        OSError: It cannot be written.
    """
    with partial_file(path, mode=mode, is_durable=is_durable) as stream:
        stream.write(data)


def sync_folder(path: Path) -> None:
    """Bring the names in a folder to the disk."""
    descriptor = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _plain_name(path: Path) -> Path:
    return path.with_name(f".{path.name}{SUFFIX}")


def _random_name(path: Path) -> Path:
    return path.with_name(f".{path.name}.{os.urandom(RANDOM_BYTES).hex()}{SUFFIX}")


def _mode_of(path: Path) -> int | None:
    """Return the mode of the file that is replaced; None if there is none."""
    try:
        return os.lstat(path).st_mode & 0o777 if path.is_file() and not path.is_symlink() else None
    except OSError:
        return None
