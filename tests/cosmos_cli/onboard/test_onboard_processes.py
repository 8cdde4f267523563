"""The verbs about a run's processes, asked through a helper process as over SSH."""

from __future__ import annotations

import contextlib
import errno
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from cosmos_cli.fleet.helper import Helper
from cosmos_cli.fleet.local import LocalConnection
from cosmos_cli.fleet.target import Target
from cosmos_cli.onboard import content_store
from cosmos_cli.onboard.processes import MARK, RunEnding, find_living, started_with
from madns_runtime.processes import ProcessEntry

pytestmark = pytest.mark.process

PARTS = ("madns_runtime.processes", "processes")
PATIENCE_S = 30.0

MEMBER = """
import signal, subprocess, sys, time
from madns_runtime.processes import register

run, role, name, directory, manner = sys.argv[1:]
entry = register(run, role, name, directory)
signal.signal(signal.SIGTERM, signal.SIG_IGN if "stubborn" in manner else lambda *_: sys.exit(0))
if "worker" in manner:
    worker = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
    print(worker.pid, flush=True)
print("ready", flush=True)
time.sleep(60)
"""

Start = Callable[..., subprocess.Popen[str]]


@pytest.fixture
def board() -> Iterator[Helper]:
    target = Target(name="pi01", address="127.0.0.1", connection="local")
    with Helper.start(LocalConnection(target), PARTS) as board:
        yield board


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Start]:
    started: list[subprocess.Popen[str]] = []

    def start(role: str, name: str, manner: str = "", run: str = "0001-a") -> subprocess.Popen[str]:
        directory = str(tmp_path / "runs" / run)
        process = subprocess.Popen(
            [sys.executable, "-c", MEMBER, run, role, name, directory, manner],
            stdout=subprocess.PIPE,
            text=True,
            start_new_session=True,
            env={**os.environ, "COSMOS_STATE_DIR": str(tmp_path / "state"), MARK: directory},
        )
        started.append(process)
        assert process.stdout is not None
        if "worker" in manner:
            process.worker_pid = int(process.stdout.readline())  # type: ignore[attr-defined]
        assert process.stdout.readline() == "ready\n"
        return process

    yield start
    for process in started:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait(PATIENCE_S)
        assert process.stdout is not None
        process.stdout.close()


def end_run(board: Helper, tmp_path: Path, run: str = "0001-a") -> RunEnding:
    arguments = {
        "state": str(tmp_path / "state"),
        "directory": str(tmp_path / "runs" / run),
        "clean_s": 0.5,
        "forced_s": PATIENCE_S,
    }
    return RunEnding.from_mapping(board.call("end_run", arguments).value)


def test_processes_are_those_of_the_register(board: Helper, start: Start, tmp_path: Path) -> None:
    pids = {start("supervisor", "pi01").pid, start("agent", "agent-01").pid}

    listed = board.call("processes", {"state": str(tmp_path / "state")}).value
    aged = board.call("processes", {"state": str(tmp_path / "state"), "ages": True}).value

    assert {ProcessEntry(**entry).pid for entry in listed} == pids
    assert all(0 <= entry["age_s"] < 600 for entry in aged)


def test_end_run_ends_that_run_alone_and_a_second_time_finds_nothing(
    board: Helper, start: Start, tmp_path: Path
) -> None:
    mine = [start("supervisor", "pi01"), start("agent", "agent-01")]
    other = start("supervisor", "pi01", run="0002-b")

    first, second = end_run(board, tmp_path), end_run(board, tmp_path)

    assert {entry.pid for entry in first.ended} == {process.pid for process in mine}
    assert first.left == ()
    assert (first.run, second.run) == ("0001-a", "0001-a")
    assert second.ended == ()
    assert other.poll() is None


def test_end_run_finds_what_a_killed_leader_left(
    board: Helper, start: Start, tmp_path: Path
) -> None:
    supervisor = start("supervisor", "pi01", "worker")
    worker_pid = supervisor.worker_pid  # type: ignore[attr-defined]
    supervisor.kill()
    supervisor.wait(PATIENCE_S)

    ending = end_run(board, tmp_path)

    assert [entry.pid for entry in ending.killed] == [worker_pid]


def test_group_is_signalled_only_as_far_as_it_is_the_runs(
    board: Helper, start: Start, tmp_path: Path
) -> None:
    mine = start("supervisor", "pi01", "stubborn")
    arguments = {"group": mine.pid, "directory": str(tmp_path / "runs/0001-a")}
    elsewhere = {**arguments, "directory": str(tmp_path / "runs/0002-b")}

    assert board.call("group", arguments).value == [mine.pid]
    assert board.call("group", elsewhere).value == []
    assert board.call("signal_group", {**elsewhere, "signal": signal.SIGKILL}).value == []
    assert mine.poll() is None
    assert board.call("signal_group", {**arguments, "signal": signal.SIGKILL}).value == [mine.pid]
    assert mine.wait(PATIENCE_S) == -signal.SIGKILL


def test_last_words_are_the_end_of_a_file(board: Helper, tmp_path: Path) -> None:
    (tmp_path / "stderr.txt").write_text("first\n\nsecond\nthird\n")
    arguments = {"path": str(tmp_path / "stderr.txt"), "bytes": 1000, "lines": 2}

    assert board.call("last_words", arguments).value == ["second", "third"]
    assert board.call("last_words", {**arguments, "path": "/nowhere"}).value == []


@pytest.mark.parametrize("number", [errno.EMFILE, errno.ENFILE, errno.ENOMEM])
@pytest.mark.parametrize(
    "ask",
    [
        lambda path: started_with(MARK, str(path)),
        lambda path: find_living(str(path), str(path)),
        lambda path: content_store.used([str(path)]),
    ],
    ids=["marked", "writers", "users of content"],
)
def test_processes_that_cannot_be_looked_at_for_now_are_not_taken_for_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, ask: Callable[[Path], object], number: int
) -> None:
    def fail(path: object, *arguments: object, **settings: object) -> None:
        raise OSError(number, os.strerror(number), str(path))

    listed = os.listdir
    monkeypatch.setenv("COSMOS_STATE_DIR", str(tmp_path))
    monkeypatch.setattr(Path, "read_bytes", fail)
    monkeypatch.setattr("builtins.open", fail)
    monkeypatch.setattr(
        os, "listdir", lambda path: fail(path) if str(path).startswith("/proc/") else listed(path)
    )

    with pytest.raises(OSError, match="Too many|Cannot allocate"):
        ask(tmp_path)
