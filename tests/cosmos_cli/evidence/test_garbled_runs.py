"""Files of a run that somebody garbled: of wrong types, too large, too deep, no files. Clear words, never a traceback."""

import copy
import json
import os
import random
import shutil

import pytest
from harness.synthetic_run import SyntheticRun

from cosmos_cli import app
from cosmos_cli.collect import finish
from cosmos_cli.collect.finish import collect_run, finish_run
from cosmos_cli.collect.machine_sources import RecordingMachines
from cosmos_cli.errors import CosmosError
from cosmos_cli.evidence import run_documents
from cosmos_cli.evidence.run_directory import RunDirectory, write_json
from cosmos_cli.evidence.streams import find_streams
from cosmos_cli.fleet.target import Target
from cosmos_cli.launch.living_processes import unfinished_runs
from cosmos_cli.report.build import build_sections

pytestmark = pytest.mark.usefixtures("own_places")

NAMES = ("run.json", "result.json", "plan.json", "manifest.json")
FOUND = [("result.json", ("who",), {}), ("run.json", ("agents", "lost"), 10**30)]
"""What once ended in a traceback: tried each time."""
WRONG = (
    None,
    [],
    {},
    "x",
    -1,
    10**30,
    True,
    0.5,
    [[]],
    {"a": {"b": []}},
    [1, "a", None],
    "\x1b[31m",
    {"name": []},
)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    made = SyntheticRun(tmp_path_factory.mktemp("whole")).write()
    finish_run(made.run, made.result(), made.expected)
    return made


@pytest.fixture
def made(tmp_path, whole):
    """Return a copy of a finished run, to be garbled."""
    made = copy.copy(whole)
    made.run = RunDirectory(tmp_path / "runs" / whole.run.name)
    shutil.copytree(whole.run.path, made.run.path)
    return made


def places(value, at=()):
    yield at
    items = (
        value.items()
        if isinstance(value, dict)
        else enumerate(value[:3])
        if isinstance(value, list)
        else ()
    )
    for key, item in items:
        yield from places(item, (*at, key))


def garbled(document, at, wrong):
    if not at:
        return wrong
    document = copy.deepcopy(document)
    inner = document
    for key in at[:-1]:
        inner = inner[key]
    inner[at[-1]] = wrong
    return document


def look_for_unfinished(_run):
    unfinished_runs()


def list_runs(_run):
    assert app.run(["runs", "--json"]) == 0


def report(_run):
    assert app.run(["report", "1"]) in (0, 2)


def draw(run):
    build_sections(run, run.read_json(run.run_json) or {})


def collect(run):
    collect_run(run, processes=lambda: [])


@pytest.mark.slow
@pytest.mark.parametrize("count", [12, pytest.param(120, marks=pytest.mark.nightly)])
def test_wrong_types_anywhere_end_in_no_traceback(made, monkeypatch, capsys, count):
    monkeypatch.setattr(finish, "write_report", lambda *_: None)
    documents = {name: json.loads((made.run.path / name).read_bytes()) for name in NAMES}
    cases = [(name, at) for name in NAMES for at in places(documents[name])]
    random_ = random.Random(count)

    uses = (look_for_unfinished, list_runs, report, draw, collect)
    done = dict.fromkeys([use.__name__ for use in uses], 0)
    drawn = [(name, at, random_.choice(WRONG)) for name, at in random_.sample(cases, count)]
    for name, at, wrong in [*FOUND, *drawn]:
        for each in NAMES:
            (made.run.path / each).write_text(json.dumps(documents[each]))
        (made.run.path / name).write_text(json.dumps(garbled(documents[name], at, wrong)))
        for use in uses:
            try:
                use(made.run)
                done[use.__name__] += 1
            except CosmosError:
                pass
            except Exception as error:
                raise AssertionError((use.__name__, name, at, wrong)) from error
        assert "defect" not in capsys.readouterr().err, (name, at, wrong)
    # Refusals are right where a file is none; a defect that always looks like one is not.
    assert min(done.values()) >= 0.75 * (len(FOUND) + count), done


@pytest.mark.parametrize(
    ("key", "wrong"),
    [
        ("checks", [{"name": "a", "limit": 0, "got": 0, "passed": True}, "x"]),
        ("checks", 5),
        ("remarks", [7]),
        ("problems", ["x"]),
        ("data", []),
    ],
)
def test_report_says_what_in_a_summary_is_wrong_and_how_to_make_it_anew(made, capsys, key, wrong):
    document = json.loads(made.run.run_json.read_bytes())
    write_json(made.run.run_json, document | {key: wrong})

    assert app.run(["report", "1"]) == 2

    err = capsys.readouterr().err
    assert f"run.json: {key}" in err
    assert "cosmos collect" in err


@pytest.mark.parametrize(
    "wrong",
    [
        {"duration_s": "long"},
        {"status": 5, "verdict": ["x"], "exit_code": {}},
        {"started_utc": 7, "agents": {"count": []}},
    ],
)
def test_runs_lists_a_run_whose_summary_has_wrong_types(made, capsys, wrong):
    document = json.loads(made.run.run_json.read_bytes())
    write_json(made.run.run_json, document | wrong)

    assert app.run(["runs"]) == 0
    assert "0001-synthetic" in capsys.readouterr().out


def test_runs_says_of_a_summary_that_is_none_why(made, capsys):
    made.run.run_json.write_text("[" * 100_000)

    assert app.run(["runs"]) == 0
    assert "run.json: cannot be used" in capsys.readouterr().out


def test_what_the_run_met_stays_unknown_when_its_summary_was_garbled(made):
    """A lost machine stands in run.json alone: garbling it must not turn a run green."""
    made.run.run_json.write_text('{"status": "comple')

    for _ in range(2):
        summary = collect_run(made.run, processes=lambda: [])
        assert summary.exit_code == 3
        assert "what the run itself met is not known" in summary.verdict.text


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("{", "cannot be used: "),
        ("[]", "expected a JSON object, got list"),
        ("{}", "expected the run's configuration under config"),
        ('{"config": {"run": 5}}', "cannot be used: config"),
    ],
)
def test_plan_that_cannot_be_used_is_a_gap_also_the_first_time(tmp_path, text, said):
    made = SyntheticRun(tmp_path / "runs").write()
    made.run.plan_json.write_text(text)

    summary = finish_run(made.run, made.result(), made.expected)

    (line,) = (line for line in summary.missing if line.startswith("plan.json: "))
    assert said in line
    assert line.endswith("what was planned is not known")
    assert summary.exit_code == 5


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_pipes_in_the_place_of_files_hold_nobody_up(made, capsys, name):
    (made.run.path / name).unlink()
    os.mkfifo(made.run.path / name)

    assert app.run(["runs"]) == 0
    assert app.run(["report", "1"]) == (2 if name == "run.json" else 0)
    collect_run(made.run, processes=lambda: [])


@pytest.mark.parametrize(
    "name",
    ["x" * 300, "agents/" + "y" * 300 + "/z.jsonl", "a/" * 3000 + "b", "", ".", "../outside"],
)
def test_name_of_a_manifest_that_no_file_of_the_run_can_have_is_missing(made, capsys, name):
    (made.run.path.parent / "outside").write_text("not of the run")
    manifest = made.run.read_json(made.run.manifest_json)
    entry = {"bytes": 14, "sha256": "0" * 64}
    write_json(made.run.manifest_json, manifest | {"files": manifest["files"] | {name: entry}})

    for _ in range(2):
        assert app.run(["report", "1"]) == 0
        assert app.run(["diff", "1", "1"]) == 0
        summary = collect_run(made.run, processes=lambda: [])

        assert summary.exit_code == 5
        assert f"{name}: missing; it was there when the run was collected" in summary.missing
    assert "defect" not in capsys.readouterr().err


@pytest.mark.parametrize("name", [b"agents/agent-01/\xe9tat.bin", b"agents/agent-01/\xe9.jsonl"])
def test_file_whose_name_is_no_text_is_named_and_costs_no_verdict(made, name):
    """As flight software leaves it that knows Latin-1 alone."""
    path = os.path.join(os.fsencode(made.run.path), name)
    shutil.copy(made.stream("agent-01", "ticks"), path)

    summary = collect_run(made.run, processes=lambda: [])

    (line,) = summary.missing
    assert summary.exit_code == 5
    assert line.startswith("agents/agent-01/\\xe9")
    assert "its name is no UTF-8; rename it" in line
    os.rename(path, made.run.path / "agents/agent-01/state.bin")
    assert collect_run(made.run, processes=lambda: []).exit_code == 0


def test_file_that_is_too_large_is_not_read(made, monkeypatch):
    monkeypatch.setattr(run_documents, "DOCUMENT_BYTES_MAX", 100)

    assert made.run.read_json(made.run.run_json) is None
    assert "expected at most 100 bytes" in (run_documents.fault_of(made.run.run_json) or "")


def test_links_and_pipes_among_records_are_no_streams_and_their_streams_are_missing(made):
    folder = made.run.path / "agents/agent-01"
    ticks, clock = folder / "ticks.jsonl", folder / "clock.jsonl"
    ticks.rename(made.run.path.parent / "elsewhere.jsonl")
    ticks.symlink_to(made.run.path.parent / "elsewhere.jsonl")
    clock.unlink()
    os.mkfifo(clock)
    (folder / "zero.jsonl").symlink_to("/dev/zero")

    assert {file.path for file in find_streams(made.run.path)}.isdisjoint({ticks, clock})
    summary = collect_run(made.run, processes=lambda: [])

    assert summary.exit_code == 5
    assert any("ticks is missing" in line and "agent-01" in line for line in summary.missing)


@pytest.mark.parametrize(
    "wrong",
    [
        {"name": 5},
        {"address": None},
        {"port": "22"},
        {"port": True},
        {"connection": "pigeon"},
        {"root": []},
    ],
)
def test_machine_of_a_plan_that_is_none_is_no_source(made, wrong):
    target = Target(name="pi01", address="192.0.2.1").to_mapping()
    plan = json.loads(made.run.plan_json.read_bytes())
    entry = {"agents": [], "target": target, "directory": "/x"}
    write_json(made.run.plan_json, plan | {"machines": {"pi01": entry}})
    assert len(RecordingMachines.read(made.run).remote) == 1

    entry["target"] = target | wrong
    write_json(made.run.plan_json, plan | {"machines": {"pi01": entry}})

    assert RecordingMachines.read(made.run).remote == ()
