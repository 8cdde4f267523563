"""One test of a suite: a scenario with the settings and the seed that it is run with, and its deadline."""

from __future__ import annotations

import os
import shlex
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from cosmos_cli.errors import Fault, InputError
from cosmos_cli.models.baseline import Baseline
from cosmos_cli.models.loading import ScenarioFile
from cosmos_cli.models.scenario_outline import ScenarioOutline, with_seed
from cosmos_cli.models.scenario_test import ExpectedOutcome, override_of
from cosmos_cli.system.bounded_process import path_word
from cosmos_cli.ui.foreign_text import clean_line
from madns_runtime.bounded_files import real_path

MACHINES: Final = ("COSMOS_INVENTORY", "COSMOS_LIMIT")
"""Variables that would have it run on machines: a test runs on this computer."""
END_S: Final = 60.0
"""Beyond the waits of the run itself: start of the program, tables, package and verdict."""
END_SHARE: Final = 0.5
"""As much of the simulated time comes to it: what is recorded for longer takes longer to read."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CaseSettings:
    """Changes that the command line makes in every test."""

    overrides: tuple[str, ...] = ()
    """KEY=VALUE of --set."""
    is_shortened: bool = True
    """Whether `test.set` counts."""
    realtime_s_max: float | None = None
    """Longest simulated time of a scenario in real time, s."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SuiteCase:
    """A checked test."""

    path: Path
    scenario_name: str
    overrides: tuple[str, ...]
    """Settings of the run, its seed among them if it was given."""
    seed: int
    has_given_seed: bool
    """Whether --seeds gave it."""
    is_lockstep: bool
    work: float
    """Ticks of all agents: those that take longer start first."""
    deadline_s: float
    expect: ExpectedOutcome
    baseline: Baseline | None

    @property
    def name(self) -> str:
        """The test as it is printed: its file, and its seed if that was given."""
        return f"{self.path}[seed={self.seed}]" if self.has_given_seed else str(self.path)

    @property
    def key(self) -> tuple[str, int | None]:
        """The test as it is remembered: absolute path of its file, and its seed if that was given."""
        return str(real_path(self.path)), self.seed if self.has_given_seed else None

    def arguments(self) -> list[str]:
        """Return the words behind `cosmos run`, with the seed even if it is the scenario's own."""
        settings = with_seed(self.overrides, self.seed)
        return [path_word(self.path), *(word for item in settings for word in ("--set", item))]

    @property
    def repeat_command(self) -> str:
        """The command that repeats the run, on one line; on this computer, whatever inventory the environment names."""
        named = [word for name in MACHINES if name in os.environ for word in ("-u", name)]
        before = ["env", *named] if named else []
        return " ".join(map(_shell_word, [*before, "cosmos", "run", *self.arguments()]))


def _shell_word(word: str) -> str:
    """Return a word as a shell takes it; with control characters as escapes, which bash and zsh know in quotes."""
    if clean_line(word, length_max=None) == word:
        return shlex.quote(word)
    shown = [each if clean_line(each) == each else f"\\U{ord(each):08x}" for each in word]
    return "$'" + "".join(f"\\{each}" if each in "\\'" else each for each in shown) + "'"


def make_cases(
    outline: ScenarioOutline,
    settings: CaseSettings,
    seeds: Sequence[int | None],
    warn: Callable[[str], None],
) -> list[SuiteCase]:
    """
    Check a scenario with what its test and the command line change, and return its tests.

    Args:
        outline: The scenario.
        settings: Of the command line.
        seeds: Of each test; None for the scenario's own.
        warn: Told of old names.

    Raises:
        InputError: With every fault of the scenario.
        MissingExtraError: The simulation needs an optional dependency that is not installed.
    """
    overrides = outline.overrides(settings.overrides, is_shortened=settings.is_shortened)
    scenario = outline.load(overrides, warn)
    longest_s = settings.realtime_s_max
    time = scenario.scenario.time
    if longest_s is not None and not time.is_lockstep and time.duration_s > longest_s:
        overrides = _shortened(overrides, longest_s)
        try:
            scenario = outline.load(overrides, warn)
        except InputError as error:
            faults = [_of_the_cut(fault, longest_s) for fault in error.all_faults]
            raise InputError(faults=faults, omitted=error.omitted) from None
    own_s = outline.test.deadline_s if settings.is_shortened else None
    agents = scenario.scenario.agents
    baseline = outline.baseline() if settings.is_shortened else None
    return [
        SuiteCase(
            path=outline.path,
            scenario_name=scenario.scenario.name,
            overrides=tuple(with_seed(overrides, seed)),
            seed=scenario.scenario.seed if seed is None else seed,
            has_given_seed=seed is not None,
            is_lockstep=scenario.scenario.time.is_lockstep,
            work=agents.count * agents.tick_hz * scenario.scenario.time.duration_s,
            deadline_s=deadline_of(scenario) if own_s is None else own_s,
            expect=outline.test.expect,
            baseline=baseline,
        )
        for seed in seeds
    ]


def _of_the_cut(fault: Fault, longest_s: float) -> Fault:
    """Return a fault that says who gave the value that it is about, and what to do."""
    cut = f"of the scenario as --realtime-max {longest_s:g} cuts it; -k leaves it out"
    return replace(fault, text=f"{fault.text} ({cut})")


def deadline_of(scenario: ScenarioFile) -> float:
    """Return how long a run may take from its start to its verdict, s: all waits behind each other, and its records."""
    duration_s = scenario.scenario.time.duration_s
    return scenario.run_config("test").longest_s + END_S + END_SHARE * duration_s


def _shortened(overrides: Sequence[str], duration_s: float) -> list[str]:
    key = "time.duration_s"
    kept = [item for item in overrides if item.partition("=")[0].strip() != key]
    return [*kept, override_of(key, duration_s)]
