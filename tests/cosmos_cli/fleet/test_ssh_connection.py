"""Connecting to a real sshd: keys, host keys, configuration, and every way in which it can fail."""

import contextlib
import os
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace

import pytest
from harness.ports import free_port
from harness.waiting import wait_until
from paramiko.ssh_exception import SSHException
from ssh_harness import needs_sshd, target_of, write_configuration
from sshd import Sshd, make_key, public, silent_server

from cosmos_cli.fleet.connection import ConnectOptions
from cosmos_cli.fleet.failure import FailureKind, MachineFailure
from cosmos_cli.fleet.open_connection import connect
from cosmos_cli.fleet.ssh import connect as attempts_module
from cosmos_cli.fleet.ssh import connection as connection_module
from cosmos_cli.fleet.ssh.link_local import address_as_seen
from cosmos_cli.fleet.ssh.transport import SshTransport
from cosmos_cli.fleet.target import Target

pytestmark = pytest.mark.process

ACCEPT = ConnectOptions(accept_new_host_keys=True, timeout_s=60.0)
DEFAULT = ConnectOptions(timeout_s=60.0)
BRIEF = ConnectOptions(timeout_s=1.0)
"""For a machine that does not answer; one that does, may take longer on a busy computer."""


@contextlib.contextmanager
def failing(kind):
    """Expect a failure of a kind."""
    with pytest.raises(MachineFailure) as caught:
        yield caught
    assert kind is caught.value.kind, caught.value
    assert caught.value.advice


def says(target, command="echo hello", options=DEFAULT):
    connection = connect(target, options)
    try:
        return connection.run(command, timeout_s=60.0).stdout
    finally:
        connection.close()


# Host keys.


def test_unknown_host_key_is_refused_and_its_fingerprint_shown(sshd, known_hosts):
    with failing(FailureKind.HOST_KEY_UNKNOWN) as caught:
        connect(target_of(sshd))

    fingerprint = subprocess.run(
        ["ssh-keygen", "-lf", str(sshd.host_keys["ed25519"])], capture_output=True, text=True
    ).stdout.split()[1]
    assert fingerprint in caught.value.text
    assert not known_hosts.exists()


def test_unknown_host_key_is_recorded_when_that_is_wanted_and_known_from_then_on(sshd, known_hosts):
    assert says(target_of(sshd), options=ACCEPT) == b"hello\n"
    assert sshd.known_hosts_line() == known_hosts.read_text()

    assert says(target_of(sshd)) == b"hello\n"
    assert sshd.known_hosts_line() == known_hosts.read_text()


@pytest.mark.parametrize("is_link", [False, True])
def test_known_hosts_that_takes_no_key_is_told_as_this_computers_fault(sshd, known_hosts, is_link):
    if is_link:
        known_hosts.symlink_to(known_hosts)
    else:
        known_hosts.mkdir()

    with failing(FailureKind.HOST_KEY_UNKNOWN) as caught:
        connect(target_of(sshd), ACCEPT)

    assert f"cannot be recorded in {known_hosts} of this computer" in caught.value.text


def test_accept_new_of_the_ssh_configuration_counts_as_wanted(sshd, home, known_hosts):
    write_configuration(home / ".ssh" / "config", "StrictHostKeyChecking accept-new")

    assert says(target_of(sshd)) == b"hello\n"
    assert sshd.known_hosts_line() == known_hosts.read_text()


@pytest.mark.parametrize("options", [DEFAULT, ACCEPT])
def test_changed_host_key_is_refused_whatever_is_wanted(sshd, known_hosts, tmp_path, options):
    other = make_key(tmp_path / "other", "ed25519")
    wrong = f"{sshd.name} {public(other)}"
    known_hosts.write_text(wrong)

    with failing(FailureKind.HOST_KEY_CHANGED) as caught:
        connect(target_of(sshd), options)

    assert f"{known_hosts}:1" in caught.value.text
    assert wrong == known_hosts.read_text()


@pytest.mark.parametrize("kind", ["ed25519", "ecdsa", "rsa"])
def test_server_is_asked_for_a_key_of_the_kind_that_is_known(sshd, known_hosts, kind):
    known_hosts.write_text(sshd.known_hosts_line(kind))

    assert says(target_of(sshd)) == b"hello\n"


def test_key_that_the_server_has_no_more_is_a_change_though_it_has_others(own_sshd, known_hosts):
    known_hosts.write_text(f"{own_sshd.name} ssh-rsa QUJD\n")

    with failing(FailureKind.HOST_KEY_CHANGED):
        connect(target_of(own_sshd), ACCEPT)


def test_revoked_host_key_is_refused(sshd, known_hosts):
    line = sshd.known_hosts_line()
    known_hosts.write_text(f"{line}@revoked * {line.split(' ', 1)[1]}")

    with failing(FailureKind.HOST_KEY_CHANGED) as caught:
        connect(target_of(sshd), ACCEPT)

    assert "revoked" in caught.value.text


def test_hashed_known_hosts_are_understood(known, known_hosts):
    subprocess.run(["ssh-keygen", "-H", "-f", str(known_hosts)], check=True, capture_output=True)

    assert says(target_of(known)) == b"hello\n"


def test_many_threads_record_many_machines_and_lose_none(sshd, home, known_hosts):
    """One server under many aliases: ten connections at once, each a machine of its own to known_hosts."""
    hosts = [f"Host pi{n}\n  HostName {sshd.address}\n  HostKeyAlias pi{n}" for n in range(10)]
    write_configuration(home / ".ssh" / "config", *hosts)
    targets = [target_of(sshd, address=f"pi{n}") for n in range(10)]

    with ThreadPoolExecutor(10) as pool:
        said = list(pool.map(lambda target: says(target, options=ACCEPT), targets))

    assert said == [b"hello\n"] * 10
    names = [line.split()[0] for line in known_hosts.read_text().splitlines()]
    assert sorted(f"pi{n}" for n in range(10)) == sorted(names)


# Logging in.


def test_wrong_key_is_told_with_user_and_key(known, tmp_path):
    wrong = make_key(tmp_path / "wrong", "ed25519")

    with failing(FailureKind.AUTHENTICATION) as caught:
        connect(target_of(known, key_file=str(wrong)))

    assert f"no login as {known.user} with {wrong}" in caught.value.text
    assert "ssh-copy-id" in caught.value.advice


def test_wrong_user_is_told_the_same_way(known):
    with failing(FailureKind.AUTHENTICATION) as caught:
        connect(target_of(known, user="nobody-of-this-name"))

    assert "nobody-of-this-name" in caught.value.text
    assert "ansible_user" in caught.value.advice


def test_missing_key_is_named(known, tmp_path):
    with failing(FailureKind.AUTHENTICATION) as caught:
        connect(target_of(known, key_file=str(tmp_path / "none")))

    assert f"{tmp_path}/none: no such key" in caught.value.text


def test_file_that_is_no_key_is_named(known, known_hosts):
    with failing(FailureKind.AUTHENTICATION) as caught:
        connect(target_of(known, key_file=str(known_hosts)))

    assert "not a private key that is understood" in caught.value.text


def test_key_of_an_unknown_cipher_is_named_and_others_are_tried(known, tmp_path, home):
    key = tmp_path / "other_cipher"
    cipher = ("-Z", "chacha20-poly1305@openssh.com")
    subprocess.run(["ssh-keygen", "-q", "-N", "secret", *cipher, "-f", key], check=True)
    shutil.copy(known.user_key, tmp_path / "good")
    identities = [f"  IdentityFile {name}" for name in (key, tmp_path / "good")]
    write_configuration(home / ".ssh" / "config", "Host *", *identities)

    with failing(FailureKind.AUTHENTICATION) as caught:
        connect(target_of(known, key_file=str(key)))

    assert f"{key} cannot be read (Unsupported cipher: " in caught.value.text
    assert "ssh-add it" in caught.value.text
    assert says(target_of(known, key_file=None)) == b"hello\n"


def test_without_any_key_it_is_said_how_to_get_one(known):
    with failing(FailureKind.AUTHENTICATION) as caught:
        connect(target_of(known, key_file=None))

    assert "no key to log in with" in caught.value.text
    assert "ssh-keygen" in caught.value.advice


def test_usual_key_files_are_tried(known, home):
    shutil.copy(known.user_key, home / ".ssh" / "id_ed25519")

    assert says(target_of(known, key_file=None)) == b"hello\n"


def test_no_more_than_three_keys_are_tried(own_sshd, home, known_hosts, tmp_path):
    known_hosts.write_text(own_sshd.known_hosts_line())
    keys = [make_key(tmp_path / f"key{n}", "ed25519") for n in range(5)]
    write_configuration(home / ".ssh" / "config", *(f"IdentityFile {key}" for key in keys))

    with failing(FailureKind.AUTHENTICATION) as caught:
        connect(target_of(own_sshd, key_file=None))

    assert "no more than 3 keys are tried" in caught.value.text
    # Its server answers before it writes down what it has answered.
    wait_until(lambda: not own_sshd.sessions(), "end of the session")
    assert own_sshd.log.read_text().count("Failed publickey") == 3


def test_password_is_never_tried(tmp_path, known_hosts):
    needs_sshd()
    with Sshd(tmp_path / "s", extra="PubkeyAuthentication no", has_passwords=True) as server:
        known_hosts.write_text(server.known_hosts_line())

        with failing(FailureKind.AUTHENTICATION) as caught:
            connect(target_of(server))

        assert "takes no key" in caught.value.text
        assert "password" not in server.log.read_text().replace("PasswordAuthentication", "")


def test_key_alone_that_is_not_enough_is_told(tmp_path, known_hosts):
    needs_sshd()
    extra = "AuthenticationMethods publickey,password"
    with Sshd(tmp_path / "s", extra=extra, has_passwords=True) as server:
        known_hosts.write_text(server.known_hosts_line())

        with failing(FailureKind.AUTHENTICATION) as caught:
            connect(target_of(server))

        assert "asked for more than a key (password)" in caught.value.text


@pytest.fixture
def agent(monkeypatch, tmp_path):
    """A real ssh-agent of the test's own."""
    socket_file = f"{tmp_path}/agent"
    process = subprocess.Popen(
        ["ssh-agent", "-D", "-a", socket_file], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    wait_until(lambda: answers(socket_file), "a socket of the agent", process=process)
    monkeypatch.setenv("SSH_AUTH_SOCK", socket_file)
    yield lambda key, **more: subprocess.run(
        ["ssh-add", "-q", str(key)], check=True, stdin=subprocess.DEVNULL, **more
    )
    process.terminate()
    process.wait()


def answers(socket_file):
    """Whether somebody listens there: the file is there a moment before."""
    with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX) as sock:
        sock.connect(socket_file)
        return True
    return False


def test_key_in_the_ssh_agent_is_used_by_many_threads(known, agent):
    agent(known.user_key)

    with ThreadPoolExecutor(6) as pool:
        said = list(pool.map(lambda _: says(target_of(known, key_file=None)), range(6)))

    assert said == [b"hello\n"] * 6


def test_key_with_a_passphrase_is_used_through_the_agent(known, agent, tmp_path, monkeypatch):
    key = tmp_path / "locked"
    shutil.copy(known.user_key, key)
    subprocess.run(["ssh-keygen", "-q", "-p", "-N", "secret", "-f", str(key)], check=True)

    with failing(FailureKind.AUTHENTICATION) as caught:
        connect(target_of(known, key_file=str(key)))
    assert f"{key} needs its passphrase: ssh-add it" in caught.value.text

    asks = tmp_path / "askpass"
    asks.write_text("#!/bin/sh\necho secret\n")
    asks.chmod(0o755)
    environment = {**os.environ, "SSH_ASKPASS": str(asks), "SSH_ASKPASS_REQUIRE": "force"}
    agent(key, env=environment)
    from cosmos_cli.fleet.ssh import keys as ssh_keys

    ssh_keys._agent_keys.cache_clear()  # a process asks its agent once; here the agent has learnt since

    assert says(target_of(known, key_file=str(key))) == b"hello\n"


def test_key_with_which_the_agent_does_not_sign_leaves_the_others(known, agent, home, tmp_path):
    refused = make_key(tmp_path / "refused", "ed25519")
    nobody = {"SSH_ASKPASS": "/bin/false", "SSH_ASKPASS_REQUIRE": "force"}
    subprocess.run(["ssh-add", "-q", "-c", refused], check=True, env={**os.environ, **nobody})

    with failing(FailureKind.AUTHENTICATION) as caught:
        connect(target_of(known, key_file=None))
    shutil.copy(known.user_key, home / ".ssh" / "id_ed25519")

    assert "the ssh agent does not sign with " in caught.value.text
    assert says(target_of(known, key_file=None)) == b"hello\n"


def test_public_key_as_identity_names_one_that_the_agent_holds(known, agent, tmp_path):
    agent(make_key(tmp_path / "other", "ed25519"))
    agent(known.user_key)
    (tmp_path / "mine.pub").write_text(public(known.user_key))

    for name in ("mine.pub", "mine"):
        assert says(target_of(known, key_file=str(tmp_path / name))) == b"hello\n"


def test_identities_only_keeps_the_agents_other_keys_back(known, agent, home):
    agent(known.user_key)
    write_configuration(home / ".ssh" / "config", "IdentitiesOnly yes")

    with failing(FailureKind.AUTHENTICATION) as caught:
        connect(target_of(known, key_file=None))

    assert "no key to log in with" in caught.value.text


# Not reached.


def test_port_without_a_server_is_refused(known):
    with failing(FailureKind.REFUSED) as caught:
        connect(target_of(known, port=free_port("127.0.0.1")), BRIEF)

    assert "connection refused" in caught.value.text


def test_server_that_starts_meanwhile_is_reached_in_a_further_attempt(
    tmp_path, known_hosts, monkeypatch
):
    needs_sshd()
    server = Sshd(tmp_path / "late")
    known_hosts.write_text(server.known_hosts_line())
    with contextlib.ExitStack() as stack:
        pauses_s = []

        def pause(seconds):
            if not pauses_s:
                stack.enter_context(server)
            pauses_s.append(seconds)

        clock = SimpleNamespace(monotonic=time.monotonic, sleep=pause)
        monkeypatch.setattr(attempts_module, "time", clock)
        assert says(target_of(server)) == b"hello\n"

    assert pauses_s == [attempts_module.PAUSES_S[0]]


def test_silent_server_is_frozen_and_costs_no_more_than_the_deadline():
    with silent_server() as port:
        start_s = time.monotonic()

        with failing(FailureKind.FROZEN):
            connect(Target(name="pi", address="127.0.0.1", port=port), BRIEF)

        assert time.monotonic() - start_s < DEFAULT.timeout_s


def test_command_on_a_machine_that_froze_meanwhile_is_given_up_long_before_its_deadline(
    own_sshd, known_hosts, monkeypatch
):
    known_hosts.write_text(own_sshd.known_hosts_line())
    monkeypatch.setattr(connection_module, "QUIET_S", 0.05)
    monkeypatch.setattr(connection_module, "SIGN_S", 2.0)
    connection = connect(target_of(own_sshd))

    def freeze_when_it_runs():
        wait_until(lambda: own_sshd.left("6123.5"), "no command")
        own_sshd.freeze()

    freezing = threading.Thread(target=freeze_when_it_runs)
    try:
        freezing.start()
        with pytest.raises(MachineFailure, match="the machine stopped answering") as caught:
            connection.run("sleep 6123.5", timeout_s=60.0)
    finally:
        freezing.join()
        own_sshd.thaw()
        connection.close()

    assert caught.value.kind is FailureKind.LOST


def test_command_that_says_nothing_is_waited_for_while_its_machine_lives(
    sshd, known_hosts, monkeypatch
):
    known_hosts.write_text(sshd.known_hosts_line())
    monkeypatch.setattr(connection_module, "QUIET_S", 0.05)
    asked = []
    gives_sign = SshTransport.gives_sign

    def count(self, **how):
        asked.append(how)
        return gives_sign(self, **how)

    monkeypatch.setattr(SshTransport, "gives_sign", count)

    assert says(target_of(sshd), "sleep 1; echo done") == b"done\n"
    assert asked


def test_stopped_server_is_frozen(own_sshd, known_hosts):
    known_hosts.write_text(own_sshd.known_hosts_line())
    own_sshd.freeze()
    try:
        with failing(FailureKind.FROZEN):
            connect(target_of(own_sshd), BRIEF)
    finally:
        own_sshd.thaw()


def test_name_that_nobody_knows_is_told(known):
    with failing(FailureKind.UNREACHABLE) as caught:
        connect(target_of(known, address="no-such-machine.invalid"), BRIEF)

    assert "the name is not known" in caught.value.text


def test_what_is_no_name_is_told(known):
    with failing(FailureKind.UNREACHABLE):
        connect(target_of(known, address="a..b"), BRIEF)


@contextlib.contextmanager
def speaking_server(answer: bytes, *, stays: bool = False):
    """A server that says something and closes, or hears the other side out before."""
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def serve():
            with contextlib.suppress(OSError):
                while True:
                    connection, _ = listener.accept()
                    with connection:
                        connection.sendall(answer)
                        while stays and connection.recv(4096):
                            pass

        thread = threading.Thread(target=serve, daemon=True)
        thread.start()
        yield listener.getsockname()[1]
        listener.shutdown(socket.SHUT_RDWR)
        thread.join()


def test_server_that_closes_at_once_is_told(known):
    with speaking_server(b"") as port, failing(FailureKind.REFUSED) as caught:
        connect(target_of(known, port=port), DEFAULT)

    assert "before a word of SSH was said" in caught.value.text


def test_server_that_closes_in_the_midst_of_it_is_told(known):
    with speaking_server(b"SSH-2.0-test\r\n") as port, failing(FailureKind.LOST):
        connect(target_of(known, port=port), DEFAULT)


def test_server_of_another_protocol_is_told(known):
    answer = b"HTTP/1.0 400 no such thing\r\n" * 200
    with speaking_server(answer) as port, failing(FailureKind.LOST) as caught:
        connect(target_of(known, port=port), DEFAULT)

    assert "Indecipherable protocol version" in caught.value.text


@pytest.mark.parametrize(
    "packet",
    [
        b"\0\0\0\x0c\xc8" + b"x" * 200,  # more padding than packet
        b"\0\0\0\x14\x04\x01\0\0\0\x02\0\0\0\x02\xff\xfe" + b"x" * 8,  # no text
    ],
)
def test_server_that_speaks_a_broken_ssh_is_no_defect(known, packet):
    server = speaking_server(b"SSH-2.0-test\r\n" + packet, stays=True)
    with server as port, failing(FailureKind.LOST) as caught:
        connect(target_of(known, port=port), DEFAULT)

    assert "what it said is not understood: " in caught.value.text


def test_server_that_names_itself_and_says_nothing_more_is_frozen(known):
    with socket.create_server(("127.0.0.1", 0)) as listener:
        sends = threading.Thread(target=lambda: accepted.append(greet(listener)), daemon=True)
        accepted = []
        sends.start()

        with failing(FailureKind.FROZEN):
            connect(target_of(known, port=listener.getsockname()[1]), BRIEF)

        sends.join()
        accepted[0].close()


def greet(listener):
    accepted, _ = listener.accept()
    accepted.sendall(b"SSH-2.0-silent\r\n")
    return accepted


SPOKEN_TO = """
import socket, sys, threading
from cosmos_cli.fleet.failure import MachineFailure
from cosmos_cli.fleet.connection import ConnectOptions
from cosmos_cli.fleet.open_connection import connect
from cosmos_cli.fleet.target import Target

heard = threading.Event()
listener = socket.create_server(("127.0.0.1", 0))

def hear():
    accepted = listener.accept()[0]
    if accepted.recv(8) == b"SSH-2.0-":
        heard.set()

class Finder:
    def find_spec(self, name, path=None, target=None):
        if name == "fabric":
            print("spoken to" if heard.wait(20.0) else "left waiting", flush=True)

assert not {"fabric", "paramiko"} & sys.modules.keys()
sys.meta_path.insert(0, Finder())
threading.Thread(target=hear).start()
try:
    connect(Target(name="pi", address="127.0.0.1", port=listener.getsockname()[1]), ConnectOptions(timeout_s=1.0))
except MachineFailure as failure:
    print(failure.kind)
"""


def test_machine_is_spoken_to_while_fabric_is_imported(known):
    done = subprocess.run(
        [sys.executable, "-c", SPOKEN_TO], capture_output=True, text=True, timeout=60.0
    )

    assert done.stdout.split("\n")[0] == "spoken to", done.stderr


# The operator's configuration.


def test_alias_of_the_ssh_configuration_is_understood(sshd, home, known_hosts):
    write_configuration(
        home / ".ssh" / "config",
        "Host board",
        f"  HostName {sshd.address}",
        f"  Port {sshd.port}",
        f"  User {sshd.user}",
        f"  IdentityFile {sshd.user_key}",
        "  IdentitiesOnly yes",
    )
    known_hosts.write_text(sshd.known_hosts_line())
    target = target_of(sshd, address="board", port=None, user=None, key_file=None)

    assert says(target) == b"hello\n"


def test_inventory_wins_over_the_ssh_configuration(known, home):
    write_configuration(
        home / ".ssh" / "config", "Host *", "  Port 1", "  User wrong", "  IdentityFile /none"
    )

    assert says(target_of(known)) == b"hello\n"


def test_proxy_jump_leads_through_other_machines(sshd, own_sshd, home, known_hosts):
    write_configuration(
        home / ".ssh" / "config",
        "Host first second",
        f"  User {sshd.user}",
        "Host first",
        f"  HostName {sshd.address}",
        f"  Port {sshd.port}",
        f"  IdentityFile {sshd.user_key}",
        "Host second",
        f"  HostName {own_sshd.address}",
        f"  Port {own_sshd.port}",
        f"  IdentityFile {own_sshd.user_key}",
        "Host last",
        f"  HostName {sshd.address}",
        "  ProxyJump first,second",
    )
    known_hosts.write_text(sshd.known_hosts_line() + own_sshd.known_hosts_line())
    connection = connect(target_of(sshd, address="last"))
    try:
        said = connection.run("echo $SSH_CONNECTION", timeout_s=60.0).stdout.split()
    finally:
        connection.close()

    assert str(sshd.port).encode() == said[3]
    assert len(own_sshd.log.read_text().split("Accepted publickey")) == 2
    # What it could not do; that the last end came by a reset is none of it.
    assert "error: " not in own_sshd.log.read_text()


def test_failure_of_a_jump_host_names_it(known, home):
    write_configuration(
        home / ".ssh" / "config", "Host pi", f"  ProxyJump 127.0.0.1:{free_port('127.0.0.1')}"
    )

    with failing(FailureKind.REFUSED) as caught:
        connect(target_of(known, address="pi"), BRIEF)

    assert caught.value.text.startswith("jump host 127.0.0.1: ")


def test_machine_behind_a_jump_host_that_is_not_reached_is_told(known, home):
    write_configuration(
        home / ".ssh" / "config",
        "Host gate",
        f"  HostName {known.address}",
        f"  Port {known.port}",
        f"  User {known.user}",
        f"  IdentityFile {known.user_key}",
        "Host 127.0.0.9",
        "  ProxyJump gate",
    )

    with failing(FailureKind.UNREACHABLE) as caught:
        connect(target_of(known, address="127.0.0.9", port=free_port("127.0.0.9")), DEFAULT)

    assert "the jump host does not reach it" in caught.value.text


@pytest.mark.parametrize(
    ("is_alive", "kind", "told"),
    [
        (True, FailureKind.UNREACHABLE, "pi port 22: the jump host got no answer of it in 3 s"),
        (False, FailureKind.FROZEN, "pi port 22: the jump host stopped answering"),
    ],
)
def test_machine_that_a_jump_host_gets_no_answer_of_is_not_one_that_opens(is_alive, kind, told):
    """As of one that is switched off: sshd there waits longer than anybody here."""

    def open_channel(*arguments, **more):
        raise SSHException("Timeout opening channel.")

    transport = SimpleNamespace(open_channel=open_channel)
    hop = SimpleNamespace(transport=transport, is_alive=lambda: is_alive)

    with failing(kind) as caught:
        connection_module.SshConnection.wire_to(hop, "pi", 22, timeout_s=3.0)

    assert caught.value.text == told


def test_jump_host_for_all_hosts_is_not_its_own(own_sshd, home):
    write_configuration(
        home / ".ssh" / "config",
        "Host *",
        f"  ProxyJump {own_sshd.user}@127.0.0.1:{own_sshd.port}",
        f"  IdentityFile {own_sshd.user_key}",
    )

    assert (
        says(target_of(own_sshd, address="localhost", key_file=None), options=ACCEPT) == b"hello\n"
    )
    assert own_sshd.log.read_text().count("Accepted publickey") == 2


PIPE = (
    "python3 -c 'import socket, sys, threading, os\n"
    "s = socket.create_connection((sys.argv[1], int(sys.argv[2])))\n"
    "def up():\n"
    "  while d := os.read(0, 65536): s.sendall(d)\n"
    "threading.Thread(target=up, daemon=True).start()\n"
    "while d := s.recv(65536): os.write(1, d)' "
)


def test_proxy_command_carries_the_connection_and_ends_with_it(known, home, tmp_path):
    script = tmp_path / "proxy"
    script.write_text(f"#!/bin/sh\necho $$ > {tmp_path}/pid\nexec {PIPE} $1 $2\n")
    script.chmod(0o755)
    write_configuration(home / ".ssh" / "config", "Host *", f"  ProxyCommand {script} %h %p")

    assert says(target_of(known)) == b"hello\n"

    pid = int((tmp_path / "pid").read_text())
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)


def test_proxy_command_that_ends_at_once_is_told(known, home):
    write_configuration(home / ".ssh" / "config", "Host *", "  ProxyCommand false")

    with failing(FailureKind.REFUSED):
        connect(target_of(known), DEFAULT)


# What a connection knows.


def test_nagles_delay_is_off(known):
    connection = connect(target_of(known))
    try:
        sock = connection._wire._pipe
        assert sock.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY) == 1
    finally:
        connection.close()


@pytest.mark.parametrize(
    ("own", "said", "expected"),
    [
        ("fe80::a", "fe80::a%eth0 48732 fe80::1%eth0 22\n", "fe80::a%eth0"),
        ("fe80::a", "a greeting\nfe80::a%wlan0.1 1 fe80::1%wlan0.1 22\n", "fe80::a%wlan0.1"),
        ("fe80::a", "fe80::b%eth0 48732 fe80::1%eth0 22\n", "fe80::a"),
        ("fe80::a", "fe80::a%$(reboot) 48732 fe80::1%eth0 22\n", "fe80::a"),
        ("fe80::a", "\n", "fe80::a"),
        ("fe80::a", None, "fe80::a"),
        ("fd00::a", "fd00::a%eth0 48732 fd00::1 22\n", "fd00::a"),
        ("10.0.0.1", "", "10.0.0.1"),
        ("", "", ""),
    ],
)
def test_link_local_address_of_this_computer_is_as_the_machine_sees_it(own, said, expected):
    """Without the machine's interface no program there can connect to it."""

    def run(command, **limits):
        if said is None:
            raise MachineFailure(FailureKind.LOST, "cut")
        return SimpleNamespace(stdout=said.encode())

    assert address_as_seen(own, run) == expected


def test_addresses_are_those_of_both_ends(known):
    connection = connect(target_of(known))
    try:
        assert (connection.own_address, connection.peer_address) == ("127.0.0.1", "127.0.0.1")
        assert connection.opening_s > 0.0
    finally:
        connection.close()


def test_nothing_is_left_behind_by_a_connection(known):
    before = set(threading.enumerate())  # of which one of an earlier test may just end
    files = open_files()

    for _ in range(3):
        says(target_of(known))

    wait_until(lambda: set(threading.enumerate()) <= before, "threads that went on")
    assert open_files() <= files


def open_files():
    """What this process has open: sockets and pipes have a number of their own each."""
    found = set()
    for link in Path("/proc/self/fd").iterdir():
        with contextlib.suppress(FileNotFoundError):  # that of the listing itself
            found.add(os.readlink(link))
    return found - {f"/proc/{os.getpid()}/fd"}


def test_living_machine_gives_a_sign(known):
    connection = connect(target_of(known))
    try:
        assert connection.is_alive(timeout_s=60.0)
        assert connection.is_alive(timeout_s=60.0)
    finally:
        connection.close()


def test_frozen_machine_gives_none_within_the_deadline(own_sshd, known_hosts):
    known_hosts.write_text(own_sshd.known_hosts_line())
    connection = connect(target_of(own_sshd))
    own_sshd.freeze()
    try:
        start_s = time.monotonic()
        assert not connection.is_alive(timeout_s=0.5)
        assert time.monotonic() - start_s < DEFAULT.timeout_s
        own_sshd.thaw()
        assert connection.is_alive(timeout_s=60.0)
    finally:
        own_sshd.thaw()
        connection.close()


def test_machine_that_is_gone_gives_no_sign(own_sshd, known_hosts):
    known_hosts.write_text(own_sshd.known_hosts_line())
    connection = connect(target_of(own_sshd))
    try:
        own_sshd.cut()
        assert not connection.is_alive(timeout_s=10.0)
        with failing(FailureKind.LOST):
            connection.run("true", timeout_s=5.0)
    finally:
        connection.close()


def test_secret_stands_in_no_process_list(known):
    """The key's path may be seen; what is in it may not."""
    key = known.user_key.read_text().splitlines()[1]
    connection = connect(target_of(known))
    try:
        assert (
            key.encode()
            not in connection.run(
                "cat /proc/[0-9]*/cmdline /proc/[0-9]*/environ 2>/dev/null", timeout_s=20.0
            ).stdout
        )
    finally:
        connection.close()


def test_interrupt_in_the_main_thread_is_not_swallowed(known):
    connection = connect(target_of(known))

    def interrupt_when_it_runs():
        wait_until(lambda: known.left("6124.5"), "no command")
        os.kill(os.getpid(), signal.SIGINT)

    interrupting = threading.Thread(target=interrupt_when_it_runs)
    try:
        with pytest.raises(KeyboardInterrupt):
            interrupting.start()
            connection.run("sleep 6124.5", timeout_s=60.0)
    finally:
        interrupting.join()
        connection.close()
