"""How many agents fit: trials of one scenario, each judged by its verdict, from few agents to too many."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from cosmos_cli.bench.child_run import ChildRunOutcome, run_child
from cosmos_cli.bench.search import CapacitySearch
from cosmos_cli.errors import ExitCode, InputError
from cosmos_cli.system.bounded_process import path_word
from cosmos_cli.ui.console import Column
from cosmos_cli.ui.plural import counted
from madns_runtime.config import AGENTS_MAX
from madns_runtime.plain_values import mapping_at

FIRST_DEFAULT: Final = 8
NUMBERS_MAX: Final = 32
"""More than any search takes: 13 doublings to AGENTS_MAX, and as many halvings."""
RUN_LIMIT_S: Final = 600.0
"""For one trial beyond its simulated time: start, end, records and verdict of thousands of agents."""
SCENARIO: Final = Path(__file__).parent / "data" / "capacity.yaml"
"""The scenario that is tried unless another is named."""
COLUMNS = (
    Column("agents", is_number=True),
    Column("budget"),
    Column("ticks", is_number=True),
    Column("missed", is_number=True),
    Column("ratio", is_number=True),
    Column("late p50 ms", is_number=True),
    Column("late p99 ms", is_number=True),
    Column("trip p99 ms", is_number=True),
    Column("run"),
    Column("why"),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class CapacityTrials:
    """Settings of all trials."""

    hz: float
    max_miss_ratio: float
    seconds: float
    per_process: int
    first: int = FIRST_DEFAULT
    largest: int = AGENTS_MAX
    resolution: float = 0.05
    tries: int = 1
    """A number of agents breaks the budget when so many runs in a row do."""
    end_s: float = float("inf")
    """No trial begins after this time of the monotonic clock."""
    is_machines_fault: bool = False
    """Whether lost machines end the search: the agents are on machines, whose failures are no question of numbers."""

    def overrides(self, agents: int) -> list[str]:
        """Return the settings of a trial, KEY=VALUE: a step may use its whole period, the budget is of missed ticks alone."""
        return [
            f"agents.count={agents}",
            f"agents.tick_hz={self.hz!r}",
            f"agents.per_process={min(self.per_process, agents)}",
            f"time.duration_s={self.seconds!r}",
            f"deadline.overrun_ms={1e3 / self.hz!r}",
            f"deadline.max_miss_ratio={self.max_miss_ratio!r}",
        ]


@dataclass(frozen=True, slots=True, kw_only=True)
class CapacityTrial:
    """One run and what came of it."""

    agents: int
    holds: bool
    outcome: ChildRunOutcome

    @property
    def why(self) -> str:
        """The verdict in a few words; empty where the budget was kept."""
        if self.holds:
            return ""
        text = self.outcome.document.get("verdict") or self.outcome.last_words
        return str(text or f"exit code {self.outcome.exit_code}")

    def row(self) -> tuple[str, ...]:
        """Return the row of the table."""
        timing = mapping_at(self.outcome.document, "timing")
        late, trip = (
            mapping_at(timing, "lateness_ms"),
            mapping_at(self.outcome.document, "round_trip_ms"),
        )
        return (
            str(self.agents),
            "kept" if self.holds else "broken",
            *(_shown(timing.get(name), form) for name, form in _COUNTS),
            *(
                _shown(value, ".3g")
                for value in (late.get("p50"), late.get("p99"), trip.get("p99"))
            ),
            self.outcome.run,
            self.why,
        )

    def to_mapping(self) -> dict[str, Any]:
        """Return plain values for --json."""
        document = self.outcome.document
        return {
            "agents": self.agents,
            "holds": self.holds,
            "exit_code": self.outcome.exit_code,
            "run": self.outcome.run or None,
            "why": self.why or None,
            "timing": dict(mapping_at(document, "timing")),
            "round_trip_ms": dict(mapping_at(document, "round_trip_ms")),
        }


_COUNTS = (("ticks", "d"), ("missed", "d"), ("miss_ratio", ".2g"))


def _shown(value: object, form: str) -> str:
    return format(value, form) if isinstance(value, int | float) else ""


@dataclass(slots=True, kw_only=True)
class CapacityFound:
    """A search, finished or not."""

    search: CapacitySearch
    trials: list[CapacityTrial] = field(default_factory=list)
    stopped_by: str = ""
    """The reason why it ended before its time; empty if it did not."""
    exit_code: ExitCode = ExitCode.OK

    @property
    def words(self) -> str:
        """The result in words: as much of it as is known."""
        search = self.search
        if search.held == 0:
            if search.broken is None:
                return "nothing is known yet"
            verb = "breaks" if search.broken == 1 else "break"
            return f"{counted(search.broken, 'agent')} {verb} it, and no smaller number kept it"
        if search.broken is None:
            return f"at least {search.held} agents keep it"
        return f"{search.held} agents keep it, {search.broken} do not"


def find_capacity(
    trials: CapacityTrials,
    scenario: Path,
    options: Sequence[str],
    say: Callable[[str], None],
    run: Callable[..., ChildRunOutcome] = run_child,
) -> CapacityFound:
    """
    Search by runs, one after the other.

    Args:
        trials: Their settings.
        scenario: Their file; its number of agents, rate, length and budget do not count.
        options: Further arguments of `cosmos run`: inventory, folder of runs, settings.
        say: Told of each trial, before and after.
        run: As `run_child`.

    Raises:
        InputError: An option does not fit, or the scenario refuses the first trial.
    """
    search = CapacitySearch(
        first=trials.first, largest=trials.largest, resolution=trials.resolution
    )
    found = CapacityFound(search=search)
    failures = 0
    for _ in range(NUMBERS_MAX * trials.tries):
        agents = search.following()
        if agents is None:
            break
        if time.monotonic() >= trials.end_s:
            found.stopped_by = "the time is over"
            break
        say(
            f"trial {len(found.trials) + 1}: {counted(agents, 'agent')} at {trials.hz:g} Hz for {trials.seconds:g} s"
        )
        settings = [word for each in trials.overrides(agents) for word in ("--set", each)]
        try:
            outcome = run(
                [path_word(scenario), "--no-report", *options, *settings],
                limit_s=trials.seconds + RUN_LIMIT_S,
                is_quiet=True,
            )
        except InputError as error:  # it takes no such number: what is known by now stays
            if not found.trials:
                raise
            found.stopped_by = f"with {counted(agents, 'agent')} {error}"
            break
        if not _take_end(found, outcome, trials):
            break
        trial = CapacityTrial(
            agents=agents, holds=outcome.exit_code == ExitCode.OK, outcome=outcome
        )
        found.trials.append(trial)
        say(f"  budget {'kept' if trial.holds else f'broken: {trial.why}'}")
        failures = 0 if trial.holds else failures + 1
        if trial.holds or failures >= trials.tries:
            search.tell(agents, holds=trial.holds)
            failures = 0
    if not found.exit_code and search.held == 0:
        found.exit_code = ExitCode.BUDGET_BROKEN
    return found


def _take_end(found: CapacityFound, outcome: ChildRunOutcome, trials: CapacityTrials) -> bool:
    """Return whether the search goes on after a run."""
    if outcome.is_last:
        found.stopped_by, found.exit_code = "interrupted", ExitCode.INTERRUPTED
    elif outcome.exit_code == ExitCode.MACHINES and trials.is_machines_fault:
        words = outcome.document.get("verdict") or outcome.last_words or "machines failed"
        found.stopped_by, found.exit_code = str(words), ExitCode.MACHINES
    return not found.stopped_by
