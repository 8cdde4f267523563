"""What a suite prints, of files whose names are meant to pass for something else."""

import subprocess
from pathlib import Path

import pytest
from suite_cases import make_case

from cosmos_cli.testing.outcome import CaseOutcome
from cosmos_cli.testing.terminal import case_line, failure_lines

pytestmark = pytest.mark.process
NAMES = ("a\n=== 7 passed ===.yaml", "a\r\t\x1b[2J'\\.yaml", "a\u2028\x85b.yaml", "it's 7.yaml")


def outcome(name):
    case = make_case(path=Path(name), overrides=("name=a\nb",))
    return CaseOutcome(case=case, outcome="failed", seconds=1.0, exit_code=1, reasons=("broken",))


@pytest.mark.parametrize("name", NAMES)
def test_each_line_is_one(name):
    lines = [case_line(outcome(name), number=1, total=1, width=10), *failure_lines([outcome(name)])]

    assert all(len(line.splitlines()) <= 1 for line in lines)
    assert not any(line.startswith("=== 7") for line in lines)


@pytest.mark.parametrize("name", NAMES)
def test_command_that_repeats_a_test_means_its_file(name):
    repeat = outcome(name).case.repeat_command
    words = repeat.removeprefix("cosmos ")

    shell = ["bash", "-c", f"printf '%s\\0' {words}"]
    told = subprocess.run(
        shell, capture_output=True, check=True, env={"LC_ALL": "C.UTF-8"}, timeout=60
    )

    assert told.stdout.decode().split("\0")[:-1] == [
        "run", name, "--set", "name=a\nb", "--set", "seed=0"
    ]  # fmt: skip
