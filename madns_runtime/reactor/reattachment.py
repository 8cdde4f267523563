"""
The way back of an operator whose connection broke: a socket in the run directory, and the events that it has not seen.

A new SSH session of the same user connects (`madns_runtime.reactor.relay`) and says for which run and which
incarnation it comes and which event it saw last. Nothing here is for an operator on the same computer,
whose line ends only with it.
"""

from __future__ import annotations

import contextlib
import socket
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import orjson

from madns_runtime import private_socket
from madns_runtime.config import OPERATOR_SOCKET, Launch
from madns_runtime.reactor.reactor import Reactor

BACKLOG = 4
KEPT_BYTES_MAX = 4 * 1024 * 1024
"""Events that the operator has not told to have seen; the oldest of more are dropped and counted."""
ATTACH_LINE_BYTES_MAX = 4096
ATTACH_LINE_S = 5.0
"""Time from a connection to its first line."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Reattachment:
    """Way of an operator back to a process."""

    directory: Path
    """Folder of its socket."""
    session_hex: str
    """The run's."""
    incarnation: int = 1
    wait_s: float
    """Time from the end of the operator's line until it counts as gone."""


def way_back_of(launch: Launch, directory: Path, incarnation: int = 1) -> Reattachment | None:
    """Return how the operator may come back to a process with its folder in *directory*; None if it may not."""
    if launch.is_detached or not launch.reattach_s:
        return None
    return Reattachment(
        directory=directory,
        session_hex=launch.session_hex,
        incarnation=incarnation,
        wait_s=launch.reattach_s,
    )


class KeptEvents:
    """Numbered events, until the operator has told that it saw them."""

    def __init__(self) -> None:
        self._number = 0
        self._kept: deque[tuple[int, bytes]] = deque()
        self._bytes = 0
        self.dropped_count = 0
        """Events that did not fit and that nobody has seen for sure."""

    def __len__(self) -> int:
        return len(self._kept)

    def add(self, event: Mapping[str, Any]) -> bytes:
        """Number an event, keep it, and return its line."""
        self._number += 1
        numbered = {**event, "number": self._number}
        line = orjson.dumps(numbered, option=orjson.OPT_SERIALIZE_NUMPY) + b"\n"
        self._kept.append((self._number, line))
        self._bytes += len(line)
        while self._bytes > KEPT_BYTES_MAX and len(self._kept) > 1:
            self._bytes -= len(self._kept.popleft()[1])
            self.dropped_count += 1
        return line

    def seen(self, number: int) -> None:
        """Forget what the operator has seen."""
        while self._kept and self._kept[0][0] <= number:
            self._bytes -= len(self._kept.popleft()[1])

    def lines(self) -> list[bytes]:
        """Return all that is kept, in order."""
        return [line for _, line in self._kept]


class AttachSocket:
    """
    The socket at which an operator comes back; one client at a time introduces itself.

    Args:
        reactor: The loop.
        place: Where it lies, and who is let in.
        on_attached: Called with a connection, the number of the last event that its operator saw, and
            what came behind its first line.

    Raises:
        OSError: It cannot be made.
    """

    def __init__(
        self,
        reactor: Reactor,
        place: Reattachment,
        on_attached: Callable[[socket.socket, int, bytes], None],
    ) -> None:
        self._reactor = reactor
        self._place = place
        self._name = OPERATOR_SOCKET.format(place.incarnation)
        self._on_attached = on_attached
        self._client: socket.socket | None = None
        self._line = b""
        self._timer = reactor.call_at(float("inf"), self._overdue)
        self._listener = private_socket.listen(place.directory, self._name, BACKLOG)
        reactor.add_reader(self._listener.fileno(), self._accept)

    def fileno(self) -> int:
        """Return what is readable when `step` has something to do."""
        return (self._client or self._listener).fileno()

    @property
    def has_client(self) -> bool:
        """Whether a client is connected that has not introduced itself yet."""
        return self._client is not None

    def step(self) -> None:
        """Do what is due, outside of the loop."""
        if self._client is None:
            self._accept()
        else:
            self._read()

    def close(self) -> None:
        """Accept no more clients."""
        self._refuse()
        self._reactor.remove_reader(self._listener.fileno())
        self._listener.close()
        with contextlib.suppress(OSError):
            (self._place.directory / self._name).unlink()

    def _accept(self) -> None:
        client = private_socket.accept(self._listener)
        if client is None:
            return
        self._client, self._line = client, b""
        self._reactor.remove_reader(self._listener.fileno())  # the next one waits
        self._reactor.add_reader(client.fileno(), self._read)
        self._timer.reschedule(self._reactor.now_s() + ATTACH_LINE_S)

    def _read(self) -> None:
        assert self._client is not None
        try:
            data = self._client.recv(ATTACH_LINE_BYTES_MAX)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        self._line += data
        line, end, rest = self._line.partition(b"\n")
        if end and (seen := self._seen(line)) is not None:
            self._on_attached(self._take_client(), seen, rest)
        elif end or not data or len(line) > ATTACH_LINE_BYTES_MAX:
            self._refuse()

    def _seen(self, line: bytes) -> int | None:
        """Return the last event that the operator saw; None for a client that does not belong here."""
        try:
            asked = orjson.loads(line)
            mine = ("attach", self._place.session_hex, self._place.incarnation)
            is_welcome = (asked["command"], asked["session"], asked["incarnation"]) == mine
            return int(asked["seen"]) if is_welcome else None
        except (orjson.JSONDecodeError, KeyError, TypeError, ValueError):
            return None

    def _take_client(self) -> socket.socket:
        client = self._client
        assert client is not None
        self._client = None
        self._timer.reschedule(float("inf"))
        self._reactor.remove_reader(client.fileno())
        self._reactor.add_reader(self._listener.fileno(), self._accept)
        return client

    def _overdue(self) -> None:
        """Turn away a client that sends nothing; one whose line came while the loop was busy is read."""
        if self._client is not None:
            self._read()
        self._refuse()

    def _refuse(self) -> None:
        if self._client is not None:
            self._take_client().close()
