"""The operator's end of the round trips: one socket and one thread for all machines."""

from __future__ import annotations

import contextlib
import dataclasses
import secrets
import select
import socket
import threading
import time
from types import TracebackType
from typing import Any, Self

from cosmos_cli.fleet.onboard.round_trips import (
    ANSWER,
    ASK,
    NONCE_BYTES,
    UNASKED,
    Datagram,
)

DATAGRAM_BYTES_MAX = 2048
STOP_TIMEOUT_S = 2.0
WAIT_S = 0.2


class Responder:
    """
    Answers machines that know its nonce; use it as a context manager.

    Args:
        port: UDP port to listen at, as the host of a run would; one that is free when it is 0 or taken.
    """

    def __init__(self, port: int = 0) -> None:
        self.nonce = secrets.token_bytes(NONCE_BYTES)
        self._socket, self.is_port_taken = _listening(port)
        self._other = _bound(self._socket.family, 0)
        self.port: int = self._socket.getsockname()[1]
        self.ignored = 0
        """Datagrams of somebody else."""
        self._is_stopped = threading.Event()
        self._thread = threading.Thread(target=self._work, name="doctor-udp", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._is_stopped.set()
        self._thread.join(STOP_TIMEOUT_S)
        self._socket.close()
        self._other.close()

    def _work(self) -> None:
        while not self._is_stopped.is_set():
            if not select.select([self._socket], [], [], WAIT_S)[0]:
                continue
            # An error is that of an earlier answer, whose asker is gone: the next datagram is another's.
            with contextlib.suppress(OSError):
                data, where = self._socket.recvfrom(DATAGRAM_BYTES_MAX)
                self._answer(data, where)

    def _answer(self, data: bytes, where: Any) -> None:
        received_s = time.clock_gettime(time.CLOCK_REALTIME)
        asked = Datagram.decode(data)
        if asked is None or asked.kind != ASK or asked.nonce != self.nonce:
            self.ignored += 1
            return
        answer = dataclasses.replace(
            asked,
            kind=ANSWER,
            received_s=received_s,
            answered_s=time.clock_gettime(time.CLOCK_REALTIME),
        )
        self._socket.sendto(answer.encode(), where)
        if asked.port:
            unasked = dataclasses.replace(asked, kind=UNASKED)
            self._other.sendto(unasked.encode(), (where[0], asked.port, *where[2:]))


def _listening(port: int) -> tuple[socket.socket, bool]:
    """Return a socket at *port*, or at a free one when that is taken, and whether it was."""
    families = (socket.AF_INET6, socket.AF_INET) if socket.has_ipv6 else (socket.AF_INET,)
    for wanted in dict.fromkeys((port, 0)):
        for family in families:
            with contextlib.suppress(OSError):
                return _bound(family, wanted), wanted != port
    return _bound(socket.AF_INET, 0), port != 0


def _bound(family: int, port: int) -> socket.socket:
    """Return a UDP socket on all addresses, of both families where there are two."""
    handle = socket.socket(family, socket.SOCK_DGRAM)
    try:
        if family == socket.AF_INET6:
            handle.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 0)
        handle.bind(("", port))
    except OSError:
        handle.close()
        raise
    return handle
