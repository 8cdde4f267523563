"""`cosmos bench capacity`: the largest number of agents that keeps a budget of missed ticks, found by runs."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Final

import typer

from cosmos_cli.bench.capacity import (
    COLUMNS,
    FIRST_DEFAULT,
    SCENARIO,
    CapacityFound,
    CapacityTrials,
    find_capacity,
)
from cosmos_cli.bench.child_run import run_arguments
from cosmos_cli.bench.prediction import CapacityPrediction, predict
from cosmos_cli.commands.fleet_command import (
    HostOption,
    LimitOption,
    SomeInventoryOption,
    some_machines,
)
from cosmos_cli.commands.run_arguments import RunsOption
from cosmos_cli.errors import InputError
from cosmos_cli.evidence.run_directory import runs_root
from cosmos_cli.models.loading import load_scenario
from cosmos_cli.models.overrides import told_as_options
from cosmos_cli.ui.console import Console, JsonOption, QuietOption, SetOption
from madns_runtime.config import AGENTS_MAX, RATE_HZ_MAX

MINUTES_DEFAULT = 30.0
MINUTES_MAX = 24 * 60.0
SECONDS_MAX = 3600.0
OPTIONS: Final = {
    "agents.count": "--first",
    "agents.tick_hz": "--hz",
    "agents.per_process": "--per-process",
    "time.duration_s": "--seconds",
    "deadline.overrun_ms": "--hz",
    "deadline.max_miss_ratio": "--max-miss-ratio",
}
"""By the settings of a trial that they make."""


ScenarioArgument = Annotated[
    Path | None,
    typer.Argument(metavar="[SCENARIO]", help="What agents do; default: they count with the host."),
]
RateOption = Annotated[
    float,
    typer.Option(
        "--hz", metavar="HZ", min=0.1, max=RATE_HZ_MAX, help="Ticks per second of each agent."
    ),
]
BudgetOption = Annotated[
    float,
    typer.Option(min=0.0, max=1.0, help="Budget: largest share of ticks that may be missed."),
]
SecondsOption = Annotated[
    float,
    typer.Option("--seconds", metavar="S", min=1.0, max=SECONDS_MAX, help="Of each trial, s."),
]
PerProcessOption = Annotated[
    int, typer.Option("--per-process", metavar="N", min=1, help="Agents in one process.")
]
FirstOption = Annotated[
    int,
    typer.Option("--first", metavar="N", min=1, max=AGENTS_MAX, help="Agents of the first trial."),
]
LargestOption = Annotated[
    int,
    typer.Option("--largest", metavar="N", min=1, max=AGENTS_MAX, help="More are not tried."),
]
ResolutionOption = Annotated[
    float,
    typer.Option(
        min=0.0, max=1.0, help="Ends when what breaks is within this share above what holds."
    ),
]
TriesOption = Annotated[
    int,
    typer.Option(
        min=1,
        max=10,
        help="Runs that must break the budget before a number counts as too large.",
    ),
]
MinutesOption = Annotated[
    float,
    typer.Option(
        metavar="M", min=0.1, max=MINUTES_MAX, help="No trial begins after so many minutes."
    ),
]


def capacity(
    scenario: ScenarioArgument = None,
    hz: RateOption = 100.0,
    max_miss_ratio: BudgetOption = 1e-3,
    inventory: SomeInventoryOption = None,
    limit: LimitOption = None,
    host: HostOption = None,
    seconds: SecondsOption = 10.0,
    per_process: PerProcessOption = 1,
    first: FirstOption = FIRST_DEFAULT,
    largest: LargestOption = AGENTS_MAX,
    resolution: ResolutionOption = 0.05,
    tries: TriesOption = 1,
    minutes: MinutesOption = MINUTES_DEFAULT,
    set_: SetOption = None,
    runs: RunsOption = None,
    json: JsonOption = False,
    quiet: QuietOption = False,
) -> int:
    """
    Find how many agents keep a budget of missed ticks, here or on an inventory, and what the plan predicts.

    Doubles their number until the budget breaks, then bisects; each trial is a run, and is kept. Ends with 4 when no
    number keeps it, or none was found in time, with 3 when machines failed.
    """
    console = Console(json=json, quiet=quiet, instead=f"the trials lie in {runs_root(runs)}")
    if first > largest:
        raise InputError(f"--first {first} is more than --largest {largest}")
    if seconds < 1 / hz:
        raise InputError(
            f"--seconds {seconds:g} is less than one tick at --hz {hz:g}: give at least --seconds {1 / hz:g}"
        )
    machines = some_machines(inventory, limit, host)
    trials = CapacityTrials(
        hz=hz,
        max_miss_ratio=max_miss_ratio,
        seconds=seconds,
        per_process=per_process,
        first=first,
        largest=largest,
        resolution=resolution,
        tries=tries,
        end_s=time.monotonic() + minutes * 60,
        is_machines_fault=any(machine.connection != "local" for machine in machines),
    )
    settings = set_ or ()
    _refuse_own_settings(settings, trials)
    own = trials.overrides(first)
    with told_as_options(OPTIONS, settings):
        checked = load_scenario(scenario or SCENARIO, [*settings, *own], warn=console.warn)
    if checked.scenario.time.is_lockstep:
        raise InputError(
            f"{checked.path}: in lockstep no tick is ever missed, so that any number of agents keeps the budget; try it"
            " in real time: --set time.mode=realtime"
        )
    predicted = predict(checked, machines, per_process=per_process, host=host)
    options = run_arguments(inventory=inventory, limit=limit, host=host, settings=settings)
    options += ["--runs", str(runs_root(runs))]
    found = find_capacity(trials, checked.path, options, console.say)
    _show(console, found, trials, predicted)
    return int(found.exit_code)


def _refuse_own_settings(given: Sequence[str], trials: CapacityTrials) -> None:
    own = {each.partition("=")[0] for each in trials.overrides(1)}
    for each in given:
        if each.partition("=")[0].strip() in own:
            raise InputError(f"--set {each}: trials set that themselves; use the command's options")


def _show(
    console: Console,
    found: CapacityFound,
    trials: CapacityTrials,
    predicted: CapacityPrediction | None,
) -> None:
    """Print the trials and what they came to."""
    console.table(COLUMNS, [trial.row() for trial in found.trials])
    console.data(_verdict(found, trials, predicted))
    console.print_json(
        {
            "hz": trials.hz,
            "max_miss_ratio": trials.max_miss_ratio,
            "seconds": trials.seconds,
            "per_process": trials.per_process,
            "agents": found.search.held,
            "broken_at": found.search.broken,
            "predicted": asdict(predicted) if predicted else None,
            "stopped_by": found.stopped_by or None,
            "trials": [trial.to_mapping() for trial in found.trials],
            "exit_code": int(found.exit_code),
        }
    )


def _verdict(
    found: CapacityFound, trials: CapacityTrials, predicted: CapacityPrediction | None
) -> str:
    parts = [
        f"{trials.hz:g} Hz, at most {trials.max_miss_ratio:g} of the ticks missed: {found.words}"
    ]
    if found.stopped_by:
        parts.append(f"stopped: {found.stopped_by}")
    if predicted is not None:
        limit = "no limit" if predicted.agents is None else str(predicted.agents)
        parts.append(f"cosmos plan predicts {limit} ({predicted.source})")
    return "; ".join(parts)
