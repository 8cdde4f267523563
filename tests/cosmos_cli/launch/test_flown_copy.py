"""The copy of what a run flies: what belongs to it, its bounds, and what is said of what is left out."""

import hashlib
import os

import pytest

from cosmos_cli.evidence import flown_files
from cosmos_cli.evidence.flown_files import flown_remarks, read_flown_files
from cosmos_cli.evidence.run_directory import RunDirectory
from cosmos_cli.launch import flown_copy
from cosmos_cli.launch.flown_copy import copy_flown
from cosmos_cli.provision.trees import folder_tree


@pytest.fixture
def run(tmp_path):
    (tmp_path / "run").mkdir()
    return RunDirectory(tmp_path / "run")


@pytest.fixture
def folder(tmp_path):
    folder = tmp_path / "scenario"
    (folder / "flight").mkdir(parents=True)
    (folder / "flight" / "guidance.py").write_text("GAIN = 1")
    (folder / "fly.sh").write_text("exec true")
    (folder / "fly.sh").chmod(0o755)
    (folder / "here").symlink_to("flight")
    (folder / ".git").mkdir()
    (folder / ".git" / "config").write_text("")
    (folder / "__pycache__").mkdir()
    (folder / "__pycache__" / "guidance.pyc").write_text("")
    return folder


def files(run):
    top = run.path / "flown"
    return {path.relative_to(top).as_posix() for path in top.rglob("*") if path.is_file()}


def test_the_copy_holds_what_machines_are_sent_and_reads_back(folder, run):
    flown = copy_flown(folder, run, "private")

    tree = folder_tree("scenario", folder)
    assert flown.is_whole and not flown.left_out
    assert {name: one.sha256 for name, one in flown.files.items()} == {
        one.path: one.sha256 for one in tree.files
    }
    assert files(run) == {"flight/guidance.py", "fly.sh", "here/guidance.py"}
    assert [name for name, one in flown.files.items() if one.is_program] == ["fly.sh"]
    assert (run.path / "flown" / "fly.sh").stat().st_mode & 0o777 == 0o600
    assert read_flown_files({"flown": flown.to_mapping()}) == flown
    assert flown_remarks({"flown": flown.to_mapping()}) == ()


def test_a_file_that_is_too_large_is_left_out_with_its_hash_and_named(folder, run, monkeypatch):
    monkeypatch.setattr(flown_copy, "FILE_BYTES_MAX", 100)
    (folder / "sky.bin").write_bytes(b"s" * 101)

    flown = copy_flown(folder, run, "private")

    sky = flown.files["sky.bin"]
    assert not sky.is_copied and sky.sha256 == hashlib.sha256(b"s" * 101).hexdigest()
    assert flown.is_whole and "sky.bin" not in files(run)
    [remark] = flown_remarks({"flown": flown.to_mapping()})
    assert "sky.bin was too large and left out" in remark
    assert read_flown_files({"flown": flown.to_mapping()}) == flown


def test_a_file_whose_name_cannot_be_listed_is_told_as_left_out(folder, run):
    (folder / "a\x1b[31m.py").write_text("")

    flown = copy_flown(folder, run, "private")

    (told,) = flown_remarks({"flown": flown.to_mapping()})
    assert told.startswith("flown: a\\x1b[31m.py was left out for its name: expected printable")
    assert not flown.is_whole


def test_of_too_much_the_smallest_are_copied(folder, run, monkeypatch):
    monkeypatch.setattr(flown_copy, "COPY_BYTES_MAX", 30)
    (folder / "data.bin").write_bytes(b"d" * 29)

    flown = copy_flown(folder, run, "private")

    assert {name for name, one in flown.files.items() if not one.is_copied} == {"data.bin"}


def test_of_too_many_files_the_uppermost_are_copied(folder, run, monkeypatch):
    monkeypatch.setattr(flown_copy, "FILES_MAX", 4)
    for number in range(5):
        (folder / "flight" / f"{number}.csv").write_text("")

    flown = copy_flown(folder, run, "private")

    assert len(flown.files) == 4 and "fly.sh" in flown.files
    assert not flown.is_whole
    assert any("more than 4 files" in text for text in flown.left_out)


@pytest.mark.parametrize(
    ("to", "why"),
    [
        ("../secret", "a link that leads out of the folder"),
        ("gone", "neither a file nor a folder"),
        ("odd", "cannot be read"),
        (None, "neither a file nor a folder"),
    ],
)
def test_what_cannot_be_copied_costs_no_run_and_is_named(folder, run, tmp_path, to, why):
    (tmp_path / "secret").write_text("x")
    path = folder / "odd"
    if to is None:
        os.mkfifo(path)
    else:
        path.symlink_to(to)

    flown = copy_flown(folder, run, "private")

    assert "odd" not in flown.files and "odd" not in files(run)
    assert not flown.is_whole
    [text] = flown.left_out
    assert text.startswith(f"{path}: {why}")


def entry(**more):
    return {"bytes": 1, "sha256": "0" * 64, **more}


@pytest.mark.parametrize(
    ("name", "given", "words"),
    [
        ("../a.py", entry(), "starts with a dot"),
        ("a/../../b.py", entry(), "starts with a dot"),
        ("/etc/passwd", entry(), "within the folder"),
        ("a//b.py", entry(), "within the folder"),
        ("", entry(), "within the folder"),
        ("a\x1b.py", entry(), "printable"),
        ("a\\b.py", entry(), "printable"),
        ("n" * 1025, entry(), "printable"),
        ("a.py", 1, "expected an object"),
        ("a.py", entry(bytes=True), "bytes >= 0"),
        ("a.py", entry(bytes=-1), "bytes >= 0"),
        ("a.py", entry(bytes=1 << 30), "at most 8388608"),
        ("a.py", entry(bytes=1 << 30, copied=False), "at most 268435456"),
        ("a.py", entry(sha256="0" * 63 + "\n"), "sha256"),
        ("a.py", entry(sha256=None), "sha256"),
    ],
)
def test_a_list_that_no_run_wrote_is_refused_by_name(name, given, words):
    with pytest.raises(ValueError, match=words):
        read_flown_files({"flown": {"files": {name: given}}})


def test_lists_of_any_other_form_are_refused_and_a_missing_one_is_none(monkeypatch):
    assert read_flown_files({}) is None
    for listed in (1, [], {"files": []}):
        with pytest.raises(ValueError, match=r"flown\.files: expected an object"):
            read_flown_files({"flown": listed})
    monkeypatch.setattr(flown_files, "FILES_MAX", 1)
    with pytest.raises(ValueError, match="at most 1 files"):
        read_flown_files({"flown": {"files": {"a": entry(), "b": entry()}}})
    monkeypatch.setattr(flown_files, "FILES_MAX", 9)
    monkeypatch.setattr(flown_files, "COPY_BYTES_MAX", 1)
    with pytest.raises(ValueError, match="in all files copied"):
        read_flown_files({"flown": {"files": {"a": entry(), "b": entry()}}})


def test_remarks_of_an_edited_list_are_harmless_and_bounded():
    remarks = flown_remarks({"flown": {"left_out": ["\x1b[2J", *map(str, range(40))]}})

    assert "\x1b" not in remarks[0]
    assert len(remarks) == flown_files.LEFT_OUT_SHOWN_MAX + 1
    assert flown_remarks({"flown": {"left_out": 3}}) == ()
