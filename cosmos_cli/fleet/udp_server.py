"""Datagrams that machines send here to try the way: one socket and one thread for all of them."""

from __future__ import annotations

import contextlib
import selectors
import socket
import threading
from collections.abc import Callable
from typing import Any, Self

DATAGRAM_BYTES_MAX = 2048
END_TIMEOUT_S = 5.0

Answer = Callable[[socket.socket, bytes, Any], None]
"""Takes the socket, a datagram, and where it came from; may raise OSError."""


class DatagramServer:
    """
    Hears datagrams from its making on; use it as a context manager, or close it.

    Args:
        answer: Called in the thread with whatever comes.
        address: Where to listen; empty for all addresses of this computer, of both families.
        port: Where to listen; one that is free when it is 0 or taken.
    """

    def __init__(self, answer: Answer, *, address: str = "", port: int = 0) -> None:
        self._answer = answer
        self._socket, self.is_port_taken = _listening(address, port)
        self._socket.setblocking(False)
        self.family: int = self._socket.family
        self.port: int = self._socket.getsockname()[1]
        self._stop_reader, self._stop_writer = socket.socketpair()
        self._thread = threading.Thread(target=self._serve, name="datagrams", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Hear no more; harmless when repeated."""
        self._stop_writer.close()
        self._thread.join(END_TIMEOUT_S)
        self._socket.close()
        self._stop_reader.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _serve(self) -> None:
        with selectors.DefaultSelector() as selector:
            selector.register(self._socket, selectors.EVENT_READ)
            selector.register(self._stop_reader, selectors.EVENT_READ)
            while all(key.fileobj is not self._stop_reader for key, _ in selector.select()):
                # An error is that of an earlier answer, whose asker is gone: the next is another's.
                with contextlib.suppress(OSError):
                    self._answer(self._socket, *self._socket.recvfrom(DATAGRAM_BYTES_MAX))


def bound_socket(address: str = "", port: int = 0, *, family: int) -> socket.socket:
    """
    Return a UDP socket; without an address, one of IPv6 is on all addresses of both families.

    Raises:
        OSError: The port is taken, or there is no such family or address here.
    """
    handle = socket.socket(family, socket.SOCK_DGRAM)
    try:
        if family == socket.AF_INET6:
            handle.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 0)
        handle.bind((address, port))
    except OSError:
        handle.close()
        raise
    return handle


def _listening(address: str, port: int) -> tuple[socket.socket, bool]:
    """Return a socket at *port*, or at a free one when that is taken, and whether it was."""
    families = [socket.AF_INET]
    if socket.has_ipv6 and (":" in address or not address):
        families.insert(0, socket.AF_INET6)
    for wanted in dict.fromkeys((port, 0)):
        for family in families:
            with contextlib.suppress(OSError):
                return bound_socket(address, wanted, family=family), wanted != port
    return bound_socket(address, family=socket.AF_INET), port != 0
