"""
Text that a program wrote, kept beside the records: its first part and its last, all of it counted.

The loop hands over what came and never waits; the recorder's writer writes it. What lies between the two
parts is dropped, and the file says how much that was.
"""

from __future__ import annotations

import os
from collections import deque
from pathlib import Path
from typing import Final

HEAD_BYTES: Final = 1024 * 1024
"""Of a file the first part; written as it comes, so that a killed process leaves it."""
TAIL_BYTES: Final = 64 * 1024
"""The last part; written at the end."""


class TextFile:
    """
    One file; opened when there is something to write.

    Args:
        path: Where; what an earlier process of the agent left there is continued.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.dropped_bytes = 0
        """Number of bytes that were neither of the first part nor of the last."""
        self._head: deque[bytes] = deque()
        self._tail = bytearray()
        self._room = HEAD_BYTES - _size_of(path)

    def add(self, data: bytes) -> None:
        """Take what came; never waits."""
        head = data[: max(0, self._room)]
        if head:
            self._room -= len(head)
            self._head.append(head)
        if len(head) == len(data):
            return
        self._tail += data[len(head) :]
        too_many = len(self._tail) - TAIL_BYTES
        if too_many > 0:
            self.dropped_bytes += too_many
            del self._tail[:too_many]

    def write_waiting(self) -> None:
        """
        Write what waits of the first part.

        Raises:
            OSError: The disk refuses; what it has not taken waits on.
        """
        if not self._head:
            return
        flags = os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_NOFOLLOW | os.O_CLOEXEC
        descriptor = os.open(self.path, flags, 0o644)
        try:
            while self._head:
                data = self._head[0]
                self._head[0] = data[os.write(descriptor, data) :]
                if not self._head[0]:
                    self._head.popleft()
        finally:
            os.close(descriptor)

    def finish(self) -> None:
        """
        Write all that waits, and the last part.

        Raises:
            OSError: The disk refuses.
        """
        if self._tail:
            gap = f"\n[{self.dropped_bytes} bytes are left out]\n".encode()
            self._head += [gap, bytes(self._tail)] if self.dropped_bytes else [bytes(self._tail)]
            self._tail.clear()
        self.write_waiting()


def _size_of(path: Path) -> int:
    try:
        return path.lstat().st_size
    except OSError:
        return 0
