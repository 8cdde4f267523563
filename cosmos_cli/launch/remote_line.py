"""
The line to a program on another machine: over one stream after another, with nothing lost or doubled between them.

Both sides number what must arrive. An operator tells with each ping which event it saw last; the program tells on
a new stream which command it saw last (`madns_runtime.reactor.operator_link`).
"""

from __future__ import annotations

import selectors
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any

import orjson

from cosmos_cli.fleet.connection import Stream
from cosmos_cli.fleet.failure import MachineFailure
from cosmos_cli.launch.channel import StreamChannel
from madns_runtime.recording.records import WHOLE_MAX

COMMANDS_KEPT_MAX = 10_000
"""Commands of a run that could be sent again; a run of thousands of agents has fewer."""


class RemoteLine:
    """
    Commands to a program, and lines from it.

    Args:
        selector: The operator's.
        on_line: Called with each line, once.
        on_end: Called when a stream has ended, with the failure if its connection was lost.
    """

    def __init__(
        self,
        selector: selectors.BaseSelector,
        *,
        on_line: Callable[[bytes], None],
        on_end: Callable[[MachineFailure | None], None],
    ) -> None:
        self._selector = selector
        self._on_line = on_line
        self._on_end = on_end
        self._channel: StreamChannel | None = None
        self._is_ready = False
        self._is_closed = False
        self.has_greeted = False
        """Whether the program has told over the newest stream that it takes it."""
        self._commands: deque[dict[str, Any]] = deque(maxlen=COMMANDS_KEPT_MAX)
        self._count = 0
        self.seen = 0
        """Number of the last event."""

    def open(self, stream: Stream) -> None:
        """Speak over the program's own stream."""
        self._use(stream)
        self._send_from(0)

    def attach(self, stream: Stream, said: bytes) -> None:
        """Speak over a new stream, on which *said* has come; commands follow when the program has greeted."""
        self._use(stream).feed(said)

    def send(self, command: Mapping[str, Any]) -> None:
        """Send one object, now or as soon as there is a stream; pings are not kept."""
        if self._is_closed:
            return
        if command["command"] == "ping":
            if self._is_ready and self._channel is not None:
                self._channel.send({**command, "seen": self.seen})
            return
        self._count += 1
        self._commands.append({**command, "number": self._count})
        if self._is_ready and self._channel is not None:
            self._channel.send(self._commands[-1])

    def push(self) -> bool:
        """Hand over what could not be sent at once; True if some of it still waits."""
        if self._channel is None or not self._channel.has_unsent:
            return False
        self._channel.push()
        return self._channel.has_unsent

    def leave(self) -> None:
        """Close the program's standard input, its life line, and mean it."""
        if self._channel is not None:
            self._channel.send({"command": "leave"})
            self._channel.close_writing()
        self._is_ready = False

    def close(self) -> None:
        """Listen no more."""
        self._is_closed = True
        if self._channel is not None:
            self._channel.close()

    def _use(self, stream: Stream) -> StreamChannel:
        if self._channel is not None:
            self._channel.close()
        self._is_ready = self.has_greeted = False
        self._channel = StreamChannel(
            self._selector, stream, on_line=self._heard, on_end=self._ended
        )
        return self._channel

    def _ended(self) -> None:
        assert self._channel is not None
        self._is_ready = False
        self._on_end(self._channel.failure)

    def _send_from(self, seen: int) -> None:
        assert self._channel is not None
        self._is_ready = True
        for command in self._commands:
            if command["number"] > seen:
                self._channel.send(command)

    def _heard(self, line: bytes) -> None:
        try:
            event = orjson.loads(line)
            number, commands = _number(event.get("number", 0)), _number(event.get("commands", 0))
        except (AttributeError, TypeError, ValueError, OverflowError):
            event, number, commands = {}, 0, 0
        if event.get("event") == "attached":
            self.has_greeted = True
            self._send_from(commands)
        elif number == 0:
            self._on_line(line)
        elif number > self.seen:
            self._note(number)
            self._on_line(line)
            if event.get("event") == "finished" and self._channel is not None and self._is_ready:
                self._channel.send({"command": "seen", "seen": number})

    def _note(self, number: int) -> None:
        missing = number - self.seen - 1
        self.seen = number
        if missing:
            text = (
                f"{missing} of its events did not fit while its connection was broken, and are lost"
            )
            self._on_line(orjson.dumps({"event": "log", "level": "warning", "text": text}))


def _number(value: Any) -> int:
    """Return the number of an event or a command; 0, as of a line without one, for one that could not be told back."""
    number = int(value)
    return number if 0 <= number <= WHOLE_MAX else 0
