"""What an earlier state of COSMoS recorded is read for good: tests/recorded_runs, see the README there."""

import json
import tarfile
from pathlib import Path

import pytest
import zstandard

from cosmos_cli import app
from cosmos_cli.diff.side import open_side
from cosmos_cli.evidence.run_directory import RunDirectory
from cosmos_cli.evidence.table_labels import run_labels

ARCHIVES = sorted((Path(__file__).parents[2] / "recorded_runs").glob("*.tar.zst"))
REALTIME, LOCKSTEP, BOARDS = "0001-kept-realtime", "0002-kept-lockstep", "0003-kept-boards"
EXTRACTED_BYTES_MAX = 16 * 1024 * 1024

SAFELY = {"filter": "data"} if hasattr(tarfile, "data_filter") else {}
"""Python 3.11.2 of Debian 12 has no filters yet; the archives are our own."""


@pytest.fixture(params=ARCHIVES, ids=lambda path: path.name)
def runs(request, own_places, tmp_path):
    """A copy of the runs in an archive."""
    with (
        request.param.open("rb") as packed,
        zstandard.ZstdDecompressor(max_window_size=EXTRACTED_BYTES_MAX * 8).stream_reader(
            packed
        ) as data,
        tarfile.open(fileobj=data, mode="r|") as archive,
    ):
        archive.extractall(tmp_path, **SAFELY)
    return tmp_path / "runs"


def test_there_are_recorded_runs():
    assert ARCHIVES


def json_of(capsys, *arguments):
    code = app.run([*arguments, "--json", "--quiet"])
    return code, json.loads(capsys.readouterr().out)


def holds(before, after):
    """Tell whether all that was told then is told now; there may be more beside."""
    if isinstance(before, dict):
        return all(key in after and holds(before[key], after[key]) for key in before)
    return before == after


def test_runs_lists_them_as_they_ended(runs, capsys):
    code, listed = json_of(capsys, "runs")

    assert code == 0
    assert [(e["run"], e["status"], e["exit_code"], e["agents"]) for e in listed] == [
        (name, "complete", 0, 4) for name in (REALTIME, LOCKSTEP, BOARDS)
    ]


@pytest.mark.parametrize("name", [REALTIME, LOCKSTEP, BOARDS])
def test_report_shows_them(runs, capsys, name):
    page = runs.parent / "page.html"

    code, told = json_of(capsys, "report", name, "--html", str(page))

    assert code == 0
    assert told["run"] == name
    assert "PASSED" in page.read_text(encoding="utf-8")


@pytest.mark.parametrize("name", [REALTIME, LOCKSTEP, BOARDS])
def test_collect_finds_all_that_was_recorded_and_judges_as_then(runs, capsys, name):
    before = json.loads((runs / name / "run.json").read_bytes())

    code, after = json_of(capsys, "collect", name)

    assert code == 0
    assert after["exit_code"] == before["exit_code"] == 0
    for key in ("status", "agents", "started_utc", "duration_s", "seed", "timing", "messages"):
        assert holds(before[key], after[key]), key
    for key in ("written", "dropped", "truncated", "damaged", "bytes"):
        assert after["records"][key] == before["records"][key], key
    assert after["records_sha256"] == before["records_sha256"]
    assert after["data"] == {"complete": True, "missing": []}
    checks = {check["name"]: check for check in after["checks"]}
    for check in before["checks"]:
        assert holds(check, checks[check["name"]])


def test_run_that_recorded_no_truth_says_how_it_is_recorded(runs, capsys):
    assert app.run(["tabulate", "0001-kept-realtime"]) == 2

    err = " ".join(capsys.readouterr().err.split())
    assert "truth.jsonl: this run recorded no truth" in err
    assert "--set parameters.record.truth=true" in err


def test_diff_compares_them(runs, capsys):
    code, found = json_of(capsys, "diff", REALTIME, LOCKSTEP)

    assert code == 0
    text = json.dumps(found)
    assert "maneuvers" in text
    assert "state" in text


def test_settings_of_old_runs_are_compared_by_the_names_of_today(runs):
    settings = open_side(RunDirectory(runs / LOCKSTEP), LOCKSTEP).settings

    assert "tolerance_ms" in (runs / LOCKSTEP / "plan.json").read_text()
    assert set(settings["deadline"]) == {"overrun_ms", "lateness_ms", "max_miss_ratio"}


@pytest.mark.slow
def test_second_names_of_old_runs_are_those_of_their_satellites(runs, capsys):
    labels = run_labels(RunDirectory(runs / LOCKSTEP))
    label = labels.names["agent-02"]

    assert (labels.column, len(labels.names)) == ("satellite", 4)
    assert label != "agent-02"
    _, by_name = json_of(capsys, "diff", REALTIME, LOCKSTEP, "--agents", "agent-02")
    _, by_label = json_of(capsys, "diff", REALTIME, LOCKSTEP, "--agents", label)
    _, of_all = json_of(capsys, "diff", REALTIME, LOCKSTEP)
    assert by_label["streams"] == by_name["streams"] != of_all["streams"]
    assert app.run(["logs", LOCKSTEP, label]) == 0
    assert not run_labels(RunDirectory(runs / BOARDS)).names


def test_diff_finds_a_run_the_same_as_itself(runs, capsys):
    assert app.run(["diff", LOCKSTEP, LOCKSTEP, "--expect-same", "--quiet"]) == 0
