"""What the verdict hears of the operator's problems."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from cosmos_cli.launch.reporter import PROBLEMS_MAX, Reporter


@pytest.mark.parametrize(
    ("count", "told"),
    [
        (PROBLEMS_MAX, []),
        (PROBLEMS_MAX + 1, ["1 further problem was shown while the run lasted, and not kept"]),
        (PROBLEMS_MAX + 70, ["70 further problems were shown while the run lasted, and not kept"]),
    ],
)
def test_problems_that_are_too_many_to_keep_are_counted(count: int, told: list[str]) -> None:
    shown: list[str] = []
    reporter = Reporter(SimpleNamespace(say=lambda text, level: shown.append(text)))
    for number in range(count):
        reporter.problem(f"machine m{number} is lost", f"m{number}")

    problems = reporter.problems({"status": "aborted"})

    assert len(shown) == count
    assert [each.text for each in problems[PROBLEMS_MAX:]] == told
    assert [each.machine for each in problems[PROBLEMS_MAX:]] == [None] * len(told)
