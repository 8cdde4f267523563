"""What of a run's records is missing, judged from scans alone."""

import json
from pathlib import Path

import pytest
from harness.synthetic_run import SyntheticRun

from cosmos_cli.evidence.completeness import ExpectedRecords, find_missing
from cosmos_cli.evidence.streams import find_streams, scan_stream


def missing(made: SyntheticRun) -> list[str]:
    scans = [scan_stream(file) for file in find_streams(made.run.path)]
    return find_missing(made.expected, scans, made.result())


def renumber(folder: Path, life: int) -> None:
    for path in folder.glob("*.jsonl"):
        path.rename(path.with_name(f"{path.stem}.{life}.jsonl"))


@pytest.mark.parametrize(
    ("folder", "name"), [("agents/agent-01", "agent-01"), ("machines/loopback", "loopback")]
)
def test_life_that_left_nothing_is_missing_when_a_later_one_recorded(tmp_path, folder, name):
    made = SyntheticRun(tmp_path).write()
    # The machine lost power before its disk had the first life's files, and returned.
    renumber(made.run.path / folder, 2)

    (line,) = missing(made)
    assert line.startswith(f"{name}: no records of incarnation 1")


def test_machine_that_runs_no_agent_owes_no_records(tmp_path):
    made = SyntheticRun(tmp_path)
    plan = made.run.read_json(made.run.plan_json) or {}
    machines = {"pi01": {"agents": []}, "pi02": {"agents": ["agent-01"]}, "pi03": ["agent-02"]}
    made.run.plan_json.write_text(json.dumps({**plan, "machines": machines}))

    assert ExpectedRecords.read(made.run).machines == ("pi02", "pi03")
