"""A machine that has no room for another process for a moment: devices and their guardian come back when it has."""

from __future__ import annotations

import errno
import mmap
import os
import signal

import pytest

from madns_runtime.errors import MachineError
from madns_runtime.hardware import manager
from tests.hardware.bench import line_bench

pytestmark = pytest.mark.process

FAILURES = 3


def test_a_device_whose_process_cannot_be_started_anew_comes_back_when_there_is_room(
    tmp_path, monkeypatch
):
    fork, failed = manager.fork_with_pair, []

    def fork_with_pair(run):
        if len(failed) < FAILURES:
            failed.append(run)
            raise MachineError("cannot start a process for a device: no room")
        return fork(run)

    with line_bench(tmp_path) as (bench, _):
        bench.start_time()
        bench.until(lambda: bench.statuses("line") == ["ok"])
        monkeypatch.setattr(manager, "fork_with_pair", fork_with_pair)

        os.kill(bench.pid_of(), signal.SIGKILL)
        bench.until(lambda: bench.statuses("line") == ["ok", "lost", "ok"])
        result = bench.close()["pi22/line"]

    texts = [event["text"] for event in bench.events if event["event"] == "log"]
    assert len(failed) == FAILURES
    assert [text for text in texts if "no room" in text] == [
        "pi22/line: cannot start a process for a device: no room; it is tried again"
    ]
    assert (result["restarts"], result["lost"]) == (1, 1)


def test_outputs_are_guarded_again_when_there_is_room_for_a_guardian(tmp_path, monkeypatch):
    fork, failed = manager.fork_with_pair, []

    def fork_with_pair(run):
        if len(failed) < FAILURES:
            failed.append(run)
            raise MachineError("no room")
        return fork(run)

    with line_bench(tmp_path) as (bench, terminal):
        bench.start_time()
        line = bench.hardware["line"]
        bench.until(lambda: line.status == "ok")
        before = bench.manager._guardian_pid
        monkeypatch.setattr(manager, "fork_with_pair", fork_with_pair)

        os.kill(before, signal.SIGKILL)
        bench.until(lambda: bench.manager._guardian_pid not in (0, before))
        line.write("valve", 1.0)
        bench.until(lambda: "VALVE 1" in terminal.heard())
        os.kill(bench.pid_of(), signal.SIGKILL)
        bench.until(lambda: "SAFE" in terminal.heard())
        bench.close()

    texts = [event["text"] for event in bench.events if event["event"] == "log"]
    assert [text for text in texts if "no room" in text] == [
        "outputs are not guarded: no room; it is tried again"
    ]


def test_the_guardian_makes_safe_when_there_is_room_for_its_process(tmp_path, monkeypatch):
    test, fork = os.getpid(), os.fork
    left = mmap.mmap(-1, 1)
    left[0] = FAILURES

    def fork_where_there_is_room():
        if os.getpid() != test and left[0]:
            left[0] -= 1
            raise OSError(errno.EAGAIN, os.strerror(errno.EAGAIN))
        return fork()

    monkeypatch.setattr(os, "fork", fork_where_there_is_room)
    with line_bench(tmp_path) as (bench, terminal):
        bench.start_time()
        line = bench.hardware["line"]
        bench.until(lambda: line.status == "ok")
        guardian = bench.manager._guardian_pid
        line.write("valve", 1.0)
        bench.until(lambda: "VALVE 1" in terminal.heard())

        os.kill(bench.pid_of(), signal.SIGKILL)
        bench.until(lambda: "SAFE" in terminal.heard())
        bench.until(lambda: not left[0])
        assert bench.manager._guardian_pid == guardian
        bench.close()
