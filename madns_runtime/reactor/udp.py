"""UDP sockets that never block, never raise for what a network does, and count it instead."""

from __future__ import annotations

import contextlib
import errno
import os
import socket
import struct
from collections.abc import Iterator

from madns_runtime.errors import MachineError
from madns_runtime.reactor.libc import IS_LINUX

Address = tuple[str, int] | tuple[str, int, int, int]

DATAGRAM_BYTES_MAX = 2048
"""Room for one datagram; a longer one is cut by the kernel, and then fails its seal."""
RECEIVE_BATCH_MAX = 256
SEND_BUFFER_BYTES = 1024 * 1024
SO_MEMINFO = 55
SO_MEMINFO_DROPS = 8
"""Index of the drop counter among the words of SO_MEMINFO (linux/sock_diag.h)."""
SO_SNDBUFFORCE = 32
SO_RCVBUFFORCE = 33
BIND_REFUSALS = {
    errno.EADDRINUSE: "the UDP port is taken; `ss -lunp` shows by whom;"
    " choose another network.port, or 0 for one that is free",
    errno.EADDRNOTAVAIL: "this machine has no such address; set network.address to one that"
    " `ip address` lists, or to 0.0.0.0",
    errno.EACCES: "not permitted; choose a network.port of 1024 or above",
}
"""Why no socket could be bound, and what to do."""


class UdpSocket:
    """
    One UDP socket, bound (a host's) or connected (an agent's); made by `bind` or `connect`.

    Attributes:
        receive_buffer_bytes: What the kernel granted, in the unit that was asked for. Linux itself
            reads back twice that, because it counts its own book-keeping.
        warning: What to do about a receive buffer smaller than asked for; None if it is as asked.
        sent: Datagrams handed to the kernel.
        received: Datagrams received.
        empty_reads: Looks for a datagram when none was waiting.
        send_refused: Datagrams not sent because the kernel's buffers were full.
        peer_refused: ICMP answers that nobody listens at the peer's port.
        failures: Other errors that the kernel reported; `last_failure` is the text of the last.
    """

    def __init__(self, handle: socket.socket, receive_buffer_bytes: int) -> None:
        self._socket = handle
        self._receive = handle.recvfrom
        self._receive_bytes = handle.recv
        self._send_bytes = handle.send
        self._send_to = handle.sendto
        self._is_closed = False
        handle.setblocking(False)
        _ask_buffer(handle, SO_SNDBUFFORCE, socket.SO_SNDBUF, SEND_BUFFER_BYTES)
        self.receive_buffer_bytes = _ask_buffer(
            handle, SO_RCVBUFFORCE, socket.SO_RCVBUF, receive_buffer_bytes
        )
        self.warning = buffer_warning(receive_buffer_bytes, self.receive_buffer_bytes)
        self.sent = 0
        self.received = 0
        self.empty_reads = 0
        self.send_refused = 0
        self.peer_refused = 0
        self.failures = 0
        self.last_failure: str | None = None

    @classmethod
    def bind(cls, address: str, port: int, *, receive_buffer_bytes: int) -> UdpSocket:
        """
        Return a socket that listens on a local address.

        Args:
            address: IPv4 or IPv6 address or name of this machine; 0.0.0.0 or :: for all.
            port: UDP port; 0 lets the kernel choose.
            receive_buffer_bytes: Receive buffer to ask for.

        Raises:
            MachineError: The port is taken, or the address is not this machine's.
        """
        family, where = _resolve(address, port)
        handle = socket.socket(family, socket.SOCK_DGRAM)
        try:
            if family == socket.AF_INET6 and where[0] == "::":
                handle.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 0)
            handle.bind(where)
        except OSError as error:
            handle.close()
            raise MachineError(_bind_refused(address, port, error)) from error
        return cls(handle, receive_buffer_bytes)

    @classmethod
    def connect(cls, address: str, port: int, *, receive_buffer_bytes: int) -> UdpSocket:
        """
        Return a socket that sends to, and hears, one peer only.

        Raises:
            MachineError: The name cannot be resolved or no route leads there.
        """
        family, where = _resolve(address, port)
        handle = socket.socket(family, socket.SOCK_DGRAM)
        try:
            handle.connect(where)
        except OSError as error:
            handle.close()
            raise MachineError(
                f"{_name(address, port)}: cannot be reached from here: {error.strerror};"
                " check network.address in the scenario, cosmos_host_address in the inventory and the routes of this machine"
            ) from error
        return cls(handle, receive_buffer_bytes)

    @property
    def address(self) -> Address:
        """The local address, with the port that the kernel chose."""
        where: Address = self._socket.getsockname()
        return where

    @property
    def dropped_by_kernel(self) -> int | None:
        """Datagrams that the kernel dropped because this socket's buffer was full; None where not known."""
        if not IS_LINUX or self._is_closed:
            return None
        words = (SO_MEMINFO_DROPS + 1) * 4
        try:
            answer = self._socket.getsockopt(socket.SOL_SOCKET, SO_MEMINFO, words)
        except OSError:
            return None
        if len(answer) < words:
            return None
        return int(struct.unpack_from("=I", answer, SO_MEMINFO_DROPS * 4)[0])

    def fileno(self) -> int:
        """Return the descriptor, for `Reactor.add_reader`."""
        return self._socket.fileno()

    def receive(self) -> bytes | None:
        """Return one datagram of a connected socket's peer, None if none is waiting."""
        try:
            datagram = self._receive_bytes(DATAGRAM_BYTES_MAX)
        except OSError as error:
            self._note_receive(error)
            return None
        self.received += 1
        return datagram

    def receive_from(self) -> tuple[bytes, Address] | None:
        """Return one datagram and its sender, None if none is waiting."""
        try:
            datagram = self._receive(DATAGRAM_BYTES_MAX)
        except OSError as error:
            self._note_receive(error)
            return None
        self.received += 1
        return datagram

    def receive_all(self, limit: int = RECEIVE_BATCH_MAX) -> Iterator[tuple[bytes, Address]]:
        """
        Yield datagrams that are waiting, with their senders; at most *limit*, and never wait.

        Each is taken from the kernel when it is asked for, so a reader that stops early loses none.
        """
        receive = self._receive
        for _ in range(limit):
            try:
                datagram = receive(DATAGRAM_BYTES_MAX)
            except BlockingIOError:
                self.empty_reads += 1
                return
            except OSError as error:
                if self._is_closed:
                    return
                self._count(error)
                continue
            self.received += 1
            yield datagram

    def send(
        self, data: bytes, address: Address | None = None, *, is_repeated: bool = False
    ) -> bool:
        """
        Send one datagram; False, and counted, if the kernel did not take it.

        Args:
            data: The datagram.
            address: The receiver; None on a connected socket.
            is_repeated: Whether this is its second and last try.
        """
        try:
            if address is None:
                self._send_bytes(data)
            else:
                self._send_to(data, address)
        except OSError as error:
            self._count(error)
            if is_repeated or not isinstance(error, ConnectionRefusedError):
                return False
            # An answer to an earlier datagram: reading it took this one's place.
            return self.send(data, address, is_repeated=True)
        self.sent += 1
        return True

    def counters(self) -> dict[str, int | str | None]:
        """Return what the kernel took, refused and dropped, as a plain mapping."""
        return {
            "sent": self.sent,
            "received": self.received,
            "empty_reads": self.empty_reads,
            "receive_buffer_bytes": self.receive_buffer_bytes,
            "dropped_by_kernel": self.dropped_by_kernel,
            "send_refused": self.send_refused,
            "peer_refused": self.peer_refused,
            "failures": self.failures,
            "last_failure": self.last_failure,
        }

    def close(self) -> None:
        """Close the socket; take it out of the reactor first."""
        self._is_closed = True
        self._socket.close()

    def _note_receive(self, error: OSError) -> None:
        if isinstance(error, BlockingIOError):
            self.empty_reads += 1
        elif not self._is_closed:
            self._count(error)

    def _count(self, error: OSError) -> None:
        if isinstance(error, ConnectionRefusedError):
            self.peer_refused += 1
        elif isinstance(error, BlockingIOError) or error.errno == errno.ENOBUFS:
            self.send_refused += 1
        else:
            self.failures += 1
            self.last_failure = str(error)


def buffer_warning(asked_bytes: int, granted_bytes: int) -> str | None:
    """Return what to tell about a receive buffer that is smaller than asked for; None if it is not."""
    if granted_bytes >= asked_bytes:
        return None
    return (
        f"UDP receive buffer: asked for {asked_bytes} bytes, the kernel granted {granted_bytes}:"
        " bursts from many agents may be lost;"
        f" raise the limit with: sudo sysctl -w net.core.rmem_max={asked_bytes}"
    )


def _ask_buffer(handle: socket.socket, forced: int, polite: int, wanted_bytes: int) -> int:
    """Ask for a buffer, past the system's limit where permitted; return what was granted."""
    try:
        if not IS_LINUX:
            raise PermissionError
        handle.setsockopt(socket.SOL_SOCKET, forced, wanted_bytes)
    except OSError:
        # Refused again, the system keeps its own size, which is read back below.
        with contextlib.suppress(OSError):
            handle.setsockopt(socket.SOL_SOCKET, polite, wanted_bytes)
    granted_bytes = handle.getsockopt(socket.SOL_SOCKET, polite)
    return granted_bytes // 2 if IS_LINUX else granted_bytes


def _resolve(address: str, port: int) -> tuple[socket.AddressFamily, Address]:
    try:
        found = socket.getaddrinfo(address, port, type=socket.SOCK_DGRAM)
    except (OSError, UnicodeError) as error:
        raise MachineError(
            f"{_name(address, port)}: cannot be resolved: {error};"
            " give an address, or a name that this machine knows"
        ) from error
    family, _, _, _, where = found[0]
    return family, where  # type: ignore[return-value]  # typeshed allows for families without ports


def _name(address: str, port: int) -> str:
    return f"[{address}]:{port}" if ":" in address else f"{address}:{port}"


def _bind_refused(address: str, port: int, error: OSError) -> str:
    number = error.errno or 0
    reason = BIND_REFUSALS.get(number, f"cannot listen: {os.strerror(number)}")
    return f"{_name(address, port)}: {reason}"
