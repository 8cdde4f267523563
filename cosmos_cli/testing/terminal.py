"""A suite on the terminal, in the form that people know from pytest."""

from __future__ import annotations

import shlex
from collections.abc import Sequence

from cosmos_cli.testing.case import SuiteCase
from cosmos_cli.testing.discovery import FoundScenarios
from cosmos_cli.testing.outcome import CaseOutcome
from cosmos_cli.testing.suite import SuiteResult
from cosmos_cli.ui.foreign_text import clean_line
from cosmos_cli.ui.plural import counted

WIDTH = 79
WORDS = {"passed": "PASSED", "failed": "FAILED", "interrupted": "INTERRUPTED"}


def printed_name(case: SuiteCase) -> str:
    """Return a test's name on one line: a file's may hold line ends, and words that would pass for a result."""
    return clean_line(case.name, length_max=None)


def case_line(outcome: CaseOutcome, *, number: int, total: int, width: int) -> str:
    """Return the line of one test: name, result, time, and how far the suite is."""
    share = f"[{100 * number // total:3d}%]"
    word = WORDS[outcome.outcome]
    return f"{printed_name(outcome.case):<{width}} {word:<11} {outcome.seconds:7.1f} s  {share}"


def failure_lines(outcomes: Sequence[CaseOutcome]) -> list[str]:
    """Return what is told of the tests that failed; nothing if none did."""
    failed = [each for each in outcomes if each.outcome == "failed"]
    if not failed:
        return []
    lines = [_ruled("FAILURES", "=")]
    for each in failed:
        lines += [_ruled(printed_name(each.case), "_"), *details(each), ""]
    return lines


def details(outcome: CaseOutcome) -> list[str]:
    """Return all that is told of one test that failed."""
    lines = list(outcome.reasons)
    lines += [f"  {line}" for line in outcome.broken]
    lines += [f"  {line}" for line in outcome.words.splitlines()]
    lines.append(f"repeat it: {outcome.case.repeat_command}")
    if outcome.directory:
        lines.append(f"its run: {outcome.directory}")
        lines.append(f"its figures: {shlex.join(['cosmos', 'report', outcome.directory])}")
    return lines


def summary_line(result: SuiteResult, *, deselected: int, seconds: float) -> str:
    """Return the last line: how many ended how, and the time of all together."""
    parts = [
        f"{result.count(word)} {word}"
        for word in ("failed", "interrupted", "passed")
        if result.count(word)
    ]
    parts += [f"{result.not_run} not run"] if result.not_run else []
    parts += [f"{deselected} deselected"] if deselected else []
    return _ruled(f"{', '.join(parts) or 'no tests ran'} in {seconds:.1f} s", "=")


def collected_line(tests: int, found: FoundScenarios, *, deselected: int) -> str:
    """Return the line before the tests: how many, and what folders hold beside their scenarios."""
    others, links = len(found.others), len(found.links)
    told = [f"collected {counted(tests + deselected, 'test')}"]
    told += [f"{deselected} deselected, {tests} selected"] if deselected else []
    told += [f"{counted(others, 'YAML file')} not of scenarios"] if others else []
    told += [f"{counted(links, 'link')} to folders not followed"] if links else []
    return f"{' / '.join(told)} ({counted(len(found.outlines), 'scenario')})"


def _ruled(text: str, mark: str) -> str:
    return f" {text} ".center(WIDTH, mark)
