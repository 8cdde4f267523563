"""
JSON lines to and from whoever started this process; when that side closes, it is gone.

An operator on another computer may go without a word, as by a power cut: it sends pings, and when they
cease it is gone as well. If its line merely ends, its connection may have broken: it has a while to come
back (`madns_runtime.reactor.reattachment`), and nothing that was said meanwhile is lost. The first line that comes in is the launch document; it may hold a secret and
is never echoed.
"""

from __future__ import annotations

import contextlib
import math
import os
import select
import socket
from collections import deque
from collections.abc import Callable, Mapping
from time import monotonic
from typing import Any

import orjson

from madns_runtime.errors import ConfigurationError
from madns_runtime.reactor.descriptors import ready
from madns_runtime.reactor.reactor import Reactor
from madns_runtime.reactor.reattachment import (
    ATTACH_LINE_S,
    AttachSocket,
    KeptEvents,
    Reattachment,
)
from madns_runtime.timing.granted_clock import GrantedClock

LINE_BYTES_MAX = 64 * 1024 * 1024
"""A launch document with the parameters of thousands of agents fits; a runaway peer does not."""
LAUNCH_TIMEOUT_S = 30.0
LAUNCH_CHECK_S = 0.5
OUT_BYTES_MAX = 4 * 1024 * 1024
"""Bytes that may wait for an operator who does not read; more is dropped, oldest first, and counted."""
READ_BYTES = 65_536
SHOWN_CHARACTERS_MAX = 200
OPERATOR_GONE = "the operator's process is gone"
OPERATOR_SIDE_GONE = "the operator's side is gone or has ended the run"
"""Reason of an agent's end when its supervisor's line to the operator has ended."""
PING_SILENCE_S = 30.0
"""An operator that has sent pings and sends none for this long is gone."""
PING_LATE_S = 2.0
"""Pings come every second; after this long without one something is wrong between here and there."""

LAUNCH_CUT = "the launch document on standard input is empty, cut or too long"


def read_launch(fd: int, *, if_none: str = LAUNCH_CUT) -> tuple[dict[str, Any], bytes]:
    """
    Read the launch document: the first line on *fd*.

    Args:
        fd: Where it comes from.
        if_none: What it means that there is none.

    Returns:
        The document, and what had already come behind it.

    Raises:
        ConfigurationError: It did not come in time, is cut, or is no JSON object.
    """
    granted: GrantedClock | None = None
    parts: list[bytes] = []
    size = 0
    while not parts or b"\n" not in parts[-1]:
        if not ready([fd], [], LAUNCH_CHECK_S)[0]:
            # Its writer may be waiting for a processor.
            granted = granted or GrantedClock(lambda: (os.getppid(),))
            if granted.now_s() < LAUNCH_TIMEOUT_S:
                continue
            raise ConfigurationError(
                f"no launch document within {LAUNCH_TIMEOUT_S:g} s: this program is started by"
                " `cosmos run`, which writes it to standard input"
            )
        chunk = os.read(fd, READ_BYTES)
        size += len(chunk)
        if not chunk or size > LINE_BYTES_MAX:
            raise ConfigurationError(LAUNCH_CUT if parts else if_none)
        parts.append(chunk)
    line, rest = b"".join(parts).split(b"\n", 1)
    try:
        document = orjson.loads(line)
    except orjson.JSONDecodeError as error:
        raise ConfigurationError(f"the launch document is not JSON: {error}") from None
    if not isinstance(document, dict):
        raise ConfigurationError("the launch document is not a JSON object")
    return document, rest


def tell_loading(fd: int, doing: str) -> None:
    """Tell the operator, before there is a loop, what is done with the plug-in's code; nothing when it is done."""
    with contextlib.suppress(OSError):  # nobody may be left to hear it
        os.write(fd, orjson.dumps({"event": "loading", "doing": doing}) + b"\n")


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
        way_back: How the operator may come back when its line has ended; None if it cannot.
        on_attached: Called when it has; the line's descriptors have kept their numbers.
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
        way_back: Reattachment | None = None,
        on_attached: Callable[[], None] = lambda: None,
    ) -> None:
        self._reactor = reactor
        self._read_fd, self._write_fd = fds
        self._on_command = on_command
        self._on_gone = on_gone
        self._on_attached = on_attached
        self._is_detached = is_detached
        self._in = b""
        self._out: deque[bytes] = deque()
        self._out_bytes = 0
        self._is_deaf = False
        self._pinged_s = math.inf
        self._dropped_count = 0
        self.is_gone = False
        self.is_cut = False
        """Whether its line has ended, and it may still come back."""
        self._kept = KeptEvents()
        self._commands_seen = 0
        self._way_back = way_back
        self._is_last_call = False
        self._cut_until_s = math.inf
        self._cut_timer = reactor.call_at(math.inf, self._given_up)
        self._attach_socket: AttachSocket | None = None
        self._silence_timer = reactor.call_at(math.inf, self._fallen_silent)
        os.set_blocking(self._read_fd, False)
        os.set_blocking(self._write_fd, False)
        reactor.add_reader(self._read_fd, self._readable)
        if way_back is not None:
            self._attach_socket = self._open_attach_socket(way_back)
        if pending:
            # In the loop, not here: whoever makes this link is not yet ready for commands.
            reactor.call_at(reactor.now_s(), lambda: self._take(pending))

    def emit(self, event: Mapping[str, Any]) -> None:
        """Send one event; never blocks."""
        if self._attach_socket is not None:
            line = self._kept.add(event)
            if self.is_cut:
                return
        else:
            line = orjson.dumps(event, option=orjson.OPT_SERIALIZE_NUMPY) + b"\n"
        self._send(line)

    def refuse(self, command: object) -> None:
        """Tell the operator that something it said is no command here."""
        shown = repr(dict(command) if isinstance(command, Mapping) else command)
        text = f"no command here: {shown[:SHOWN_CHARACTERS_MAX]}"
        self.emit({"event": "log", "level": "warning", "text": text})

    def _send(self, line: bytes) -> None:
        if self._is_deaf:
            self._dropped_count += self._attach_socket is None
            return
        self._out.append(line)
        self._out_bytes += len(line)
        self._write()
        while self._out_bytes > OUT_BYTES_MAX and len(self._out) > 1:
            # The first may be half written, so the second oldest goes.
            first = self._out.popleft()
            self._out_bytes -= len(self._out.popleft())
            self._out.appendleft(first)
            self._dropped_count += 1

    @property
    def dropped_count(self) -> int:
        """Events that nobody took."""
        return self._dropped_count + self._kept.dropped_count

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
        return self.is_gone or self.is_cut or bool(poll.poll(wait_s * 1e3))

    @property
    def is_silent(self) -> bool:
        """Whether an operator that sends pings has not done so for a while, though its line stands."""
        is_late = self._reactor.now_s() - self._pinged_s > PING_LATE_S
        is_watched = not self._is_detached and not self.is_cut
        return is_late and is_watched and not ready([self._read_fd], [], 0)[0]

    def flush(self, timeout_s: float) -> bool:
        """
        Write what waits; False if the operator did not take it in time.

        One that may come back has told of the last event when this is done; if its line ends meanwhile, it has
        its time to come back, and then *timeout_s* anew.
        """
        if self._attach_socket is not None:
            return self._flush_and_hear(self._attach_socket, timeout_s)
        deadline_s = monotonic() + timeout_s
        while self._out and not self.is_gone:
            left_s = deadline_s - monotonic()
            if left_s <= 0 or not ready([], [self._write_fd], left_s)[1]:
                return False
            self._write()
        return not self._out

    def close(self) -> None:
        """Stop listening; the descriptors stay open."""
        self._silence_timer.cancel()
        self._cut_timer.cancel()
        if self._attach_socket is not None:
            self._attach_socket.close()
            self._attach_socket = None
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
                self._dropped_count += len(self._out) if self._attach_socket is None else 0
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
        elif self._way_back is None or self._attach_socket is None:
            self._lost()
        else:
            self._cut(self._way_back.wait_s)

    def _fallen_silent(self) -> None:
        """Take an operator for gone whose pings have ceased; those that came while the loop was busy are heard."""
        pinged_s = self._pinged_s
        if ready([self._read_fd], [], 0)[0]:
            self._readable()
        if not self.is_gone and not self.is_cut and self._pinged_s == pinged_s:
            self._lost()

    def _lost(self) -> None:
        """Take the operator for gone."""
        self._silence_timer.cancel()
        self._cut_timer.cancel()
        self._reactor.remove_reader(self._read_fd)
        self.is_gone = True
        if not self._is_detached:
            self._on_gone()

    # The way back ---------------------------------------------------------------------------------

    def _open_attach_socket(self, way_back: Reattachment) -> AttachSocket | None:
        try:
            return AttachSocket(self._reactor, way_back, self._attached)
        except OSError as error:
            text = f"a broken connection would end what runs here: {error}"
            self.emit({"event": "log", "level": "warning", "text": text})
            return None

    def _cut(self, wait_s: float) -> None:
        """Keep what is said from now on, until the operator is back or its time is over."""
        self.is_cut = True
        self._silence_timer.reschedule(math.inf)
        self._reactor.remove_reader(self._read_fd)
        self._out.clear()
        self._out_bytes = 0
        self._cut_until_s = self._reactor.now_s() + wait_s
        self._cut_timer.reschedule(self._cut_until_s)

    def _given_up(self) -> None:
        """Take an operator for gone that has not come back; one that connected while the loop was busy is heard."""
        assert self._attach_socket is not None
        if ready([self._attach_socket.fileno()], [], 0)[0]:
            self._attach_socket.step()
        if self.is_cut and self._attach_socket.has_client and not self._is_last_call:
            self._is_last_call = True
            self._cut_timer.reschedule(self._reactor.now_s() + ATTACH_LINE_S)
        elif self.is_cut:
            self._lost()

    def _attached(self, connection: socket.socket, seen: int, rest: bytes) -> None:
        """Take a new line for the old one, which may not have ended here yet."""
        self._reactor.remove_reader(self._read_fd)
        for fd in {self._read_fd, self._write_fd}:
            os.dup2(connection.fileno(), fd)
            os.set_blocking(fd, False)
        connection.close()
        self._reactor.add_reader(self._read_fd, self._readable)
        self.is_cut = self._is_deaf = self._is_last_call = False
        self._pinged_s = self._reactor.now_s()
        self._silence_timer.reschedule(self._pinged_s + PING_SILENCE_S)
        self._cut_timer.reschedule(math.inf)
        self._in = b""
        self._out.clear()
        self._out_bytes = 0
        self._kept.seen(seen)
        hello = {"event": "attached", "commands": self._commands_seen}
        for line in (orjson.dumps(hello) + b"\n", *self._kept.lines()):
            self._send(line)
        self._on_attached()
        self._take(rest)

    def _flush_and_hear(self, attach_socket: AttachSocket, timeout_s: float) -> bool:
        deadline_s = monotonic() + timeout_s
        while self._kept and not self.is_gone:
            left_s = (self._cut_until_s if self.is_cut else deadline_s) - monotonic()
            if left_s <= 0:
                return False
            reading = [attach_socket.fileno(), *(() if self.is_cut else (self._read_fd,))]
            writing = [self._write_fd] if self._out and not self.is_cut else []
            readable, writable = ready(reading, writing, left_s)
            was_cut = self.is_cut
            if writable:
                self._write()
            if attach_socket.fileno() in readable:
                attach_socket.step()
            elif readable:
                self._readable()
            if was_cut and not self.is_cut:
                deadline_s = monotonic() + timeout_s
        return not self._kept

    # Commands -------------------------------------------------------------------------------------

    def _take(self, data: bytes) -> None:
        *lines, self._in = (self._in + data).split(b"\n")
        self._in = self._in[:LINE_BYTES_MAX]
        for line in lines:
            try:
                command = orjson.loads(line)
            except orjson.JSONDecodeError:
                command = line
            if isinstance(command, dict):
                self._obey(command)
            elif line:
                self.refuse(command)

    def _obey(self, command: Mapping[str, Any]) -> None:
        what = command.get("command")
        self._kept.seen(int(command.get("seen", 0)))
        if what == "ping":
            self._pinged(command.get("n"))
        elif what == "leave":
            self._way_back = None  # the end of the line is meant
        elif what != "seen":
            number = int(command.get("number", 0))
            if number == 0 or number > self._commands_seen:
                self._commands_seen = max(number, self._commands_seen)
                self._on_command(command)

    def _pinged(self, number: object) -> None:
        self._send(orjson.dumps({"event": "pong", "n": number}) + b"\n")
        self._pinged_s = self._reactor.now_s()
        if not self._is_detached:
            self._silence_timer.reschedule(self._pinged_s + PING_SILENCE_S)
