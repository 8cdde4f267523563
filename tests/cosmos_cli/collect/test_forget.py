"""A machine of a run that is gone for good: asked no more, never green, and it can be taken back."""

import json

import pytest
from harness.split_run import SplitRun

from cosmos_cli import app
from cosmos_cli.collect import retrieve
from cosmos_cli.commands import ps
from cosmos_cli.evidence.run_directory import write_json
from cosmos_cli.fleet.failure import FailureKind, MachineFailure
from cosmos_cli.fleet.local import LocalConnection
from cosmos_cli.launch.living_processes import unfinished_runs

pytestmark = pytest.mark.process


@pytest.fixture
def asked(own_places, monkeypatch):
    """Who was connected to; what is in `off` does not answer."""
    names = []

    def connect(target, _options):
        names.append(target.name)
        if target.name == "pi02":
            raise MachineFailure(FailureKind.UNREACHABLE, "no route to host")
        return LocalConnection(target)

    monkeypatch.setattr(retrieve, "_connect", connect)
    return names


@pytest.fixture
def split(asked, tmp_path):
    split = SplitRun(tmp_path)
    split.leave_result()
    return split


def document(split):
    return json.loads(split.run.run_json.read_bytes())


def test_forgotten_machine_is_asked_no_more_and_stays_missing(split, asked, capsys):
    assert app.run(["collect", "1", "--forget", "pi02"]) == 5

    err = capsys.readouterr().err
    assert "pi02: is asked no more" in err
    assert set(asked) == {"pi01"}
    assert not split.directory("pi01").exists()
    for _ in range(2):
        asked.clear()
        assert app.run(["collect", "1"]) == 5
        assert asked == []
        told = document(split)
        # Nobody looks after that machine any more: the data are what is wrong.
        assert told["exit_code"] == 5
        assert told["verdict"].startswith("DATA INCOMPLETE: ")
        assert {line.split(":")[0] for line in told["data"]["missing"]} == {"agent-02", "pi02"}
        assert any("pi02: given up on 20" in line for line in told["data"]["missing"])
        (problem,) = told["problems"]
        assert (problem["machine"], problem["step"]) == ("pi02", "forgotten")
    files = json.loads(split.run.manifest_json.read_bytes())["files"]
    assert "machines/pi02/retrieved.json" in files
    assert split.directory("pi02").exists()


def test_all_that_is_left_can_be_forgotten_at_once(split, asked):
    assert app.run(["collect", "1", "--forget", "all"]) == 5

    assert asked == []
    assert {p["machine"] for p in document(split)["problems"]} == {"pi01", "pi02"}


def test_what_was_forgotten_is_asked_again_on_demand(split, asked, monkeypatch):
    app.run(["collect", "1", "--forget", "all"])
    monkeypatch.setattr(retrieve, "_connect", lambda target, _: LocalConnection(target))

    assert app.run(["collect", "1", "--forget", "none"]) == 0

    assert document(split)["problems"] == []
    assert not split.directory("pi02").exists()


def test_machine_whose_records_are_all_here_is_forgotten_without_loss(split, monkeypatch):
    release = retrieve.MachineRetrieval._release
    kept = MachineFailure(FailureKind.BUSY, "kept")

    def refuse(self, board, note):
        raise kept

    monkeypatch.setattr(retrieve, "_connect", lambda target, _: LocalConnection(target))
    monkeypatch.setattr(retrieve.MachineRetrieval, "_release", refuse)
    app.run(["collect", "1"])
    monkeypatch.setattr(retrieve.MachineRetrieval, "_release", release)

    assert app.run(["collect", "1", "--forget", "all"]) == 0

    assert document(split)["problems"] == []
    assert app.run(["collect", "1", "--forget", "none"]) == 0
    assert not split.directory("pi01").exists()


@pytest.mark.parametrize(
    ("names", "text"),
    [(["pi09"], "pi01, pi02"), (["none", "pi01"], "give no other name")],
)
def test_name_that_is_no_machines_is_refused_and_nothing_is_noted(split, capsys, names, text):
    options = [word for name in names for word in ("--forget", name)]

    assert app.run(["collect", "1", *options]) == 2

    assert text in capsys.readouterr().err
    assert not list(split.run.path.glob("machines/*/retrieved.json"))


def test_machine_whose_records_have_come_cannot_be_forgotten(split, monkeypatch, capsys):
    def connect(target, _):
        if target.name == "pi01":
            return LocalConnection(target)
        raise MachineFailure(FailureKind.UNREACHABLE, "no route")

    monkeypatch.setattr(retrieve, "_connect", connect)
    assert app.run(["collect", "1"]) == 5
    capsys.readouterr()

    assert app.run(["collect", "1", "--forget", "pi01"]) == 2

    assert "may still come: pi02" in capsys.readouterr().err


def test_run_without_other_machines_has_nothing_to_forget(split, monkeypatch, capsys):
    monkeypatch.setattr(retrieve, "_connect", lambda target, _: LocalConnection(target))
    app.run(["collect", "1"])

    assert app.run(["collect", "1", "--forget", "all"]) == 2

    assert "there is nothing to forget" in capsys.readouterr().err


def test_ps_and_down_ask_a_forgotten_machine_no_more(split):
    write_json(split.run.run_json, {**document(split), "status": "running"})
    assert [run.path for run in unfinished_runs()] == [split.run.path]
    assert [s.machine for s in ps.asked_sources(split.run)] == ["pi01", "pi02"]

    app.run(["collect", "1", "--forget", "all"])
    write_json(split.run.run_json, {**document(split), "status": "running"})

    assert unfinished_runs() == []
    assert ps.asked_sources(split.run) == ()


@pytest.mark.parametrize(
    "damage",
    [
        {"files": []},
        {"bytes": "many"},
        {"manifest_sha256": None},
        {"state": ["verified"]},
        {"files": -1},
    ],
)
def test_note_of_wrong_types_is_taken_for_none(split, monkeypatch, damage):
    monkeypatch.setattr(retrieve, "_connect", lambda target, _: LocalConnection(target))
    app.run(["collect", "1"])
    note = split.run.path / "machines/pi01/retrieved.json"
    write_json(note, {**json.loads(note.read_bytes()), **damage})

    # Nothing of it is there any more, and no note says that it came.
    assert app.run(["collect", "1"]) == 5

    assert [p["machine"] for p in document(split)["problems"]] == ["pi01"]
