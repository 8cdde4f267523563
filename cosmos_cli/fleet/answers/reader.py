"""
Reads the frames that a helper sends: each one within a deadline as a whole and within a bound on its size.

A machine that drips its answer, sends one without end, or says what no helper says, fails by itself.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from cosmos_cli.fleet.answers import verbs
from cosmos_cli.fleet.answers.parts import error
from cosmos_cli.fleet.answers.shapes import (
    Shape,
    WrongShape,
    anything,
    exactly,
    nothing,
    record,
    whole,
)
from cosmos_cli.fleet.failure import FailureKind, MachineFailure, ended_early
from cosmos_cli.fleet.liveness import BlockingStream
from cosmos_cli.fleet.transfer_limits import Patience, duration_words

READ_BYTES = 262_144
HEADER_BYTES_MAX = 8 * 1024 * 1024
"""Bytes of one line of JSON. The largest that is meant, many contents of files for --diff, is far smaller."""
VALUES_MAX = 500_000
"""Values of one line: each takes some hundred times its bytes here."""
SAID_BYTES_MAX = 60
TALKS_ADVICE = (
    "a shell start-up file there (.bashrc, .profile, .ssh/rc) that prints in sessions that are not interactive"
    " must be silent"
)

_whole = record({"ok": exactly(True), "body": whole(), "value": anything})
_piece = record({"ok": exactly(True), "body": whole(), "value": anything, "piece": exactly(True)})
_refused = record({"ok": exactly(False), "body": whole(), "error": error})


@dataclass(frozen=True, slots=True, kw_only=True)
class ExpectedAnswer:
    """Shape and bounds of an answer."""

    shape: Shape
    """Shape of the answer's value; of one that streams, of the value of each piece."""
    what: str
    """The question, for messages."""
    is_streamed: bool = False
    """Whether it comes in pieces, and an end without a value."""
    body_bytes_max: int = 0


class AnswerReader:
    """
    Cuts a stream into answers.

    Args:
        source: The helper's standard output.
        now_s: A monotonic clock.
    """

    def __init__(
        self, source: BlockingStream, *, now_s: Callable[[], float] = time.monotonic
    ) -> None:
        self._source = source
        self._now_s = now_s
        self._buffer = bytearray()

    @property
    def has_rest(self) -> bool:
        """Whether bytes have come that belong to no answer."""
        return bool(self._buffer)

    def read(self, expected: ExpectedAnswer, *, timeout_s: float) -> tuple[dict[str, Any], bytes]:
        """
        Return the next answer, which may be a refusal: header and body.

        Args:
            expected: What it may be.
            timeout_s: For all of it, and for what came as much more as `Patience` grants.

        Raises:
            MachineFailure: TIMEOUT, or the end of the stream, or DATA: it is too large or cannot be meant.
                Whatever comes next belongs to no question.
        """
        patience = Patience(timeout_s, now_s=self._now_s)
        line = self._line(patience, timeout_s)
        header = _checked(line, expected)
        size = header["body"]
        if size > expected.body_bytes_max:
            raise verbs.malformed(
                expected.what,
                f"expected at most {expected.body_bytes_max} bytes after it, got {size}",
            )
        while len(self._buffer) < size:
            self._more(patience, timeout_s)
        body = bytes(self._buffer[:size])
        del self._buffer[:size]
        return header, body

    def _line(self, patience: Patience, timeout_s: float) -> bytes:
        end = self._buffer.find(b"\n")
        while end < 0:
            searched = len(self._buffer)
            if searched > HEADER_BYTES_MAX:
                raise MachineFailure(
                    FailureKind.DATA,
                    f"expected an answer of at most {HEADER_BYTES_MAX} bytes, got one without an end:"
                    f" {_said(bytes(self._buffer[: SAID_BYTES_MAX + 1]))}",
                    TALKS_ADVICE,
                )
            self._more(patience, timeout_s)
            end = self._buffer.find(b"\n", searched)
        line = bytes(self._buffer[:end])
        del self._buffer[: end + 1]
        return line

    def _more(self, patience: Patience, timeout_s: float) -> None:
        left_s = patience.left_s
        if left_s <= 0:
            raise _too_late(patience, timeout_s)
        try:
            data = self._source.read_some(READ_BYTES, timeout_s=left_s)
        except MachineFailure as failure:
            if failure.kind is not FailureKind.TIMEOUT:
                raise
            raise _too_late(patience, timeout_s) from None
        if not data:
            end = self._source.ending()
            raise ended_early(end.errors, end.exit_status)
        patience.moved(len(data))
        self._buffer += data


def _too_late(patience: Patience, timeout_s: float) -> MachineFailure:
    if not patience.moved_bytes:
        return MachineFailure(FailureKind.TIMEOUT, f"no answer in {duration_words(timeout_s)}")
    return MachineFailure(
        FailureKind.TIMEOUT,
        f"its answer was not whole after {duration_words(patience.spent_s)}: only"
        f" {patience.moved_bytes} bytes of it had come",
        "is its link or its processor overloaded?",
    )


def _checked(line: bytes, expected: ExpectedAnswer) -> dict[str, Any]:
    """Return a header that is what it should be, its value included."""
    header = _parsed(line)
    if not isinstance(header, dict) or not {"ok", "body"} <= header.keys():
        raise _talk(line)
    try:
        if header["ok"] is not True:
            _refused(header, "")
            return header
        is_piece = header.get("piece") is True
        (_piece if expected.is_streamed and is_piece else _whole)(header, "")
        shape = nothing if expected.is_streamed and not is_piece else expected.shape
        shape(header["value"], "")
    except WrongShape as fault:
        raise verbs.malformed(expected.what, str(fault)) from None
    return header


def _parsed(line: bytes) -> Any:
    if line.count(b",") + line.count(b"[") + line.count(b"{") > VALUES_MAX:
        raise MachineFailure(
            FailureKind.DATA, f"expected an answer of at most {VALUES_MAX} values, got more"
        )
    try:
        return json.loads(line.decode("utf-8"), parse_constant=_finite, parse_float=_finite)
    except (ValueError, RecursionError):
        raise _talk(line) from None


def _finite(digits: str) -> float:
    value = float(digits)
    if not math.isfinite(value):
        raise ValueError(digits)
    return value


def _talk(line: bytes) -> MachineFailure:
    return MachineFailure(FailureKind.DATA, f"expected an answer, got {_said(line)}", TALKS_ADVICE)


def _said(line: bytes) -> str:
    said = repr(line[:SAID_BYTES_MAX].decode(errors="replace"))
    return said + ("..." if len(line) > SAID_BYTES_MAX else "")
