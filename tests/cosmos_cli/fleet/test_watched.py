"""A watched command ends, with its children, when its standard input does; otherwise it is as it was."""

import contextlib
import os
import signal
import time
from pathlib import Path

import pytest

from cosmos_cli.fleet.connection import OUTPUT_BYTES_MAX
from cosmos_cli.fleet.failure import FailureKind, MachineFailure
from cosmos_cli.fleet.liveness import BlockingStream
from cosmos_cli.fleet.local import LocalConnection
from cosmos_cli.fleet.shell import FORCED_AFTER_S, NO_SUDO_MARK, watched
from cosmos_cli.fleet.target import Target

pytestmark = pytest.mark.process

WAIT_S = 60.0


@pytest.fixture
def here():
    return LocalConnection(Target(name="here", address="127.0.0.1", connection="local"))


@pytest.mark.parametrize(
    ("command", "status", "output"),
    [
        ("echo hello", 0, b"hello\n"),
        ("exit 3", 3, b""),
        ("echo 'a b' \"c\"; false", 1, b"a b c\n"),
        ("cat; echo $#", 0, b"0\n"),
        ("no-such-command-anywhere", 127, b""),
        ("kill -9 $$", -9, b""),
        ("echo one\necho two", 0, b"one\ntwo\n"),
    ],
)
def test_command_does_what_it_did(here, command, status, output):
    done = here.run(watched(command), stdin=None, timeout_s=WAIT_S)

    assert (done.exit_status, done.stdout) == (status, output)


def test_nothing_is_left_when_it_has_ended(here, tmp_path):
    here.run(watched(f"ps -o pid= -g $$ > {tmp_path}/pids; echo $$ > {tmp_path}/group"),
             stdin=None, timeout_s=WAIT_S)  # fmt: skip
    group = int((tmp_path / "group").read_text())

    assert group_is_gone(group)


def group_is_gone(group):
    until_s = time.monotonic() + WAIT_S
    while time.monotonic() < until_s:
        if not living(group):
            return True
        time.sleep(0.02)
    return False


def living(group):
    """Pids of a process group's members; one that has ended is none though nobody has asked for its status."""
    found = []
    for entry in Path("/proc").iterdir():
        with contextlib.suppress(OSError, ValueError):
            fields = (entry / "stat").read_text().rpartition(")")[2].split()
            if entry.name.isdigit() and int(fields[2]) == group and fields[0] != "Z":
                found.append(int(entry.name))
    return found


@pytest.mark.parametrize(
    "command",
    [
        "sleep 60",
        "sleep 61 & sleep 62; wait",
        "sh -c 'trap : TERM; while :; do sleep 1; done'",
        "(sleep 63 &) ; sleep 64",
    ],
)
def test_end_of_standard_input_ends_it_and_its_children(here, command):
    stream = here.open(f"echo $$; {watched(command)}")
    group = int(BlockingStream(stream).read_some(100, timeout_s=WAIT_S))
    assert living(group)
    stream.close_writing()

    assert group_is_gone(group)
    stream.close()


def test_command_is_asked_to_end_before_it_is_made_to(here, tmp_path):
    command = f"trap 'echo asked > {tmp_path}/asked; exit' TERM; echo ready; sleep 60 & wait"
    forced = f"sleep {FORCED_AFTER_S}; kill -KILL 0"
    assert forced in watched(command)
    # A busy machine may hold a shell for longer than it has.
    patient = watched(command).replace(forced, f"sleep {WAIT_S:g}; kill -KILL 0")
    stream = here.open(f"echo $$; {patient}")
    output = b""
    while not output.endswith(b"ready\n"):
        output += BlockingStream(stream).read_some(100, timeout_s=WAIT_S)
    stream.close_writing()

    until_s = time.monotonic() + WAIT_S
    while not (tmp_path / "asked").exists() and time.monotonic() < until_s:
        time.sleep(0.02)
    assert (tmp_path / "asked").exists()
    with contextlib.suppress(ProcessLookupError):
        os.killpg(int(output.split()[0]), signal.SIGKILL)  # who waits beside it
    stream.close()


def test_local_command_has_a_deadline_that_its_children_keep(here, tmp_path):
    with pytest.raises(MachineFailure) as caught:
        here.run(f"echo $$ > {tmp_path}/group; sleep 60 & sleep 61", timeout_s=5.0)

    assert caught.value.kind is FailureKind.TIMEOUT
    assert group_is_gone(int((tmp_path / "group").read_text()))


def test_local_command_takes_input_and_bounds_output(here):
    data = os.urandom(3_000_000)
    assert here.run("cat", stdin=data, timeout_s=WAIT_S).stdout == data

    done = here.run(f"head -c {2 * OUTPUT_BYTES_MAX} /dev/zero", timeout_s=WAIT_S)
    assert done.cut_bytes == OUTPUT_BYTES_MAX
    assert here.run("exit 5", stdin=data, timeout_s=WAIT_S).exit_status == 5


def test_who_may_not_become_root_is_told_by_a_mark(here, tmp_path, monkeypatch):
    # A stand-in for sudo that refuses, and for id that is not root.
    for name, text in (
        ("sudo", "echo 'sudo: a password is required' >&2; exit 1"),
        ("id", "echo 1000"),
    ):
        (tmp_path / name).write_text(f"#!/bin/sh\n{text}\n")
        (tmp_path / name).chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")

    done = here.run(watched("touch /never", is_root=True), stdin=None, timeout_s=WAIT_S)

    assert done.exit_status == 1
    assert done.stderr == f"sudo: a password is required\n{NO_SUDO_MARK}\n".encode()


def test_who_may_becomes_root_once(here, tmp_path, monkeypatch):
    (tmp_path / "id").write_text("#!/bin/sh\necho 1000\n")
    (tmp_path / "sudo").write_text('#!/bin/sh\nshift; test "$1" = true || echo rooted; exec "$@"\n')
    for name in ("id", "sudo"):
        (tmp_path / name).chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")

    done = here.run(watched("echo 'x y'\nexit 3", is_root=True), stdin=None, timeout_s=WAIT_S)

    assert (done.exit_status, done.stdout) == (3, b"rooted\nx y\n")
