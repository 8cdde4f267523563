"""The judgement of one test: what its run came to beside what was expected. Pure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from typing import Any, Literal

from cosmos_cli.errors import ExitCode
from cosmos_cli.models.scenario_test import ExpectedOutcome
from cosmos_cli.system.bounded_process import describe_exit
from cosmos_cli.testing.case import SuiteCase
from cosmos_cli.testing.check_lines import broken_checks, check_line
from cosmos_cli.testing.figures import ComparedFigure
from cosmos_cli.testing.suite_process import ProcessResult

ResultWord = Literal["passed", "failed", "interrupted"]
WORDS_LINES_MAX = 12


@dataclass(frozen=True, slots=True, kw_only=True)
class CaseOutcome:
    """A test that has ended."""

    case: SuiteCase
    outcome: ResultWord
    seconds: float
    reasons: tuple[str, ...] = ()
    """Reasons for which it did not pass, the first the shortest."""
    exit_code: int | None = None
    verdict: str = ""
    broken: tuple[str, ...] = ()
    """One line per broken check."""
    words: str = ""
    """Last words of the run, where it came to no verdict."""
    directory: str = ""
    """Kept evidence; empty where none is kept."""
    figures: tuple[ComparedFigure, ...] = ()
    """Those of the baseline."""

    def to_mapping(self) -> dict[str, Any]:
        """Return plain values for --json."""
        return {
            "name": self.case.name,
            "scenario": str(self.case.path),
            "seed": self.case.seed,
            "outcome": self.outcome,
            "seconds": round(self.seconds, 3),
            "exit_code": self.exit_code,
            "verdict": self.verdict or None,
            "reasons": list(self.reasons),
            "broken": list(self.broken),
            "figures": [figure.to_mapping() for figure in self.figures],
            "run": self.directory or None,
            "repeat": self.case.repeat_command,
        }


def judge_case(
    case: SuiteCase,
    result: ProcessResult,
    *,
    is_interrupted: bool,
) -> CaseOutcome:
    """
    Judge a test, but for its baseline.

    Args:
        case: The test.
        result: End of its run.
        is_interrupted: Whether somebody stopped the suite, and the run did not come to its end before.
    """
    reasons = _reasons(case, result)
    outcome: ResultWord = "failed" if reasons else "passed"
    # Of one that is too long its deadline was before.
    if is_interrupted and _is_cut(result) and not result.is_too_long:
        outcome, reasons = "interrupted", []
    verdict = str(result.document.get("verdict") or "")
    return CaseOutcome(
        case=case,
        outcome=outcome,
        seconds=result.seconds,
        reasons=tuple(reasons),
        exit_code=result.exit_code,
        verdict=verdict,
        broken=tuple(map(check_line, broken_checks(result.document))),
        words="" if verdict else "\n".join(result.words.splitlines()[-WORDS_LINES_MAX:]),
        directory=str(result.directory or ""),
    )


def _is_cut(result: ProcessResult) -> bool:
    """Tell whether a signal ended a run: as Python began, it says so itself, and ends as any program that crashed."""
    is_early = not result.document and result.words.endswith(KeyboardInterrupt.__name__)
    return result.exit_code == ExitCode.INTERRUPTED or result.exit_code < 0 or is_early


def with_figures(
    outcome: CaseOutcome, figures: Sequence[ComparedFigure], *, why_not_written: str = ""
) -> CaseOutcome:
    """
    Return a judged test, judged by its baseline as well.

    Args:
        outcome: The test.
        figures: The baseline's, with what came.
        why_not_written: Why the baseline could not be written, which was to be; empty if it was, or was not to be.
    """
    # That one is to be written is no news where it could not be.
    is_new = bool(why_not_written)
    failed = [each for each in figures if not each.passed]
    told = [e.reason() for e in failed if not (is_new and e.expected is None and e.got is not None)]
    reasons = [f"baseline: {text}" for text in (*told, why_not_written) if text]
    return replace(
        outcome,
        figures=tuple(figures),
        outcome="failed" if reasons else outcome.outcome,
        reasons=(*outcome.reasons, *reasons),
    )


def _reasons(case: SuiteCase, result: ProcessResult) -> list[str]:
    if result.is_too_long:
        return [f"not done after {case.deadline_s:g} s (its deadline), and ended"]
    reasons = []
    code, expected = result.exit_code, case.expect.exit_code
    verdict = str(result.document.get("verdict") or "")
    told = verdict or f"the run {describe_exit(code)} without a verdict"
    if code != expected or not verdict:
        reasons.append(f"expected exit code {expected}, got {code}: {told}" if expected else told)
    return reasons + _unexpected(case.expect, result.document, verdict)


def _unexpected(expect: ExpectedOutcome, document: Mapping[str, Any], verdict: str) -> list[str]:
    reasons = []
    if expect.verdict and expect.verdict not in verdict:
        reasons.append(f"expected a verdict with {expect.verdict!r}, got {verdict or 'none'!r}")
    if expect.broken is None:
        return reasons
    names = [str(check.get("name")) for check in broken_checks(document)]
    reasons += [
        f"expected {pattern} to be broken: it held, or was not judged"
        for pattern in expect.broken
        if not any(fnmatchcase(name, pattern) for name in names)
    ]
    reasons += [
        f"{name} is broken, which is not among test.expect.broken"
        for name in names
        if not any(fnmatchcase(name, pattern) for pattern in expect.broken)
    ]
    return reasons
