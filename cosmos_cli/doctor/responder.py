"""The operator's end of the round trips."""

from __future__ import annotations

import dataclasses
import secrets
import socket
import time
from types import TracebackType
from typing import Any, Self

from cosmos_cli.fleet.datagrams import DatagramServer, bound_socket
from cosmos_cli.fleet.onboard.round_trips import ANSWER, ASK, NONCE_BYTES, UNASKED, Datagram


class Responder:
    """
    Answers machines that know its nonce, from its making on; use it as a context manager.

    Args:
        port: UDP port to listen at, as the host of a run would; one that is free when it is 0 or taken.
    """

    def __init__(self, port: int = 0) -> None:
        self.nonce = secrets.token_bytes(NONCE_BYTES)
        self.ignored = 0
        """Datagrams of somebody else."""
        self._server = DatagramServer(self._answer, port=port)
        self._other = bound_socket(family=self._server.family)

    @property
    def port(self) -> int:
        """Where it listens."""
        return self._server.port

    @property
    def is_port_taken(self) -> bool:
        """Whether the wanted port was somebody else's."""
        return self._server.is_port_taken

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._server.close()
        self._other.close()

    def _answer(self, own: socket.socket, data: bytes, where: Any) -> None:
        received_s = time.clock_gettime(time.CLOCK_REALTIME)
        asked = Datagram.decode(data)
        if asked is None or asked.kind != ASK or asked.nonce != self.nonce:
            self.ignored += 1
            return
        answered_s = time.clock_gettime(time.CLOCK_REALTIME)
        answer = dataclasses.replace(
            asked, kind=ANSWER, received_s=received_s, answered_s=answered_s
        )
        own.sendto(answer.encode(), where)
        if asked.port:
            unasked = dataclasses.replace(asked, kind=UNASKED)
            self._other.sendto(unasked.encode(), (where[0], asked.port, *where[2:]))
