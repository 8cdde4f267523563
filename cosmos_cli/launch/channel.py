"""
JSON lines to and from one child, inside the operator's loop: never blocks, and holds a bounded amount.

A child's two pipes and a hand-started agent's socket are the same to this module.
"""

from __future__ import annotations

import os
import selectors
from collections.abc import Callable, Mapping
from typing import Any

import orjson

LINE_BYTES_MAX = 4 * 1024 * 1024
"""What is longer is cut; a result that is, as of a thousand agents, is read from the file that the host leaves."""
READ_BYTES = 65_536
READS_MAX = 64
"""Reads of one descriptor before the others have their turn."""


class LineSplitter:
    """Cuts a stream of bytes into lines of at most LINE_BYTES_MAX; the rest of a longer one is dropped."""

    __slots__ = ("_is_skipping", "_rest")

    def __init__(self) -> None:
        self._rest = b""
        self._is_skipping = False

    def feed(self, data: bytes) -> list[bytes]:
        """Take *data* and return the lines that are now whole, without empty ones."""
        *lines, self._rest = (self._rest + data).split(b"\n")
        if lines and self._is_skipping:
            del lines[0]
            self._is_skipping = False
        if len(self._rest) > LINE_BYTES_MAX:
            if not self._is_skipping:
                lines.append(self._rest[:LINE_BYTES_MAX])
            self._rest, self._is_skipping = b"", True
        return [line for line in lines if line]

    def flush(self) -> list[bytes]:
        """Return what came without an end of line before the stream ended."""
        rest, self._rest = self._rest, b""
        return [rest] if rest and not self._is_skipping else []


class Channel:
    """
    The line to one child.

    Args:
        selector: The operator's.
        read_fd: Where events come from.
        write_fd: Where commands go to; may be the same descriptor. Both belong to this channel now.
        on_line: Called with each line.
        on_end: Called once when the other side has closed.
    """

    def __init__(
        self,
        selector: selectors.BaseSelector,
        fds: tuple[int, int],
        *,
        on_line: Callable[[bytes], None],
        on_end: Callable[[], None],
    ) -> None:
        self._selector = selector
        self._read_fd, self._write_fd = fds
        self._on_line = on_line
        self._on_end = on_end
        self._splitter = LineSplitter()
        self._out = bytearray()
        self.is_open = True
        self._is_writable = True
        for fd in {*fds}:
            os.set_blocking(fd, False)
        selector.register(self._read_fd, selectors.EVENT_READ, self._ready)

    def send(self, command: Mapping[str, Any]) -> None:
        """Send one object; a child that is gone is none of the sender's business."""
        if self._is_writable:
            self._out += orjson.dumps(command) + b"\n"
            self._write()

    def close_writing(self) -> None:
        """Close the child's standard input, its life line; only for two separate descriptors."""
        if not self._is_writable:
            return
        self._is_writable = False
        self._out.clear()
        if self._write_fd != self._read_fd:
            if self._write_fd in self._selector.get_map():
                self._selector.unregister(self._write_fd)
            os.close(self._write_fd)

    def close(self) -> None:
        """Close both directions."""
        self.close_writing()
        if self.is_open:
            self.is_open = False
            self._selector.unregister(self._read_fd)
            os.close(self._read_fd)

    def drain(self) -> None:
        """Read all that has come until now; called when the child has ended."""
        for _ in range(READS_MAX * READS_MAX):
            if not self.is_open or not self._read():
                return

    def _ready(self, mask: int) -> None:
        if mask & selectors.EVENT_WRITE:
            self._write()
        if mask & selectors.EVENT_READ:
            for _ in range(READS_MAX):
                if not self.is_open or not self._read():
                    return

    def _read(self) -> bool:
        try:
            data = os.read(self._read_fd, READ_BYTES)
        except BlockingIOError:
            return False
        except OSError:
            data = b""
        for line in self._splitter.feed(data) if data else self._splitter.flush():
            self._on_line(line)
        if not data and self.is_open:
            self.close()
            self._on_end()
        return bool(data)

    def _write(self) -> None:
        try:
            while self._out:
                del self._out[: os.write(self._write_fd, self._out)]
        except BlockingIOError:
            pass
        except OSError:
            self._out.clear()
        self._watch_writing()

    def _watch_writing(self) -> None:
        """Ask to be called when there is room, only while something waits."""
        is_same = self._write_fd == self._read_fd
        wanted = (selectors.EVENT_READ if is_same else 0) | (
            selectors.EVENT_WRITE if self._out else 0
        )
        registered = self._selector.get_map().get(self._write_fd)
        if registered is None:
            if wanted:
                self._selector.register(self._write_fd, wanted, self._ready)
        elif not wanted:
            self._selector.unregister(self._write_fd)
        elif registered.events != wanted:
            self._selector.modify(self._write_fd, wanted, self._ready)
