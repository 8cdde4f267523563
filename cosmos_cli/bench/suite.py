"""Scenarios run one after the other, and the tables that the thesis makes of them: round trips by who saw them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from cosmos_cli.bench.child_run import ChildRunOutcome, run_child
from cosmos_cli.errors import ExitCode, InputError
from cosmos_cli.evidence.run_directory import RunDirectory
from cosmos_cli.models.loading import ScenarioFile
from cosmos_cli.report.build import with_simulation
from cosmos_cli.system.bounded_process import path_word
from cosmos_cli.ui.console import Column, Console
from madns_runtime.plain_values import mapping_at

SUITE_FILES: Final = "benchmark_*.yaml"
"""Scenarios of a folder that is named instead of its files."""
COLLECT_SHARE: Final = 1.0
"""Share of a run's simulated time that reading and packing its records may take, beyond all waits of its own."""
ALL: Final = "all"
FIGURES = ("mean", "sd", "min", "max", "range", "p50", "p99", "p999")
ROUND_TRIPS = (
    Column("seen by"),
    Column("agent"),
    Column("trips", is_number=True),
    *(Column(f"{name} ms", is_number=True) for name in (*FIGURES[:-1], "p99.9")),
    Column("sent", is_number=True),
    Column("lost", is_number=True),
    Column("ticks", is_number=True),
    Column("missed", is_number=True),
)
SUMMARY = (
    Column("run"),
    Column("agents", is_number=True),
    Column("Hz", is_number=True),
    Column("s", is_number=True),
    Column("seen by"),
    *(
        Column(f"{name} ms", is_number=True)
        for name in ("mean", "sd", "min", "max", "p99", "p99.9")
    ),
    Column("lost", is_number=True),
    Column("ticks", is_number=True),
    Column("missed", is_number=True),
    Column("verdict"),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class SuiteRun:
    """One run of a suite."""

    scenario: ScenarioFile
    outcome: ChildRunOutcome
    document: Mapping[str, Any] = field(default_factory=dict)
    """run.json, with what the simulation tells of the run."""

    @property
    def round_trips(self) -> list[Mapping[str, Any]]:
        """Statistics of round trips, ms, by who saw them and agent; empty where the simulation tells none."""
        found = mapping_at(self.document, "benchmark").get("round_trips_ms")
        return (
            [each for each in found if isinstance(each, Mapping)] if isinstance(found, list) else []
        )

    @property
    def counts(self) -> Mapping[str, Any]:
        """Packets and ticks, by agent."""
        return mapping_at(self.document, "benchmark", "agents")

    def rows(self) -> list[tuple[str, ...]]:
        """Return the rows of the run's own table: one per agent and one for all, as agents and as the host saw it."""
        total = {name: self._total(name) for name in COUNTS}
        return [
            (
                str(trips.get("seen_by")),
                str(trips.get("agent")),
                _shown(trips.get("count")),
                *(_shown(trips.get(name)) for name in FIGURES),
                *self._count_cells(trips, total),
            )
            for trips in self.round_trips
        ]

    def summary_rows(self) -> list[tuple[str, ...]]:
        """Return the rows of the table of all runs: one as agents saw it, one as the host did."""
        agents = self.scenario.scenario.agents
        head = (
            self.outcome.run,
            str(agents.count),
            f"{agents.tick_hz:g}",
            f"{self.scenario.scenario.time.duration_s:g}",
        )
        timing = mapping_at(self.document, "timing")
        tail = (
            _shown(self._total("lost")),
            _shown(_done(timing.get("ticks"), timing.get("missed"))),
            _shown(timing.get("missed")),
            str(self.document.get("status") or f"exit code {self.outcome.exit_code}"),
        )
        names = ("mean", "sd", "min", "max", "p99", "p999")
        found = [
            (*head, str(trips.get("seen_by")), *(_shown(trips.get(name)) for name in names), *tail)
            for trips in self.round_trips
            if trips.get("agent") == ALL
        ]
        return found or [(*head, "", *[""] * len(names), *tail)]

    def to_mapping(self) -> dict[str, Any]:
        """Return plain values for --json."""
        return {
            "scenario": str(self.scenario.path),
            "run": self.outcome.run or None,
            "exit_code": self.outcome.exit_code,
            "verdict": self.document.get("verdict"),
            "rtf": self.document.get("rtf"),
            "timing": dict(mapping_at(self.document, "timing")),
            "round_trips_ms": [dict(each) for each in self.round_trips],
            "agents": dict(self.counts),
        }

    def _count_cells(self, trips: Mapping[str, Any], total: Mapping[str, int | None]) -> list[str]:
        """Return packets and ticks of an agent, beside the agents' own view alone: the host's row has the same ones."""
        if trips.get("seen_by") != "agent":
            return [""] * len(COUNTS)
        agent = str(trips.get("agent"))
        counts = total if agent == ALL else mapping_at(self.counts, agent)
        return [_shown(counts.get(name)) for name in COUNTS]

    def _total(self, name: str) -> int | None:
        """Return the sum over the agents; None where none tells, as of ticks in lockstep, which records none."""
        values = [mapping_at(self.counts, agent).get(name) for agent in self.counts]
        known = [value for value in values if isinstance(value, int)]
        return sum(known) if known else None


COUNTS = ("sent", "lost", "ticks", "missed")


def _done(due: object, missed: object) -> object:
    """Return the ticks that were done, as the table of a run has them; run.json tells all that were due."""
    return due - missed if isinstance(due, int) and isinstance(missed, int) else due


def _shown(value: object) -> str:
    if isinstance(value, int):
        return str(value)
    return f"{value:.3f}" if isinstance(value, float) else ""


def suite_files(given: Sequence[Path]) -> list[Path]:
    """
    Return the files that are meant, of a folder those of a suite.

    Raises:
        InputError: A folder has none.
    """
    found: list[Path] = []
    for path in given:
        if not path.is_dir():
            found.append(path)
            continue
        files = sorted(path.glob(SUITE_FILES))
        if not files:
            raise InputError(f"{path}: expected {SUITE_FILES} there, found none; name files")
        found += files
    return found


def run_suite(
    scenarios: Sequence[ScenarioFile],
    options: Sequence[str],
    runs: Path,
    console: Console,
) -> list[SuiteRun]:
    """
    Run scenarios one after the other, those of the shortest time first, and print each one's table.

    Args:
        scenarios: Checked files, with their settings.
        options: Further arguments of `cosmos run`: inventory, settings.
        runs: Folder of all runs.
        console: Where tables and talk go.

    Returns:
        The runs that were made; an interrupted one is the last.

    Raises:
        InputError: The first one refused its input. A later one counts as ended by it: those before have made their figures.
    """
    done: list[SuiteRun] = []
    ordered = sorted(scenarios, key=lambda each: each.scenario.time.duration_s)
    for number, scenario in enumerate(ordered, start=1):
        duration_s = scenario.scenario.time.duration_s
        console.say(f"{number} of {len(ordered)}: {scenario.path}, {duration_s:g} s")
        longest_s = scenario.run_config("bench").longest_s
        try:
            outcome = run_child(
                [path_word(scenario.path), "--runs", str(runs), *options],
                limit_s=longest_s + 600.0 + COLLECT_SHARE * duration_s,
                is_quiet=console.quiet,
            )
        except InputError as error:
            if not done:
                raise
            outcome = ChildRunOutcome(exit_code=ExitCode.BAD_INPUT, last_words=str(error))
        document = _with_benchmark(outcome, runs, console)
        done.append(SuiteRun(scenario=scenario, outcome=outcome, document=document))
        if done[-1].round_trips:
            console.table(ROUND_TRIPS, done[-1].rows())
        elif outcome.last_words:
            console.say(outcome.last_words)
        console.data(f"{outcome.run or scenario.path}: {document.get('verdict') or 'no verdict'}")
        console.data("")
        if outcome.is_last:
            break
    return done


def _with_benchmark(outcome: ChildRunOutcome, runs: Path, console: Console) -> Mapping[str, Any]:
    if not outcome.run:
        return outcome.document
    return with_simulation(RunDirectory(runs / outcome.run), outcome.document, console.warn)


def suite_exit_code(done: Sequence[SuiteRun]) -> int:
    """Return that of the interruption, else of the first run that did not end well."""
    if any(each.outcome.is_last for each in done):
        return int(ExitCode.INTERRUPTED)
    codes = [-1 if each.outcome.is_too_long else each.outcome.exit_code for each in done]
    bad = [code if code > 0 else int(ExitCode.RUN_FAILED) for code in codes if code]
    return bad[0] if bad else int(ExitCode.OK)
