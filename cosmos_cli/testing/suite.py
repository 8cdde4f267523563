"""
A suite: tests are started as the schedule says, looked after until they end, judged, and told one by one.

Stop signals go on to every run, once each: a run ends cleanly by itself. A second one ends all at once.
"""

from __future__ import annotations

import contextlib
import shutil
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final

from cosmos_cli.errors import ExitCode, InputError
from cosmos_cli.evidence.run_directory import RunDirectory
from cosmos_cli.models.baseline import Baseline
from cosmos_cli.system.stop_signals import stop_signals_noted
from cosmos_cli.testing.baseline_update import update_baseline
from cosmos_cli.testing.case import SuiteCase
from cosmos_cli.testing.figures import ComparedFigure, compare_figures
from cosmos_cli.testing.outcome import CaseOutcome, judge_case, with_figures
from cosmos_cli.testing.schedule import SuiteSchedule
from cosmos_cli.testing.suite_process import ProcessResult, SuiteProcess

FOLDER: Final = "tests"
"""Of the runs of tests, in the folder of all runs."""
POLL_S: Final = 0.05


@dataclass(frozen=True, slots=True, kw_only=True)
class SuiteOptions:
    """How a suite is run."""

    runs: Path
    """Folder of its runs."""
    jobs: int
    """Tests in lockstep beside each other."""
    keeps_all: bool = False
    """Whether evidence of tests that passed stays."""
    updates_baselines: bool = False


@dataclass(slots=True, kw_only=True)
class SuiteResult:
    """Outcome of a suite."""

    outcomes: list[CaseOutcome] = field(default_factory=list)
    not_run: int = 0
    """Tests that an interruption left out."""
    is_interrupted: bool = False
    written: dict[Path, int] = field(default_factory=dict)
    """Expected values that were written, by the baseline's file."""

    def count(self, word: str) -> int:
        """Return how many tests ended so."""
        return sum(each.outcome == word for each in self.outcomes)

    @property
    def exit_code(self) -> ExitCode:
        """130 if it was interrupted, 1 if a test failed, else 0."""
        if self.is_interrupted:
            return ExitCode.INTERRUPTED
        return ExitCode.RUN_FAILED if self.count("failed") else ExitCode.OK


def run_cases(
    cases: Sequence[SuiteCase], options: SuiteOptions, tell: Callable[[CaseOutcome], None]
) -> SuiteResult:
    """
    Run tests.

    Args:
        cases: The tests.
        options: How they are run.
        tell: Told of each test that has ended.
    """
    suite = _Suite(cases, options, tell)
    try:
        with stop_signals_noted() as stops:
            suite.run(stops)
    finally:
        suite.end_all()
    return suite.result


class _Suite:
    def __init__(
        self,
        cases: Sequence[SuiteCase],
        options: SuiteOptions,
        tell: Callable[[CaseOutcome], None],
    ) -> None:
        self.schedule = SuiteSchedule(cases, options.jobs)
        self.options = options
        self.tell = tell
        self.processes: list[tuple[SuiteCase, SuiteProcess]] = []
        self.result = SuiteResult()

    def run(self, stops: list[int]) -> None:
        """Run until all have ended, or those that began when a stop signal comes."""
        heard = 0
        while not self.schedule.is_done:
            now_s = time.monotonic()
            if len(stops) > heard:
                heard = len(stops)
                self.stop(now_s, at_once=heard > 1)
            while (case := self.schedule.begin()) is not None:
                self.start(case, now_s)
            for case, process in list(self.processes):
                found = process.poll(now_s)
                if found is not None:
                    self.end(case, process, found)
            time.sleep(POLL_S)

    def start(self, case: SuiteCase, now_s: float) -> None:
        """Start a test's run."""
        process = SuiteProcess(
            case.arguments(), self.options.runs, deadline_s=case.deadline_s, now_s=now_s
        )
        self.processes.append((case, process))

    def stop(self, now_s: float, *, at_once: bool) -> None:
        """Begin no more tests, and end those that run."""
        self.result.is_interrupted = True
        self.result.not_run += len(self.schedule.waiting)
        self.schedule.waiting.clear()
        for _, process in self.processes:
            if at_once:
                process.kill()
            else:
                process.stop(now_s)

    def end_all(self) -> None:
        """End what still runs, whatever happened."""
        for _, process in self.processes:
            process.kill()

    def end(self, case: SuiteCase, process: SuiteProcess, found: ProcessResult) -> None:
        """Judge a test that has ended, and clear up behind it."""
        self.processes.remove((case, process))
        self.schedule.end(case)
        outcome = judge_case(case, found, is_interrupted=self.result.is_interrupted)
        if case.baseline is not None and outcome.outcome != "interrupted":
            figures, why_not = self.figures(
                case.baseline, case, found, updates=outcome.outcome == "passed"
            )
            outcome = with_figures(outcome, figures, why_not_written=why_not)
        if outcome.outcome == "passed" and not self.options.keeps_all:
            if found.directory is not None:
                _forget(RunDirectory(found.directory))
            outcome = replace(outcome, directory="")
        self.result.outcomes.append(outcome)
        self.tell(outcome)

    def figures(
        self, baseline: Baseline, case: SuiteCase, found: ProcessResult, *, updates: bool
    ) -> tuple[list[ComparedFigure], str]:
        """Return the baseline's figures, written anew if that is wanted and *updates*; and why they cannot be."""
        if found.directory is None or found.exit_code != case.expect.exit_code:
            return [], ""
        compared = compare_figures(baseline, RunDirectory(found.directory), found.document)
        if not (updates and self.options.updates_baselines):
            return compared, ""
        if any(each.got is None for each in compared):
            return compared, "nothing is written while a figure has no value"
        try:
            self.result.written[baseline.path] = update_baseline(baseline, compared)
        except InputError as error:
            return compared, "; ".join(
                each.render().partition("\n")[0] for each in error.faults
            ) or str(error)
        return [replace(each, expected=each.got) for each in compared], ""


def _forget(run: RunDirectory) -> None:
    shutil.rmtree(run.path, ignore_errors=True)
    with contextlib.suppress(OSError):
        run.bundle.unlink()


def check_folder(runs: Path) -> None:
    """
    Make the folder of the suite's runs.

    Raises:
        InputError: It cannot be made.
    """
    try:
        runs.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        cure = "choose another folder with --runs or COSMOS_RUNS"
        raise InputError(f"{runs}: cannot be made: {error.strerror}; {cure}") from error
