"""
UDP between a machine and the operator, as a run would need it: a machine asks, the operator answers.

Also the datagram itself, for both sides. The operator answers from the port that was asked, and once more
from another port to another socket, which only a machine without a firewall lets in.
"""

from __future__ import annotations

import contextlib
import socket
import statistics
import struct
import time
from dataclasses import dataclass

from cosmos_cli.onboard.request_loop import PlainValue, VerbRequest, verb

ASK, ANSWER, UNASKED = 1, 2, 3
NONCE_BYTES = 16
PERIOD_S = 0.01
ANSWER_TIMEOUT_S = 0.25
SILENCE_COUNT_MAX = 6
"""Unanswered in a row, from the beginning: nobody answers at all."""
UNASKED_COUNT = 5
UNASKED_TIMEOUT_S = 0.3
_LAYOUT = struct.Struct("!4s16sBHHddd")
_MARK = b"CSMd"


@dataclass(frozen=True, slots=True, kw_only=True)
class Datagram:
    """One datagram; all have the same size, so that nobody can make much of little."""

    nonce: bytes
    """Of one command: others are not answered."""
    kind: int
    sequence: int
    port: int = 0
    """Further port on which the asker listens; 0 for none."""
    asked_s: float = 0.0
    """The asker's wall clock when it asked; the others are the operator's."""
    received_s: float = 0.0
    answered_s: float = 0.0

    def encode(self) -> bytes:
        """Return the bytes."""
        times = (self.asked_s, self.received_s, self.answered_s)
        return _LAYOUT.pack(_MARK, self.nonce, self.kind, self.sequence, self.port, *times)

    @classmethod
    def decode(cls, data: bytes) -> Datagram | None:
        """Return what the bytes mean; None when they are none of ours."""
        if len(data) != _LAYOUT.size or not data.startswith(_MARK):
            return None
        _, nonce, kind, sequence, port, asked_s, received_s, answered_s = _LAYOUT.unpack(data)
        return cls(
            nonce=nonce,
            kind=kind,
            sequence=sequence,
            port=port,
            asked_s=asked_s,
            received_s=received_s,
            answered_s=answered_s,
        )


@verb("round_trips")
def round_trips_to(request: VerbRequest) -> dict[str, PlainValue]:
    """Ask the operator's responder ("address", "port", "nonce_hex") "count" times, and tell what came back."""
    asked = request.arguments
    nonce = bytes.fromhex(asked["nonce_hex"])
    return round_trips(asked["address"], int(asked["port"]), nonce, int(asked["count"]))


def round_trips(address: str, port: int, nonce: bytes, count: int) -> dict[str, PlainValue]:
    """
    Ask *count* times and tell what came back.

    Returns:
        "sent", "answered", "min_ms", "p50_ms", "max_ms" (null without an answer), "unasked": how many
        came in that this machine had not asked for, "clock_offset_s": this machine's wall clock less
        the operator's with "clock_uncertainty_s"; "error" when nothing could be sent.
    """
    told: dict[str, PlainValue] = {"address": address, "port": port, "sent": 0, "answered": 0}
    try:
        family, _, _, _, where = socket.getaddrinfo(address, port, type=socket.SOCK_DGRAM)[0]
        with (
            socket.socket(family, socket.SOCK_DGRAM) as asker,
            socket.socket(family, socket.SOCK_DGRAM) as listener,
        ):
            asker.connect(where)
            listener.bind(("", 0))
            _exchange(told, asker, listener, nonce, count)
    except OSError as error:
        told["error"] = error.strerror or str(error)
    return told


def _exchange(
    told: dict[str, PlainValue],
    asker: socket.socket,
    listener: socket.socket,
    nonce: bytes,
    count: int,
) -> None:
    trips_s: list[float] = []
    offsets_s: list[tuple[float, float]] = []
    own_port = listener.getsockname()[1]
    start_s = time.monotonic()
    for sequence in range(count):
        time.sleep(max(0.0, start_s + sequence * PERIOD_S - time.monotonic()))
        port = own_port if sequence < UNASKED_COUNT else 0
        answer, trip_s = _ask(asker, nonce, sequence, port)
        told["sent"] += 1
        if answer is not None:
            trips_s.append(trip_s)
            answered_by_wall_s = answer.asked_s + trip_s
            ahead_s = (
                answer.asked_s - answer.received_s + answered_by_wall_s - answer.answered_s
            ) / 2
            offsets_s.append((trip_s, ahead_s))
        elif not trips_s and sequence + 1 >= SILENCE_COUNT_MAX:
            break
    told |= {
        "answered": len(trips_s),
        "unasked": _count_unasked(listener, nonce) if trips_s else None,
        "min_ms": min(trips_s) * 1e3 if trips_s else None,
        "p50_ms": statistics.median(trips_s) * 1e3 if trips_s else None,
        "max_ms": max(trips_s) * 1e3 if trips_s else None,
    }
    if offsets_s:
        quickest_s, ahead_s = min(offsets_s)
        told["clock_offset_s"], told["clock_uncertainty_s"] = ahead_s, quickest_s / 2


def _ask(
    asker: socket.socket, nonce: bytes, sequence: int, port: int
) -> tuple[Datagram | None, float]:
    """Ask once; also return the time it took, by a clock that nobody sets."""
    wall_s, start_s = time.clock_gettime(time.CLOCK_REALTIME), time.monotonic()
    asked = Datagram(nonce=nonce, kind=ASK, sequence=sequence, port=port, asked_s=wall_s)
    with contextlib.suppress(OSError):  # refused or unreachable: as good as no answer
        asker.send(asked.encode())
        while (left_s := start_s + ANSWER_TIMEOUT_S - time.monotonic()) > 0:
            asker.settimeout(left_s)
            answer = Datagram.decode(asker.recv(2048))
            if answer and (answer.nonce, answer.kind, answer.sequence) == (nonce, ANSWER, sequence):
                return answer, time.monotonic() - start_s
    return None, 0.0


def _count_unasked(listener: socket.socket, nonce: bytes) -> int:
    seen: set[int] = set()
    end_s = time.monotonic() + UNASKED_TIMEOUT_S
    with contextlib.suppress(OSError):
        while len(seen) < UNASKED_COUNT and (left_s := end_s - time.monotonic()) > 0:
            listener.settimeout(left_s)
            came = Datagram.decode(listener.recv(2048))
            if came and (came.nonce, came.kind) == (nonce, UNASKED):
                seen.add(came.sequence)
    return len(seen)
