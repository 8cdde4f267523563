"""Orders to a living run, through the door that its operator, or of a detached run its host, has open."""

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
from madns_runtime.hardware.order_socket import LINE_BYTES_MAX, SOCKET_NAME, Fault

ANSWER_S = 10.0
"""An order whose answer has not come by then is given up by who gave it."""


class SelectorReaders:
    """The operator's loop, as the door of a run wants it."""

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
        InputError: Nobody of this run listens.
        RunFailedError: It does not answer in time.
    """
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as line:
        line.settimeout(ANSWER_S)
        try:
            with private_socket.socket_address(folder.resolve(), SOCKET_NAME) as path:
                if not stat.S_ISSOCK(os.lstat(path).st_mode):
                    raise FileNotFoundError(path)
                line.connect(path)
        except OSError:
            raise InputError(
                f"{name}: nobody of this run listens: it has ended, has no devices, or its host runs on another computer"
            ) from None
        try:
            return _ask(line, dict(zip(("target", "action", "value"), fault, strict=True)))
        except OSError as error:
            why = str(error.strerror or error)
            raise RunFailedError(f"{name}: it took no order: {why}") from None


def _ask(line: socket.socket, order: Mapping[str, Any]) -> str:
    deadline_s = monotonic() + ANSWER_S
    line.sendall(orjson.dumps(order) + b"\n")
    heard = b""
    while not heard.endswith(b"\n"):
        line.settimeout(max(0.001, deadline_s - monotonic()))
        data = line.recv(LINE_BYTES_MAX)
        heard += data
        if not data or len(heard) > LINE_BYTES_MAX:
            raise ConnectionResetError("it closed the line; the run may be ending")
    try:
        return clean_line(str(orjson.loads(heard)["refusal"]))
    except (ValueError, KeyError, TypeError):
        raise ConnectionResetError("its answer is none") from None
