"""The process that works on a machine, over a real SSH connection."""

import contextlib
import os
import shutil
import signal
import subprocess
import time

import pytest
from harness.waiting import is_alive, wait_until
from ssh_harness import needs_sshd, target_of
from sshd import Sshd

from cosmos_cli.fleet import helper
from cosmos_cli.fleet import local as local_module
from cosmos_cli.fleet.failure import FailureKind, MachineFailure
from cosmos_cli.fleet.helper import Helper
from cosmos_cli.fleet.local import LocalConnection, LocalStream
from cosmos_cli.fleet.open_connection import connect
from cosmos_cli.fleet.target import Target

pytestmark = pytest.mark.process


@pytest.fixture
def connection(known):
    made = connect(target_of(known))
    yield made
    made.close()


def test_it_greets_with_what_it_is(connection, known):
    with Helper.start(connection) as board:
        greeting = board.greeting

    assert greeting["uid"] == os.geteuid()
    assert greeting["home"] == str(known.directory)
    assert greeting["pid"] != os.getpid()


def test_lock_is_held_by_one_until_it_ends(connection, tmp_path):
    path = str(tmp_path / "state" / "lock")
    with Helper.start(connection) as first, Helper.start(connection) as second:
        first.call("lock", {"path": path, "holder": "first"})
        with pytest.raises(MachineFailure) as caught:
            second.call("lock", {"path": path, "holder": "second"})
        assert caught.value.kind is FailureKind.BUSY
        assert "first" in caught.value.text
        first.close()

        until_s = time.monotonic() + 60.0
        while True:
            try:
                second.call("lock", {"path": path, "holder": "second"})
                break
            except MachineFailure:
                assert time.monotonic() < until_s, "the lock outlives its holder"
                time.sleep(0.02)


@pytest.mark.parametrize("is_here", [False, True])
def test_signal_that_ends_it_is_told(connection, is_here):
    local = LocalConnection(Target(name="here", address="127.0.0.1", connection="local"))
    with Helper.start(local if is_here else connection) as board:
        os.kill(board.greeting["pid"], signal.SIGKILL)
        wait_until(lambda: not is_alive(board.greeting["pid"]), "end of the helper")
        with pytest.raises(MachineFailure) as caught:
            board.call("lock", {"path": "/nowhere"})

    assert caught.value.kind is FailureKind.LOST
    assert caught.value.text == f"what worked there ended early (signal {signal.SIGKILL.value})"


def test_signal_that_ends_it_a_moment_after_its_pipe_has_closed_is_told(monkeypatch):
    monkeypatch.setattr(local_module, "END_TIMEOUT_S", 60.0)  # on a busy machine
    stream = LocalStream("exec 0<&-; echo ready; sleep 0.3; kill -KILL $$")
    assert stream.read(6, timeout_s=60.0) == b"ready\n"

    with pytest.raises(MachineFailure, match=r"^what worked there ended early \(signal 9\)$"):
        stream.write(b"x", timeout_s=60.0)
    stream.close()


def test_unknown_verb_is_refused_and_the_next_question_answered(connection, tmp_path):
    with Helper.start(connection) as board:
        with pytest.raises(MachineFailure) as caught:
            board.call("no such verb")
        assert caught.value.kind is FailureKind.DEFECT
        board.call("lock", {"path": str(tmp_path / "lock")})


def test_root_answers_where_sudo_works_and_is_refused_elsewhere(connection, tmp_path):
    with Helper.start(connection) as board:
        if os.geteuid() == 0 or _may_sudo():
            board.call("lock", {"path": str(tmp_path / "lock")}, as_root=True)
            return
        with pytest.raises(MachineFailure) as caught:
            board.call("lock", {"path": str(tmp_path / "lock")}, as_root=True)
        assert caught.value.kind is FailureKind.NO_SUDO


def _may_sudo():
    if shutil.which("sudo") is None:
        return False
    return subprocess.run(["sudo", "-n", "true"], capture_output=True, check=False).returncode == 0


@pytest.mark.parametrize("python", ["/no/such/python", "false"])
def test_machine_without_the_python_that_is_named_says_so(known, python):
    connection = connect(target_of(known, python=python))
    try:
        with pytest.raises(MachineFailure) as caught:
            Helper.start(connection, timeout_s=20.0)
    finally:
        connection.close()

    assert caught.value.kind in (FailureKind.PYTHON, FailureKind.LOST)


def test_start_up_file_that_talks_is_told(own_sshd, known_hosts):
    known_hosts.write_text(own_sshd.known_hosts_line())
    talking = own_sshd.directory / "talk"
    talking.write_text('#!/bin/sh\necho Welcome to this board\nexec python3 "$@"\n')
    talking.chmod(0o755)
    connection = connect(target_of(own_sshd, python=str(talking)))
    try:
        with pytest.raises(MachineFailure) as caught:
            Helper.start(connection)
    finally:
        connection.close()

    assert caught.value.kind is FailureKind.DATA
    assert ".ssh/rc" in caught.value.advice and "must be silent" in caught.value.advice


@pytest.mark.parametrize("ends", ["sleep 2; exit 1", "exec >&- 2>&-; sleep 2; exit 1"])
def test_account_without_commands_on_a_busy_board_is_told_though_it_ends_late(
    tmp_path, known_hosts, monkeypatch, ends
):
    needs_sshd()
    monkeypatch.setattr(helper, "LAST_WORDS_S", 60.0)  # this computer may be busy as well
    says = "This account is currently not available."
    with Sshd(tmp_path / "nologin", extra=f"ForceCommand echo {says}; {ends}") as server:
        known_hosts.write_text(server.known_hosts_line())
        connection = connect(target_of(server))
        try:
            with pytest.raises(MachineFailure, match=says) as caught:
                Helper.start(connection)
        finally:
            connection.close()

    assert caught.value.kind is FailureKind.AUTHENTICATION
    assert "exit status 1" in caught.value.text


class LateStream:
    """A stream into which nothing is written before its program has ended."""

    def __init__(self, stream, ends_by_s):
        self._stream = stream
        self._ends_by_s = ends_by_s
        self._read = b""

    def __getattr__(self, name):
        return getattr(self._stream, name)

    def write(self, data, *, timeout_s=0.0):
        while data := self._stream.read(4096, timeout_s=self._ends_by_s):
            self._read += data
        with contextlib.suppress(MachineFailure):
            self._stream.ending(timeout_s=self._ends_by_s)
            while True:
                self._stream.write(b"x", timeout_s=self._ends_by_s)
        return self._stream.write(b"x", timeout_s=self._ends_by_s)

    def read(self, count, *, timeout_s=0.0):
        if self._read:
            data, self._read = self._read, b""
            return data
        return self._stream.read(count, timeout_s=timeout_s)


def test_account_without_commands_that_is_gone_before_the_helper_is_sent_is_told(
    tmp_path, known_hosts, monkeypatch
):
    needs_sshd()
    says = "ForceCommand echo This account is currently not available.; exit 1"
    with Sshd(tmp_path / "nologin", extra=says) as server:
        known_hosts.write_text(server.known_hosts_line())
        connection = connect(target_of(server))
        monkeypatch.setattr(
            connection,
            "open",
            lambda command, open=connection.open: LateStream(open(command), 20.0),
        )
        try:
            with pytest.raises(MachineFailure) as caught:
                Helper.start(connection)
        finally:
            connection.close()

    assert caught.value.kind is FailureKind.AUTHENTICATION
    assert "exit status 1" in caught.value.text
    assert "This account is currently not available." in caught.value.text


def test_machine_that_dies_in_the_midst_of_an_answer_is_lost(own_sshd, known_hosts, tmp_path):
    known_hosts.write_text(own_sshd.known_hosts_line())
    connection = connect(target_of(own_sshd))
    try:
        with Helper.start(connection) as board:
            own_sshd.cut()
            with pytest.raises(MachineFailure) as caught:
                board.call("lock", {"path": str(tmp_path / "lock")})
    finally:
        connection.close()

    assert caught.value.kind is FailureKind.LOST
