"""Ways of a bare star to send and to echo: UDP, TCP and ZeroMQ, each without anything of ours."""

from __future__ import annotations

import contextlib
import select
import socket
import struct
import time
from collections.abc import Callable, Iterator
from typing import NamedTuple, Protocol

LENGTH = struct.Struct("<I")


class Client(Protocol):
    """An agent process's end."""

    def wait(self, seconds: float) -> bool:
        """Wait for so long at most; return whether something came."""

    def send(self, message: bytes, /) -> object:
        """Send a message."""

    def receive(self) -> bytes | None:
        """Return the next message; None if there is none."""


class UdpClient:
    """A connected UDP socket."""

    def __init__(self, address: tuple[str, int]) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.connect(address)
        self._socket.setblocking(False)
        self.send = self._socket.send

    def wait(self, seconds: float) -> bool:
        """Wait for so long at most; return whether something came."""
        return bool(select.select([self._socket], [], [], seconds)[0])

    def receive(self) -> bytes | None:
        """Return the next datagram; None if there is none."""
        try:
            return self._socket.recv(2048)
        except BlockingIOError:
            return None


class TcpClient:
    """A connection without Nagle's delay; each message has its length before it."""

    def __init__(self, address: tuple[str, int]) -> None:
        self._socket = socket.create_connection(address)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._socket.setblocking(False)
        self._buffer = bytearray()

    def wait(self, seconds: float) -> bool:
        """Wait for so long at most; return whether something came."""
        return bool(select.select([self._socket], [], [], seconds)[0])

    def send(self, message: bytes) -> None:
        """Send a message; one that finds the buffer full is not sent."""
        try:
            self._socket.send(LENGTH.pack(len(message)) + message)
        except BlockingIOError:
            return

    def receive(self) -> bytes | None:
        """Return the next message; None if there is none."""
        with contextlib.suppress(BlockingIOError):
            self._buffer += self._socket.recv(65536)
        return next(iter(messages_in(self._buffer)), None)


class ZeroMqClient:
    """A DEALER."""

    def __init__(self, address: tuple[str, int]) -> None:
        import zmq  # noqa: PLC0415 - for this rival alone

        self._socket = zmq.Context().socket(zmq.DEALER)
        self._socket.connect(f"tcp://{address[0]}:{address[1]}")
        self._fd = self._socket.getsockopt(zmq.FD)
        self._no_wait, self._events, self._is_in = zmq.NOBLOCK, zmq.EVENTS, zmq.POLLIN

    def wait(self, seconds: float) -> bool:
        """Wait for so long at most; return whether something may have come."""
        # Its descriptor tells of changes only, and what a send has seen of them it tells no more.
        if self._socket.getsockopt(self._events) & self._is_in:
            return True
        return bool(select.select([self._fd], [], [], seconds)[0])

    def send(self, message: bytes) -> None:
        """Send a message."""
        self._socket.send(message, self._no_wait)

    def receive(self) -> bytes | None:
        """Return the next message; None if there is none."""
        if self._socket.getsockopt(self._events) & self._is_in:
            return self._socket.recv(self._no_wait)
        return None


def messages_in(buffer: bytearray) -> Iterator[bytes]:
    """Take whole messages from the front of a buffer."""
    while len(buffer) >= LENGTH.size:
        end = LENGTH.size + LENGTH.unpack_from(buffer)[0]
        if len(buffer) < end:
            return
        message = bytes(buffer[LENGTH.size : end])
        del buffer[:end]
        yield message


def echo_udp(server: socket.socket, end_s: float) -> None:
    """Return every datagram to its sender."""
    server.settimeout(0.2)
    while time.monotonic() < end_s:
        try:
            data, address = server.recvfrom(2048)
        except TimeoutError:
            continue
        server.sendto(data, address)


def echo_tcp(server: socket.socket, end_s: float) -> None:
    """Return every message on its connection."""
    poller, connections = select.epoll(), {}
    poller.register(server, select.EPOLLIN)
    while time.monotonic() < end_s:
        for fd, _ in poller.poll(0.2):
            if fd == server.fileno():
                connection, _ = server.accept()
                connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                connection.setblocking(False)
                connections[connection.fileno()] = connection, bytearray()
                poller.register(connection, select.EPOLLIN)
                continue
            connection, buffer = connections[fd]
            data = connection.recv(65536)
            if not data:
                poller.unregister(fd)
            buffer += data
            for message in messages_in(buffer):
                try:
                    connection.send(LENGTH.pack(len(message)) + message)
                except (BlockingIOError, ConnectionError):
                    continue


def echo_zeromq(server: socket.socket, end_s: float) -> None:
    """Return every message to its DEALER, from a ROUTER in the server's place."""
    import zmq  # noqa: PLC0415 - for this rival alone

    host, port = server.getsockname()
    server.close()
    router = zmq.Context().socket(zmq.ROUTER)
    router.setsockopt(zmq.RCVTIMEO, 200)
    router.bind(f"tcp://{host}:{port}")
    while time.monotonic() < end_s:
        try:
            router.send_multipart(router.recv_multipart())
        except zmq.Again:
            continue


class Transport(NamedTuple):
    """A way to send."""

    kind: socket.SocketKind
    client: Callable[[tuple[str, int]], Client]
    echo: Callable[[socket.socket, float], None]


TRANSPORTS = {
    "udp": Transport(socket.SOCK_DGRAM, UdpClient, echo_udp),
    "tcp": Transport(socket.SOCK_STREAM, TcpClient, echo_tcp),
    "zeromq": Transport(socket.SOCK_STREAM, ZeroMqClient, echo_zeromq),
}
