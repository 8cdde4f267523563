"""
paramiko's transport with what it leaves out: a command's signal, and requests that do not wait for ever.

What is used of paramiko beyond its public names stands here and in `ssh_stream`, and nowhere else.
"""

from __future__ import annotations

import contextlib
import functools
import logging
import signal
import threading
import time
from collections.abc import Callable, Sequence
from typing import Any, ClassVar

from paramiko.channel import Channel
from paramiko.common import (
    MSG_CHANNEL_REQUEST,
    MSG_REQUEST_FAILURE,
    MSG_REQUEST_SUCCESS,
    cMSG_CHANNEL_REQUEST,
    cMSG_GLOBAL_REQUEST,
)
from paramiko.message import Message
from paramiko.ssh_exception import SSHException
from paramiko.transport import Transport

from cosmos_cli.fleet.ssh.socket import SshSocket

WINDOW_BYTES = 4 * 1024 * 1024
PACKET_BYTES = 32 * 1024
READ_BYTES_MAX = 512 * 1024
"""Of one packet: twice what OpenSSH sends. paramiko would gather the 4 GiB that a server may announce."""
ACTIVE_CHECK_S = 0.1
"""Between looks whether a connection still stands; paramiko's own waits look as often."""

RSA_ALGORITHMS = ("rsa-sha2-512", "rsa-sha2-256")
CERTIFICATE = "-cert-"
CIPHERS_FIRST = ("aes128-gcm@openssh.com", "aes256-gcm@openssh.com")
"""Encrypt and authenticate in one go: 370 MB/s here where AES-CTR with HMAC moves 260."""

# paramiko tells every failure on stderr, with a traceback, beside raising it.
logging.getLogger("paramiko").setLevel(logging.CRITICAL)
logging.getLogger("paramiko").addHandler(logging.NullHandler())


def _request(channel: Any, message: Message) -> None:
    """Take note of the signal that ended a command; leave every other request to paramiko."""
    if message.get_text() == "exit-signal":
        message.get_boolean()
        number = signal.Signals.__members__.get(f"SIG{message.get_text()}")
        if number is not None:
            channel.signal_number = int(number)
        return
    message.rewind()
    message.get_int()
    Channel._handle_request(channel, message)  # type: ignore[attr-defined]  # private, in no stub


def _read_bounded(read_all: Callable[..., bytes], count: int, check_rekey: bool = False) -> bytes:
    """Read what a packet announces, unless nobody sends such packets."""
    if count > READ_BYTES_MAX:
        raise SSHException(f"a packet of {count} bytes was announced")
    return read_all(count, check_rekey)


class SshTransport(Transport):
    """
    A connection's protocol.

    Args:
        wire: To the machine's SSH server.
    """

    _channel_handler_table: ClassVar[Any] = {
        **Transport._channel_handler_table,  # type: ignore[attr-defined]  # private, in no stub
        MSG_CHANNEL_REQUEST: _request,
    }

    def __init__(self, wire: SshSocket) -> None:
        super().__init__(
            wire,  # type: ignore[arg-type]  # has those methods of a socket that paramiko calls
            default_window_size=WINDOW_BYTES,
            default_max_packet_size=PACKET_BYTES,
        )
        self.wire = wire
        self.is_certified = False
        packetizer: Any = self.packetizer
        packetizer.read_all = functools.partial(_read_bounded, packetizer.read_all)
        self._begun = threading.Event()
        self._news = threading.Condition()
        self._asked = 0
        self._answered = 0
        paramikos: Any = self
        handlers: dict[int, Callable[[Message], None]] = paramikos._handler_table
        for kind in (MSG_REQUEST_SUCCESS, MSG_REQUEST_FAILURE):
            handlers[kind] = functools.partial(self._count_answer, handlers[kind])

    @property
    def preferred_keys(self) -> tuple[str, ...]:
        """Return the algorithms of host keys in their order; paramiko's own has certificates last."""
        keys = super().preferred_keys
        return tuple(sorted(keys, key=lambda name: self.is_certified and CERTIFICATE not in name))

    def get_exception(self) -> Exception | None:
        """Return what ended the connection: whatever the machine's bytes raised while they were read is SSH's fault."""
        error = super().get_exception()
        if error is None or isinstance(error, (SSHException, OSError, EOFError)):
            return error
        foreign = SSHException(f"what it said is not understood: {error}")
        foreign.__cause__ = error
        return foreign

    def begin(self, *, timeout_s: float) -> None:
        """Begin to agree on keys, and hear a word in *timeout_s*; `start_client` waits until it is done."""
        self.banner_timeout = timeout_s
        super().start_client(self._begun)

    def start_client(
        self, event: threading.Event | None = None, timeout: float | None = None
    ) -> None:
        """
        Wait until the keys are agreed on; paramiko calls it, as if nothing had begun.

        Raises:
            SSHException: Keys could not be agreed on.
            OSError: The wire broke.
        """
        until_s = None if timeout is None else time.monotonic() + timeout
        while not self._begun.wait(ACTIVE_CHECK_S) and self.is_active():
            if until_s is not None and time.monotonic() >= until_s:
                return  # as paramiko's own does: what asks for the keys next finds none
        if not self.is_active():
            raise self.get_exception() or SSHException("Negotiation failed.")

    def start_command(self, command: str, *, timeout_s: float) -> Channel:
        """
        Open a channel and ask for a command; a refusal shows as an end without an exit status.

        Not waiting for the answer saves a round trip, and the wait would have no deadline.

        Raises:
            SSHException: The channel was refused, or *timeout_s* is over.
        """
        channel = self.open_session(timeout=timeout_s)
        message = Message()
        message.add_byte(cMSG_CHANNEL_REQUEST)
        message.add(channel.remote_chanid, "exec", True, command)
        self._send_user_message(message)  # type: ignore[attr-defined]  # private, in no stub
        return channel

    def gives_sign(self, *, timeout_s: float) -> bool:
        """
        Ask the server for an answer to a request and wait for it.

        Only an answer counts: other bytes may have been on their way when a machine froze.
        """
        with self._news:
            is_asking = self._asked == self._answered
            self._asked += is_asking
            wanted = self._asked
        if is_asking:
            # Sending may wait behind an upload that has come to a standstill; this wait has a deadline.
            threading.Thread(target=self._ask, name="sign-of-life", daemon=True).start()
        until_s = time.monotonic() + timeout_s
        with self._news:
            while self._answered < wanted and self.is_active():
                remaining_s = until_s - time.monotonic()
                if remaining_s <= 0:
                    return False
                self._news.wait(min(remaining_s, ACTIVE_CHECK_S))
            return self._answered >= wanted

    def _ask(self) -> None:
        """Send a request that every server answers, if only by refusing it."""
        message = Message()
        message.add_byte(cMSG_GLOBAL_REQUEST)
        message.add("keepalive@openssh.com", True)
        with contextlib.suppress(SSHException, OSError, EOFError):  # then it is not active any more
            self._send_user_message(message)  # type: ignore[attr-defined]  # private, in no stub

    def _count_answer(self, handle: Callable[[Message], None], message: Message) -> None:
        handle(message)
        with self._news:
            self._answered += 1
            self._news.notify_all()


def make_transport(
    wire: SshSocket, known_kinds: Sequence[str], *, is_certified: bool = False
) -> SshTransport:
    """
    Return a transport that asks for a host key of a kind that is known of this machine.

    Left to its own order, paramiko would get another one and take a known machine for unknown.

    Args:
        wire: To the machine.
        known_kinds: Of the machine's keys that known_hosts lists.
        is_certified: Whether a certificate would be a proof; it is asked for first.
    """
    transport = SshTransport(wire)
    transport.is_certified = is_certified
    options = transport.get_security_options()
    options.key_types = ordered(tuple(options.key_types), algorithms_of(known_kinds))
    options.ciphers = ordered(tuple(options.ciphers), CIPHERS_FIRST)
    return transport


def algorithms_of(kinds: Sequence[str]) -> list[str]:
    """Return the algorithms by which a server proves that it has keys of these kinds."""
    return [name for kind in kinds for name in (RSA_ALGORITHMS if kind == "ssh-rsa" else (kind,))]


def ordered(offered: Sequence[str], wanted: Sequence[str]) -> tuple[str, ...]:
    """Return what is offered, those that are wanted first."""
    first = [name for name in wanted if name in offered]
    return (*first, *(name for name in offered if name not in first))
