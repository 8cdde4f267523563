"""Machines that drip their answers or send ones without end: they fail by themselves, and hold nobody up."""

import contextlib
import json
import os
import socket
import struct
import subprocess
import sys
import threading
import time
from types import SimpleNamespace

import pytest
from paramiko.ssh_exception import SSHException
from ssh_harness import needs_sshd, target_of, write_configuration
from sshd import Sshd

from cosmos_cli.fleet.failure import FailureKind, MachineFailure
from cosmos_cli.fleet.helper import Helper
from cosmos_cli.fleet.local import LocalConnection
from cosmos_cli.fleet.open_connection import connect
from cosmos_cli.fleet.ssh.connection import _converse
from cosmos_cli.fleet.ssh.socket import SshSocket
from cosmos_cli.fleet.ssh.stream import SshStream
from cosmos_cli.fleet.ssh.transport import SshTransport
from cosmos_cli.fleet.target import Target
from cosmos_cli.fleet.transfer_limits import BoundedOutput, OutputLimits

pytestmark = pytest.mark.process

HOSTILE = {
    "endless": "yes",
    "line": "cat /dev/zero",
    "errors": "yes >&2",
    "drip": "while printf x; do sleep 0.1; done",
}
MEMORY_BYTES_MAX = 400_000_000
MEASURE = """
import os, sys
os.set_inheritable(int(sys.argv[1]), False)
pid = os.spawnv(os.P_NOWAIT, sys.argv[2], sys.argv[2:])
_, status, used = os.wait4(pid, 0)
os.write(int(sys.argv[1]), str(used.ru_maxrss).encode())
sys.exit(os.waitstatus_to_exitcode(status))
"""
PATIENCE_S = 120.0


@pytest.fixture(scope="module")
def servers(tmp_path_factory):
    needs_sshd()
    with contextlib.ExitStack() as stack:
        commands = {"good": None, **HOSTILE}
        made = {}
        for number, (name, command) in enumerate(commands.items(), start=1):
            extra = f"ForceCommand {command}" if command else ""
            folder = tmp_path_factory.mktemp(name)
            server = Sshd(folder, address=f"127.0.0.{number}", extra=extra)
            made[name] = stack.enter_context(server)
        yield made


@pytest.fixture
def inventory(servers, tmp_path, known_hosts, monkeypatch, home):
    # Several logins at once take a busy computer long.
    write_configuration(home / ".ssh" / "config", "Host *", "  ConnectTimeout 60")
    monkeypatch.setenv("COSMOS_STATE_DIR", str(tmp_path / "state"))  # where no other run is known
    known_hosts.write_text("".join(server.known_hosts_line() for server in servers.values()))
    hosts = {
        name: server.variables | {"cosmos_root": str(tmp_path / "root")}
        for name, server in servers.items()
    }
    # The good one is the last: it must not wait for those before it.
    names = [*HOSTILE, "good"]
    lines = [f"    {name}: {json.dumps(hosts[name])}" for name in names]
    file = tmp_path / "inventory.yaml"
    file.write_text("\n".join(["all:", "  hosts:", *lines]) + "\n")
    return str(file)


class Command:
    """
    A `cosmos` of its own process: what it said, when, and how much memory it took.

    The kernel counts the peak of who starts a program as the program's own; the tests' is large, a small one's is not.
    """

    def __init__(self, *arguments):
        measured, written = os.pipe()
        process = subprocess.Popen(
            [
                sys.executable,
                "-S",
                "-c",
                MEASURE,
                str(written),
                sys.executable,
                "-m",
                "cosmos_cli.start",
                *arguments,
            ],
            pass_fds=(written,),
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            stdin=subprocess.DEVNULL,
            text=True,
        )
        start_s = time.monotonic()
        self.lines = []
        for line in process.stdout:
            self.lines.append(line.rstrip())
            assert time.monotonic() - start_s < PATIENCE_S
        process.stdout.close()
        self.code = process.wait(PATIENCE_S)
        os.close(written)
        with open(measured) as file:
            self.memory_bytes = int(file.read()) * 1024

    def line_of(self, name, *words):
        found = [
            number
            for number, line in enumerate(self.lines)
            if line.split(":")[0].split()[:1] == [name] and all(word in line for word in words)
        ]
        assert found, f"no line of {name} with {words}: {self.lines}"
        return found[0]


def test_ping_tells_the_others_first_and_each_failure_by_name(inventory):
    ping = Command("ping", "-i", inventory)

    assert ping.code == 3
    assert ping.line_of("good", "ok") < ping.line_of("drip", "failed")
    for name in ("endless", "line", "errors"):
        ping.line_of(name, "failed", "said more than 1048576 bytes")
    ping.line_of("drip", "did not end in 10 s")
    assert ping.lines[-1] == "5 machines: 1 answered, 4 failed"
    assert ping.memory_bytes < MEMORY_BYTES_MAX


def test_exec_ends_what_does_not_end_at_its_deadline(inventory):
    done = Command("exec", "-i", inventory, "--timeout", "6", "--", "echo here")

    assert done.code == 3
    assert done.line_of("good", "| here") < done.line_of("drip", "did not end in 6 s")
    for name in ("endless", "line", "errors"):
        line = done.lines[done.line_of(name)]
        assert "did not end in 6 s" in line or "said more than" in line
    assert done.memory_bytes < MEMORY_BYTES_MAX


@pytest.mark.nightly
def test_ps_says_who_could_not_be_asked(inventory):
    done = Command("ps", "-i", inventory)

    assert done.code == 3
    assert "no run lives on this machine and on the 1 machine that answered" in done.lines
    unasked = next(line for line in done.lines if "could not be asked" in line)
    assert unasked.startswith("whether a run lives there is not known: ")
    assert all(name in unasked for name in HOSTILE) and "good" not in unasked
    done.line_of("line", "expected an answer of at most 8388608 bytes, got one without an end")
    done.line_of("endless", "expected an answer, got 'y'")
    done.line_of("drip", "its answer was not whole after 20 s")
    assert done.memory_bytes < MEMORY_BYTES_MAX


def test_ps_of_machines_none_of_which_answers_does_not_say_that_no_run_lives_there(inventory):
    done = Command("ps", "-i", inventory, "--limit", "line")

    assert done.code == 3
    assert "no run lives on this machine" in done.lines
    assert "whether a run lives there is not known: line could not be asked" in done.lines


@pytest.mark.parametrize("name", HOSTILE)
def test_helper_that_is_no_helper_is_given_up(servers, known_hosts, name):
    known_hosts.write_text(servers[name].known_hosts_line())
    connection = connect(target_of(servers[name]))
    try:
        start_s = time.monotonic()
        with pytest.raises(MachineFailure) as caught:
            Helper.start(connection, timeout_s=2.0)
        assert time.monotonic() - start_s < PATIENCE_S / 2
        assert caught.value.kind in (FailureKind.DATA, FailureKind.TIMEOUT)
    finally:
        connection.close()


def test_server_that_talks_before_a_login_without_end_is_given_up(tmp_path, home):
    (home / ".ssh" / "config").write_text(
        f"Host *\n  ProxyCommand cat /dev/zero\n{(home / '.ssh' / 'config').read_text()}"
    )
    file = tmp_path / "inventory.yaml"
    file.write_text('all:\n  hosts:\n    babbler: {"ansible_host": "192.0.2.1"}\n')

    ping = Command("ping", "-i", str(file))

    assert ping.code == 3
    ping.line_of("babbler", "bytes came before a login")
    assert ping.memory_bytes < MEMORY_BYTES_MAX


def test_packet_of_gigabytes_is_refused_when_it_is_announced():
    ours, theirs = socket.socketpair()
    with ours, theirs:
        transport = SshTransport(SshSocket(ours))
        theirs.sendall(b"SSH-2.0-hostile\r\n" + struct.pack(">I", 0x7FFFFF04) + bytes(4096))
        try:
            with pytest.raises(SSHException, match=r"a packet of \d{10} bytes was announced"):
                transport.begin(timeout_s=PATIENCE_S)
                transport.start_client(timeout=PATIENCE_S)
        finally:
            transport.close()


class Endless:
    """A command whose output never ends and is there whenever somebody looks."""

    def read(self, count, *, timeout_s=0.0):
        return b"y\n" * 1000

    def fileno(self):
        raise AssertionError("nobody needs to wait")


@pytest.mark.parametrize(
    ("limits", "kind"),
    [
        (OutputLimits(timeout_s=0.2, said_bytes_max=10**15), FailureKind.TIMEOUT),
        (OutputLimits(timeout_s=PATIENCE_S, said_bytes_max=10**6), FailureKind.DATA),
    ],
)
def test_command_that_is_never_silent_ends_at_its_limits(limits, kind):
    outputs = BoundedOutput(100, 100), BoundedOutput(100, 100)

    with pytest.raises(MachineFailure) as caught:
        _converse(Endless(), None, outputs, limits, gives_sign=lambda timeout_s: True)

    assert caught.value.kind is kind
    assert len(outputs[0].data) < 300


@pytest.mark.parametrize(
    ("most", "kind"), [(10**15, FailureKind.TIMEOUT), (10**6, FailureKind.DATA)]
)
def test_command_here_that_is_never_silent_ends_at_its_limits(most, kind):
    connection = LocalConnection(Target(name="here", address="127.0.0.1", connection="local"))

    with pytest.raises(MachineFailure) as caught:
        connection.run(
            "yes", timeout_s=1.0 if kind == "timeout" else PATIENCE_S, said_bytes_max=most
        )

    assert caught.value.kind is kind


def test_standard_error_without_end_keeps_nobody_from_the_output():
    event = SimpleNamespace(set_event=lambda bell: None)
    channel = SimpleNamespace(
        in_buffer=event,
        in_stderr_buffer=event,
        recv_stderr_ready=lambda: True,
        recv_stderr=lambda count: b"e" * 1000,
        recv_ready=lambda: True,
        recv=lambda count: b"out",
        close=lambda: None,
        eof_received=False,
        status_event=threading.Event(),
    )
    stream = SshStream(channel, SimpleNamespace(is_active=lambda: True))

    assert stream.read(100) == b"out"
    assert len(stream.ending().errors) <= 8192
    stream.close()
