"""
Keys that are offered to a machine, and their order: few, because servers punish who tries many.

A key that the inventory or the ssh configuration names comes first, and through the ssh agent when it needs
a passphrase. Only when nobody names one do the ssh agent's and the usual files follow. Nothing but keys is
ever offered: no password, no questions.
"""

from __future__ import annotations

import base64
import binascii
import contextlib
import functools
import socket
import struct
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from cryptography.exceptions import UnsupportedAlgorithm
from paramiko.agent import (
    SSH2_AGENT_SIGN_RESPONSE,
    AgentKey,
    AgentSSH,
    cSSH2_AGENTC_SIGN_REQUEST,
)
from paramiko.message import Message
from paramiko.pkey import PKey, UnknownKeyType
from paramiko.ssh_exception import (
    AuthenticationException,
    BadAuthenticationType,
    PasswordRequiredException,
    SSHException,
)
from paramiko.transport import Transport
from paramiko.util import asbytes

from cosmos_cli.fleet.failure import FailureKind, MachineFailure
from cosmos_cli.fleet.ssh.failures import login_failure
from cosmos_cli.fleet.ssh.settings import SshSettings
from madns_runtime.bounded_files import check_regular_file, read_regular_file

KEYS_TRIED_MAX = 3
KEY_BYTES_MAX = 1024 * 1024
AGENT_TIMEOUT_S = 10.0
OPENSSH_MAGIC = b"openssh-key-v1\0"

_LOADING = threading.Lock()


class FewKeys:
    """
    Logs in with the first key that the machine takes; what paramiko calls a strategy.

    Args:
        settings: Of the machine.
    """

    def __init__(self, settings: SshSettings) -> None:
        self._settings = settings

    def authenticate(self, transport: Transport) -> None:
        """
        Log in.

        Raises:
            MachineFailure: No key was taken, there is none, or the connection broke.
        """
        try:
            self._try_keys(transport)
        except (SSHException, OSError, EOFError) as error:
            raise login_failure(error, self._settings.user, self._settings.where) from error

    def _try_keys(self, transport: Transport) -> None:
        user = self._settings.user
        tried: list[str] = []
        notes: list[str] = []
        for label, key in _keys(self._settings, notes):
            if len(tried) == KEYS_TRIED_MAX:
                notes.append(f"no more than {KEYS_TRIED_MAX} keys are tried")
                break
            tried.append(label)
            try:
                further = transport.auth_publickey(user, key)
            except BadAuthenticationType as error:
                methods = ", ".join(error.allowed_types)
                notes.append(f"the machine takes no key now, only {methods}")
                break
            except AuthenticationException as error:
                if not transport.is_active() or "timeout" in str(error):
                    raise
                if _is_unsigned(key):
                    notes.append(f"the ssh agent does not sign with {label}")
                continue
            if further:
                raise MachineFailure(
                    FailureKind.AUTHENTICATION,
                    f"{user} is asked for more than a key ({', '.join(further)})",
                    "let that user log in with a key alone",
                )
            return
        raise refused(self._settings, tried, notes)


def refused(settings: SshSettings, tried: list[str], notes: list[str]) -> MachineFailure:
    """Return the failure of a machine that took no key; SSH does not tell a wrong user from a wrong key."""
    also = f" ({'; '.join(notes)})" if notes else ""
    port = "" if settings.port == 22 else f"-p {settings.port} "
    copy = f"ssh-copy-id {port}{settings.user}@{settings.host}"
    if not tried:
        return MachineFailure(
            FailureKind.AUTHENTICATION,
            f"no key to log in with as {settings.user}{also}",
            f"make one with ssh-keygen, then {copy}; or name it with ansible_ssh_private_key_file",
        )
    return MachineFailure(
        FailureKind.AUTHENTICATION,
        f"no login as {settings.user} with {', '.join(tried)}{also}",
        f"check ansible_user and ansible_ssh_private_key_file, or let the key in: {copy}",
    )


def _keys(settings: SshSettings, notes: list[str]) -> Iterator[tuple[str, PKey]]:
    seen: set[bytes] = set()
    sources = [_of_files(settings, notes), _of_agent(settings)]
    if settings.identities_only:
        sources.pop()
    elif not settings.are_keys_named:
        sources.reverse()
    for source in sources:
        for label, key in source:
            if key.asbytes() not in seen:
                seen.add(key.asbytes())
                yield label, key


def _of_files(settings: SshSettings, notes: list[str]) -> Iterator[tuple[str, PKey]]:
    for file in settings.key_files:
        try:
            yield str(file), load_key(str(file))
            continue
        except FileNotFoundError:
            note = f"{file}: no such key" if settings.are_keys_named else ""
        except OSError as error:
            note = f"{file}: {error.strerror or error}"
        except PasswordRequiredException:
            note = f"{file} needs its passphrase: ssh-add it"
        except UnsupportedAlgorithm as error:
            note = f"{file} cannot be read ({error}): ssh-add it"
        except (SSHException, UnknownKeyType, ValueError) as error:
            note = f"{file}: not a private key that is understood ({error})"
        held = _held_by_agent(settings, file)
        if held is not None:
            yield f"{file} (ssh agent)", held
        elif note:
            notes.append(note)


def _of_agent(settings: SshSettings) -> Iterator[tuple[str, PKey]]:
    for key in agent_keys(settings.agent_socket):
        yield f"{key.comment or key.get_name()} (ssh agent)", key


def _held_by_agent(settings: SshSettings, file: Path) -> PKey | None:
    blob = public_part(file)
    held = agent_keys(settings.agent_socket) if blob is not None else ()
    return next((key for key in held if key.blob == blob), None)


def load_key(file: str) -> PKey:
    """
    Read a private key, once per process.

    Raises:
        OSError: It cannot be read.
        PasswordRequiredException: It needs a passphrase.
        SSHException: It is no key.
        UnknownKeyType: It is one of a kind that paramiko does not know.
        UnsupportedAlgorithm: Its other half is on a security token, or its cipher is not known.
    """
    with _LOADING:
        return _load_key(file)


@functools.lru_cache(maxsize=64)
def _load_key(file: str) -> PKey:
    check_regular_file(file, bytes_max=KEY_BYTES_MAX)
    try:
        return PKey.from_path(file)
    except TypeError as error:  # what cryptography raises of a key that is encrypted
        raise PasswordRequiredException(str(error)) from error


def public_part(file: Path) -> bytes | None:
    """
    Return the public key that a file's name stands for, without a passphrase; None if unknown.

    As with ssh, the file may hold the public key itself, or its neighbour may: the ssh agent has the other half.
    """
    for path in (Path(f"{file}.pub"), file):
        with contextlib.suppress(OSError, ValueError):
            kind, blob = read_regular_file(path, bytes_max=KEY_BYTES_MAX).decode().split()[:2]
            if not kind.startswith("-"):  # as a private key's first line does
                return base64.b64decode(blob, validate=True)
    with contextlib.suppress(OSError, ValueError, struct.error, binascii.Error):
        text = read_regular_file(file, bytes_max=KEY_BYTES_MAX).decode("ascii")
        data = base64.b64decode("".join(text.strip().splitlines()[1:-1]))
        if data.startswith(OPENSSH_MAGIC):
            message = Message(data[len(OPENSSH_MAGIC) :])
            for _ in ("cipher", "derivation", "its options"):
                message.get_binary()
            message.get_int()
            return message.get_binary()
    return None


class _Agent(AgentSSH):
    """The operator's ssh agent, shared by all threads."""

    def __init__(self, path: str) -> None:
        super().__init__()
        self.refused: set[bytes] = set()
        """Public keys with which it did not sign when it was asked last, such as one that nobody confirmed."""
        self._asking = threading.Lock()
        pipe = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        pipe.settimeout(AGENT_TIMEOUT_S)
        try:
            pipe.connect(path)
            self._connect(pipe)  # type: ignore[attr-defined]  # private, in no stub
        except BaseException:
            pipe.close()
            raise

    def _send_message(self, message: Any) -> Any:
        with self._asking:
            kind, reply = super()._send_message(message)  # type: ignore[misc]  # private, in no stub
        sent: Any = asbytes(message)
        asked = Message(sent)
        if asked.get_byte() != cSSH2_AGENTC_SIGN_REQUEST:
            return kind, reply
        key = asked.get_binary()
        if kind == SSH2_AGENT_SIGN_RESPONSE:
            self.refused.discard(key)
            return kind, reply
        # Without a signature the machine takes another key; paramiko would end the connection.
        self.refused.add(key)
        return SSH2_AGENT_SIGN_RESPONSE, Message(Message().add_string(b"").asbytes())


def _is_unsigned(key: PKey) -> bool:
    """Tell whether a key is one of the ssh agent's with which it did not sign."""
    return (
        isinstance(key, AgentKey)
        and isinstance(key.agent, _Agent)
        and key.blob in key.agent.refused
    )


def agent_keys(path: str | None) -> tuple[AgentKey, ...]:
    """Return the keys that the ssh agent holds, asked once per process; none when there is no agent."""
    if path is None:
        return ()
    with _LOADING:
        return _agent_keys(path)


@functools.lru_cache(maxsize=4)
def _agent_keys(path: str) -> tuple[AgentKey, ...]:
    try:
        return tuple(_Agent(path).get_keys())
    except (OSError, SSHException):  # a socket that an agent has left behind
        return ()
