"""The operator's end of the round trips."""

from __future__ import annotations

import dataclasses
import secrets
import socket
import time
from typing import Any

from cosmos_cli.fleet.datagrams import DatagramServer, bound_socket
from cosmos_cli.fleet.onboard.round_trips import ANSWER, ASK, NONCE_BYTES, UNASKED, Datagram


class Responder(DatagramServer):
    """
    Answers machines that know its nonce; use it as a context manager.

    Args:
        port: UDP port to listen at, as the host of a run would; one that is free when it is 0 or taken.
    """

    def __init__(self, port: int = 0) -> None:
        self.nonce = secrets.token_bytes(NONCE_BYTES)
        self.ignored = 0
        """Datagrams of somebody else."""
        super().__init__(self._reply, port=port)
        self._other = bound_socket(family=self.family)

    def close(self) -> None:
        """Hear no more; harmless when repeated."""
        super().close()
        self._other.close()

    def _reply(self, own: socket.socket, data: bytes, where: Any) -> None:
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
