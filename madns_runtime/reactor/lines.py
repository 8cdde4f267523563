"""
JSON lines to and from whoever started this process; when that side closes, it is gone.

An operator on another computer may go without a word, as by a power cut: it sends pings, and when they
cease it is gone as well. The first line that comes in is the launch document; it may hold a secret and
is never echoed.
"""

from __future__ import annotations

import math
import os
import select
import time
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any

import orjson

from madns_runtime.errors import ConfigurationError
from madns_runtime.reactor.reactor import Reactor

LINE_BYTES_MAX = 64 * 1024 * 1024
"""A launch document with the parameters of thousands of agents fits; a runaway peer does not."""
LAUNCH_TIMEOUT_S = 30.0
OUT_BYTES_MAX = 4 * 1024 * 1024
"""What may wait for an operator who does not read; more is dropped, oldest first, and counted."""
READ_BYTES = 65_536
OPERATOR_SIDE_GONE = "the operator's side is gone or has ended the run"
"""What an agent says that ends because its supervisor's line to the operator has ended."""
PING_SILENCE_S = 30.0
"""An operator that has sent pings and sends none for this long is gone."""
PING_LATE_S = 2.0
"""Pings come once a second; after this long without one something is wrong between here and there."""


def read_launch(fd: int) -> tuple[dict[str, Any], bytes]:
    """
    Read the launch document: the first line on *fd*.

    Returns:
        The document, and what had already come behind it.

    Raises:
        ConfigurationError: It did not come in time, is cut, or is no JSON object.
    """
    deadline_s = time.monotonic() + LAUNCH_TIMEOUT_S
    parts: list[bytes] = []
    size = 0
    while not parts or b"\n" not in parts[-1]:
        left_s = deadline_s - time.monotonic()
        if left_s <= 0 or not select.select([fd], [], [], left_s)[0]:
            raise ConfigurationError(
                f"no launch document within {LAUNCH_TIMEOUT_S:g} s: this program is started by"
                " `cosmos run`, which writes it to standard input"
            )
        chunk = os.read(fd, READ_BYTES)
        size += len(chunk)
        if not chunk or size > LINE_BYTES_MAX:
            raise ConfigurationError(
                "the launch document on standard input is empty, cut or too long"
            )
        parts.append(chunk)
    line, rest = b"".join(parts).split(b"\n", 1)
    try:
        document = orjson.loads(line)
    except orjson.JSONDecodeError as error:
        raise ConfigurationError(f"the launch document is not JSON: {error}") from None
    if not isinstance(document, dict):
        raise ConfigurationError("the launch document is not a JSON object")
    return document, rest


class OperatorLink:
    """
    The line to the operator, inside the loop.

    Args:
        reactor: The loop.
        fds: Where commands come from, whose end means that the operator is gone, and where events go to.
        on_command: Called with each command; pings are answered here.
        on_gone: Called once when the operator's end closes, or its pings cease.
        pending: What had already come behind the launch document.
        is_detached: The operator will leave, and that is no end.
    """

    def __init__(  # noqa: PLR0913 - three are optional or by name
        self,
        reactor: Reactor,
        fds: tuple[int, int],
        *,
        on_command: Callable[[Mapping[str, Any]], None],
        on_gone: Callable[[], None],
        pending: bytes = b"",
        is_detached: bool = False,
    ) -> None:
        self._reactor = reactor
        self._read_fd, self._write_fd = fds
        self._on_command = on_command
        self._on_gone = on_gone
        self._is_detached = is_detached
        self._in = b""
        self._out: deque[bytes] = deque()
        self._out_bytes = 0
        self._is_deaf = False
        self._pinged_s = math.inf
        self.dropped_count = 0
        """Events that nobody took."""
        self.is_gone = False
        self._silence_timer = reactor.call_at(math.inf, self._lost)
        os.set_blocking(self._read_fd, False)
        os.set_blocking(self._write_fd, False)
        reactor.add_reader(self._read_fd, self._readable)
        if pending:
            # In the loop, not here: whoever makes this link is not yet ready for commands.
            reactor.call_at(reactor.now_s(), lambda: self._take(pending))

    def emit(self, event: Mapping[str, Any]) -> None:
        """Send one event; never blocks."""
        if self._is_deaf:
            self.dropped_count += 1
            return
        line = orjson.dumps(event, option=orjson.OPT_SERIALIZE_NUMPY) + b"\n"
        self._out.append(line)
        self._out_bytes += len(line)
        self._write()
        while self._out_bytes > OUT_BYTES_MAX and len(self._out) > 1:
            # The first may be half written, so the second oldest goes.
            first = self._out.popleft()
            self._out_bytes -= len(self._out.popleft())
            self._out.appendleft(first)
            self.dropped_count += 1

    def has_hung_up(self, wait_s: float = 0.0) -> bool:
        """
        Tell whether the operator's end is closed though it should not be, before the loop has come to see it.

        Args:
            wait_s: The kernel closes a dead process's lines one after the other: wait so long for this one.
        """
        if self._is_detached:
            return False
        poll = select.poll()
        poll.register(self._read_fd, 0)
        return self.is_gone or bool(poll.poll(wait_s * 1e3))

    @property
    def is_late(self) -> bool:
        """Whether an operator that sends pings has not done so for a while."""
        return not self._is_detached and self._reactor.now_s() - self._pinged_s > PING_LATE_S

    def flush(self, timeout_s: float) -> bool:
        """Write what waits; False if the operator did not take it in time."""
        deadline_s = time.monotonic() + timeout_s
        while self._out and not self.is_gone:
            left_s = deadline_s - time.monotonic()
            if left_s <= 0 or not select.select([], [self._write_fd], [], left_s)[1]:
                return False
            self._write()
        return not self._out

    def close(self) -> None:
        """Stop listening; the descriptors stay open."""
        self._silence_timer.cancel()
        if not self.is_gone:
            self._reactor.remove_reader(self._read_fd)

    def _write(self) -> None:
        while self._out:
            line = self._out[0]
            try:
                count = os.write(self._write_fd, line)
            except BlockingIOError:
                return
            except OSError:
                self._is_deaf = True
                self.dropped_count += len(self._out)
                self._out.clear()
                self._out_bytes = 0
                return
            self._out_bytes -= count
            if count < len(line):
                self._out[0] = line[count:]
                return
            self._out.popleft()

    def _readable(self) -> None:
        try:
            data = os.read(self._read_fd, READ_BYTES)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if data:
            self._take(data)
            return
        self._lost()

    def _lost(self) -> None:
        """Take the operator for gone."""
        self._silence_timer.cancel()
        self._reactor.remove_reader(self._read_fd)
        self.is_gone = True
        if not self._is_detached:
            self._on_gone()

    def _take(self, data: bytes) -> None:
        *lines, self._in = (self._in + data).split(b"\n")
        self._in = self._in[:LINE_BYTES_MAX]
        for line in lines:
            try:
                command = orjson.loads(line)
            except orjson.JSONDecodeError:
                continue
            if isinstance(command, dict):
                self._obey(command)

    def _obey(self, command: Mapping[str, Any]) -> None:
        if command.get("command") != "ping":
            self._on_command(command)
            return
        self.emit({"event": "pong", "n": command.get("n")})
        self._pinged_s = self._reactor.now_s()
        if not self._is_detached:
            self._silence_timer.reschedule(self._pinged_s + PING_SILENCE_S)
