"""What a killed process and a full disk leave behind, tried for real."""

import json
import os
import subprocess
import sys
import threading
import time
from contextlib import contextmanager

import pytest
from harness.waiting import wait_until

from madns_runtime.config import Recording
from madns_runtime.recording.reader import read_stream
from madns_runtime.recording.record_files import RecordFiles
from madns_runtime.recording.recorder import Recorder
from madns_runtime.recording.records import TICKS
from madns_runtime.recording.writer_thread import FIFO_PRIORITY, WriterThread

RECORDING_CHILD = """
import json, sys, time
from pathlib import Path
from madns_runtime.config import Recording
from madns_runtime.recording.records import EVENTS, TICKS
from madns_runtime.recording.record_files import RecordFiles
from madns_runtime.recording.recorder import Recorder

settings = Recording(flush_interval_s=float(sys.argv[2]))
recorder = Recorder(RecordFiles(Path(sys.argv[1]), run="r", source="a"), settings)
recorder.open_stream(TICKS)
recorder.open_stream(EVENTS)
recorder.start()
for tick in range(1_000_000):
    recorder.record("ticks", (tick, 50, 9000, 0))
    recorder.record("events", (tick * 0.002, "u", "e"))
    written = recorder.counts().streams["ticks"].written
    print(json.dumps([tick, time.monotonic(), written]), flush=True)
    time.sleep(0.002)
"""
FLUSH_INTERVAL_S = 0.1
LATE_MAX_S = 5.0
"""How late a starved machine may run the writer thread; far more than it takes."""


@pytest.mark.process
@pytest.mark.parametrize("run_s", [0.5, 1.3])
def test_killed_process_loses_no_more_than_the_last_interval(tmp_path, run_s):
    command = [sys.executable, "-c", RECORDING_CHILD, str(tmp_path), str(FLUSH_INTERVAL_S)]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as child:
        said = [json.loads(child.stdout.readline())]
        while said[-1][1] < said[0][1] + run_s or said[-1][2] < 20:
            said.append(json.loads(child.stdout.readline()))
        child.kill()
        said += [
            json.loads(line) for line in child.stdout.read().splitlines() if line.endswith(b"]")
        ]

    reading = read_stream(tmp_path / "ticks.jsonl")
    ticks = [record[0] for record in reading.records()]
    assert ticks == list(range(len(ticks)))
    assert reading.state.is_cut
    assert reading.state.damaged == 0
    last_s = said[-1][1]
    due = [tick for tick, at_s, _ in said if at_s < last_s - FLUSH_INTERVAL_S - LATE_MAX_S]
    assert len(ticks) >= len(due)
    # What the recorder has called written is in the file, though the process had no time for anything.
    assert len(ticks) >= max(written for _, _, written in said)
    assert len(ticks) >= 20


@pytest.mark.process
def test_process_killed_before_its_first_record_leaves_a_schema(tmp_path):
    script = RECORDING_CHILD.replace(
        "for tick in range(1_000_000):", "while True: time.sleep(60)\n'''"
    )
    command = [sys.executable, "-c", script + "'''", str(tmp_path), "0.05"]
    with subprocess.Popen(command) as child:
        wait_until(lambda: _size(tmp_path / "ticks.jsonl") and _size(tmp_path / "events.jsonl"))
        child.kill()

    reading = read_stream(tmp_path / "ticks.jsonl")
    assert reading.schema["stream"] == "ticks"
    assert (reading.state.records, reading.state.is_cut) == (0, True)


@contextmanager
def small_disk(directory, size_bytes):
    """A file system of its own, whose fullness is nobody else's."""
    directory.mkdir()
    options = f"size={size_bytes},mode=700"
    subprocess.run(["mount", "-t", "tmpfs", "-o", options, "none", str(directory)], check=True)
    try:
        yield directory
    finally:
        # Lazily: a descriptor that a failed test left open must not keep it mounted.
        subprocess.run(["umount", "-l", str(directory)], check=True)


needs_mount = pytest.mark.skipif(os.geteuid() != 0, reason="mounts a file system")


def fill(path):
    with path.open("wb", buffering=0) as file:
        try:
            while True:
                file.write(bytes(4096))
        except OSError:
            return


@pytest.mark.root
@needs_mount
def test_records_wait_until_a_full_disk_has_room_again(tmp_path):
    with small_disk(tmp_path / "disk", 1 << 20) as disk:
        recorder = Recorder(
            RecordFiles(disk, run="r", source="a"), Recording(flush_interval_s=0.05)
        )
        recorder.open_stream(TICKS)
        recorder.start()
        recorder.record("ticks", (0, 50, 9000, 0))
        wait_until(lambda: recorder.counts().written == 1)
        fill(disk / "ballast")
        for tick in range(1, 5000):
            recorder.record("ticks", (tick, 50, 9000, 0))
        wait_until(lambda: recorder.problem)
        problem = recorder.problem
        assert recorder.counts().written < 5000
        (disk / "ballast").unlink()
        wait_until(lambda: recorder.counts().written == 5000)
        counts = recorder.close(30)
        reading = read_stream(disk / "ticks.jsonl")
        ticks = [record[0] for record in reading.records()]

    assert "No space left on device" in problem
    assert ticks == list(range(5000))
    assert (counts.written, counts.dropped) == (5000, 0)
    assert counts.errors
    assert (reading.state.damaged, reading.state.is_cut) == (0, False)


@pytest.mark.root
@needs_mount
def test_disk_that_stays_full_costs_counted_records_and_no_broken_line(tmp_path):
    with small_disk(tmp_path / "disk", 65_536) as disk:
        settings = Recording(flush_interval_s=0.05, buffer_bytes=65_536)
        recorder = Recorder(RecordFiles(disk, run="r", source="a"), settings)
        recorder.open_stream(TICKS)
        recorder.start()
        recorded = 0
        end_s = time.monotonic() + 60
        while not (recorder.problem and recorder.counts().dropped):
            assert time.monotonic() < end_s
            for _ in range(100):
                recorder.record("ticks", (recorded, 50, 9000, 0))
                recorded += 1
            time.sleep(0.001)
        counts = recorder.close(30)
        text = (disk / "ticks.jsonl").read_bytes()
        reading = read_stream(disk / "ticks.jsonl")
        ticks = [record[0] for record in reading.records()]

    assert counts.written + counts.dropped == recorded
    assert counts.dropped > 0
    assert "No space left on device" in counts.errors[0]
    assert text.endswith(b"\n")
    assert len(ticks) == counts.written
    assert ticks == sorted(set(ticks))
    assert (reading.state.damaged, reading.state.truncated_lines) == (0, 0)
    # The end line fits only if cutting off the broken line made room for it.
    assert reading.state.is_cut or reading.state.dropped == counts.dropped


@pytest.mark.root
@pytest.mark.skipif(os.geteuid() != 0, reason="sets a real-time policy")
@pytest.mark.parametrize(
    ("granted", "policy", "priority"),
    [(0, os.SCHED_OTHER, 0), (1, os.SCHED_OTHER, 0), (2, os.SCHED_FIFO, FIFO_PRIORITY)],
)
def test_writer_has_the_least_real_time_priority_if_its_loop_was_granted_a_higher_one(
    tmp_path, granted, policy, priority
):
    schedulings = []

    def loop():
        try:
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(5))
        except OSError:
            return
        settings = Recording(flush_interval_s=0.05)
        writer = WriterThread(settings)
        files = RecordFiles(tmp_path, run="r", source="a")
        recorder = Recorder(files, settings, writer.writes(files))
        recorder.open_stream(TICKS)
        recorder.start()
        writer.follow(granted)
        recorder.record("ticks", (0, 50, 9000, 0))
        wait_until(lambda: recorder.counts().written)
        thread = next(t for t in threading.enumerate() if t.name == "recorder").native_id
        for number in (0, thread):
            its_priority = os.sched_getparam(number).sched_priority
            schedulings.append((os.sched_getscheduler(number), its_priority))
        recorder.close(30)

    thread = threading.Thread(target=loop)
    thread.start()
    thread.join(120)
    if not schedulings:
        pytest.skip("no real-time policy is granted here")

    assert schedulings == [(os.SCHED_FIFO, 5), (policy, priority)]


def _size(path):
    return path.stat().st_size if path.exists() else 0
