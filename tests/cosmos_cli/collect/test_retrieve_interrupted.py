"""A transfer that is cut at any point goes on where it ended, and nothing is lost or taken twice."""

import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time

import pytest
from harness.split_run import CutConnection, LyingConnection, SplitRun, frame_ends, hashes, pieces

from cosmos_cli.collect import retrieve
from cosmos_cli.collect.partial_files import PartWriter
from cosmos_cli.fleet.failure import FailureKind, MachineFailure
from cosmos_cli.fleet.local import LocalConnection

pytestmark = pytest.mark.process


@pytest.fixture(autouse=True)
def no_second_attempt(monkeypatch):
    monkeypatch.setattr(retrieve, "ATTEMPTS_MAX", 1)


def large_run(root):
    """Return a run of one machine with files of several pieces."""
    split = SplitRun(root, machines=1, ticks=20)
    folder = split.directory("pi01") / "agents/agent-01"
    (folder / "noise.bin").write_bytes(os.urandom(700_000))
    (folder / "text.csv").write_text("1,2,3\n" * 100_000)
    return split


def test_link_that_is_cut_after_any_frame_costs_nothing_but_what_was_on_the_way(tmp_path):
    split = large_run(tmp_path / "model")
    whole = split.there("pi01")
    total = sum(path.stat().st_size for path in split.directory("pi01").rglob("*.*"))
    model = CutConnection(split.targets["pi01"])
    assert split.retrieve({"pi01": model})["pi01"].value.fetched_bytes == total

    # By frames, not by bytes: their sizes and their number differ with process ids and with a machine's speed.
    for number in range(1, len(frame_ends(model.came))):
        split = large_run(tmp_path / str(number))
        noise = split.directory("pi01") / "agents/agent-01/noise.bin"
        whole = split.there("pi01")
        link = CutConnection(split.targets["pi01"], frames_max=number)

        first = split.retrieve({"pi01": link})["pi01"]

        said = list(frames(link.came))
        came = sum(frame["bytes"] for frame in said if "offset" in frame)
        if first.failure is None:  # only the word that it was released is missing
            assert came == total
            assert first.value.is_released == ("released" in said[-1])
        else:
            assert first.failure.kind is FailureKind.LOST
            assert noise.exists()

        second = split.retrieve()["pi01"]

        assert second.is_ok
        assert came + second.value.fetched_bytes == total
        assert whole.items() <= hashes(split.run.path).items()
        assert not split.directory("pi01").exists()
        assert not (split.run.path / ".incoming").exists()
        shutil.rmtree(tmp_path / str(number))


def frames(data):
    at = 0
    for end in frame_ends(data):
        header = json.loads(data[at : data.index(b"\n", at)])
        if isinstance(header.get("value"), dict):
            yield header["value"]
        at = end


def test_failure_tells_how_far_it_came_and_what_is_whole_is_in_its_place(tmp_path):
    split = large_run(tmp_path)
    link = CutConnection(split.targets["pi01"], bytes_max=500_000)

    failure = split.retrieve({"pi01": link})["pi01"].failure

    assert failure.text.startswith("the connection broke (")
    assert "of 9 files" in failure.text
    assert (split.run.path / "agents/agent-01/clock.jsonl").exists()
    assert not (split.run.path / "agents/agent-01/noise.bin").exists()


def test_broken_link_is_made_anew_as_long_as_something_comes(tmp_path, monkeypatch):
    split = large_run(tmp_path)
    whole = split.there("pi01")
    target = split.targets["pi01"]
    links = [CutConnection(target, bytes_max=400_000) for _ in range(4)]
    monkeypatch.setattr(retrieve, "ATTEMPTS_MAX", 5)
    monkeypatch.setattr(retrieve, "PAUSE_S", 0.0)
    monkeypatch.setattr(retrieve, "_connect", lambda *_: links.pop())

    outcome = split.retrieve({})["pi01"]

    assert outcome.is_ok
    assert len(links) < 4
    assert outcome.value.fetched_bytes == outcome.value.bytes
    assert whole.items() <= hashes(split.run.path).items()


def test_link_that_breaks_while_it_is_opened_is_made_anew(tmp_path, monkeypatch):
    split = SplitRun(tmp_path, machines=1)
    broken = [CutConnection(split.targets["pi01"], bytes_max=count) for count in (0, 300)]
    links = [LocalConnection(split.targets["pi01"]), *broken]
    monkeypatch.setattr(retrieve, "ATTEMPTS_MAX", 5)
    monkeypatch.setattr(retrieve, "PAUSE_S", 0.0)
    monkeypatch.setattr(retrieve, "_connect", lambda *_: links.pop())

    assert split.retrieve({})["pi01"].is_ok
    assert links == []


def test_link_that_breaks_while_it_is_asked_what_lives_is_made_anew(tmp_path, monkeypatch):
    split = SplitRun(tmp_path, machines=1)
    split.leave_result()
    failures = [MachineFailure(FailureKind.LOST, "the connection broke while it was opened")] * 2
    monkeypatch.setattr(retrieve, "ATTEMPTS_MAX", 5)
    monkeypatch.setattr(retrieve, "PAUSE_S", 0.0)

    def connect(target, _options):
        if failures:
            raise failures.pop()
        return LocalConnection(target)

    monkeypatch.setattr(retrieve, "_connect", connect)
    with split.visit({}) as visit:
        assert visit.find_living() == {}
        (outcome,) = visit.fetch()

    assert outcome.is_ok


@pytest.mark.parametrize("kind", [FailureKind.UNREACHABLE, FailureKind.AUTHENTICATION])
def test_machine_that_is_not_there_or_refuses_is_asked_once(tmp_path, monkeypatch, kind):
    split = SplitRun(tmp_path, machines=1)
    asked = []
    monkeypatch.setattr(retrieve, "ATTEMPTS_MAX", 5)

    def connect(target, _options):
        asked.append(target.name)
        raise MachineFailure(kind, "no")

    monkeypatch.setattr(retrieve, "_connect", connect)

    assert split.retrieve({})["pi01"].failure.kind is kind
    assert asked == ["pi01"]


def test_machine_that_is_silent_while_it_is_connected_to_is_named(tmp_path, monkeypatch):
    split = SplitRun(tmp_path, machines=1)
    told = threading.Event()
    said = []
    monkeypatch.setattr(retrieve, "NAMED_S", 0.05)

    def connect(target, _options):
        assert told.wait(60)
        return LocalConnection(target)

    def say(text):
        said.append(text)
        told.set()

    monkeypatch.setattr(retrieve, "_connect", connect)

    assert split.retrieve({}, say=say)["pi01"].is_ok
    assert said == ["pi01: no sign of life for 0.05 s; waiting for it"]


def test_machine_that_never_sends_anything_is_given_up_after_some_attempts(tmp_path, monkeypatch):
    split = SplitRun(tmp_path, machines=1)
    links = [CutConnection(split.targets["pi01"], bytes_max=300) for _ in range(4)]
    monkeypatch.setattr(retrieve, "ATTEMPTS_MAX", 5)
    monkeypatch.setattr(retrieve, "_connect", lambda *_: links.pop())

    assert split.retrieve({})["pi01"].failure.kind is FailureKind.LOST
    assert len(links) == 1


def test_connection_that_was_given_and_is_dead_is_made_anew(tmp_path, monkeypatch):
    split = SplitRun(tmp_path, machines=1)

    class Dead(LocalConnection):
        def is_alive(self, *, timeout_s=2.0):
            return False

    monkeypatch.setattr(retrieve, "_connect", lambda target, _: LocalConnection(target))

    assert split.retrieve({"pi01": Dead(split.targets["pi01"])})["pi01"].is_ok


def cut_in_noise(split):
    """Leave a part of noise.bin, and return it."""
    split.retrieve({"pi01": CutConnection(split.targets["pi01"], bytes_max=500_000)})
    parts = sorted((split.run.path / ".incoming/pi01").glob("*.part"))
    return next(part for part in parts if 100_000 < part.stat().st_size < 700_000)


def test_part_with_a_flipped_byte_is_noticed_and_fetched_anew_once(tmp_path):
    split = large_run(tmp_path)
    whole = split.there("pi01")
    part = cut_in_noise(split)
    content = bytearray(part.read_bytes())
    content[1000] ^= 1
    part.write_bytes(content)

    outcome = split.retrieve()["pi01"]

    assert outcome.is_ok
    assert whole.items() <= hashes(split.run.path).items()
    # The rest in vain, then all of it; the other files once.
    assert outcome.value.fetched_bytes >= 700_000 + (700_000 - len(content))


@pytest.mark.parametrize("length", [700_000, 700_001, 2_000_000])
def test_part_of_other_content_is_not_taken_for_the_file(tmp_path, length):
    split = large_run(tmp_path)
    whole = split.there("pi01")
    cut_in_noise(split).write_bytes(b"x" * length)

    assert split.retrieve()["pi01"].is_ok
    assert whole.items() <= hashes(split.run.path).items()


def test_byte_that_is_flipped_on_the_way_is_noticed_and_fetched_anew(tmp_path):
    split = large_run(tmp_path)
    whole = split.there("pi01")
    flipped = []

    def flip(value, body):
        if not value["packed"] and not flipped:
            flipped.append(value)
            body = body[:100] + bytes([body[100] ^ 1]) + body[101:]
        return value, body

    connection = LyingConnection(split.targets["pi01"], pieces(flip))
    outcome = split.retrieve({"pi01": connection})["pi01"]

    assert flipped
    assert outcome.is_ok
    assert whole.items() <= hashes(split.run.path).items()


RETRIEVER = """
import sys
from pathlib import Path
from cosmos_cli.fleet.local import LocalConnection
from cosmos_cli.collect.retrieve import Retrieval
from cosmos_cli.collect.machine_sources import RecordingMachines
from cosmos_cli.evidence.run_directory import RunDirectory

run = RunDirectory(Path(sys.argv[1]))
targets = [source.target for source in RecordingMachines.read(run).remote]
with Retrieval(run, options=None, connections={t.name: LocalConnection(t) for t in targets}) as it:
    it.fetch()
"""


@pytest.mark.nightly
def test_operator_that_is_killed_at_any_moment_can_go_on(tmp_path):
    for delay_s in (0.05, 0.15, 0.25, 0.35, 0.5):
        split = large_run(tmp_path / str(delay_s))
        (split.directory("pi01") / "agents/agent-01/more.bin").write_bytes(os.urandom(20_000_000))
        whole = split.there("pi01")
        process = subprocess.Popen([sys.executable, "-c", RETRIEVER, str(split.run.path)])
        incoming = split.run.path / ".incoming/pi01"
        until_s = time.monotonic() + 30
        while not incoming.exists() and process.poll() is None and time.monotonic() < until_s:
            time.sleep(0.005)
        time.sleep(delay_s / 5)
        process.send_signal(signal.SIGKILL)
        process.wait()

        outcome = split.retrieve()["pi01"]

        assert outcome.is_ok, outcome.failure
        assert whole.items() <= hashes(split.run.path).items()
        assert not split.directory("pi01").exists()


def test_interrupt_leaves_what_has_come(tmp_path, monkeypatch):
    split = large_run(tmp_path)
    seen = []

    def interrupt(_targets, task, **_more):
        seen.append(task)
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(retrieve, "for_each", interrupt)
        with pytest.raises(KeyboardInterrupt):
            split.retrieve()
    assert seen

    assert split.retrieve()["pi01"].is_ok


def test_bytes_that_came_over_a_link_that_broke_are_not_counted_twice(tmp_path, monkeypatch):
    split = large_run(tmp_path)
    total = sum(path.stat().st_size for path in split.directory("pi01").rglob("*.*"))
    monkeypatch.setattr(retrieve, "ATTEMPTS_MAX", 2)
    monkeypatch.setattr(retrieve, "PAUSE_S", 0.0)
    monkeypatch.setattr(retrieve, "_connect", lambda target, options: LocalConnection(target))
    write = PartWriter.write
    pieces_left = [2]

    def cut(self, value, body):
        if self._transfers[value["file"]].file.path.endswith("noise.bin"):
            pieces_left[0] -= 1
            if pieces_left[0] == 0:
                raise MachineFailure(FailureKind.LOST, "cut by the test")
        return write(self, value, body)

    monkeypatch.setattr(PartWriter, "write", cut)

    told = split.retrieve()["pi01"].value

    assert pieces_left[0] < 0
    assert (told.fetched_bytes, told.resumed_bytes) == (total, 0)


@pytest.mark.root
@pytest.mark.skipif(os.geteuid() != 0, reason="mounts a small file system")
def test_full_disk_here_is_told_and_the_next_attempt_goes_on(tmp_path, monkeypatch):
    split = large_run(tmp_path)
    whole = split.there("pi01")
    small = tmp_path / "small"
    small.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", str(small)]
    made = subprocess.run(mount, capture_output=True, text=True, check=False)
    if made.returncode:
        pytest.skip(f"cannot mount a tmpfs: {made.stderr.strip()}")
    try:
        without = shutil.ignore_patterns(".reserve")
        shutil.copytree(split.run.path, small / split.run.name, ignore=without)
        moved = SplitRun.__new__(SplitRun)
        moved.__dict__ = {**split.__dict__, "run": type(split.run)(small / split.run.name)}

        foreseen = moved.retrieve()["pi01"].failure
        monkeypatch.setattr("cosmos_cli.collect.disk.SPARE_BYTES", -(1 << 40))
        met = moved.retrieve()["pi01"].failure

        for failure in (foreseen, met):
            assert failure.kind is FailureKind.DISK_FULL
            assert "here" in failure.text
        assert split.there("pi01") == whole
        remount = ["mount", "-o", "remount,size=20m", str(small)]
        subprocess.run(remount, check=True)

        outcome = moved.retrieve()["pi01"]

        assert outcome.is_ok, outcome.failure
        assert outcome.value.resumed_bytes > 0
        assert whole.items() <= hashes(moved.run.path).items()
    finally:
        subprocess.run(["umount", str(small)], check=True)


def test_unwritable_run_directory_is_no_fault_of_the_machine(tmp_path, monkeypatch):
    split = SplitRun(tmp_path, machines=1)

    def refuse(*_arguments):
        raise OSError(30, "Read-only file system")

    monkeypatch.setattr("cosmos_cli.collect.partial_files.write_whole", refuse)

    failure = split.retrieve()["pi01"].failure

    assert isinstance(failure, MachineFailure)
    assert failure.kind is FailureKind.READ_ONLY
    assert failure.text.startswith("cannot write here: ")
