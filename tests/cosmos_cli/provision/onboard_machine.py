"""This computer as a machine with a root of its own, and connections to it that are cut at any point."""

from __future__ import annotations

import os
import signal
from contextlib import contextmanager
from pathlib import Path

from cosmos_cli.fleet.failure import FailureKind, MachineFailure
from cosmos_cli.fleet.helper import Helper
from cosmos_cli.fleet.layout import Layout
from cosmos_cli.fleet.liveness import BlockingStream
from cosmos_cli.fleet.local import LocalConnection
from cosmos_cli.fleet.target import Target
from cosmos_cli.provision import STORE_PARTS


class CutStream:
    """A stream that loses its connection after a number of frames were handed over or asked for."""

    def __init__(self, stream, connection):
        self._stream = stream
        self._connection = connection
        self._left_bytes = 0  # of the frame that is being handed over

    def __getattr__(self, name):
        return getattr(self._stream, name)

    def write(self, data, *, timeout_s=0.0):
        if not self._left_bytes and self._connection.is_over():
            # Half of it may have come through.
            BlockingStream(self._stream).write_all(data[: len(data) // 2], timeout_s=timeout_s)
            self._cut()
        self._left_bytes = len(data)
        count = self._stream.write(data, timeout_s=timeout_s)
        self._left_bytes -= count
        return count

    def read(self, count, *, timeout_s=0.0):
        if self._connection.is_over():
            self._cut()
        return self._stream.read(count, timeout_s=timeout_s)

    def _cut(self):
        self._stream.close()
        raise MachineFailure(FailureKind.LOST, "cut by the test")


class OwnMachine:
    """This computer, below a folder of its own."""

    def __init__(self, root):
        self.root = root
        self.target = Target(name="own", address="127.0.0.1", connection="ssh", root=str(root))
        self.layout = Layout(str(root))
        self.steps_left = None
        self.calls = []

    own_address = peer_address = "127.0.0.1"

    def is_over(self):
        if self.steps_left is None:
            return False
        self.steps_left -= 1
        return self.steps_left < 0

    def open(self, command):
        return CutStream(LocalConnection(self.target).open(command), self)

    @contextmanager
    def board(self, *, cut_after=None):
        """Start a helper; *cut_after* counts steps from its greeting on."""
        with Helper.start(self, STORE_PARTS) as board:
            self.steps_left = cut_after
            self._count(board)
            try:
                yield board
            finally:
                self.steps_left = None

    def _count(self, board):
        call = board.call

        def counted(verb, arguments=None, **how):
            self.calls.append((verb, dict(arguments or {}), len(how.get("body", b""))))
            return call(verb, arguments, **how)

        board.call = counted

    def kill(self, board):
        """End the helper as a power cut would: in the midst of anything."""
        os.kill(board.greeting["pid"], signal.SIGKILL)


def snapshot(folder):
    """Return every file below a folder with its content, mode and time; caches and marks included."""
    found = {}
    for top, _, names in os.walk(folder):
        for name in names:
            path = os.path.join(top, name)
            status = os.lstat(path)
            is_link = os.path.islink(path)
            content = os.readlink(path) if is_link else Path(path).read_bytes()
            found[os.path.relpath(path, folder)] = (content, status.st_mode, status.st_mtime_ns)
    return found
