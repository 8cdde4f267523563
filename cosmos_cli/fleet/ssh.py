"""
A machine over SSH: Fabric's connection with strict host keys and few login attempts.

Imported after a wire is open: importing paramiko and Fabric takes longer than the servers need to start.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

import fabric
from paramiko.client import MissingHostKeyPolicy
from paramiko.config import SSHConfig
from paramiko.pkey import PKey
from paramiko.ssh_exception import ChannelException, SSHException

from cosmos_cli.fleet.connection import OUTPUT_BYTES_MAX, Completed, ConnectOptions
from cosmos_cli.fleet.failure import FailureKind, MachineFailure
from cosmos_cli.fleet.known_hosts import HostKey, KnownHosts, Standing
from cosmos_cli.fleet.local import LOOPBACK
from cosmos_cli.fleet.output import BoundedOutput
from cosmos_cli.fleet.ssh_failures import (
    host_key_failure,
    jump_failure,
    lost,
    opening_failure,
)
from cosmos_cli.fleet.ssh_keys import FewKeys
from cosmos_cli.fleet.ssh_settings import SshSettings
from cosmos_cli.fleet.ssh_stream import READ_BYTES, SshStream, wait_for
from cosmos_cli.fleet.ssh_transport import SshTransport, make_transport
from cosmos_cli.fleet.target import Target
from cosmos_cli.fleet.wire import Wire

TIMEOUT_S_MIN = 0.5
"""What is left of a deadline for logging in, at least."""
OPEN_TIMEOUT_S = 20.0
"""To start a command; a busy board takes seconds."""
INPUT_POLL_S = 0.005


class SshConnection:
    """
    A machine that is logged in at.

    Args:
        target: Its entry in the inventory.
        connection: Fabric's, open.
        wire: Below it.
        hops: The jump hosts' connections, closed with this one.
    """

    def __init__(
        self,
        target: Target,
        connection: fabric.Connection,
        wire: Wire,
        hops: Sequence[SshConnection] = (),
    ) -> None:
        self.target = target
        self.opening_s = 0.0
        self._connection = connection
        self._wire = wire
        self._hops = tuple(hops)

    @property
    def transport(self) -> SshTransport:
        """Return paramiko's part."""
        transport: SshTransport = self._connection.transport
        return transport

    @property
    def own_address(self) -> str:
        """Address of this computer as the machine reaches it; through a jump host, as that one does."""
        return self._wire.own_address

    @property
    def peer_address(self) -> str:
        """Address of the machine."""
        return self._wire.peer_address or self.target.address

    def open(self, command: str) -> SshStream:
        """Start a shell command."""
        return self._start(command)

    def run(self, command: str, *, stdin: bytes | None = b"", timeout_s: float) -> Completed:
        """Run a shell command to its end."""
        half = OUTPUT_BYTES_MAX // 2
        output, errors = BoundedOutput(half, half), BoundedOutput(half, half)
        stream = self._start(command, errors)
        try:
            _converse(stream, None if stdin is None else memoryview(stdin), output, timeout_s)
            status = stream.exit_status()
        finally:
            stream.close()
        if status is None:
            raise lost() if not self.transport.is_active() else _unknown_end()
        return Completed(
            exit_status=status,
            stdout=output.data,
            stderr=errors.data,
            cut_bytes=output.cut_bytes + errors.cut_bytes,
        )

    def is_alive(self, *, timeout_s: float = 2.0) -> bool:
        """Ask for a sign of life; paramiko's own keepalive notices neither a dead link nor a frozen machine."""
        return self.transport.gives_sign(timeout_s=timeout_s)

    def close(self) -> None:
        """Close it."""
        self._connection.close()
        self._wire.close()
        for hop in reversed(self._hops):
            hop.close()

    def wire_to(self, host: str, port: int, *, timeout_s: float) -> Wire:
        """
        Open a wire from the machine to another one, as a jump host does.

        Raises:
            MachineFailure: The machine does not reach it, or may not.
        """
        try:
            channel = self.transport.open_channel(
                "direct-tcpip", (host, port), (LOOPBACK, 0), timeout=timeout_s
            )
        except ChannelException as error:
            raise jump_failure(error.code, error.text, f"{host} port {port}") from error
        except (SSHException, OSError, EOFError) as error:
            raise opening_failure(error, f"{host} port {port}", timeout_s) from error
        return Wire(channel, addresses=(self.own_address, host))

    def _start(self, command: str, errors: BoundedOutput | None = None) -> SshStream:
        try:
            channel = self.transport.start_command(command, timeout_s=OPEN_TIMEOUT_S)
        except ChannelException as error:
            raise MachineFailure(
                FailureKind.BUSY,
                f"the machine opens no further session ({error.text})",
                "MaxSessions of its sshd_config may be too small",
            ) from error
        except (SSHException, OSError, EOFError) as error:
            raise lost(error) from error
        return SshStream(channel, self.transport, errors)


def _unknown_end() -> MachineFailure:
    return MachineFailure(
        FailureKind.LOST,
        "the command was refused, or ended without an exit status",
        "may that user run commands there (ForceCommand, a login shell that ends at once)?",
    )


def _converse(
    stream: SshStream, pending: memoryview | None, output: BoundedOutput, timeout_s: float
) -> None:
    """Feed a command, unless *pending* is None, and read what it says until it has ended."""
    until_s = time.monotonic() + timeout_s
    while True:
        if pending is not None and not (pending := _feed(stream, pending)):
            stream.close_writing()
            pending = None
        try:
            data = stream.read(READ_BYTES)
        except BlockingIOError:
            remaining_s = until_s - time.monotonic()
            if remaining_s <= 0:
                text = f"the command did not end in {timeout_s:g} s"
                raise MachineFailure(FailureKind.TIMEOUT, text) from None
            wait_for(stream.fileno(), INPUT_POLL_S if pending else remaining_s)
            continue
        if not data:
            return
        output.add(data)


def _feed(stream: SshStream, pending: memoryview) -> memoryview:
    """Hand over what fits now and return the rest."""
    try:
        while pending:
            pending = pending[stream.write(pending) :]  # type: ignore[arg-type]
    except BlockingIOError:
        pass
    except MachineFailure:
        return memoryview(b"")  # it ended before it had read all; its status tells
    return pending


def log_in(
    settings: SshSettings, options: ConnectOptions, wire: Wire, until_s: float
) -> fabric.Connection:
    """
    Log in at a machine whose wire is open.

    Args:
        settings: Of the machine.
        options: Whether unknown host keys are recorded.
        wire: To its SSH server; closed when this fails.
        until_s: Deadline, monotonic.

    Raises:
        MachineFailure: In words that say what to do.
    """
    known = KnownHosts(settings.known_hosts)
    timeout_s = max(TIMEOUT_S_MIN, until_s - time.monotonic())
    connection = fabric.Connection(
        settings.host,
        user=settings.user,
        port=settings.port,
        config=_config(),
        forward_agent=False,
        connect_kwargs={
            "sock": wire,
            "timeout": timeout_s,
            "banner_timeout": timeout_s,
            "auth_timeout": timeout_s,
            "transport_factory": _factory(known, settings),
            "auth_strategy": FewKeys(settings),
        },
    )
    connection.client.set_missing_host_key_policy(_StrictHostKeys(settings, options, known))
    try:
        connection.open()
    except (SSHException, OSError, EOFError) as error:
        transport = connection.client.get_transport()
        has_spoken = transport is not None and bool(transport.remote_version)
        raise opening_failure(error, settings.where, timeout_s, has_spoken=has_spoken) from error
    finally:
        if connection.transport is None:
            connection.client.close()
            wire.close()
    return connection


def _factory(known: KnownHosts, settings: SshSettings) -> Callable[..., SshTransport]:
    def make(sock: Wire, disabled_algorithms: Any) -> SshTransport:
        return sock.transport or make_transport(sock, known.kinds(settings.names))

    return make


def _config() -> fabric.Config:
    """
    Return an empty configuration: Fabric's files and ssh's are none of its business here.

    Each connection has one of its own: reading one writes to it, and threads would meet there.
    """
    return fabric.Config(ssh_config=SSHConfig(), lazy=True)


class _StrictHostKeys(MissingHostKeyPolicy):
    """Judges every host key: Fabric's own lists stay empty, so that it always asks here."""

    def __init__(self, settings: SshSettings, options: ConnectOptions, known: KnownHosts) -> None:
        self._settings = settings
        self._accepts_new = options.accept_new_host_keys or settings.accepts_new_host_keys
        self._known = known

    def missing_host_key(self, client: Any, hostname: str, key: PKey) -> None:
        """Accept a known key, record an unknown one if that is wanted, refuse every other."""
        settings = self._settings
        shown = HostKey(kind=key.get_name(), blob=key.asbytes())
        verdict = self._known.judge(settings.names, shown)
        if verdict.standing is Standing.UNKNOWN and self._accepts_new:
            is_hashed = settings.hashes_known_hosts
            verdict = self._known.record(settings.names[0], shown, is_hashed=is_hashed)
        if verdict.standing is not Standing.KNOWN:
            raise host_key_failure(verdict, shown, settings.names, settings.where)
