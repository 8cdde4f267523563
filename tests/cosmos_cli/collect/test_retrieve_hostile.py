"""A machine's manifest is input: nothing it says leads out of the run directory or over another's files."""

import functools
import hashlib
import zlib

import pytest
from harness.split_run import LyingConnection, SplitRun, hashes, pieces

from cosmos_cli.collect.machine_sources import RecordingMachines
from cosmos_cli.collect.remote_manifest import check_offer
from cosmos_cli.collect.retrieval_state import read_note, retrieved_files
from cosmos_cli.fleet.failure import FailureKind
from cosmos_cli.onboard.records import entry_line

DIGEST = "0" * 64
OWNERS = RecordingMachines(machine_of_agent={"agent-01": "pi01", "agent-02": "pi02"})


def check(*entries, machine="pi01"):
    return check_offer(entries, machine, OWNERS.owner_of)


def entry(path, **more):
    return {"path": path, "bytes": 5, "mtime_s": 0, "sha256": DIGEST} | more


@pytest.mark.parametrize(
    "path",
    [
        "agents/agent-01/ticks.jsonl",
        "agents/agent-01/own/deep/file.csv",
        "machines/pi01/health.jsonl",
        "machines/pi01/sub/manifest.json",
        "core.77",
        "agents/nobodys/ticks.jsonl",
        "Ümlaut/日本.txt",
    ],
)
def test_ordinary_paths_may_come(path):
    offer = check(entry(path))

    assert [file.path for file in offer.files] == [path]
    assert offer.faults == ()


@pytest.mark.parametrize(
    ("path", "reason"),
    [
        ("../evil", "leads out"),
        ("agents/../../evil", "leads out"),
        ("/etc/passwd", "leads out"),
        ("agents//ticks.jsonl", "leads out"),
        ("./agents", "leads out"),
        ("agents/agent-01/", "leads out"),
        ("", "leads out"),
        ("agents/a\0b", "printable"),
        ("agents/a\x1b[2Jb", "printable"),
        ("agents/a\nb", "printable"),
        ("agents/\udcff", "printable"),
        ("a" * 300, "255 bytes"),
        ("a/" * 600 + "b", "moderate length"),
        ("run.json", "operator's"),
        ("plan.json", "operator's"),
        ("manifest.json", "operator's"),
        ("tables/ticks.parquet", "operator's"),
        (".incoming/pi02/x.part", "operator's"),
        ("machines/pi01/retrieved.json", "operator's"),
        ("machines/pi01/manifest.json", "operator's"),
        ("machines/pi02/retrieved.json", "pi01 offers it, but it is of pi02"),
        ("agents/agent-02/ticks.jsonl", "pi01 offers it, but it is of pi02"),
        ("host/events.jsonl", "pi01 offers it, but it is of this computer"),
    ],
)
def test_paths_that_may_not_come_are_named_with_the_reason(path, reason):
    offer = check(entry(path), entry("core.77"))

    assert [file.path for file in offer.files] == ["core.77"]
    assert len(offer.faults) == 1
    assert reason in offer.faults[0]
    assert offer.faults[0].isprintable()


@pytest.mark.parametrize(
    "bad",
    [
        None,
        7,
        [],
        {},
        {"path": None},
        {"path": ["a"]},
        entry("a", bytes=-1),
        entry("a", bytes=True),
        entry("a", bytes="5"),
        entry("a", bytes=1 << 60),
        entry("a", sha256="zz"),
        entry("a", sha256=None),
        entry("a", error="Input/output error"),
    ],
)
def test_entries_that_are_none_are_faults_and_do_not_keep_the_others(bad):
    offer = check(bad, entry("b"))

    assert [file.path for file in offer.files] == ["b"]
    assert len(offer.faults) == 1


def test_file_that_is_listed_twice_is_a_fault():
    offer = check(entry("a"), entry("a", bytes=6))

    assert [file.size_bytes for file in offer.files] == [5]
    assert offer.faults == ("a: listed twice",)


def test_host_of_a_named_machine_brings_the_hosts_records():
    owners = RecordingMachines(host_machine="pi01")

    mine = check_offer([entry("host/events.jsonl")], "pi01", owners.owner_of)
    others = check_offer([entry("host/events.jsonl")], "pi02", owners.owner_of)

    assert mine.faults == ()
    assert others.faults == ("host/events.jsonl: pi02 offers it, but it is of pi01",)


def listing(change):
    """Return a lie about the list of files, whose hash fits again."""

    def lie(header, body):
        value = header.get("value")
        if isinstance(value, dict) and "sha256" in value:
            change(value["files"])
            digest = hashlib.sha256()
            for each in value["files"]:
                digest.update(entry_line(each))
            value["sha256"] = digest.hexdigest()
        return header, body

    return lie


@pytest.mark.process
def test_file_that_would_leave_the_run_directory_is_named_and_the_rest_comes(tmp_path):
    split = SplitRun(tmp_path)
    before = split.there("pi01")
    around = {p for p in hashes(tmp_path) if not p.startswith(("boards", "runs/0001"))}
    lie = listing(lambda files: files.append(entry("../../evil", bytes=0)))

    outcome = split.retrieve(split.connections(pi01=LyingConnection(split.targets["pi01"], lie)))[
        "pi01"
    ]

    assert outcome.failure.kind is FailureKind.DATA
    assert "../../evil: leads out of the run directory" in str(outcome.failure)
    assert before.items() <= hashes(split.run.path).items()
    assert split.there("pi01") == before  # it stays there
    assert around == {p for p in hashes(tmp_path) if not p.startswith(("boards", "runs/0001"))}


@pytest.mark.process
def test_two_machines_that_have_the_same_file_are_both_named(tmp_path):
    split = SplitRun(tmp_path)
    for name in split.names:
        (split.directory(name) / "notes.txt").write_text(name)

    outcomes = split.retrieve(forks=1)

    assert outcomes["pi01"].is_ok
    assert "notes.txt: pi02 offers it, but it is of pi01" in str(outcomes["pi02"].failure)
    assert (split.run.path / "notes.txt").read_text() == "pi01"
    assert "notes.txt: pi02 offers it" in str(split.retrieve()["pi02"].failure)
    assert (split.directory("pi02") / "notes.txt").read_text() == "pi02"


@pytest.mark.process
def test_file_that_is_here_with_other_content_is_not_overwritten(tmp_path):
    split = SplitRun(tmp_path, machines=1)
    here = split.run.path / "agents/agent-01/ticks.jsonl"
    here.parent.mkdir(parents=True)
    here.write_text("mine\n")

    failure = split.retrieve()["pi01"].failure

    assert "ticks.jsonl: another file of that name is here" in str(failure)
    assert here.read_text() == "mine\n"
    assert (split.directory("pi01") / "agents/agent-01/ticks.jsonl").exists()
    here.unlink()
    assert split.retrieve()["pi01"].is_ok


@pytest.mark.process
@pytest.mark.parametrize("place", ["agents", "agents/agent-01", "agents/agent-01/ticks.jsonl"])
def test_link_here_is_not_followed(tmp_path, place):
    split = SplitRun(tmp_path, machines=1)
    outside = tmp_path / "outside"
    outside.mkdir()
    path = split.run.path / place
    if path.is_dir():
        path.rmdir()
    path.parent.mkdir(parents=True, exist_ok=True)
    path.symlink_to(outside)

    failure = split.retrieve()["pi01"].failure

    assert failure.kind is FailureKind.DATA
    assert "link" in failure.text
    assert list(outside.iterdir()) == []
    assert split.directory("pi01").exists()


@functools.cache
def bomb():
    """Return what unpacks to 100 MB."""
    return zlib.compress(bytes(10**8), 1)


@pytest.mark.process
@pytest.mark.parametrize(
    "change",
    [
        lambda value, body: (value | {"file": 99}, body),
        lambda value, body: (value | {"file": -1}, body),
        lambda value, body: (value | {"offset": value["offset"] + 1}, body),
        lambda value, body: (value | {"bytes": 1 << 40}, body),
        lambda value, body: (value | {"packed": not value["packed"]}, body),
        lambda value, body: (value | {"packed": True}, bomb()),
        lambda value, body: ({"offset": None}, body),
    ],
)
def test_pieces_that_were_not_asked_for_are_refused(tmp_path, change):
    split = SplitRun(tmp_path, machines=1)
    connection = LyingConnection(split.targets["pi01"], pieces(change))

    failure = split.retrieve({"pi01": connection})["pi01"].failure

    assert failure.kind is FailureKind.DATA
    assert split.retrieve()["pi01"].is_ok


@pytest.mark.process
def test_content_that_is_never_what_was_listed_is_given_up_and_leaves_no_part(tmp_path):
    split = SplitRun(tmp_path, machines=1)
    lie = listing(lambda files: files[0].update(sha256="ab" * 32))
    connection = LyingConnection(split.targets["pi01"], lie)

    failure = split.retrieve({"pi01": connection})["pi01"].failure

    assert failure.kind is FailureKind.DATA
    assert "came with another content" in failure.text
    assert list(split.run.path.rglob("*.part")) == []
    assert not (split.run.path / "agents/agent-01/clock.jsonl").exists()


@pytest.mark.process
def test_list_that_is_not_whole_is_refused(tmp_path):
    split = SplitRun(tmp_path, machines=1)

    def lie(header, body):
        if isinstance(header.get("value"), dict) and "files" in header["value"]:
            header["value"]["files"].pop()
        return header, body

    failure = split.retrieve({"pi01": LyingConnection(split.targets["pi01"], lie)})["pi01"].failure

    assert failure.kind is FailureKind.DATA
    assert "not whole" in failure.text
    assert split.directory("pi01").exists()


@pytest.mark.process
def test_size_that_no_disk_holds_is_refused_before_anything_is_fetched(tmp_path):
    split = SplitRun(tmp_path, machines=1)
    lie = listing(lambda files: files[0].update(bytes=1 << 49))
    fetched = []
    lying = LyingConnection(split.targets["pi01"], lie)

    failure = split.retrieve({"pi01": lying}, progress=lambda what, share: fetched.append(what))[
        "pi01"
    ].failure

    assert failure.kind is FailureKind.DISK_FULL
    assert fetched == []


@pytest.mark.process
@pytest.mark.parametrize("wrong", [{"mtime_s": 2**70}, {"mtime_s": "\ud800"}, {"more": 2**70}])
def test_a_value_that_no_file_of_ours_holds_keeps_no_record_from_coming(tmp_path, wrong):
    split = SplitRun(tmp_path, machines=1)
    change = listing(lambda files: [each.update(wrong) for each in files])

    def lie(header, body):
        """Take the release of what was never listed, too."""
        if "error" in header:
            header = {"ok": True, "value": {"released": True}}
        return change(header, body)

    outcome = split.retrieve({"pi01": LyingConnection(split.targets["pi01"], lie)})["pi01"]

    assert outcome.is_ok, outcome.failure
    assert outcome.value.is_released
    assert read_note(split.run, "pi01").state == "released"
    kept = dict(retrieved_files(split.run))
    assert kept.keys() == split.there("pi01").keys()
    assert all(entry.keys() - {"mtime_s"} == {"bytes", "sha256"} for entry in kept.values())
