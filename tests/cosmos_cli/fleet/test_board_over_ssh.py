"""The process that works on a machine, over a real SSH connection."""

import os
import shutil
import subprocess
import time

import pytest
from ssh_harness import target_of

from cosmos_cli.fleet.failure import FailureKind, MachineFailure
from cosmos_cli.fleet.helper import Helper
from cosmos_cli.fleet.open_connection import connect

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

        until_s = time.monotonic() + 20.0
        while True:
            try:
                second.call("lock", {"path": path, "holder": "second"})
                break
            except MachineFailure:
                assert time.monotonic() < until_s, "the lock outlives its holder"
                time.sleep(0.02)


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
    assert "must be silent" in caught.value.advice


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
