"""
Bytes between a new SSH session and the process of a run that waits for its operator (`AttachSocket`).

    python -m madns_runtime.reactor.relay DIRECTORY NAME

Says RELAY_CONNECTED when it is connected, then nothing of its own. It ends with 0 when the process has closed
its side, and with RELAY_NOBODY if none listens there.
"""

from __future__ import annotations

import os
import select
import socket
import sys

from madns_runtime.config import RELAY_CONNECTED, RELAY_NOBODY
from madns_runtime.private_socket import socket_address

OPERATOR_LEFT = 4
READ_BYTES = 65_536


def main(arguments: list[str]) -> int:
    """Connect, relay until either side ends, and return the exit code."""
    directory, name = arguments
    connection = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        with socket_address(directory, name) as address:
            connection.connect(address)
    except OSError as error:
        sys.stderr.write(f"nobody waits at {directory}/{name}: {error.strerror or error}\n")
        return RELAY_NOBODY
    os.write(1, RELAY_CONNECTED)
    return _relay(connection)


def _relay(connection: socket.socket) -> int:
    """Copy both ways; a side that does not take what comes holds up the other, and nothing piles up."""
    while True:
        ready, _, _ = select.select([0, connection.fileno()], [], [])
        if connection.fileno() in ready:
            data = _received(connection)
            if not data:
                return 0
            _write_all(data)
        if 0 in ready:
            data = os.read(0, READ_BYTES)
            if not data:
                return OPERATOR_LEFT
            connection.sendall(data)


def _received(connection: socket.socket) -> bytes:
    try:
        return connection.recv(READ_BYTES)
    except OSError:
        return b""


def _write_all(data: bytes) -> None:
    view = memoryview(data)
    while view:
        view = view[os.write(1, view) :]


if __name__ == "__main__":
    try:
        sys.exit(main(sys.argv[1:]))
    except OSError:
        # The other end of the session, or the process, has gone in the middle of a word.
        sys.exit(OPERATOR_LEFT)
