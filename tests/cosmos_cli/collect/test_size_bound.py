"""How much a machine may have of a run: asked before a byte is read there, and bounded by the run's plan."""

import dataclasses
import os
import re
import shutil
from collections import namedtuple

import pytest
from harness.split_run import SplitRun
from harness.synthetic_run import make_config

from cosmos_cli import app
from cosmos_cli.collect import retrieve, size_bound
from cosmos_cli.collect.size_bound import (
    BASE_BYTES,
    SizedFile,
    check_sizes,
    hash_deadline_s,
    parse_size,
    recordable_bytes,
)
from cosmos_cli.collect.wipe import look
from cosmos_cli.fleet.failure import FailureKind, MachineFailure
from cosmos_cli.fleet.helper import Helper
from cosmos_cli.fleet.local import LocalConnection

pytestmark = pytest.mark.usefixtures("own_places")

NINE_TB = 9 * 10**12
Usage = namedtuple("Usage", "total used free")


@pytest.fixture
def asked(monkeypatch):
    """The verbs that boards are asked for streams of."""
    verbs = []
    pieces = Helper.pieces

    def spy(self, verb, *args, **more):
        verbs.append(verb)
        return pieces(self, verb, *args, **more)

    monkeypatch.setattr(Helper, "pieces", spy)
    return verbs


def sparse(split, size_bytes, machine="pi01"):
    path = split.directory(machine) / "agents/agent-01/ticks.jsonl"
    os.truncate(path, size_bytes)
    return path


@pytest.mark.process
def test_sparse_file_of_nine_terabytes_is_refused_unread_and_others_come(tmp_path, asked):
    split = SplitRun(tmp_path)
    path = sparse(split, NINE_TB)

    outcomes = split.retrieve()

    failure = outcomes["pi01"].failure
    assert failure.kind is FailureKind.DATA
    assert "holds 9.0 TB, of which agents/agent-01/ticks.jsonl is 9.0 TB" in failure.text
    assert "--size-max" in failure.advice
    assert path.stat().st_size == NINE_TB
    assert outcomes["pi02"].is_ok
    assert asked.count("manifest") == 1  # pi02's


@pytest.mark.process
def test_user_may_allow_more_and_room_is_asked_for_before_anything_is_read(
    tmp_path, monkeypatch, capsys, asked
):
    split = SplitRun(tmp_path)
    split.leave_result()
    sparse(split, NINE_TB)
    monkeypatch.setattr(retrieve, "_connect", lambda target, _: LocalConnection(target))
    monkeypatch.setattr(shutil, "disk_usage", lambda _: Usage(10**12, 0, 10**12))

    assert app.run(["collect", "1", "--size-max", "10TB"]) == 5

    err = capsys.readouterr().err
    assert "no room on the disk here" in err
    assert "9.0 TB needed, 1.0 TB free" in err
    assert asked.count("manifest") == 1


@pytest.mark.process
def test_large_file_within_the_allowance_comes(tmp_path, monkeypatch, capsys):
    split = SplitRun(tmp_path)
    split.leave_result()
    big = split.directory("pi01") / "agents/agent-01/noise.bin"
    big.write_bytes(os.urandom(1_000_000))
    monkeypatch.setattr(retrieve, "_connect", lambda target, _: LocalConnection(target))
    monkeypatch.setattr(size_bound, "BASE_BYTES", 100_000)
    monkeypatch.setattr(size_bound, "TICK_BYTES", 0)

    assert app.run(["collect", "1"]) == 5
    assert "can have recorded at most 100.0 kB there" in capsys.readouterr().err
    assert app.run(["collect", "1", "--size-max", "2MB"]) == 0
    assert (split.run.path / "agents/agent-01/noise.bin").stat().st_size == 1_000_000


@pytest.mark.process
def test_helper_itself_reads_no_more_than_it_may(tmp_path):
    """What grows between the question of sizes and that of hashes is bounded as well."""
    split = SplitRun(tmp_path)
    sparse(split, NINE_TB)
    where = {"directory": str(split.directory("pi01")), "state": str(split.state("pi01"))}

    with Helper.start(LocalConnection(split.targets["pi01"]), retrieve.PARTS) as board:
        with pytest.raises(MachineFailure, match="holds more than 1000000 bytes") as caught:
            list(board.pieces("manifest", {**where, "bytes_max": 1_000_000}))
        assert caught.value.kind is FailureKind.DATA


@pytest.mark.process
def test_reading_that_takes_longer_than_so_much_may_is_told_in_full(tmp_path, monkeypatch):
    split = SplitRun(tmp_path, machines=1)
    sparse(split, 900_000_000)
    monkeypatch.setattr(size_bound, "HASH_BASE_S", 0.05)
    monkeypatch.setattr(size_bound, "FILE_S_MAX", 0.0)
    monkeypatch.setattr(size_bound, "HASH_BYTES_S_MIN", 10**15)

    failure = split.retrieve()["pi01"].failure

    assert failure.kind is FailureKind.TIMEOUT
    told = rf"reading \d+ files of {split.directory('pi01')}, 900\.\d MB: not done in [\d.]+ s"
    assert re.search(told, failure.text)
    assert failure.advice == (f"is its card failing? repeat with: cosmos collect {split.run.path}")


@pytest.mark.process
def test_collected_run_that_grew_to_terabytes_is_not_read_to_be_wiped(tmp_path):
    split = SplitRun(tmp_path, machines=1)
    kept = tmp_path / "kept"
    shutil.copytree(split.directory("pi01"), kept)
    assert split.retrieve()["pi01"].is_ok
    shutil.copytree(kept, split.directory("pi01"))
    sparse(split, NINE_TB)
    known = {split.directory("pi01").name: split.run}

    findings = look(LocalConnection(split.targets["pi01"]), known, is_all=False)

    assert [run.state for run in findings.runs] == ["not collected"]


def test_bound_grows_with_what_the_plan_lets_a_machine_record():
    config = make_config(10, ticks=1800)

    assert recordable_bytes(None, 3, is_host=False) == BASE_BYTES
    assert recordable_bytes(config, 0, is_host=False) == BASE_BYTES
    one = recordable_bytes(config, 1, is_host=False) - BASE_BYTES
    assert one == 1800 * size_bound.TICK_BYTES
    assert recordable_bytes(config, 3, is_host=False) - BASE_BYTES == 3 * one
    assert recordable_bytes(config, 0, is_host=True) - BASE_BYTES == 10 * one
    again = dataclasses.replace(config.agents, restarts_max=2)
    restarted = dataclasses.replace(config, agents=again)
    assert recordable_bytes(restarted, 1, is_host=False) - BASE_BYTES == 3 * one


def test_sizes_up_to_the_bound_pass():
    files = [SizedFile("a", 60), SizedFile("b", 40)]

    check_sizes(files, 100, "/d", run="runs/7")
    check_sizes([], 0, "/d", run="runs/7")
    with pytest.raises(MachineFailure, match="of which a is 60 B") as caught:
        check_sizes(files, 99, "/d", run="runs/7")
    assert caught.value.advice.endswith("cosmos collect --size-max SIZE runs/7")


def test_hashing_has_a_deadline_by_size():
    assert hash_deadline_s(0, 0) == 60
    assert hash_deadline_s(100, 10**9) == 60 + 2 + 500


@pytest.mark.parametrize(
    ("text", "size"),
    [("20GB", 20 * 10**9), ("1.5 tb", 15 * 10**11), ("1500000", 1_500_000), ("2k", 2000)],
)
def test_size_as_people_write_it(text, size):
    assert parse_size(text) == size


@pytest.mark.parametrize("text", ["", "GB", "-1", "0", "1e9", "nan", "9" * 400, "1 XB"])
def test_size_that_is_none_is_refused(text, capsys):
    with pytest.raises(ValueError, match="expected a size"):
        parse_size(text)
    assert app.run(["collect", "1", "--size-max", text]) == 2
