"""
Words between an agent's process and a device's, over a socket pair that keeps datagrams apart.

Nobody waits: who finds the other's buffer full keeps the newest for later, or counts what is lost.
"""

from __future__ import annotations

import socket
from collections.abc import Iterator, Mapping
from typing import Any, Final

import msgpack

from madns_runtime.errors import MachineError

BYTES_MAX: Final = 65_536
BUFFER_BYTES: Final = 262_144
MAP_HEAD_BYTES: Final = 4
"""By which the head of a mapping of many entries is longer than that of an empty one."""
DATAGRAMS_MAX: Final = 4096
"""Of one look: more wait for the next, so that a flood holds nobody."""

WRITE, TIME, FRAME, FAULT, OWNER_GONE, END = "write", "time", "frame", "fault", "owner", "end"
ERROR, ANSWER, PLAY = "error", "answer", "play"
"""First elements of messages: [WRITE, channel, value, due_s]; [PLAY, channel, from_s, points]: simulated
times, see `profiles.pack_points`; [TIME]: the page tells the time anew; [FRAME, channel, number, taken_s,
bytes]; from the manager [FAULT, device, action, value] and to it the same of one that came from an agent;
from an agent [FAULT, number, action, value] and to it [ANSWER, number, refusal]; [OWNER_GONE]; [END, reason];
[ERROR, device, what its driver raised]."""


def make_pair() -> tuple[socket.socket, socket.socket]:
    """
    Return two connected sockets that keep datagrams apart, and never wait.

    Raises:
        MachineError: The machine gives this process no more of them.
    """
    try:
        pair = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    except OSError as error:
        raise MachineError(
            f"no socket for a device: {error.strerror}; `ulimit -Hn` tells how many files a process may have open here,"
            " and each agent that uses a device needs three"
        ) from error
    for end in pair:
        end.setblocking(False)
        end.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, BUFFER_BYTES)
    return pair


def send(end: socket.socket, message: list[Any]) -> bool:
    """Send a message without waiting; False if there was no room, or nobody."""
    try:
        end.send(msgpack.packb(message))
    except (BlockingIOError, ConnectionError, OSError):
        return False
    return True


def in_parts(word: str, told: Mapping[str, Any]) -> Iterator[list[Any]]:
    """Yield messages [word, part of *told*] that hold all of it; each is received whole if no entry alone is too long for that."""
    part: dict[str, Any] = {}
    size_bytes = empty_bytes = len(msgpack.packb([word, part])) + MAP_HEAD_BYTES
    for name, value in told.items():
        entry_bytes = len(msgpack.packb(name)) + len(msgpack.packb(value))
        if part and size_bytes + entry_bytes > BYTES_MAX:
            yield [word, part]
            part, size_bytes = {}, empty_bytes
        part[name] = value
        size_bytes += entry_bytes
    if part:
        yield [word, part]


def receive_all(end: socket.socket) -> Iterator[list[Any]]:
    """Yield the messages that wait, at most DATAGRAMS_MAX; what is none of ours is left out."""
    for _ in range(DATAGRAMS_MAX):
        try:
            data = end.recv(BYTES_MAX)
        except ConnectionResetError:
            continue  # told once, of one that has ended without reading all: what it said before comes behind that
        except OSError:
            return
        if not data:
            return
        try:
            message = msgpack.unpackb(data)
        except ValueError:
            continue
        if isinstance(message, list) and message:
            yield message


def is_over(end: socket.socket) -> bool:
    """Tell whether the other end is gone, and all that it said was received."""
    try:
        return not end.recv(1, socket.MSG_PEEK)
    except (BlockingIOError, ConnectionResetError):
        return False
    except OSError:
        return True
