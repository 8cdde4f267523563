"""
The bytes below SSH: a TCP socket, a proxy command's pipe or a channel through a jump host, with what paramiko lacks added.

It acknowledges at once what sshd waits for, and it gives up on a machine that takes no more bytes, or talks without
end before the login; paramiko alone would go on for ever.
"""

from __future__ import annotations

import contextlib
import socket
import subprocess
import time
from typing import Protocol

SEND_STALL_S_MAX = 15.0
"""A machine that took no byte for so long is taken for lost; a busy card delays sshd by less."""
LOGIN_BYTES_MAX = 1024 * 1024
"""Greeting, keys and banners of a server take some kilobytes."""
PROXY_END_TIMEOUT_S = 1.0
TIMEOUT_S_MIN = 0.01


class Pipe(Protocol):
    """Contract that paramiko has with a socket."""

    def send(self, data: bytes, /) -> int:
        """Send what fits."""

    def recv(self, count: int, /) -> bytes:
        """Wait for bytes."""

    def settimeout(self, timeout_s: float | None, /) -> None:
        """Bound both."""

    def close(self) -> None:
        """Close it."""


class SshSocket:
    """
    A socket for paramiko.

    Args:
        pipe: What carries the bytes.
        proxy: The process at its other end, which ends with it.
        addresses: Of this computer and of the machine, as far as they are known.
    """

    def __init__(
        self,
        pipe: Pipe,
        *,
        proxy: subprocess.Popen[bytes] | None = None,
        addresses: tuple[str, str] = ("", ""),
    ) -> None:
        self._pipe = pipe
        self._proxy = proxy
        # sshd leaves Nagle on until a command runs: its second small packet waits for our acknowledgement
        # of the first, which the kernel holds back for 40 ms unless told otherwise, each time anew.
        self._quick: socket.socket | None = None
        if isinstance(pipe, socket.socket) and pipe.family != socket.AF_UNIX:
            self._quick = pipe if hasattr(socket, "TCP_QUICKACK") else None
        self._stalled_since_s: float | None = None
        self.breach: ConnectionAbortedError | None = None
        """Why this side gave the machine up, if it did."""
        self._closed = False  # paramiko asks for a socket's own
        self.came_bytes = 0
        self.bytes_max: int | None = LOGIN_BYTES_MAX
        """Bytes that may come before somebody is logged in; None from then on."""
        self.own_address, self.peer_address = addresses

    def send(self, data: bytes) -> int:
        """Send what fits; raise when nothing has fitted for SEND_STALL_S_MAX."""
        try:
            count = self._pipe.send(data)
        except TimeoutError:
            now_s = time.monotonic()
            if self._stalled_since_s is None:
                self._stalled_since_s = now_s
            elif now_s - self._stalled_since_s > SEND_STALL_S_MAX:
                self.breach = ConnectionAbortedError("it takes no more bytes")
                raise self.breach from None
            raise
        self._stalled_since_s = None
        return count

    def recv(self, count: int) -> bytes:
        """Wait for bytes."""
        data = self._pipe.recv(count)
        self.came_bytes += len(data)
        if self.has_babbled:
            raise ConnectionAbortedError(f"over {self.bytes_max} bytes came before the login")
        if data and self._quick is not None:
            self._quick.setsockopt(socket.IPPROTO_TCP, socket.TCP_QUICKACK, 1)
        return data

    @property
    def has_babbled(self) -> bool:
        """Whether more has come than anybody says before a login."""
        return self.bytes_max is not None and self.came_bytes > self.bytes_max

    def settimeout(self, timeout_s: float | None) -> None:
        """Bound `send` and `recv`."""
        self._pipe.settimeout(timeout_s)

    def close(self) -> None:
        """Close it, also for a thread that waits in it; harmless when repeated."""
        self._closed = True
        if isinstance(self._pipe, socket.socket):
            with contextlib.suppress(OSError):
                self._pipe.shutdown(socket.SHUT_RDWR)
        self._pipe.close()
        if self._proxy is not None:
            end(self._proxy)


def connect_tcp(host: str, port: int, *, timeout_s: float) -> SshSocket:
    """
    Connect without Nagle's delay, which would cost SSH 40 ms per command.

    Raises:
        OSError: Of the last address that the name stands for.
    """
    until_s = time.monotonic() + timeout_s
    error = OSError(f"{host} stands for no address")
    try:
        found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
    except UnicodeError:
        raise socket.gaierror(socket.EAI_NONAME, "not a host name") from None
    for index, (family, kind, protocol, _, address) in enumerate(found):
        sock = socket.socket(family, kind, protocol)
        try:
            # An address that does not answer must leave time for the others.
            share_s = (until_s - time.monotonic()) / (len(found) - index)
            sock.settimeout(max(TIMEOUT_S_MIN, share_s))
            sock.connect(address)
            sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            return SshSocket(sock, addresses=(sock.getsockname()[0], _peer_address(sock)))
        except OSError as failed:
            sock.close()
            error = failed
    raise error


def _peer_address(sock: socket.socket) -> str:
    """Return the other end's address, a link-local one with the interface here on whose link it is."""
    address, *_, scope = sock.getpeername()
    is_on_link = sock.family == socket.AF_INET6 and scope
    return f"{address}%{socket.if_indextoname(scope)}" if is_on_link else str(address)


def connect_through_command(command: str) -> SshSocket:
    """
    Talk to the machine through a ProxyCommand of the operator's ssh configuration.

    Raises:
        OSError: There is no shell to run it.
    """
    ours, theirs = socket.socketpair()
    try:
        proxy = subprocess.Popen(
            ["/bin/sh", "-c", f"exec {command}"],
            stdin=theirs.fileno(),
            stdout=theirs.fileno(),
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
    except OSError:
        ours.close()
        raise
    finally:
        theirs.close()
    return SshSocket(ours, proxy=proxy)


def end(process: subprocess.Popen[bytes]) -> None:
    """End a proxy command whose pipe is closed."""
    with contextlib.suppress(OSError):
        process.terminate()
    try:
        process.wait(PROXY_END_TIMEOUT_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
