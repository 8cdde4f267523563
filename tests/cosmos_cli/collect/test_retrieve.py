"""What a run's machines recorded comes here whole, is verified, and only then released there."""

import contextlib
import os
import shutil
import signal
import socket
import threading
from pathlib import Path

import orjson
import pytest
from harness.split_run import CutConnection, SplitRun, hashes

from cosmos_cli.collect import machine_retrieval, retrieve
from cosmos_cli.collect.machine_retrieval import PATIENCE_S
from cosmos_cli.collect.retrieve import PARTS, problems_of
from cosmos_cli.fleet.failure import FailureKind, MachineFailure
from cosmos_cli.fleet.helper import Helper
from cosmos_cli.fleet.local import LocalConnection
from madns_runtime.health.sampler import SAMPLER_TIMEOUT_S

pytestmark = pytest.mark.process


@pytest.fixture(autouse=True)
def no_real_network(monkeypatch):
    def refuse(target, _options):
        raise MachineFailure(FailureKind.UNREACHABLE, "no route to host", "is it switched on?")

    monkeypatch.setattr(retrieve, "_connect", refuse)


def test_everything_comes_and_is_released_there(tmp_path):
    split = SplitRun(tmp_path)
    before = {path: digest for name in split.names for path, digest in split.there(name).items()}

    outcomes = split.retrieve()

    assert all(outcome.is_ok for outcome in outcomes.values())
    assert before.items() <= hashes(split.run.path).items()
    assert not any(split.directory(name).exists() for name in split.names)
    assert [outcomes[name].value.fetched_files for name in split.names] == [7, 7]
    assert all(outcome.value.is_released for outcome in outcomes.values())
    assert not (split.run.path / ".incoming").exists()


def test_socket_that_a_power_cut_left_is_no_record(tmp_path, monkeypatch):
    split = SplitRun(tmp_path)
    monkeypatch.chdir(split.directory("pi01"))  # a socket's path must be short
    with socket.socket(socket.AF_UNIX) as waiting:
        waiting.bind("operator.1.sock")

    outcomes = split.retrieve()

    assert all(outcome.value.is_released for outcome in outcomes.values())
    assert outcomes["pi01"].value.fetched_files == 7
    assert not split.directory("pi01").exists()


def test_second_time_asks_no_machine_that_was_released(tmp_path):
    split = SplitRun(tmp_path)
    split.retrieve()
    before = hashes(split.run.path)

    outcomes = split.retrieve(connections={})

    assert all(outcome.is_ok for outcome in outcomes.values())
    assert [outcomes[name].value.fetched_files for name in split.names] == [0, 0]
    assert [outcomes[name].value.files for name in split.names] == [7, 7]
    assert hashes(split.run.path) == before


def test_run_of_this_computer_alone_has_nothing_to_retrieve(tmp_path):
    split = SplitRun(tmp_path)
    split.run.plan_json.write_bytes(b'{"machines": {"loopback": {"agents": ["agent-01"]}}}')

    assert split.retrieve() == {}


def test_one_machine_that_is_gone_does_not_hide_the_other(tmp_path):
    split = SplitRun(tmp_path)
    connections = split.connections()
    del connections["pi01"]

    first = split.retrieve(connections)

    assert first["pi01"].failure.kind is FailureKind.UNREACHABLE
    assert first["pi02"].is_ok
    assert [p.to_mapping() for p in problems_of(list(first.values()))] == [
        {
            "machine": "pi01",
            "text": "no route to host; is it switched on?",
            "step": "collect",
        }
    ]
    assert split.directory("pi01").exists()

    second = split.retrieve()

    assert second["pi01"].is_ok
    assert (second["pi01"].value.fetched_files, second["pi02"].value.fetched_files) == (7, 0)


def test_machine_whose_records_vanished_is_a_failure(tmp_path):
    split = SplitRun(tmp_path)
    shutil.rmtree(split.directory("pi01"))

    outcome = split.retrieve()["pi01"]

    assert outcome.failure.kind is FailureKind.DATA
    assert str(split.directory("pi01")) in str(outcome.failure)
    cure = f"a power cut or a deletion took it: give it up with: cosmos collect {split.run.shell_path} --forget pi01"
    assert outcome.failure.advice.endswith(cure)


def test_directory_that_was_released_before_the_note_of_it_was_written_is_no_failure(tmp_path):
    split = SplitRun(tmp_path)
    split.retrieve()
    note = split.run.path / "machines/pi01/retrieved.json"
    note.write_bytes(orjson.dumps(orjson.loads(note.read_bytes()) | {"state": "verified"}))

    outcome = split.retrieve()["pi01"]

    assert outcome.is_ok
    assert outcome.value.is_released
    assert orjson.loads(note.read_bytes())["state"] == "released"


def test_manifest_of_each_machine_is_kept(tmp_path):
    split = SplitRun(tmp_path)
    before = split.there("pi01")
    (split.directory("pi01") / "latest").symlink_to("agents")
    os.mkfifo(split.directory("pi01") / "agents/pipe")

    outcome = split.retrieve()["pi01"]

    assert outcome.is_ok
    kept = orjson.loads((split.run.path / "machines/pi01/manifest.json").read_bytes())["files"]
    assert {p: e["sha256"] for p, e in kept.items() if "sha256" in e} == before
    assert (kept["latest"]["kind"], kept["agents/pipe"]["kind"]) == ("a link", "a pipe")
    assert not (split.run.path / "latest").exists()


def test_empty_files_and_files_without_any_structure_come_too(tmp_path):
    split = SplitRun(tmp_path)
    there = split.directory("pi01")
    (there / "agents/agent-01/empty.jsonl").touch()
    (there / "agents/agent-01/more").mkdir()
    (there / "agents/agent-01/more/noise.bin").write_bytes(os.urandom(700_001))
    (there / "core.77").write_bytes(b"core")
    before = split.there("pi01")

    outcome = split.retrieve()["pi01"]

    assert outcome.is_ok
    assert before.items() <= hashes(split.run.path).items()


def test_lines_are_packed_on_the_way_and_noise_is_not(tmp_path):
    split = SplitRun(tmp_path, machines=1, ticks=5000)
    packed = split.retrieve()["pi01"].value
    split = SplitRun(tmp_path / "noise", machines=1)
    (split.directory("pi01") / "noise.bin").write_bytes(os.urandom(2_000_000))

    noise = split.retrieve()["pi01"].value

    assert packed.packed_bytes < packed.fetched_bytes / 2
    assert 2_000_000 < noise.packed_bytes < noise.fetched_bytes + 1


def test_what_ends_there_at_this_moment_is_waited_for(tmp_path, monkeypatch):
    split = SplitRun(tmp_path, machines=1)
    pieces = Helper.pieces

    with split.living("pi01", "sampler", "pi01") as pid:
        end = threading.Timer(0.3, os.kill, [pid, signal.SIGKILL])

        def ask(board, verb, *arguments, **more):
            if verb == "sizes":
                end.start()
            return pieces(board, verb, *arguments, **more)

        monkeypatch.setattr(Helper, "pieces", ask)
        outcome = split.retrieve()["pi01"]
        end.join()

    assert outcome.is_ok, outcome.failure
    assert PATIENCE_S > SAMPLER_TIMEOUT_S


def test_living_processes_of_the_run_are_named_and_nothing_is_touched(tmp_path, monkeypatch):
    monkeypatch.setattr(machine_retrieval, "PATIENCE_S", 1.0)
    split = SplitRun(tmp_path)
    before = split.there("pi02")
    with split.living("pi02", "agent", "agent-02") as pid:
        with split.visit() as visit:
            living = visit.find_living()
        outcomes = split.retrieve()

    assert living == {"pi02": [f"agent agent-02 (pid {pid})"]}
    assert outcomes["pi01"].is_ok
    assert outcomes["pi02"].failure.kind is FailureKind.BUSY
    assert f"agent agent-02 (pid {pid})" in str(outcomes["pi02"].failure)
    assert split.there("pi02") == before
    assert split.retrieve()["pi02"].is_ok


def test_who_writes_there_is_alive_without_being_registered(tmp_path):
    split = SplitRun(tmp_path)
    path = split.directory("pi01") / "agents/agent-01/ticks.jsonl"
    with path.open("ab"), split.visit() as visit:
        writing = visit.find_living()
    with path.open("rb"), split.visit() as visit:
        reading = visit.find_living()

    # A process that another test has forked at this moment has it open, too, until it is another program.
    assert f"pid {os.getpid()} writes agents/agent-01/ticks.jsonl" in writing["pi01"]
    assert reading == {}


def test_release_is_refused_when_a_file_changed_or_came_after_the_list(tmp_path):
    split = SplitRun(tmp_path, machines=1)
    there = split.directory("pi01")
    where = {"directory": str(there), "state": str(split.state("pi01"))}
    path = there / "agents/agent-01/ticks.jsonl"
    changes = [
        lambda: path.write_bytes(path.read_bytes()),
        lambda: (there / "late.jsonl").touch(),
        lambda: path.unlink(),
    ]
    for change in changes:
        with Helper.start(LocalConnection(split.targets["pi01"]), PARTS) as board:
            listed = list(board.pieces("manifest", {**where, "bytes_max": 10**9}))
            change()
            with pytest.raises(MachineFailure, match="changed since they were listed") as refused:
                board.call("release", {**where, "manifest_sha256": listed[-1].value["sha256"]})

        assert refused.value.kind is FailureKind.DATA
        assert there.exists()


def test_release_is_refused_while_something_lives_and_of_what_was_not_listed(tmp_path):
    split = SplitRun(tmp_path, machines=1)
    where = {"directory": str(split.directory("pi01")), "state": str(split.state("pi01"))}
    with Helper.start(LocalConnection(split.targets["pi01"]), PARTS) as board:
        digest = list(board.pieces("manifest", {**where, "bytes_max": 10**9}))[-1].value["sha256"]
        with (
            split.living("pi01", "supervisor", "pi01"),
            pytest.raises(MachineFailure, match="supervisor pi01") as busy,
        ):
            board.call("release", {**where, "manifest_sha256": digest})
        with pytest.raises(MachineFailure, match="not listed"):
            board.call("release", {**where, "manifest_sha256": "0" * 64})
        with pytest.raises(MachineFailure, match="not listed"):
            elsewhere = {**where, "directory": str(tmp_path)}
            board.call("release", {**elsewhere, "manifest_sha256": digest})

    assert busy.value.kind is FailureKind.BUSY
    assert split.directory("pi01").exists()


def test_what_an_interrupted_deletion_left_is_swept(tmp_path):
    split = SplitRun(tmp_path, machines=1)
    there = split.directory("pi01")
    left = there.with_name(f".released-{there.name}-99")
    left.mkdir()
    (left / "file").touch()

    split.retrieve()

    assert list(there.parent.iterdir()) == []


def test_file_that_grows_after_it_was_listed_is_fetched_again(tmp_path):
    split = SplitRun(tmp_path, machines=1)
    path = split.directory("pi01") / "agents/agent-01/log.jsonl"
    grown = threading.Event()

    def grow(data: bytes) -> bytes:
        if b'"sha256"' in data and not grown.is_set():  # the list is on its way
            grown.set()
            with path.open("ab") as file:
                file.write(b"a late line\n")
        return data

    outcome = split.retrieve({"pi01": CutConnection(split.targets["pi01"], change=grow)})["pi01"]

    assert grown.is_set()
    assert outcome.is_ok
    assert (split.run.path / "agents/agent-01/log.jsonl").read_bytes().endswith(b"a late line\n")
    assert not split.directory("pi01").exists()


def test_file_that_never_stays_the_same_is_named_and_stays_there(tmp_path):
    split = SplitRun(tmp_path, machines=1)
    path = split.directory("pi01") / "agents/agent-01/log.jsonl"

    def grow(data: bytes) -> bytes:
        if b'"sha256"' in data:
            with path.open("ab") as file:
                file.write(b"another line\n")
        return data

    outcome = split.retrieve({"pi01": CutConnection(split.targets["pi01"], change=grow)})["pi01"]

    assert outcome.failure.kind is FailureKind.DATA
    assert "log.jsonl" in str(outcome.failure)
    assert path.exists()
    again = split.retrieve()["pi01"]
    assert again.is_ok, again.failure
    assert hashes(split.run.path)["agents/agent-01/log.jsonl"]


def test_unreadable_file_does_not_keep_the_others(tmp_path):
    split = SplitRun(tmp_path, machines=1)
    where = split.directory("pi01") / "agents/agent-01"
    (where / "own.csv").write_text("1\n")

    def lose(data: bytes) -> bytes:  # as a bad block would: listed, and then not readable
        if b'"sha256"' in data:
            with contextlib.suppress(FileNotFoundError):
                (where / "own.csv").unlink()
        return data

    outcome = split.retrieve({"pi01": CutConnection(split.targets["pi01"], change=lose)})["pi01"]

    assert outcome.is_ok, outcome.failure  # listed anew, without it
    assert (split.run.path / "agents/agent-01/ticks.jsonl").exists()


def test_every_byte_and_name_is_on_the_disk_before_a_machine_deletes_its_copy(
    tmp_path, monkeypatch
):
    split = SplitRun(tmp_path, machines=1)
    already = split.run.path / "agents/agent-01/log.jsonl"
    already.parent.mkdir(parents=True)
    shutil.copy(split.directory("pi01") / "agents/agent-01/log.jsonl", already)
    synced, log = set(), []
    fsync, rename, call = os.fsync, Path.replace, Helper.call

    def note_sync(descriptor):
        synced.add(os.fstat(descriptor).st_ino)
        fsync(descriptor)

    def note_rename(path, target):
        assert path.stat().st_ino in synced, f"{target} got its name before its content was safe"
        synced.discard(Path(target).parent.stat().st_ino)
        return rename(path, target)

    def note_call(board, verb, *arguments, **more):
        if verb == "release":
            for path in (split.run.path / "agents/agent-01").iterdir():
                log.append(path.name)
                assert path.stat().st_ino in synced, f"{path} is not safe"
                assert path.parent.stat().st_ino in synced, f"the name of {path} is not safe"
        return call(board, verb, *arguments, **more)

    monkeypatch.setattr(os, "fsync", note_sync)
    monkeypatch.setattr(Path, "replace", note_rename)
    monkeypatch.setattr(Helper, "call", note_call)

    assert split.retrieve()["pi01"].is_ok
    assert len(log) == 6
