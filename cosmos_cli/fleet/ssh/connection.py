"""
A machine over SSH: Fabric's connection with strict host keys and few login attempts.

Fabric opens the connection and holds it; paramiko below it carries commands and jumps. Fabric's own `run`
keeps all output in memory and starts three threads per command, its gateway leaves Nagle's delay on (44 ms
per command where 2.3 ms do), and its `sudo` answers prompts, of which `sudo -n` has none.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from typing import Any

import fabric
from paramiko.client import MissingHostKeyPolicy
from paramiko.config import SSHConfig
from paramiko.pkey import PKey
from paramiko.ssh_exception import ChannelException, SSHException

from cosmos_cli.fleet.connection import (
    EXIT_STATUS_TIMEOUT_S,
    LEFT_OPEN_S,
    OUTPUT_BYTES_MAX,
    SAID_BYTES_MAX,
    Completed,
    ConnectOptions,
)
from cosmos_cli.fleet.failure import FailureKind, MachineFailure
from cosmos_cli.fleet.liveness import SIGN_S, SilentMachine
from cosmos_cli.fleet.local import LOOPBACK
from cosmos_cli.fleet.ssh.failures import (
    babble_failure,
    certificate_failure,
    host_key_failure,
    jump_failure,
    lost,
    opening_failure,
    unanswered_jump,
    unrecorded_failure,
)
from cosmos_cli.fleet.ssh.host_certificate import read_certificate
from cosmos_cli.fleet.ssh.keys import FewKeys
from cosmos_cli.fleet.ssh.known_hosts import HostKey, KnownHosts, Standing
from cosmos_cli.fleet.ssh.settings import SshSettings
from cosmos_cli.fleet.ssh.socket import SshSocket
from cosmos_cli.fleet.ssh.stream import READ_BYTES, SshStream
from cosmos_cli.fleet.ssh.transport import SshTransport
from cosmos_cli.fleet.target import Target
from cosmos_cli.fleet.transfer_limits import BoundedOutput, OutputLimits

TIMEOUT_S_MIN = 0.5
"""Least time for logging in, of a deadline that is nearly over."""
OPEN_TIMEOUT_S = 20.0
"""To start a command; a busy board takes seconds."""
INPUT_POLL_S = 0.005
QUIET_S = 5.0
"""After so long without output of a command its machine is asked for a sign of life."""
NO_CHANNEL = "Timeout opening channel."
"""Text of paramiko where the other side says nothing."""
LIMITS_POLL_S = 0.25
"""Between looks at the limits of a command that writes to standard error alone, or nothing."""


class SshConnection:
    """
    A machine that is logged in at.

    Args:
        target: Its entry in the inventory.
        connection: Fabric's, open.
    """

    def __init__(
        self,
        target: Target,
        connection: fabric.Connection,
    ) -> None:
        self.target = target
        self.opening_s = 0.0
        self._connection = connection
        self.transport: SshTransport = connection.transport
        self._wire: SshSocket = self.transport.wire
        self.hops: Sequence[SshConnection] = ()
        """The jump hosts' connections, closed with this one."""

    @property
    def own_address(self) -> str:
        """Address of this computer as the machine reaches it; through a jump host, as that one does."""
        return self._wire.own_address

    @property
    def peer_address(self) -> str:
        """Address of the machine."""
        return self._wire.peer_address or self.target.address

    def open(self, command: str, errors: BoundedOutput | None = None) -> SshStream:
        """Start a shell command; *errors* keeps what it writes to standard error."""
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

    def run(
        self,
        command: str,
        *,
        stdin: bytes | None = b"",
        timeout_s: float,
        said_bytes_max: int = SAID_BYTES_MAX,
    ) -> Completed:
        """Run a shell command to its end."""
        half = OUTPUT_BYTES_MAX // 2
        output, errors = BoundedOutput(half, half), BoundedOutput(half, half)
        stream = self.open(command, errors)
        limits = OutputLimits(timeout_s=timeout_s, said_bytes_max=said_bytes_max)
        try:
            is_left_open = _converse(
                stream,
                None if stdin is None else memoryview(stdin),
                (output, errors),
                limits,
                gives_sign=self.transport.gives_sign,
            )
            status = stream.ending(timeout_s=EXIT_STATUS_TIMEOUT_S).exit_status
        finally:
            stream.close()
        if status is None:
            raise lost() if not self.transport.is_active() else _unknown_end()
        return Completed(
            exit_status=status,
            stdout=output.data,
            stderr=errors.data,
            cut_bytes=output.cut_bytes + errors.cut_bytes,
            is_left_open=is_left_open,
        )

    def is_alive(self, *, timeout_s: float = 2.0) -> bool:
        """Ask for a sign of life; paramiko's own keepalive notices neither a dead link nor a frozen machine."""
        return self.transport.gives_sign(timeout_s=timeout_s)

    def close(self) -> None:
        """Close it."""
        self._connection.close()
        self._wire.close()
        for hop in reversed(self.hops):
            hop.close()

    def wire_to(self, host: str, port: int, *, timeout_s: float) -> SshSocket:
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
            if str(error) == NO_CHANNEL:
                where = f"{host} port {port}"
                raise unanswered_jump(where, timeout_s, is_alive=self.is_alive()) from error
            raise opening_failure(error, f"{host} port {port}", timeout_s) from error
        return SshSocket(channel, addresses=(self.own_address, host))


def _unknown_end() -> MachineFailure:
    return MachineFailure(
        FailureKind.LOST,
        "the command was refused, or ended without an exit status",
        "may that user run commands there (ForceCommand, a login shell that ends at once)?",
    )


def _converse(
    stream: SshStream,
    pending: memoryview | None,
    outputs: tuple[BoundedOutput, BoundedOutput],
    limits: OutputLimits,
    *,
    gives_sign: Callable[..., bool],
) -> bool:
    """
    Feed a command, unless *pending* is None, and read what it says until it has ended.

    It may be silent as long as it likes, a machine may not: *gives_sign* asks that.

    Returns:
        Whether its output is still open, though it has ended: what it left running holds that.
    """
    until_s = time.monotonic() + limits.timeout_s
    heard_s = time.monotonic()
    is_dead = is_over = False
    while True:
        remaining_s = until_s - time.monotonic()
        limits.check(remaining_s, outputs)
        if pending is not None and not (pending := _feed(stream, pending)):
            stream.close_writing()
            pending = None
        try:
            wait_s = INPUT_POLL_S if pending else LIMITS_POLL_S
            data = stream.read(READ_BYTES, timeout_s=min(wait_s, remaining_s))
        except BlockingIOError:
            if is_dead:  # and nothing came while it was asked
                raise SilentMachine from None
            if is_over:  # what it had said before it ended came before the sign
                return True
            has_exited = stream.has_exited()
            quiet_s = LEFT_OPEN_S if has_exited else QUIET_S
            if pending is None and time.monotonic() - heard_s >= quiet_s:
                gave_sign = gives_sign(timeout_s=min(SIGN_S, remaining_s))
                is_dead = remaining_s > SIGN_S and not gave_sign
                is_over = has_exited and gave_sign
                heard_s = time.monotonic()
            continue
        if not data:
            return False
        outputs[0].add(data)
        heard_s, is_dead, is_over = time.monotonic(), False, False


def _feed(stream: SshStream, pending: memoryview) -> memoryview:
    """Hand over what fits now and return the rest."""
    try:
        while pending:
            pending = pending[stream.write(pending) :]
    except BlockingIOError:
        pass
    except MachineFailure:
        return memoryview(b"")  # it ended before it had read all; its status tells
    return pending


def log_in(
    settings: SshSettings, options: ConnectOptions, transport: SshTransport, until_s: float
) -> fabric.Connection:
    """
    Log in at a machine that agrees on keys already.

    Args:
        settings: Of the machine.
        options: Whether unknown host keys are recorded.
        transport: To its SSH server; closed with its wire when this fails.
        until_s: Deadline, monotonic.

    Raises:
        MachineFailure: In words that say what to do.
    """
    wire = transport.wire
    timeout_s = max(TIMEOUT_S_MIN, until_s - time.monotonic())
    connection = fabric.Connection(
        settings.host,
        user=settings.user,
        port=settings.port,
        # Empty: Fabric's files and ssh's are none of its business here. One for each connection: reading one
        # writes to it, and threads would meet there.
        config=fabric.Config(ssh_config=SSHConfig(), lazy=True),
        forward_agent=False,
        connect_kwargs={
            "sock": wire,
            "timeout": timeout_s,
            "banner_timeout": timeout_s,
            "auth_timeout": timeout_s,
            "transport_factory": lambda sock, disabled_algorithms: transport,
            "auth_strategy": FewKeys(settings),
        },
    )
    connection.client.set_missing_host_key_policy(_StrictHostKeys(settings, options))
    try:
        connection.open()
    except (SSHException, OSError, EOFError) as error:
        if wire.has_babbled:
            raise babble_failure(settings.where, wire.came_bytes) from error
        raise opening_failure(
            error,
            settings.where,
            timeout_s,
            has_spoken=bool(transport.remote_version),
            came_bytes=wire.came_bytes,
        ) from error
    finally:
        if connection.transport is None:
            connection.client.close()
            wire.close()
    wire.bytes_max = None
    return connection


class _StrictHostKeys(MissingHostKeyPolicy):
    """Judges every host key and certificate: Fabric's own lists stay empty, so that it always asks here."""

    def __init__(self, settings: SshSettings, options: ConnectOptions) -> None:
        self._settings = settings
        self._accepts_new = options.accept_new_host_keys or settings.accepts_new_host_keys
        self._known = KnownHosts(settings.known_hosts)

    def missing_host_key(self, client: Any, hostname: str, key: PKey) -> None:
        """Accept a known key, record an unknown one if that is wanted, refuse every other."""
        settings = self._settings
        shown = HostKey(kind=key.get_name(), blob=key.asbytes())
        verdict = self._known.judge(settings.names, shown)
        is_known = verdict.standing is Standing.KNOWN
        if (
            verdict.standing is not Standing.REVOKED
            and key.public_blob is not None
            and self._is_certified(key.public_blob.key_blob, is_known=is_known)
        ):
            return
        if verdict.standing is Standing.UNKNOWN and self._accepts_new:
            try:
                verdict = self._known.record(
                    settings.names[0], shown, is_hashed=settings.hashes_known_hosts
                )
            except OSError as error:
                raise unrecorded_failure(error, settings.known_hosts[0], settings.where) from error
        if verdict.standing is not Standing.KNOWN:
            raise host_key_failure(verdict, shown, settings.names, settings.where)

    def _is_certified(self, blob: bytes, *, is_known: bool) -> bool:
        """
        Tell whether an authority of known_hosts vouches for the machine.

        Raises:
            MachineFailure: That authority is revoked, or what it signed does not count and the key is not known.
        """
        settings = self._settings
        try:
            certificate = read_certificate(blob)
        except ValueError:  # the machine has proved that it holds the key; that alone counts
            return False
        authority = certificate.authority
        verdict = self._known.judge_authority(settings.names, authority)
        if verdict.against is None:
            return False
        if verdict.standing is Standing.REVOKED:
            raise host_key_failure(
                verdict,
                authority,
                settings.names,
                settings.where,
                what="host certificate's authority",
            )
        fault = certificate.fault(settings.names[-1], datetime.now(UTC).timestamp())
        if fault is not None and not is_known:
            raise certificate_failure(fault, verdict.against, settings.where)
        return fault is None
