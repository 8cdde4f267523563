"""
This computer as a machine that answers with nonsense: the real helper, its answers altered on their way.

What is altered is chosen by a seed, so that a failure can be repeated.
"""

from __future__ import annotations

import json
import random
from collections.abc import Callable
from typing import Any

from harness.altered_values import altered

from cosmos_cli.fleet.local import LocalConnection

NESTED = '{"ok":true,"body":0,"value":' + "[" * 100_000 + "]" * 100_000 + "}\n"
RAW: tuple[bytes, ...] = (
    b"\n",
    b"null\n",
    b"[]\n",
    b"{}\n",
    b'{"ok":true}\n',
    b'{"ok":true,"body":0}\n',
    b'{"ok":true,"body":null,"value":null}\n',
    b'{"ok":true,"body":-5,"value":null}\n',
    b'{"ok":true,"body":1e999,"value":null}\n',
    b'{"ok":true,"body":99999999999999,"value":null}\n',
    b'{"ok":true,"body":0,"value":NaN}\n',
    b'{"ok":true,"body":0,"value":-Infinity}\n',
    b'{"ok":true,"body":0,"value":1e999}\n',
    b'{"ok":true,"body":0,"value":' + b"9" * 100_000 + b"}\n",
    b'{"ok":true,"body":0,"value":"\xff\xfe"}\n',
    b"\xff\xfe{\x00}\x00\n",
    b"\x00" * 1000 + b"\n",
    NESTED.encode(),
    b'{"ok":true,"body":0,"value":[' + b"[]," * 600_000 + b"[]]}\n",
    b'{"ok":false,"body":0}\n',
    b'{"ok":false,"body":0,"error":null}\n',
    b'{"ok":false,"body":0,"error":[]}\n',
    b'{"ok":false,"body":0,"error":{"kind":{},"text":[]}}\n',
    b'{"ok":false,"body":0,"error":{"kind":"no such kind","text":"\\ud800"}}\n',
    b'{"ok":"yes","body":0,"value":null}\n',
    b'{"ok":true,"piece":true,"body":0,"value":null}\n',
    b"Welcome to this board\n",
)
"""Lines in the place of an answer."""

Tamper = Callable[[int, dict[str, Any], bytes], bytes]
"""Takes which answer it is (0 is the greeting), its header and body; returns what is to come instead."""


def frame(header: dict[str, Any], body: bytes = b"") -> bytes:
    return json.dumps(header).encode() + b"\n" + body


class TamperedStream:
    """The helper's stream, with other answers; all else is the stream's own."""

    def __init__(self, stream: Any, tamper: Tamper) -> None:
        self._stream = stream
        self._tamper = tamper
        self._rest = bytearray()
        self._out = bytearray()
        self._count = 0

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def read(self, count: int, *, timeout_s: float = 0.0) -> bytes:
        while not self._out:
            header, end = self._header(timeout_s)
            if header is None:
                return b""
            while len(self._rest) < end + header["body"]:
                self._rest += self._stream.read(262_144, timeout_s=timeout_s)
            body = bytes(self._rest[end : end + header["body"]])
            del self._rest[: end + header["body"]]
            self._out += self._tamper(self._count, header, body)
            self._count += 1
        data = bytes(self._out[:count])
        del self._out[:count]
        return data

    def _header(self, timeout_s: float) -> tuple[dict[str, Any] | None, int]:
        while (end := self._rest.find(b"\n") + 1) == 0:
            data = self._stream.read(262_144, timeout_s=timeout_s)
            if not data:
                return None, 0
            self._rest += data
        return json.loads(self._rest[:end]), end


class TamperedConnection(LocalConnection):
    """This computer, whose helper's answers are altered."""

    def __init__(self, target: Any, tamper: Tamper) -> None:
        super().__init__(target)
        self._tamper = tamper

    def open(self, command: str) -> Any:
        return TamperedStream(super().open(command), self._tamper)


def at(number: int, chance: random.Random) -> Tamper:
    """Return what alters one answer: the greeting is 0, the answer to the first question 1."""

    def tamper(index: int, header: dict[str, Any], body: bytes) -> bytes:
        if index != number:
            return frame(header, body)
        if "value" in header:
            header = {**header, "value": altered(header["value"], chance)}
        else:
            header = {**header, "error": altered(header["error"], chance)}
        return frame(header, body)

    return tamper
