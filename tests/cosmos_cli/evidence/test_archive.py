import io
import os
import tarfile

import pytest
import zstandard
from harness import full_disk
from harness.nested_folders import nested_folders
from harness.synthetic_run import SyntheticRun

from cosmos_cli.collect.finish import finish_run
from cosmos_cli.evidence.manifest import pack_run

MTIME_S = 1_700_000_000


def members(run):
    data = zstandard.ZstdDecompressor().stream_reader(io.BytesIO(run.bundle.read_bytes())).read()
    with tarfile.open(fileobj=io.BytesIO(data)) as archive:
        return {m.name: (m.mtime, archive.extractfile(m).read()) for m in archive}


def test_package_is_the_same_whenever_and_by_whomever_the_files_were_touched(tmp_path):
    made = SyntheticRun(tmp_path).write()
    first = pack_run(made.run, MTIME_S).read_bytes()
    for path in made.run.path.rglob("*"):
        os.utime(path, (1, 1))
        if path.is_file():
            path.chmod(0o600)

    assert pack_run(made.run, MTIME_S).read_bytes() == first
    assert {mtime for mtime, _ in members(made.run).values()} == {MTIME_S}


def test_package_leaves_out_the_reserve_links_and_halves(tmp_path):
    made = SyntheticRun(tmp_path).write()
    (made.run.path / "link").symlink_to("/etc/hostname")
    (made.run.path / "tables").mkdir(exist_ok=True)
    (made.run.path / "tables" / ".ticks.parquet.part").write_bytes(b"half")

    pack_run(made.run, MTIME_S)

    names = members(made.run)
    assert f"{made.run.name}/plan.json" in names
    assert not [n for n in names if "reserve" in n or "link" in n or n.endswith(".part")]


def test_files_of_folders_within_folders_are_packaged_however_deep(tmp_path):
    made = SyntheticRun(tmp_path).write()
    depth = min(1100, (4000 - len(str(made.run.path))) // 2)

    with nested_folders(made.run.path, "a", depth):
        summary = finish_run(made.run, made.result(), made.expected, has_report=False)

    assert summary.exit_code == 0
    assert f"{made.run.name}/{'a/' * depth}deep.txt" in members(made.run)


def test_a_file_whose_path_is_too_long_is_named(tmp_path):
    made = SyntheticRun(tmp_path).write()

    with nested_folders(made.run.path, "b" * 250, 17):
        summary = finish_run(made.run, made.result(), made.expected, has_report=False)

    (line,) = summary.missing
    assert line.startswith("b" * 250) and line.endswith("not read: File name too long")


def test_files_come_back_byte_by_byte(tmp_path):
    made = SyntheticRun(tmp_path).write()

    pack_run(made.run, MTIME_S)

    path = made.stream("agent-02", "ticks")
    name = f"{made.run.name}/agents/agent-02/ticks.jsonl"
    assert members(made.run)[name][1] == path.read_bytes()


def test_package_that_cannot_be_written_leaves_the_old_one_and_no_rest(tmp_path, monkeypatch):
    made = SyntheticRun(tmp_path).write()
    before = pack_run(made.run, MTIME_S).read_bytes()

    monkeypatch.setattr("cosmos_cli.evidence.manifest.os.fsync", full_disk.refuse)
    with pytest.raises(OSError, match="No space"):
        pack_run(made.run, MTIME_S)

    assert made.run.bundle.read_bytes() == before
    assert not list(tmp_path.glob(".*.part"))


def test_rest_of_one_that_was_killed_is_taken_by_the_next(tmp_path):
    made = SyntheticRun(tmp_path).write()
    rest = tmp_path / f".{made.run.bundle.name}.part"
    rest.write_bytes(b"half" * 1000)

    pack_run(made.run, MTIME_S)

    assert not rest.exists()
    assert members(made.run)
