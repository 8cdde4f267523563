"""Locks that others hold: waited for until a deadline, and then it is said who holds them."""

import fcntl
import getpass
import os
import subprocess
import sys
import threading

import pytest

from cosmos_cli.errors import InputError
from cosmos_cli.evidence.run_directory import alone, create_run
from cosmos_cli.fleet.ssh import known_hosts
from cosmos_cli.fleet.ssh.known_hosts import HostKey, KnownHosts
from cosmos_cli.system.file_lock import LockHeld, lock_pids, locked, open_lock, take_lock

HOLD = (
    "import fcntl,os,sys; fd=os.open(sys.argv[1], os.O_RDONLY); fcntl.flock(fd, fcntl.LOCK_EX);"
    "print('held', flush=True); sys.stdin.read()"
)


@pytest.fixture
def hold():
    """Have another process lock a file."""
    holders = []

    def begin(path):
        holder = subprocess.Popen(
            [sys.executable, "-c", HOLD, str(path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE
        )
        holders.append(holder)
        assert holder.stdout.readline() == b"held\n"
        return holder

    yield begin
    for holder in holders:
        holder.communicate(timeout=60)


@pytest.mark.process
def test_who_holds_a_lock_is_named(tmp_path, hold):
    path = tmp_path / "lock"
    path.touch()
    holder = hold(path)

    with pytest.raises(LockHeld) as caught, locked(path, timeout_s=0.0):
        raise AssertionError("two hold it")

    words = str(caught.value)
    if words != "somebody":  # a file system that the kernel lists under another device
        assert f"pid {holder.pid} (" in words
        assert f"of user {getpass.getuser()}" in words


@pytest.mark.process
def test_run_that_another_user_holds_is_not_waited_for_without_end(tmp_path, monkeypatch, hold):
    monkeypatch.setenv("COSMOS_STATE_DIR", str(tmp_path / "state"))
    run = create_run(tmp_path / "runs", "a", "all")
    holder = hold(run.path)

    with (
        pytest.raises(InputError, match="another command is collecting it: ") as caught,
        alone(run, patience_s=0.1),
    ):
        raise AssertionError("two collect it")

    assert f"pid {holder.pid}" in str(caught.value) or "somebody" in str(caught.value)


def test_free_lock_is_taken_and_a_second_one_waits(tmp_path):
    path = tmp_path / "lock"
    with locked(path, timeout_s=0.0):
        waiting = threading.Timer(0.2, lambda: None)
        waiting.start()
        with pytest.raises(LockHeld), locked(path, timeout_s=0.1):
            raise AssertionError("two hold it")
    with locked(path, timeout_s=0.0):
        pass


def test_lock_follows_no_link_and_truncates_nothing(tmp_path):
    victim = tmp_path / "victim"
    victim.write_bytes(b"precious")
    (tmp_path / "link").symlink_to(victim)

    with pytest.raises(OSError, match="symbolic links"):
        open_lock(tmp_path / "link")
    os.close(open_lock(victim))

    assert victim.read_bytes() == b"precious"


def test_pipe_in_its_place_holds_nobody_up(tmp_path):
    os.mkfifo(tmp_path / "lock")

    with locked(tmp_path / "lock", timeout_s=0.0):
        pass


def test_only_who_holds_a_lock_is_taken_from_the_kernels_list():
    listed = (
        "1: POSIX  ADVISORY  WRITE 11 00:1f:42 0 EOF\n"
        "2: FLOCK  ADVISORY  WRITE 22 00:1f:42 0 EOF\n"
        "2: -> FLOCK  ADVISORY  WRITE 33 00:1f:42 0 EOF\n"
        "3: FLOCK  ADVISORY  WRITE 44 00:1f:43 0 EOF\n"
        "garbage\n"
    )

    assert lock_pids(listed, device=os.makedev(0, 0x1F), inode=42) == [22]


@pytest.mark.process
def test_known_hosts_that_somebody_locks_is_not_waited_for_without_end(tmp_path, monkeypatch, hold):
    monkeypatch.setattr(known_hosts, "LOCK_TIMEOUT_S", 0.1)
    file = tmp_path / "known_hosts"
    file.touch()
    hold(file)
    known = KnownHosts([file])

    with pytest.raises(OSError, match=r"locked for 0\.1 s by "):
        known.record("pi01", HostKey(kind="ssh-ed25519", blob=b"x"), is_hashed=False)

    assert file.read_bytes() == b""


def test_lock_is_gone_with_its_holder(tmp_path):
    path = tmp_path / "lock"
    descriptor = open_lock(path)
    take_lock(descriptor, timeout_s=0.0)
    os.close(descriptor)

    again = os.open(path, os.O_RDONLY)
    fcntl.flock(again, fcntl.LOCK_EX | fcntl.LOCK_NB)
    os.close(again)
