"""
JSON lines to and from a program on another machine, inside the operator's loop: as `Channel`, over a stream.

A stream tells when there is something to read; whether it takes more can only be tried.
"""

from __future__ import annotations

import selectors
from collections.abc import Callable, Mapping
from typing import Any

import orjson

from cosmos_cli.fleet.connection import Stream
from cosmos_cli.fleet.failure import MachineFailure
from cosmos_cli.launch.channel import READ_BYTES, READS_MAX, LineSplitter


class StreamChannel:
    """
    The line to one program.

    Args:
        selector: The operator's.
        stream: To the program; its owner closes it.
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
        self._selector = selector
        self._stream = stream
        self._on_line = on_line
        self._on_end = on_end
        self._splitter = LineSplitter()
        self._out = bytearray()
        self._is_writable = True
        self.is_open = True
        self.failure: MachineFailure | None = None
        """Why the connection was lost, if it was."""
        selector.register(stream.fileno(), selectors.EVENT_READ, self._ready)

    @property
    def has_unsent(self) -> bool:
        """Whether `push` should be called again soon."""
        return bool(self._out)

    def send(self, command: Mapping[str, Any]) -> None:
        """Send one object; a program that is gone is none of the sender's business."""
        if self._is_writable:
            self._out += orjson.dumps(command) + b"\n"
            self.push()

    def push(self) -> None:
        """Hand over what still waits, as far as there is room."""
        try:
            while self._out:
                del self._out[: self._stream.write(bytes(self._out[:READ_BYTES]))]
        except BlockingIOError:
            return
        except MachineFailure:  # reading tells what became of it
            self._out.clear()

    def close_writing(self) -> None:
        """Close the program's standard input, its life line."""
        if self._is_writable:
            self._is_writable = False
            self._out.clear()
            self._stream.close_writing()

    def close(self) -> None:
        """Listen no more."""
        self._is_writable = False
        self._out.clear()
        if self.is_open:
            self.is_open = False
            self._selector.unregister(self._stream.fileno())

    def _ready(self, mask: int) -> None:
        for _ in range(READS_MAX):
            if not self.is_open or not self._read():
                return

    def _read(self) -> bool:
        try:
            data = self._stream.read(READ_BYTES)
        except BlockingIOError:
            return False
        except MachineFailure as failure:
            self.failure, data = failure, b""
        for line in self._splitter.feed(data) if data else self._splitter.flush():
            self._on_line(line)
        if not data and self.is_open:
            self.close()
            self._on_end()
        return bool(data)
