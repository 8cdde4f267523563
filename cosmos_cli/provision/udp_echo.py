"""
Answers datagrams, so that a machine can see whether UDP between it and this computer works.

Only what carries a nonce that was given out is answered, with no more bytes than came: nobody else can use it.
"""

from __future__ import annotations

import secrets
import socket
from typing import Any

from cosmos_cli.fleet.udp_server import DatagramServer

NONCE_BYTES = 16
PACKET_BYTES_MAX = 256
NONCES_MAX = 10_000


class Echo(DatagramServer):
    """
    An echo for all machines; use it as a context manager.

    Args:
        address: Where to listen; empty for all addresses of this computer.
    """

    def __init__(self, address: str = "") -> None:
        self._nonces: dict[bytes, int] = {}
        super().__init__(self._echo, address=address)

    def question(self, address: str) -> dict[str, Any]:
        """
        Return what a machine is told for one round trip: "udp" of the verb "check_runtime".

        Args:
            address: Of this computer, as the machine reaches it.
        """
        nonce = secrets.token_bytes(NONCE_BYTES)
        if len(self._nonces) >= NONCES_MAX:
            del self._nonces[next(iter(self._nonces))]
        self._nonces[nonce] = 0
        return {"address": address, "port": self.port, "nonce_hex": nonce.hex()}

    def heard(self, question: dict[str, Any]) -> int:
        """Return how many datagrams of a question came: more than none means that only the answers are lost."""
        return self._nonces.get(bytes.fromhex(question["nonce_hex"]), 0)

    def _echo(self, link: socket.socket, packet: bytes, sender: Any) -> None:
        nonce = packet[:NONCE_BYTES]
        if nonce in self._nonces and len(packet) <= PACKET_BYTES_MAX:
            self._nonces[nonce] += 1
            link.sendto(packet, sender)
