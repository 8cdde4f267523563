"""Transports over sockets: tcp, unix, udp; never blocking."""

from __future__ import annotations

import contextlib
import errno
import os
import socket
import stat
from collections.abc import Sequence
from time import monotonic
from typing import Any

from madns_runtime.errors import BlamedError
from madns_runtime.simulations.constellation.flight.interface.transport import (
    READ_BYTES,
    RETRY_S,
    StreamTransport,
    Transport,
)
from madns_runtime.simulations.constellation.interface_settings import SOCKET_PATH_BYTES_MAX

DATAGRAM_BYTES_MAX = 65_507
DATAGRAMS_MAX = 256
"""Read at once."""
CONNECT_S = 1.0
"""For one attempt."""
REFUSED_MAX = 16
"""Turned away at once."""
QUEUED_MAX = 1024
"""Packets that wait for somebody to send them to."""


class SocketLink(StreamTransport):
    """
    One connection of a stream socket, in either direction.

    Args:
        name: For people.
        family: Of the address.
        place: The address.
        listens: Whether the software connects to it.
    """

    def __init__(self, name: str, family: int, place: Any, *, listens: bool) -> None:
        super().__init__(name)
        self._family = family
        self._place = place
        self._listens = listens
        self._socket: socket.socket | None = None
        """The connection, or what is to become one."""
        self._listener: socket.socket | None = None
        self._tried_s = -RETRY_S
        if listens:
            self.counts["peers_refused"] = 0  # who connected while another was there

    @property
    def awaited(self) -> str:
        """Return what shows that the software is there, in words."""
        if self._listens:
            return f"it to connect to {self.address}"
        return f"it to take a connection at {self.address}"

    def open(self) -> None:
        """
        Listen, or have the address ready.

        Raises:
            BlamedError: The address cannot be listened at.
        """
        self.address = _shown(self._place)
        if self._family == socket.AF_UNIX and len(os.fsencode(self._place)) > SOCKET_PATH_BYTES_MAX:
            raise BlamedError(
                f"{self.name}: expected a path of at most {SOCKET_PATH_BYTES_MAX} bytes, got "
                f"{len(os.fsencode(self._place))}; an absolute one such as /tmp/NAME is shorter"
            )
        if not self._listens:
            return
        with contextlib.ExitStack() as unless_listening:
            try:
                listener = unless_listening.enter_context(
                    socket.socket(self._family, socket.SOCK_STREAM)
                )
                listener.setblocking(False)
                if self._family == socket.AF_UNIX:
                    _remove_socket(self._place, self.name)
                else:
                    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                listener.bind(self._place)
                listener.listen(1)
            except OSError as error:
                raise BlamedError(f"{self.name}: cannot be listened at: {error}") from error
            unless_listening.pop_all()
        self._listener = listener
        self.address = _shown(listener.getsockname())

    def push(self) -> None:
        """Connect, and send what waits; who comes second is turned away at once, and counted."""
        super().push()
        if self._listener is None or not self.is_ready:
            return
        for _ in range(REFUSED_MAX):
            try:
                self._listener.accept()[0].close()
            except OSError:  # nobody
                return
            self.counts["peers_refused"] += 1

    def connect(self) -> None:
        """Accept, or try to connect again."""
        if self._listener is not None:
            with contextlib.suppress(OSError):
                self._begin(self._listener.accept()[0])
        elif not self._listens:
            self._try_to_connect()

    def _try_to_connect(self) -> None:
        if self._socket is None:
            if monotonic() - self._tried_s < RETRY_S:
                return
            self._tried_s = monotonic()
            self._socket = socket.socket(self._family, socket.SOCK_STREAM)
            self._socket.setblocking(False)
            try:
                code = self._socket.connect_ex(self._place)
            except (OSError, OverflowError) as error:  # no address at all, such as too long a path
                raise BlamedError(f"{self.name}: cannot be reached: {error}") from error
        else:
            code = self._socket.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR)
        peer = _peer_of(self._socket) if code == 0 else None
        # Where nobody listens, the kernel may connect a port of its choice with itself, and so keep the software from it.
        is_itself = peer is not None and peer == self._socket.getsockname()
        if peer is not None and not is_itself:
            self._begin(self._socket)
        elif (
            is_itself
            or code not in (0, errno.EINPROGRESS)
            or monotonic() - self._tried_s > CONNECT_S
        ):
            self._socket.close()
            self._socket = None

    def _begin(self, connection: socket.socket) -> None:
        self._socket = connection
        connection.setblocking(False)
        if self._family != socket.AF_UNIX:
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.use(connection.fileno(), connection.fileno())

    def close_input(self) -> None:
        """End this direction alone."""
        self._waiting.clear()
        self._is_over = True
        if self._socket is not None:
            with contextlib.suppress(OSError):
                self._socket.shutdown(socket.SHUT_WR)

    def close(self) -> None:
        """Close the connection, and listen no more."""
        self._in = self._out = -1
        super().close()
        for one in (self._socket, self._listener):
            if one is not None:
                one.close()
        if self._listener is not None and self._family == socket.AF_UNIX:
            with contextlib.suppress(OSError):
                os.unlink(self._place)
        self._socket = self._listener = None


class UdpLink(Transport):
    """
    Datagrams, one for each packet.

    Args:
        name: For people.
        local: Address to receive at.
        remote: Address to send to; None for that of the first datagram.
        family: Of both.
    """

    may_lose = True

    def __init__(self, name: str, local: Any, remote: Any, *, family: int) -> None:
        super().__init__(name)
        self._local = local
        self._remote = remote
        self._family = family
        self._socket: socket.socket | None = None
        self._queued: list[bytes] = []
        self._first: list[bytes] = []
        self.counts |= {"packets_overlong": 0, "packets_unsent": 0, "packets_foreign": 0}

    @property
    def is_ready(self) -> bool:
        """Whether it is known where to send."""
        return self._remote is not None

    @property
    def awaited(self) -> str:
        """Return what shows that the software is there, in words."""
        return f"its first datagram at {self.address}"

    def open(self) -> None:
        """
        Take the local address.

        Raises:
            BlamedError: It cannot be had.
        """
        with contextlib.ExitStack() as unless_bound:
            try:
                one = unless_bound.enter_context(socket.socket(self._family, socket.SOCK_DGRAM))
                one.setblocking(False)
                one.bind(self._local)
            except OSError as error:
                raise BlamedError(f"{self.name}: cannot be received at: {error}") from error
            unless_bound.pop_all()
        self._socket = one
        self.address = _shown(one.getsockname())

    def fds(self) -> tuple[int, ...]:
        """Return the socket's descriptor."""
        return () if self._socket is None else (self._socket.fileno(),)

    def push(self) -> None:
        """Learn where to send from the first datagram."""
        if self.is_ready or self._socket is None:
            return
        with contextlib.suppress(OSError):
            data, self._remote = self._socket.recvfrom(READ_BYTES)
            self._first = [data]
            self.write([])

    def write(self, packets: Sequence[bytes]) -> bool:
        """Send each as a datagram; what the kernel has no room for is lost, as on any network, and counted."""
        if len(self._queued) + len(packets) > QUEUED_MAX:
            return False
        self._queued += packets
        if self._socket is None or not self.is_ready:
            return True
        queued, self._queued = self._queued, []
        for packet in queued:
            if len(packet) > DATAGRAM_BYTES_MAX:
                self.counts["packets_overlong"] += 1
                continue
            try:
                self._socket.sendto(packet, self._remote)
                self.counts["bytes_sent"] += len(packet)
            except OSError:  # nobody listens there, yet or any more: answers tell
                self.counts["packets_unsent"] += 1
        return True

    def may_take(self, packets: Sequence[bytes]) -> bool:
        """Tell whether they are not too many."""
        return len(packets) <= QUEUED_MAX

    def receive(self) -> bytes | None:
        """Return the datagrams that are there, together; those of others are counted."""
        found, self._first = self._first, []
        size = sum(map(len, found))
        while self._socket is not None and len(found) < DATAGRAMS_MAX and size < READ_BYTES:
            try:
                data, sender = self._socket.recvfrom(READ_BYTES)
            except BlockingIOError:
                break
            except OSError:  # what was sent before could not be delivered
                break
            if sender == self._remote:
                found.append(data)
                size += len(data)
            else:
                self.counts["packets_foreign"] += 1
                if self.counts["packets_foreign"] % DATAGRAMS_MAX == 0:
                    break
        return b"".join(found) or None

    def close_input(self) -> None:
        """Send an empty datagram, which says that nothing more will come."""
        if self._socket is not None and self.is_ready:
            with contextlib.suppress(OSError):
                self._socket.sendto(b"", self._remote)

    def close(self) -> None:
        """Give the address back."""
        if self._socket is not None:
            self._socket.close()
        self._socket = None


def resolve(address: str, kind: int, where: str) -> tuple[int, Any]:
    """
    Return the family and the socket address of HOST:PORT.

    Raises:
        BlamedError: It is none, or its host is not known.
    """
    return _resolved(address, kind, where)[0]


def resolve_both(local: str, remote: str) -> tuple[int, Any, Any]:
    """
    Return the family and the socket addresses of both ends of a UDP transport: a name may stand for IPv4 and IPv6.

    Raises:
        BlamedError: One is none, its host is not known, or they have no family in common.
    """
    ours = _resolved(local, socket.SOCK_DGRAM, "transport.local")
    theirs = dict(reversed(_resolved(remote, socket.SOCK_DGRAM, "transport.remote")))
    for family, place in ours:
        if family in theirs:
            return family, place, theirs[family]
    raise BlamedError(
        f"transport.remote: expected an address of the same kind as local, {local}, got {remote}: one is of IPv4 and "
        "the other of IPv6"
    )


def _resolved(address: str, kind: int, where: str) -> list[tuple[int, Any]]:
    host, _, port = address.rpartition(":")
    try:
        found = socket.getaddrinfo(host.strip("[]") or None, int(port), type=kind)
    except (OSError, ValueError, OverflowError) as error:
        raise BlamedError(f"{where}: expected HOST:PORT, got {address!r}: {error}") from error
    return [(int(family), place) for family, _, _, _, place in found]


def _peer_of(one: socket.socket) -> Any:
    """Return the address at the other end of a connection; None if there is none yet."""
    try:
        return one.getpeername()
    except OSError:
        return None


def _remove_socket(path: str, name: str) -> None:
    """
    Remove a socket that an earlier run has left behind; anything else stays, and is in the way.

    Raises:
        BlamedError: Somebody listens there.
    """
    with contextlib.suppress(OSError):
        if not stat.S_ISSOCK(os.stat(path, follow_symlinks=False).st_mode):
            return
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
            probe.setblocking(False)
            code = probe.connect_ex(path)
        if code in (0, errno.EAGAIN, errno.EINPROGRESS):
            raise BlamedError(f"{name}: cannot be listened at: another program listens there")
        os.unlink(path)


def _shown(place: Any) -> str:
    if isinstance(place, str):
        return place
    host, port = place[:2]
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
