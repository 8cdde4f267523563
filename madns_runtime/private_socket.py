"""Unix sockets in a folder of one user, for processes of that user alone."""

from __future__ import annotations

import contextlib
import errno
import os
import socket
import stat
import struct
from collections.abc import Iterator
from pathlib import Path

SOCKET_MODE = 0o600
UNNAMED_SUFFIX = ".new"
"""Suffix of the name of a socket that does not listen yet."""
SOCKET_PATH_BYTES_MAX = 96
"""Bytes of a path that every system takes, also with that suffix; longer ones go through their folder's descriptor."""


@contextlib.contextmanager
def socket_address(directory: str | Path, name: str) -> Iterator[str]:
    """
    Yield an address for a socket in a folder, however long its path.

    Raises:
        OSError: The folder is a link, another user's, or not there; or its path is too long for this system.
    """
    fd = os.open(directory, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
    try:
        if os.fstat(fd).st_uid != os.geteuid():
            raise PermissionError(f"{directory} belongs to another user")
        path = os.path.join(directory, name)
        is_short = len(os.fsencode(path)) <= SOCKET_PATH_BYTES_MAX
        yield path if is_short else f"/proc/self/fd/{fd}/{name}"
    finally:
        os.close(fd)


def listen(directory: str | Path, name: str, backlog: int) -> socket.socket:
    """
    Return a socket that listens, and never waits; one that an earlier process left at this name gives way.

    It gets its name when it listens already: who finds it is let in.

    Raises:
        OSError: It cannot be made; see `socket_address`.
    """
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        with contextlib.suppress(OSError):  # where it can: so it holds from the first moment
            os.fchmod(listener.fileno(), SOCKET_MODE)
        with socket_address(directory, name) as address:
            unnamed = address + UNNAMED_SUFFIX
            for left in (address, unnamed):
                _remove_own_socket(left)
            if os.path.lexists(address):
                raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), address)
            listener.bind(unnamed)
            os.chmod(unnamed, SOCKET_MODE)
            listener.listen(backlog)
            os.rename(unnamed, address)
    except OSError:
        listener.close()
        raise
    listener.setblocking(False)
    return listener


def accept(listener: socket.socket) -> socket.socket | None:
    """Return the next visitor, who never blocks; None if there is none, or it is another user, and sent away."""
    try:
        visitor, _ = listener.accept()
    except OSError:
        return None
    if not _is_same_user(visitor):
        visitor.close()
        return None
    visitor.setblocking(False)
    return visitor


def _is_same_user(connection: socket.socket) -> bool:
    """Check the peer where the kernel tells (Linux); elsewhere the socket's mode must do."""
    if not hasattr(socket, "SO_PEERCRED"):
        return True
    size = struct.calcsize("3i")
    credentials = connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, size)
    _, uid, _ = struct.unpack("3i", credentials)
    return bool(uid in (os.getuid(), 0))


def _remove_own_socket(address: str) -> None:
    """Remove what an earlier process left; anything else stays, and binding fails."""
    with contextlib.suppress(FileNotFoundError):
        found = os.lstat(address)
        if stat.S_ISSOCK(found.st_mode) and found.st_uid == os.geteuid():
            os.unlink(address)
