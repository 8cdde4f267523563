"""Orders to a living run, over a socket of its operator or its host (`madns_runtime.hardware.order_socket`)."""

from __future__ import annotations

import os
import selectors
import socket
import stat
from collections.abc import Callable, Mapping
from pathlib import Path
from time import monotonic
from typing import Any

import orjson

from cosmos_cli.errors import InputError, RunFailedError
from cosmos_cli.ui.foreign_text import clean_line
from madns_runtime import private_socket
from madns_runtime.hardware.action_socket import SOCKET_NAME as ACTIONS_SOCKET
from madns_runtime.hardware.order_socket import LINE_BYTES_MAX, SOCKET_NAME, Fault, overlong

ANSWER_BYTES_MAX = 1 << 20
ANSWER_S = 10.0
"""An order whose answer has not come by then is given up by who gave it."""


class SelectorReaders:
    """The operator's loop, with the methods that a run's socket needs."""

    def __init__(self, selector: selectors.BaseSelector) -> None:
        self._selector = selector

    def add_reader(self, fd: int, callback: Callable[[], None], /) -> None:
        """Call back whenever a descriptor is readable."""
        self._selector.register(fd, selectors.EVENT_READ, lambda mask: callback())

    def remove_reader(self, fd: int, /) -> None:
        """Call back no more."""
        self._selector.unregister(fd)


def order_fault(folder: Path, name: str, fault: Fault) -> str:
    """
    Hand whoever supervises a living run the order to insert a fault, and return why it is refused; "" if it is in force.

    Args:
        folder: The run directory.
        name: The run's.
        fault: Target, action and value.

    Raises:
        InputError: Nobody of this run listens, or the order is too long.
        RunFailedError: It does not answer in time.
    """
    order = dict(zip(("target", "action", "value"), fault, strict=True))
    why_not = "it has ended, has no devices, or its host runs on another computer"
    return _refusal_in(_exchange(folder / SOCKET_NAME, name, order, why_not))


def order_action(folder: Path, name: str, order: Mapping[str, Any]) -> Mapping[str, Any]:
    """
    Hand the host of a living run an order of an action, or the question what there is (list: true); return its answer.

    Args:
        folder: The run directory.
        name: The run's.
        order: target, action, parameters and for_s, or list.

    Raises:
        InputError: Nobody of this run listens, or the order is too long.
        RunFailedError: It does not answer in time.
    """
    why_not = "it has not begun, has ended, or its host runs on another computer"
    return _exchange(folder / ACTIONS_SOCKET, name, order, why_not)


def _exchange(
    socket_path: Path, name: str, order: Mapping[str, Any], why_not: str
) -> Mapping[str, Any]:
    line = _line_of(order, name)
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as connection:
        connection.settimeout(ANSWER_S)
        try:
            with private_socket.socket_address(
                socket_path.parent.resolve(), socket_path.name
            ) as path:
                if not stat.S_ISSOCK(os.lstat(path).st_mode):
                    raise FileNotFoundError(path)
                connection.connect(path)
        except OSError:
            raise InputError(f"{name}: nobody of this run listens: {why_not}") from None
        try:
            return _ask(connection, line)
        except OSError as error:
            why = str(error.strerror or error)
            raise RunFailedError(f"{name}: it took no order: {why}") from None


def _line_of(order: Mapping[str, Any], name: str) -> bytes:
    """
    Return an order as its line.

    Raises:
        InputError: It is too long, or holds what has no line.
    """
    try:
        line = orjson.dumps(order) + b"\n"
    except TypeError as error:  # a whole number of more than 64 bits
        raise InputError(f"{name}: no order: {error}") from None
    if len(line) > LINE_BYTES_MAX:  # who refuses it may not be heard over what is still written
        raise InputError(f"{name}: {overlong(len(line))}")
    return line


def _ask(connection: socket.socket, line: bytes) -> Mapping[str, Any]:
    deadline_s = monotonic() + ANSWER_S
    connection.sendall(line)
    heard = b""
    while not heard.endswith(b"\n"):
        connection.settimeout(max(0.001, deadline_s - monotonic()))
        data = connection.recv(ANSWER_BYTES_MAX)
        heard += data
        if not data or len(heard) > ANSWER_BYTES_MAX:
            raise ConnectionResetError("it closed the line; the run may be ending")
    try:
        answer = orjson.loads(heard)
    except ValueError:
        answer = None
    if not isinstance(answer, dict) or "refusal" not in answer:
        raise ConnectionResetError("its answer is none")
    return answer


def _refusal_in(answer: Mapping[str, Any]) -> str:
    return clean_line(str(answer["refusal"]))
