"""Standard output that takes nothing: full, closed, or whose reader has gone."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from harness.synthetic_run import SyntheticRun

COSMOS = f"{sys.executable} -m cosmos_cli.app"


def shell(command: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        ["bash", "-c", command], capture_output=True, text=True, timeout=120, check=False
    )


@pytest.fixture
def run_path(tmp_path: Path) -> Path:
    made = SyntheticRun(tmp_path).write()
    made.run.left_result_json.write_text('{"status": "complete"')
    return made.run.path


@pytest.mark.process
@pytest.mark.parametrize("json", ["", "--json"])
@pytest.mark.parametrize(
    ("redirection", "why"),
    [(">/dev/full", "No space left on device"), (">&-", "it is closed")],
)
def test_verdicts_exit_code_survives_an_output_that_takes_nothing(
    run_path: Path, redirection: str, why: str, json: str
) -> None:
    ended = shell(f"{COSMOS} collect {run_path} -q {json} {redirection}")

    assert ended.returncode == 5
    lines = ended.stderr.splitlines()
    assert [line for line in lines if line.startswith("error: ")] == [
        f"error: stdout: {why}; FAILED: host: it ended without a result; was it killed?; "
        f"it stands in {run_path / 'run.json'}"
    ]
    assert "defect" not in ended.stderr


@pytest.mark.process
def test_verdicts_exit_code_survives_a_reader_that_has_gone(run_path: Path) -> None:
    ended = shell(f"{COSMOS} collect {run_path} -q --json | true; exit ${{PIPESTATUS[0]}}")

    assert ended.returncode == 5
    assert "defect" not in ended.stderr
    assert "Exception ignored" not in ended.stderr


@pytest.mark.process
@pytest.mark.parametrize("redirection", [">/dev/full", ">&-"])
def test_other_commands_end_with_1_and_one_line(redirection: str) -> None:
    ended = shell(f"{COSMOS} schema {redirection}")

    assert ended.returncode == 1
    assert ended.stderr.count("\n") == 1
    assert ended.stderr.startswith("error: stdout: ")


@pytest.mark.process
def test_commands_work_without_any_standard_stream(tmp_path: Path) -> None:
    (tmp_path / "a.yaml").write_text("name: a\nsimulation: counter\nagents: {count: 3}\nsed: 1\n")

    assert shell(f"{COSMOS} validate {tmp_path / 'a.yaml'} <&- >&- 2>&-").returncode == 2
