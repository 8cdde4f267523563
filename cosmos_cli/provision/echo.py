"""
Answers datagrams, so that a machine can see whether UDP between it and this computer works.

One socket and one thread for all machines. Only what carries a nonce that was given out is answered, with
no more bytes than came: nobody else can use it.
"""

from __future__ import annotations

import secrets
import selectors
import socket
import threading
from types import TracebackType
from typing import Any, Self

NONCE_BYTES = 16
PACKET_BYTES_MAX = 256
NONCES_MAX = 10_000
END_TIMEOUT_S = 5.0


class Echo:
    """
    An echo of datagrams; use it as a context manager.

    Args:
        address: Where to listen; the default hears IPv4 on every address of this computer.
        port: Where to listen; 0 takes a free one.
    """

    def __init__(self, address: str = "0.0.0.0", port: int = 0) -> None:
        family = socket.AF_INET6 if ":" in address else socket.AF_INET
        self._socket = socket.socket(family, socket.SOCK_DGRAM)
        self._socket.bind((address, port))
        self._socket.setblocking(False)
        self.port: int = self._socket.getsockname()[1]
        self._nonces: dict[bytes, int] = {}
        self._stop_reader, self._stop_writer = socket.socketpair()
        self._thread = threading.Thread(target=self._serve, name="echo", daemon=True)
        self._thread.start()

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

    def close(self) -> None:
        """Stop answering; harmless when repeated."""
        self._stop_writer.close()
        self._thread.join(END_TIMEOUT_S)
        self._socket.close()
        self._stop_reader.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    def _serve(self) -> None:
        with selectors.DefaultSelector() as selector:
            selector.register(self._socket, selectors.EVENT_READ)
            selector.register(self._stop_reader, selectors.EVENT_READ)
            while True:
                ready = {key.fileobj for key, _ in selector.select()}
                if self._stop_reader in ready:
                    return
                self._answer()

    def _answer(self) -> None:
        try:
            packet, sender = self._socket.recvfrom(PACKET_BYTES_MAX)
        except OSError:  # an earlier answer could not be delivered
            return
        nonce = packet[:NONCE_BYTES]
        if nonce not in self._nonces:
            return
        self._nonces[nonce] += 1
        try:
            self._socket.sendto(packet, sender)
        except OSError:
            return  # the machine asks again, and says so when nothing comes
