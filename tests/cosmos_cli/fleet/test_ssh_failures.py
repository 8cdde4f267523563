"""Every way in which a connection fails, in words that say what to do."""

import errno
import re
import shutil
import socket
import subprocess

import pytest
from paramiko.ssh_exception import (
    AuthenticationException,
    IncompatiblePeer,
    SSHException,
)

from cosmos_cli.fleet.failure import FailureKind, MachineFailure
from cosmos_cli.fleet.ssh.failures import (
    host_key_failure,
    jump_failure,
    login_failure,
    lost,
    opening_failure,
)
from cosmos_cli.fleet.ssh.known_hosts import HostKey, KeyVerdict, KnownHost, Standing

WHERE = "10.0.0.3 port 22"
KEY = HostKey(kind="ssh-ed25519", blob=b"key")
LINE = KnownHost(
    patterns="pi", key=HostKey(kind="ssh-rsa", blob=b"old"), file="known_hosts", line=7
)


@pytest.mark.parametrize(
    ("error", "kind", "words"),
    [
        (OSError(errno.EHOSTUNREACH, "No route to host"), FailureKind.UNREACHABLE, "no route"),
        (OSError(errno.ENETUNREACH, "Network is unreachable"), FailureKind.UNREACHABLE, "no route"),
        (TimeoutError("timed out"), FailureKind.UNREACHABLE, "no answer in 10 s"),
        (ConnectionRefusedError(111, "refused"), FailureKind.REFUSED, "connection refused"),
        (
            socket.gaierror(-2, "Name or service not known"),
            FailureKind.UNREACHABLE,
            "the name is not known",
        ),
        (
            SSHException("Error reading SSH protocol banner"),
            FailureKind.REFUSED,
            "closed before a word",
        ),
        (
            SSHException("Error reading SSH protocol banner[Errno 104] Connection reset by peer"),
            FailureKind.REFUSED,
            "closed before a word",
        ),
        (SSHException("No existing session"), FailureKind.FROZEN, "nothing was said in 10 s"),
        (SSHException("Negotiation failed."), FailureKind.LOST, "broke while it was opened"),
        (EOFError(), FailureKind.LOST, "broke while it was opened"),
        (ConnectionResetError(104, "reset"), FailureKind.LOST, "broke while it was opened"),
        (
            IncompatiblePeer("Incompatible ssh peer (no acceptable kex algorithm)"),
            FailureKind.UNSUPPORTED,
            "no algorithm",
        ),
        (
            SSHException('Indecipherable protocol version "HTTP/1.1 400 Bad Request"'),
            FailureKind.LOST,
            "HTTP/1.1",
        ),
    ],
)
def test_opening_that_fails_says_why_and_what_to_do(error, kind, words):
    failure = opening_failure(error, WHERE, 10.0)

    assert kind is failure.kind
    assert words in failure.text
    assert WHERE in failure.text
    assert failure.advice


@pytest.mark.parametrize(
    ("error", "kind", "words"),
    [
        (
            AuthenticationException("Authentication failed: transport shut down or saw EOF"),
            FailureKind.LOST,
            "closed while pi logged in",
        ),
        (EOFError(), FailureKind.LOST, "closed while pi logged in"),
        (AuthenticationException("Authentication timeout."), FailureKind.FROZEN, "no answer"),
    ],
)
def test_login_that_breaks_is_told_from_one_that_is_refused(error, kind, words):
    failure = login_failure(error, "pi", WHERE)

    assert kind is failure.kind
    assert words in failure.text
    assert failure.advice


def test_silence_before_a_word_was_heard_is_a_frozen_machine():
    error = SSHException("Error reading SSH protocol banner")
    error.__context__ = TimeoutError()  # the text alone does not tell

    failure = opening_failure(error, WHERE, 10.0)

    assert FailureKind.FROZEN is failure.kind
    assert "nothing was said in 10 s" in failure.text


@pytest.mark.parametrize(
    "text", ["Error reading SSH protocol banner", "No existing session", "Timeout opening channel."]
)
def test_words_that_are_none_of_ssh_are_no_silence(text):
    error = SSHException(text)
    error.__context__ = TimeoutError()

    failure = opening_failure(error, WHERE, 10.0, has_spoken=False, came_bytes=23)

    assert failure.kind is FailureKind.DATA
    assert "23 bytes came before a login" in failure.text


@pytest.mark.parametrize(
    "error", [EOFError(), ConnectionResetError(104, "reset"), BrokenPipeError()]
)
def test_end_before_a_word_was_heard_is_no_broken_connection(error):
    """As of a machine that goes down or just starts: opening is tried again."""
    failure = opening_failure(error, WHERE, 10.0, has_spoken=False)

    assert FailureKind.REFUSED is failure.kind


def test_failure_in_words_already_stays_as_it_is():
    failure = MachineFailure(FailureKind.NO_SUDO, "text")

    assert failure is opening_failure(failure, WHERE, 1.0)
    assert failure is login_failure(failure, "pi", WHERE)


def test_unknown_host_key_is_shown_with_both_ways_to_accept_it():
    failure = host_key_failure(KeyVerdict(standing=Standing.UNKNOWN), KEY, ("pi",), WHERE)

    assert FailureKind.HOST_KEY_UNKNOWN is failure.kind
    assert f"ssh-ed25519 {KEY.fingerprint}" in failure.text
    assert "--accept-new-host-keys" in failure.advice
    assert "once with ssh" in failure.advice


def test_changed_host_key_names_both_keys_the_line_and_the_danger():
    verdict = KeyVerdict(standing=Standing.CHANGED, against=LINE)

    failure = host_key_failure(verdict, KEY, ("[pi]:2222", "pi"), WHERE)

    assert FailureKind.HOST_KEY_CHANGED is failure.kind
    assert KEY.fingerprint in failure.text
    assert LINE.key.fingerprint in failure.text
    assert "known_hosts:7" in failure.text
    assert f"ssh-keygen -R '[pi]:2222' -f {LINE.file}" in failure.advice
    assert "--accept-new-host-keys" not in failure.advice


def test_revoked_host_key_is_no_matter_of_accepting():
    verdict = KeyVerdict(standing=Standing.REVOKED, against=LINE)

    failure = host_key_failure(verdict, KEY, ("pi",), WHERE)

    assert FailureKind.HOST_KEY_CHANGED is failure.kind
    assert "revoked" in failure.text
    assert "accept" not in failure.advice


def test_jump_host_that_may_not_is_told_from_one_that_does_not_reach_it():
    refused = jump_failure(1, "Administratively prohibited", WHERE)
    unreached = jump_failure(2, "Connect failed", WHERE)

    assert FailureKind.UNSUPPORTED is refused.kind
    assert "AllowTcpForwarding" in refused.advice
    assert FailureKind.UNREACHABLE is unreached.kind


def test_lost_connection_is_told_with_its_cause():
    assert lost(OSError("reset")).text == "the connection is lost (reset)"
    assert FailureKind.LOST is lost().kind


@pytest.mark.process
def test_command_that_shows_a_machines_fingerprints_shows_all_of_its_keys(tmp_path):
    """Most machines have three keys, and ssh-keygen takes one file."""
    if shutil.which("ssh-keygen") is None:
        pytest.skip("needs ssh-keygen")
    for kind in ("ed25519", "ecdsa"):
        path = tmp_path / f"ssh_host_{kind}_key"
        subprocess.run(["ssh-keygen", "-q", "-t", kind, "-N", "", "-f", str(path)], check=True)
    failure = host_key_failure(KeyVerdict(standing=Standing.UNKNOWN), KEY, ("pi",), WHERE)
    (command,) = re.findall("`([^`]*ssh-keygen[^`]*)`", failure.advice)

    done = subprocess.run(
        ["/bin/sh", "-c", command.replace("/etc/ssh", str(tmp_path))],
        capture_output=True,
        text=True,
        check=True,
    )

    assert done.stdout.count("SHA256:") == 2
