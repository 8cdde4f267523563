"""Records on a machine while another operator collects or wipes there: what goes meanwhile is no failure."""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from typing import Any

import pytest

from cosmos_cli.onboard import deletion, records
from cosmos_cli.onboard.request_loop import HelperRefusal, VerbRequest


@pytest.fixture
def runs(tmp_path: Path) -> Path:
    for name in ("0001-a", "0002-b"):
        for agent in ("agent-01", "agent-02"):
            folder = tmp_path / "runs" / name / "agents" / agent
            folder.mkdir(parents=True)
            (folder / "ticks.jsonl").write_text("1234\n")
    return tmp_path / "runs"


def found_in(runs: Path) -> list[tuple[Any, Any]]:
    request = VerbRequest(arguments={"runs": str(runs), "state": str(runs.parent / "state")})
    return [(entry["name"], entry["bytes"]) for entry in records.inventory_runs(request)]


def discard(directory: Path, **shown: int) -> None:
    arguments = {"directory": str(directory), "state": str(directory.parents[1] / "state")}
    deletion.discard(VerbRequest(arguments={**arguments, "shown": shown}))


@pytest.mark.parametrize(
    ("goes", "found"),
    [
        ("0001-a", [("0002-b", 10)]),
        ("0001-a/agents/agent-01", [("0001-a", 5), ("0002-b", 10)]),
        ("0001-a/agents/agent-02", [("0001-a", 5), ("0002-b", 10)]),
    ],
)
def test_what_goes_while_runs_are_looked_at_is_passed_over(runs, monkeypatch, goes, found):
    look = os.lstat

    def look_late(path, **how):
        if str(path).endswith("0001-a/agents/agent-01/ticks.jsonl"):
            shutil.rmtree(runs / goes, ignore_errors=True)
        return look(path, **how)

    monkeypatch.setattr(os, "lstat", look_late)

    assert found_in(runs) == found


def test_run_of_which_others_delete_as_well_is_deleted(runs, monkeypatch):
    unlink = os.unlink

    def unlink_second(path, *, dir_fd=None):
        unlink(path, dir_fd=dir_fd)
        unlink(path, dir_fd=dir_fd)  # somebody else was first

    monkeypatch.setattr(os, "unlink", unlink_second)
    records.remove(str(runs / "0001-a"))

    assert os.listdir(runs) == ["0002-b"]


def test_run_that_is_gone_is_deleted(runs):
    shutil.rmtree(runs / "0001-a")

    records.remove(str(runs / "0001-a"))

    assert os.listdir(runs) == ["0002-b"]


def test_what_was_released_goes_though_it_is_less_than_was_shown(runs):
    left = runs / ".released-0001-a-7"
    (runs / "0001-a").rename(left)

    discard(left, bytes=10, files=2, newest_s=0)

    assert os.listdir(runs) == ["0002-b"]


def test_run_that_has_changed_since_it_was_shown_stays(runs):
    with pytest.raises(HelperRefusal, match="has changed since it was listed"):
        discard(runs / "0001-a", bytes=9, files=2, newest_s=0)

    assert sorted(os.listdir(runs)) == ["0001-a", "0002-b"]
