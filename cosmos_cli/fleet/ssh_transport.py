"""
paramiko's transport with what it leaves out: a command's signal, and requests that do not wait for ever.

What is used of paramiko beyond its public names stands here and in `ssh_stream`, and nowhere else.
"""

from __future__ import annotations

import logging
import signal
from collections.abc import Sequence
from typing import Any, ClassVar

from paramiko.channel import Channel
from paramiko.common import (
    MSG_CHANNEL_REQUEST,
    cMSG_CHANNEL_REQUEST,
    cMSG_GLOBAL_REQUEST,
)
from paramiko.message import Message
from paramiko.transport import Transport

from cosmos_cli.fleet.wire import Wire

WINDOW_BYTES = 4 * 1024 * 1024
PACKET_BYTES = 32 * 1024

RSA_KINDS = ("rsa-sha2-512", "rsa-sha2-256")

# paramiko tells every failure on stderr, with a traceback, beside raising it.
logging.getLogger("paramiko").setLevel(logging.CRITICAL)
logging.getLogger("paramiko").addHandler(logging.NullHandler())


def _request(channel: Channel, message: Message) -> None:
    """Take note of the signal that ended a command; leave every other request to paramiko."""
    if message.get_text() == "exit-signal":
        message.get_boolean()
        number = signal.Signals.__members__.get(f"SIG{message.get_text()}")
        if number is not None:
            channel.signal_number = int(number)  # type: ignore[attr-defined]
        return
    message.rewind()
    message.get_int()
    Channel._handle_request(channel, message)  # type: ignore[attr-defined]


class SshTransport(Transport):
    """A connection's protocol."""

    _channel_handler_table: ClassVar[Any] = {
        **Transport._channel_handler_table,  # type: ignore[attr-defined]
        MSG_CHANNEL_REQUEST: _request,
    }

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
        message.add_int(channel.remote_chanid)
        message.add_string("exec")
        message.add_boolean(True)
        message.add_string(command)
        self._send_user_message(message)  # type: ignore[attr-defined]
        return channel

    def ask_for_sign(self) -> None:
        """Send a request that every server answers, if only by refusing it."""
        message = Message()
        message.add_byte(cMSG_GLOBAL_REQUEST)
        message.add_string("keepalive@openssh.com")
        message.add_boolean(True)
        self._send_user_message(message)  # type: ignore[attr-defined]


def make_transport(wire: Wire, known_kinds: Sequence[str], *, timeout_s: float) -> SshTransport:
    """
    Return a transport that asks for a host key of a kind that is known of this machine.

    Left to its own order, paramiko would get another one and take a known machine for unknown.
    """
    transport = SshTransport(
        wire,  # type: ignore[arg-type]
        default_window_size=WINDOW_BYTES,
        default_max_packet_size=PACKET_BYTES,
    )
    transport.banner_timeout = transport.handshake_timeout = transport.auth_timeout = timeout_s
    options = transport.get_security_options()
    options.key_types = ordered(tuple(options.key_types), known_kinds)
    return transport


def ordered(offered: Sequence[str], known_kinds: Sequence[str]) -> tuple[str, ...]:
    """Return the algorithms that are offered, those of known keys first."""
    first: list[str] = []
    for kind in known_kinds:
        first += [name for name in (RSA_KINDS if kind == "ssh-rsa" else (kind,)) if name in offered]
    return (*first, *(name for name in offered if name not in first))
