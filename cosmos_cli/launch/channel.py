"""
JSON lines to and from one child, inside the operator's loop: never blocks, and holds a bounded amount.

A child's two pipes and a hand-started agent's socket are the same to `PipeChannel`; `StreamChannel` speaks over a
stream to a program on another machine, which tells when there is something to read, while whether it takes more
can only be tried.
"""

from __future__ import annotations

import os
import selectors
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from typing import Any

import orjson

from cosmos_cli.fleet.connection import Stream
from cosmos_cli.fleet.failure import MachineFailure

LINE_BYTES_MAX = 4 * 1024 * 1024
"""Longest line, the rest is cut; a longer result, as of 1000 agents, is read from the file that the host leaves."""
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


class LineChannel(ABC):
    """
    The line to one child.

    Args:
        selector: The operator's.
        fd: Readable when something has come.
        on_line: Called with each line.
        on_end: Called once when the other side has closed, or the connection is lost.
    """

    def __init__(
        self,
        selector: selectors.BaseSelector,
        fd: int,
        *,
        on_line: Callable[[bytes], None],
        on_end: Callable[[], None],
    ) -> None:
        self._selector = selector
        self._fd = fd
        self._on_line = on_line
        self._on_end = on_end
        self._splitter = LineSplitter()
        self._out = bytearray()
        self.is_open = True
        self._is_writable = True
        selector.register(fd, selectors.EVENT_READ, self._ready)

    def send(self, command: Mapping[str, Any]) -> None:
        """Send one object; a child that is gone is none of the sender's business."""
        if self._is_writable:
            self._out += orjson.dumps(command) + b"\n"
            self.push()

    @abstractmethod
    def push(self) -> None:
        """Hand over what still waits, as far as there is room."""

    def close_writing(self) -> None:
        """Close the child's standard input, its life line; harmless when repeated."""
        if self._is_writable:
            self._is_writable = False
            self._out.clear()
            self._end_writing()

    @abstractmethod
    def close(self) -> None:
        """Let go of it; harmless when repeated."""

    @abstractmethod
    def _end_writing(self) -> None:
        """Close what is written to."""

    @abstractmethod
    def _take(self) -> bytes:
        """Return what has come, empty at the end; BlockingIOError if that is nothing yet."""

    def _ready(self, mask: int) -> None:
        for _ in range(READS_MAX):
            if not self.is_open or not self._read():
                return

    def _read(self) -> bool:
        try:
            data = self._take()
        except BlockingIOError:
            return False
        for line in self._splitter.feed(data) if data else self._splitter.flush():
            self._on_line(line)
        if not data and self.is_open:
            self.close()
            self._on_end()
        return bool(data)


class PipeChannel(LineChannel):
    """
    The line over descriptors, which belong to this channel now.

    Args:
        selector: The operator's.
        fds: Where events come from, and where commands go to; may be the same.
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
        read_fd, self._write_fd = fds
        for fd in {*fds}:
            os.set_blocking(fd, False)
        super().__init__(selector, read_fd, on_line=on_line, on_end=on_end)

    def push(self) -> None:
        """Hand over what still waits, as far as there is room; the selector tells when there is more."""
        try:
            while self._out:
                del self._out[: os.write(self._write_fd, self._out)]
        except BlockingIOError:
            pass
        except OSError:
            self._out.clear()
        self._watch_writing()

    def close(self) -> None:
        """Close both directions."""
        self.close_writing()
        if self.is_open:
            self.is_open = False
            self._selector.unregister(self._fd)
            os.close(self._fd)

    def drain(self) -> None:
        """Read all that has come until now; called when the child has ended."""
        for _ in range(READS_MAX * READS_MAX):
            if not self.is_open or not self._read():
                return

    def _end_writing(self) -> None:
        if self._write_fd != self._fd:
            if self._write_fd in self._selector.get_map():
                self._selector.unregister(self._write_fd)
            os.close(self._write_fd)

    def _take(self) -> bytes:
        try:
            return os.read(self._fd, READ_BYTES)
        except BlockingIOError:
            raise
        except OSError:
            return b""

    def _ready(self, mask: int) -> None:
        if mask & selectors.EVENT_WRITE:
            self.push()
        if mask & selectors.EVENT_READ:
            super()._ready(mask)

    def _watch_writing(self) -> None:
        """Ask to be called when there is room, only while something waits."""
        is_same = self._write_fd == self._fd
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


class StreamChannel(LineChannel):
    """
    The line over a stream, whose owner closes it.

    Args:
        selector: The operator's.
        stream: To the program.
        on_line: Called with each line.
        on_end: Called once when the program's side has closed, or the connection is lost.
    """

    def __init__(
        self,
        selector: selectors.BaseSelector,
        stream: Stream,
        *,
        on_line: Callable[[bytes], None],
        on_end: Callable[[], None],
    ) -> None:
        self._stream = stream
        self.failure: MachineFailure | None = None
        """Why the connection was lost, if it was."""
        super().__init__(selector, stream.fileno(), on_line=on_line, on_end=on_end)

    def feed(self, data: bytes) -> None:
        """Take what was read from the stream before this channel was there."""
        for line in self._splitter.feed(data):
            self._on_line(line)

    @property
    def has_unsent(self) -> bool:
        """Whether `push` should be called again soon."""
        return bool(self._out)

    def push(self) -> None:
        """Hand over what still waits, as far as there is room."""
        try:
            while self._out:
                del self._out[: self._stream.write(bytes(self._out[:READ_BYTES]))]
        except BlockingIOError:
            return
        except MachineFailure:  # reading tells what became of it
            self._out.clear()

    def close(self) -> None:
        """Listen no more."""
        self._is_writable = False
        self._out.clear()
        if self.is_open:
            self.is_open = False
            self._selector.unregister(self._fd)

    def _end_writing(self) -> None:
        self._stream.close_writing()

    def _take(self) -> bytes:
        try:
            return self._stream.read(READ_BYTES)
        except MachineFailure as failure:
            self.failure = failure
            return b""
