"""
Frames between host and workers: length-prefixed MessagePack on a socket pair. Pure.

Every frame is a list that begins with its kind. Plug-ins' messages are in it as the bytes that would
travel between machines: what cannot be sent there cannot be sent here.
"""

from __future__ import annotations

from collections.abc import Iterator
from struct import Struct
from typing import Any, Final, NamedTuple

import msgpack

from madns_runtime.errors import PeerError

# Host to worker.
SETUP: Final = 1
"""[SETUP, [[index, initial data], ...]]"""
TICK: Final = 2
"""[TICK, number, [[index, body], ...]]: hand out the messages, then step every agent."""
DRAIN: Final = 3
"""[DRAIN, simulated time, [[index, body], ...]]: that is over; hand out the last messages."""
FINISH: Final = 4
"""[FINISH, simulated time]: that is over, also where no message was left; ask every agent for its summary."""
STOP: Final = 5
"""[STOP, reason]: close the records and end; the reason of an emergency, or None."""
RETURN: Final = 6
"""[RETURN, tick, [[index, incarnation, initial data], ...]]: make lost agents anew; *tick* is the next."""
FAULT: Final = 7
"""[FAULT, simulated time, values of an AgentFault, [index, ...]]: begin or end a fault of agents, of which there may be
none: the time is every worker's."""

# Worker to host.
READY: Final = 11
"""[READY]: the agents' half is loaded."""
DONE: Final = 12
"""[DONE, [[index, service, body], ...], [[index, newest values of columns], ...], [loss, ...]]: an order is carried
out, and this was sent; now and then with the values of the worker's agents. Losses, see `Loss`, only if there are."""
SUMMARIES: Final = 13
"""[SUMMARIES, [], [], [loss, ...], [[index, summary, deadlines broken, counts of messages between agents, newest
values], ...]]"""
FAILED: Final = 14
"""[FAILED, index, reason]"""
CLOSED: Final = 15
"""[CLOSED, index, record counts]"""

FRAME_BYTES_MAX: Final = 1 << 30
HEAD: Final = Struct("<I")

# Positions: what a worker is doing, in memory that it shares with the host.
(
    IDLE, LOADING, SETTING_UP, RECEIVING, STEPPING, FINISHING, CLOSING, HEARING, REFUSED, ACTING, ABANDONING,
) = range(11)  # fmt: skip
METHODS: Final = (
    "",
    "",
    "setup",
    "receive",
    "step",
    "finish",
    "",
    "hear",
    "refused",
    "begin_action",
    "abandon",
)
"""The plug-in's method at each position; empty where the framework is at work."""
POSITIONS: Final = 16


class Sent(NamedTuple):
    """One message of an agent's half."""

    agent: int
    service: int
    body: bytes


class Loss(NamedTuple):
    """An agent that its worker runs no more, while the others go on."""

    agent: int
    reason: str
    records: dict[str, Any]
    """Counts of its records, and what found no room between it and its devices."""
    unheard: int
    """Messages that came for it in the same order and were not handed in."""
    deadlines_broken: int
    peer_messages: dict[str, int]


LOSSES: Final = 3
"""Place of the losses in a DONE or SUMMARIES frame, which ends before it if there are none."""


def encode_frame(*parts: Any) -> bytes:
    """
    Return a frame's bytes.

    Raises:
        PeerError: It is longer than FRAME_BYTES_MAX.
    """
    body: bytes = msgpack.packb(parts)
    if len(body) > FRAME_BYTES_MAX:
        raise PeerError(f"a frame of {len(body)} bytes: expected at most {FRAME_BYTES_MAX}")
    return HEAD.pack(len(body)) + body


class FrameReader:
    """Cuts a stream of bytes into frames."""

    __slots__ = ("_data",)

    def __init__(self) -> None:
        self._data = bytearray()

    def feed(self, data: bytes) -> Iterator[list[Any]]:
        """Take *data* and yield the frames that are now whole."""
        held = self._data
        held += data
        while len(held) >= HEAD.size:
            end = HEAD.size + HEAD.unpack_from(held)[0]
            if end > FRAME_BYTES_MAX + HEAD.size:
                raise PeerError(f"a frame of {end} bytes is announced: something else has written")
            if len(held) < end:
                return
            body = bytes(held[HEAD.size : end])
            del held[:end]
            yield msgpack.unpackb(body)
