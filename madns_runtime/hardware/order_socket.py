"""
Sockets of a living run: a command of the same user connects, gives an order in one line, and gets one line back.

Unix sockets of this user alone, in the run directory.
"""

from __future__ import annotations

import contextlib
import socket
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, Final, Protocol

import orjson

from madns_runtime import private_socket
from madns_runtime.errors import MadnsError
from madns_runtime.hardware.fault_actions import check_fault
from madns_runtime.plain_values import is_real

SOCKET_NAME: Final = ".orders.sock"
LINE_BYTES_MAX: Final = 65_536
"""Bytes of an order: the longest text that an action takes fits in several times."""
TOO_DEEP: Final = "a value is nested too deep"
"""Why an order is refused of which something cannot even be shown."""
CLIENTS_MAX: Final = 8
"""With one more, the connection of the client that has waited longest is closed."""

Fault = tuple[str, str, float | None]
"""Target, action and value."""


class Readers(Protocol):
    """A loop that calls back when descriptors are readable."""

    def add_reader(self, fd: int, callback: Callable[[], None], /) -> None:
        """Call back whenever a descriptor is readable."""

    def remove_reader(self, fd: int, /) -> object:
        """Call back no more."""


class LineSocket:
    """
    A socket whose clients each send one line, and get one.

    Args:
        folder: The run directory.
        name: Of the socket there.
        loop: Of the process.
        on_line: Called with a client's number and its line; `tell` answers.

    Raises:
        OSError: It cannot be made there.
    """

    def __init__(
        self, folder: Path, name: str, *, loop: Readers, on_line: Callable[[int, bytes], None]
    ) -> None:
        self._path = folder / name
        self._loop = loop
        self._on_line = on_line
        self._clients: dict[int, socket.socket] = {}
        self._heard: dict[int, bytes] = {}
        self._hearing: set[int] = set()
        self._count = 0
        self._listener = private_socket.listen(folder, name, CLIENTS_MAX)
        loop.add_reader(self._listener.fileno(), self._accept)

    def tell(self, number: int, reply: Mapping[str, Any]) -> None:
        """Answer a client, and close its connection."""
        client = self._clients.get(number)
        if client is not None:
            with contextlib.suppress(OSError):  # it has gone, or takes nothing
                client.send(orjson.dumps(reply) + b"\n")
            self._disconnect(number)

    def close(self) -> None:
        """Close the socket, and the connections of all clients."""
        for number in list(self._clients):
            self._disconnect(number)
        self._loop.remove_reader(self._listener.fileno())
        self._listener.close()
        with contextlib.suppress(OSError):
            self._path.unlink()

    def _accept(self) -> None:
        client = private_socket.accept(self._listener)
        if client is None:
            return
        if len(self._clients) >= CLIENTS_MAX:
            self._disconnect(min(self._clients))
        self._count += 1
        number = self._count
        self._clients[number], self._heard[number] = client, b""
        self._hearing.add(number)
        self._loop.add_reader(client.fileno(), partial(self._hear, number))

    def _hear(self, number: int) -> None:
        try:
            data = self._clients[number].recv(LINE_BYTES_MAX)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        heard = self._heard[number] = self._heard[number] + data
        if not data:
            self._disconnect(number)
        elif len(heard) > LINE_BYTES_MAX:
            self.tell(number, {"refusal": overlong(len(heard))})
        elif heard.endswith(b"\n"):
            self._stop_hearing(number)
            self._on_line(number, heard)

    def _disconnect(self, number: int) -> None:
        self._stop_hearing(number)
        del self._heard[number]
        self._clients.pop(number).close()

    def _stop_hearing(self, number: int) -> None:
        if number in self._hearing:
            self._hearing.remove(number)
            self._loop.remove_reader(self._clients[number].fileno())


def overlong(size_bytes: int) -> str:
    """Return why an order of so many bytes, as far as they have come, is refused."""
    return (
        f"expected an order of at most {LINE_BYTES_MAX} bytes, got {size_bytes}; shorten its texts"
    )


class OrderSocket(LineSocket):
    """
    The socket for faults of devices. Whoever supervises the run has it: the operator, or the host of a detached run.

    Args:
        folder: The run directory.
        loop: Of the process.
        on_order: Called with a number and the fault that is ordered; `answer` tells what became of it.

    Raises:
        OSError: It cannot be made there.
    """

    def __init__(self, folder: Path, loop: Readers, on_order: Callable[[int, Fault], None]) -> None:
        self._on_order = on_order
        super().__init__(folder, SOCKET_NAME, loop=loop, on_line=self._obey)

    def answer(self, number: int, refusal: str) -> None:
        """Tell who gave an order what became of it, and close the connection."""
        self.tell(number, {"refusal": refusal})

    def _obey(self, number: int, line: bytes) -> None:
        try:
            order = orjson.loads(line)
            value = order["value"]
            fault = (str(order["target"]), str(order["action"]), _number(value))
            check_fault(fault[1], fault[2])
        except RecursionError:
            self.answer(number, f"no order: {TOO_DEEP}")
        except (ValueError, KeyError, TypeError, MadnsError) as error:
            self.answer(number, f"no order: {error}")
        else:
            self._on_order(number, fault)


def _number(value: object) -> float | None:
    if value is None or is_real(value):
        return None if value is None else float(value)
    raise ValueError(f"expected a number, got {value!r}")
