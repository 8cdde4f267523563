"""Many runs, one after the other and at once."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from fault_harness import SCENARIO, Laboratory, check_evidence

pytestmark = pytest.mark.process

DRIVER = Path(__file__).with_name("start_and_stop.py")
WARM_UP = 2
"""The first runs of a process import what the next ones find."""
HANG_S = 500.0


@pytest.mark.timeout(600)
@pytest.mark.parametrize("times", [4, pytest.param(50, marks=pytest.mark.nightly)])
def test_runs_in_a_row_leave_nothing_but_their_evidence(laboratory: Laboratory, times: int):
    scenario = laboratory.folder / "brief.yaml"
    brief = {**SCENARIO, "agents": {"count": 2, "tick_hz": 20}}
    brief["time"] = {**SCENARIO["time"], "duration_s": 0.2}
    brief["timeouts"] = {**SCENARIO["timeouts"], "start_lead_s": 0.05}
    scenario.write_text(yaml.safe_dump(brief))
    done = subprocess.run(
        [sys.executable, str(DRIVER), str(times), str(scenario), "--no-report", "--quiet"],
        env=laboratory.environment,
        capture_output=True,
        text=True,
        timeout=HANG_S,
        check=False,
    )

    assert done.returncode == 0, done.stderr
    said = [json.loads(line) for line in done.stderr.splitlines() if line.startswith("{")]
    # A machine that stands still for the 0.2 s of a run costs all its ticks: 4 is then the right answer.
    assert {line.pop("code") for line in said} <= {0, 4}, done.stderr
    assert len(said) == times
    assert all(line == said[WARM_UP] for line in said[WARM_UP:]), done.stderr
    assert said[-1]["children"] == 0
    assert laboratory.living() == []
    assert laboratory.leftovers() == []
    runs = sorted(path for path in laboratory.runs.iterdir() if path.is_dir())
    assert [path.name for path in runs] == [f"{n:04d}-fault" for n in range(1, times + 1)]
    for path in (runs[0], runs[-1]):
        check_evidence(path, json.loads((path / "run.json").read_text()))


def test_runs_at_once_do_not_meet(laboratory: Laboratory):
    first, second = laboratory.start(), laboratory.start()

    codes = [run.finish() for run in (first, second)]
    assert codes == [0, 0], first.describe() + second.describe()
    names = sorted(path.name for path in laboratory.runs.iterdir() if path.is_dir())
    assert len({name.partition("-")[0] for name in names}) == len(names) == 2
    for name in names:
        path = laboratory.runs / name
        document = json.loads((path / "run.json").read_text())
        check_evidence(path, document)
        assert document["agents"]["lost"] == []
    assert laboratory.leftovers() == []
