"""
Why a connection failed, in words: what paramiko and the sockets raise becomes a MachineFailure. Pure.

paramiko tells many cases apart by their texts only; this is the one place that reads them.
"""

from __future__ import annotations

import errno
from pathlib import Path
from socket import gaierror

from cosmos_cli.fleet.failure import FailureKind, MachineFailure
from cosmos_cli.fleet.ssh.known_hosts import HostKey, KeyVerdict, KnownHost, Standing
from cosmos_cli.fleet.transfer_limits import duration_words

UNREACHABLE = (errno.EHOSTUNREACH, errno.ENETUNREACH, errno.EHOSTDOWN, errno.ENETDOWN)
ENDS = (EOFError, ConnectionResetError, BrokenPipeError)
"""Signs of the other side's end, depending on what was under way."""
BANNER_ERROR = "Error reading SSH protocol banner"
NO_SESSION = "No existing session"
NOT_ALLOWED = 1
"""SSH_OPEN_ADMINISTRATIVELY_PROHIBITED."""


def opening_failure(
    error: Exception, where: str, timeout_s: float, *, has_spoken: bool = True, came_bytes: int = 0
) -> MachineFailure:
    """
    Say why a connection could not be opened.

    Args:
        error: What was raised before anybody was logged in.
        where: Address and port.
        timeout_s: How long it was waited for.
        has_spoken: Whether a word of SSH was heard.
        came_bytes: What was heard, of SSH or not.
    """
    if isinstance(error, MachineFailure):
        return error
    if not has_spoken and isinstance(error, ENDS):  # while paramiko greeted
        return _silent(where)
    if isinstance(error, gaierror):
        return MachineFailure(
            FailureKind.UNREACHABLE,
            f"{where}: the name is not known ({error.strerror})",
            "set ansible_host to its address, or enter the name in DNS, /etc/hosts or the ssh configuration",
        )
    if isinstance(error, ConnectionRefusedError):
        return MachineFailure(
            FailureKind.REFUSED,
            f"{where}: connection refused",
            "is its SSH server enabled and started, and ansible_port right?",
        )
    text = str(error)
    # The text is the same for silence and for an end; what paramiko was handling tells.
    if BANNER_ERROR in text and not isinstance(error.__context__, TimeoutError):
        return _silent(where)
    is_over_time = BANNER_ERROR in text or text == NO_SESSION or "timeout" in text.lower()
    if is_over_time and came_bytes and not has_spoken:
        return babble_failure(where, came_bytes)
    if isinstance(error, TimeoutError):
        return MachineFailure(
            FailureKind.UNREACHABLE,
            f"{where}: no answer in {duration_words(timeout_s)}",
            "is it switched on, on this network, and its address right?",
        )
    if isinstance(error, OSError) and error.errno in UNREACHABLE:
        return MachineFailure(
            FailureKind.UNREACHABLE,
            f"{where}: no route ({error.strerror})",
            "is it switched on, on this network, and its address right?",
        )
    if is_over_time:
        return _frozen(where, timeout_s)
    if "Incompatible ssh peer" in text or "Incompatible version" in text:
        return MachineFailure(
            FailureKind.UNSUPPORTED,
            f"{where}: its SSH server shares no algorithm with this computer ({text})",
            "update OpenSSH there",
        )
    return MachineFailure(
        FailureKind.LOST,
        f"{where}: the connection broke while it was opened ({text or type(error).__name__})",
        "look into the log of sshd there",
    )


def unrecorded_failure(error: OSError, file: Path, where: str) -> MachineFailure:
    """Say that this computer's list of host keys takes no new one."""
    return MachineFailure(
        FailureKind.HOST_KEY_UNKNOWN,
        f"{where}: its host key is not known, and cannot be recorded in {file} of this computer:"
        f" {error.strerror or error}",
        "mend that file, or name another as UserKnownHostsFile in the ssh configuration",
    )


def jump_failure(code: int, said: str, where: str) -> MachineFailure:
    """Say why a jump host did not connect further."""
    if code == NOT_ALLOWED:
        return MachineFailure(
            FailureKind.UNSUPPORTED,
            f"{where}: the jump host does not let connections through ({said})",
            "allow it there with AllowTcpForwarding",
        )
    return MachineFailure(
        FailureKind.UNREACHABLE,
        f"{where}: the jump host does not reach it ({said})",
        "is it switched on, on that network, and its address right?",
    )


def unanswered_jump(where: str, timeout_s: float, *, is_alive: bool) -> MachineFailure:
    """Say that a jump host had nothing to tell of its way further: the machine does not answer it, or it hangs itself."""
    if not is_alive:
        return MachineFailure(
            FailureKind.FROZEN,
            f"{where}: the jump host stopped answering",
            "it hangs: wait, or switch it off and on",
        )
    return MachineFailure(
        FailureKind.UNREACHABLE,
        f"{where}: the jump host got no answer of it in {duration_words(timeout_s)}",
        "is it switched on, on that network, and its address right?",
    )


def _silent(where: str) -> MachineFailure:
    return MachineFailure(
        FailureKind.REFUSED,
        f"{where}: the connection was closed before a word of SSH was said",
        "is that an SSH server? it may also be starting, be full (MaxStartups), or punish earlier"
        " failed logins: try again in a minute",
    )


def babble_failure(where: str, came_bytes: int) -> MachineFailure:
    """Say that a server talks without end before anybody is logged in."""
    return MachineFailure(
        FailureKind.DATA,
        f"{where}: {came_bytes} bytes came before a login, and the connection was closed",
        "is that an SSH server?",
    )


def _frozen(where: str, timeout_s: float) -> MachineFailure:
    return MachineFailure(
        FailureKind.FROZEN,
        f"{where}: the connection opens, but nothing was said in {duration_words(timeout_s)}",
        "it hangs or is just starting: wait, or switch it off and on",
    )


def login_failure(error: Exception, user: str, where: str) -> MachineFailure:
    """Say why nobody could be logged in, the host key being right."""
    if isinstance(error, MachineFailure):
        return error
    text = str(error)
    if "timeout" in text.lower():
        return MachineFailure(
            FailureKind.FROZEN,
            f"{where}: no answer to the login of {user}",
            "it hangs or is overloaded: wait, or switch it off and on",
        )
    return MachineFailure(
        FailureKind.LOST,
        f"{where}: the connection was closed while {user} logged in ({text or type(error).__name__})",
        "it may be going down, or refuse that user (AllowUsers, /etc/nologin); look into the log of"
        " sshd there",
    )


def lost(error: Exception | None = None) -> MachineFailure:
    """Say that a connection broke in the midst of it."""
    said = f" ({error})" if error is not None and str(error) else ""
    return MachineFailure(
        FailureKind.LOST,
        f"the connection is lost{said}",
        "has it lost power or network? repeat the command when it is back",
    )


def host_key_failure(
    verdict: KeyVerdict, key: HostKey, names: tuple[str, ...], where: str, *, what: str = "host key"
) -> MachineFailure:
    """Say why a machine's host key is not accepted, or *what* else it showed."""
    shown = f"{key.kind} {key.fingerprint}"
    if verdict.standing is Standing.UNKNOWN:
        return MachineFailure(
            FailureKind.HOST_KEY_UNKNOWN,
            f"{where}: its host key is not known: {shown}",
            "compare it with `cat /etc/ssh/ssh_host_*_key.pub | ssh-keygen -lf -` there, then record it with"
            " --accept-new-host-keys, or log in once with ssh",
        )
    old = verdict.against
    assert old is not None  # who says more than "unknown" says by which line
    place = f"({old.file}:{old.line})"
    if verdict.standing is Standing.REVOKED:
        return MachineFailure(
            FailureKind.HOST_KEY_CHANGED,
            f"{where}: its {what} is revoked {place}: {shown}",
            "do not use that machine before you know who has its key",
        )
    return MachineFailure(
        FailureKind.HOST_KEY_CHANGED,
        f"{where}: its host key has changed: got {shown},"
        f" expected {old.key.kind} {old.key.fingerprint} {place}",
        "somebody else may answer there; if the machine was installed anew, forget the old key with"
        f" `ssh-keygen -R '{names[0]}' -f {old.file}` and accept the new one",
    )


def certificate_failure(fault: str, authority: KnownHost, where: str) -> MachineFailure:
    """Say why a certificate that a known authority signed does not make a machine known; nothing is recorded then."""
    return MachineFailure(
        FailureKind.HOST_KEY_UNKNOWN,
        f"{where}: its host certificate does not count: {fault}"
        f" (signed by the authority of {authority.file}:{authority.line})",
        "sign its key anew with `ssh-keygen -s`, or compare its own key and log in once with ssh",
    )
