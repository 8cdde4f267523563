"""`cosmos test`: scenarios as tests, many at once."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Annotated

import typer

from cosmos_cli.commands.run_arguments import RunsOption
from cosmos_cli.errors import ExitCode, Fault, InputError
from cosmos_cli.evidence.run_directory import runs_root, utc_now
from cosmos_cli.models.overrides import override_steps
from cosmos_cli.models.test_settings import SECTION
from cosmos_cli.testing.case import CaseSettings, SuiteCase
from cosmos_cli.testing.discovery import ChosenCases, FoundScenarios, choose_cases, find_scenarios
from cosmos_cli.testing.expression import parse_expression
from cosmos_cli.testing.junit import JunitCase, JunitOption, prepare_junit, write_junit
from cosmos_cli.testing.last_failed import read_failed, remember_failed
from cosmos_cli.testing.outcome import CaseOutcome
from cosmos_cli.testing.seeds import parse_seeds
from cosmos_cli.testing.suite import FOLDER, SuiteOptions, SuiteResult, check_folder, run_cases
from cosmos_cli.testing.terminal import (
    case_line,
    collected_line,
    details,
    failure_lines,
    printed_name,
    summary_line,
)
from cosmos_cli.ui.console import Console, JsonOption, QuietOption, SetOption
from cosmos_cli.ui.plural import counted
from madns_runtime.bounded_files import real_path

JOBS_MAX = 256
SECONDS_MAX = 86_400.0 * 30
OF_BUDGETS = ("time", "rtf_tolerance")
"""Beside the section `deadline`, the setting that is no more than a limit."""


PathsArgument = Annotated[
    list[Path] | None,
    typer.Argument(
        metavar="[PATH]...", help="Scenarios, or folders of them; default: ./scenarios, or ."
    ),
]
ExpressionOption = Annotated[
    str,
    typer.Option(
        "-k",
        metavar="EXPR",
        help="Only tests whose name, file or tags match, as in 'quick and not hohmann'.",
    ),
]
JobsOption = Annotated[
    int,
    typer.Option(
        "-j",
        "--jobs",
        metavar="N",
        min=0,
        max=JOBS_MAX,
        help="Scenarios in lockstep beside each other; 0 for one per processor.",
    ),
]
LastFailedOption = Annotated[
    bool, typer.Option("--last-failed", help="Only what failed last time; all if nothing did.")
]
SeedsOption = Annotated[
    str | None,
    typer.Option(metavar="SEEDS", help="Run each with these seeds: 1..20, or 1,5,9."),
]
FullLengthOption = Annotated[
    bool, typer.Option("--full-length", help="Leave out what test.set changes, and baselines.")
]
RealtimeMaxOption = Annotated[
    float | None,
    typer.Option(
        "--realtime-max",
        metavar="S",
        min=0.1,
        max=SECONDS_MAX,
        help="Longest simulated time of a scenario in real time, s.",
    ),
]
UpdateBaselinesOption = Annotated[
    bool, typer.Option("--update-baselines", help="Write what comes as what baselines expect.")
]
KeepOption = Annotated[bool, typer.Option("--keep", help="Keep the runs of tests that pass, too.")]


def test(
    paths: PathsArgument = None,
    expression: ExpressionOption = "",
    jobs: JobsOption = 0,
    last_failed: LastFailedOption = False,
    seeds: SeedsOption = None,
    set_: SetOption = None,
    full_length: FullLengthOption = False,
    realtime_s_max: RealtimeMaxOption = None,
    junit: JunitOption = None,
    update_baselines: UpdateBaselinesOption = False,
    keep: KeepOption = False,
    runs: RunsOption = None,
    json: JsonOption = False,
    quiet: QuietOption = False,
) -> int:
    """
    Run scenarios as tests: each shortened by its `test.set`, judged by its verdict, `test.expect` and `test.baseline`.

    Their runs lie in `tests` of the folder of runs. Ends with 0 if all passed, 1 if one failed, 2 if a scenario is wrong
    or none is meant, 130 if interrupted.
    """
    console = Console(json=json, quiet=quiet, instead=_instead(junit))
    if update_baselines:
        is_another = seeds is not None or full_length or realtime_s_max is not None
        _refuse_other_tests(set_ or (), is_another=is_another)
    _refuse_section(set_ or ())
    if seeds is not None:
        _refuse_seed(set_ or ())
    prepare_junit(junit)
    settings = CaseSettings(
        overrides=tuple(set_ or ()), is_shortened=not full_length, realtime_s_max=realtime_s_max
    )
    found = find_scenarios(paths or [])
    seeds_of = _seeds_of(console, found, seeds, last_failed=last_failed)
    chosen = _chosen(console, found, settings, expression=expression, seeds_of=seeds_of)
    if update_baselines:
        _check_owners(chosen.cases)
    options = SuiteOptions(
        runs=runs_root(runs) / FOLDER,
        jobs=jobs or len(os.sched_getaffinity(0)),
        keeps_all=keep,
        updates_baselines=update_baselines,
    )
    check_folder(options.runs)
    started_utc, started_s = utc_now(), time.monotonic()
    result = _run(console, chosen.cases, options)
    seconds = time.monotonic() - started_s
    remember_failed(result.outcomes)
    code = result.exit_code
    try:
        if junit is not None:
            cases = list(junit_cases(result.outcomes, chosen.cases))
            write_junit(junit, cases, seconds=seconds, started_utc=started_utc)
    except InputError as error:
        code = error.exit_code
        raise
    finally:  # a disk that is full by now takes no file, and what failed is told all the same
        _tell(console, result, chosen, seconds, code=code)
    return int(code)


def _refuse_other_tests(given: Sequence[str], *, is_another: bool) -> None:
    """
    Refuse to write baselines with figures of another test than the one that stands there.

    Args:
        given: Of --set; budgets of time change no figure of a run.
        is_another: Whether an option makes it another.

    Raises:
        InputError: It is another.
    """
    steps = map(override_steps, given)
    changing = [each for each in steps if each[0] != "deadline" and each != OF_BUDGETS]
    if is_another or changing:
        raise InputError(
            "--update-baselines writes figures of the test as it stands: leave out --seeds, --full-length, --realtime-max"
            f" and --set (but that of deadline.* and {'.'.join(OF_BUDGETS)}); what always holds belongs in its test.set"
        )


def _refuse_section(given: Sequence[str]) -> None:
    """
    Refuse settings of the section `test`, which is read from the file, before there are any.

    Raises:
        InputError: There is one: it would change nothing.
    """
    for each in given:
        if override_steps(each)[0] == SECTION:
            key = each.partition("=")[0]
            text = "changes nothing: what a scenario is as a test is read from its file alone; write it there"
            raise InputError(faults=[Fault(text=text, override=key)])


def _refuse_seed(given: Sequence[str]) -> None:
    """
    Refuse a seed of its own beside those of --seeds.

    Raises:
        InputError: There is one: it would count in no run.
    """
    for each in given:
        if override_steps(each) == ("seed",):
            text = "each run has a seed of --seeds already; leave out one of the two"
            raise InputError(faults=[Fault(text=text, override="seed")])


def _instead(junit: Path | None) -> str:
    return (
        f"the tests go on{f', their results come to {junit}' if junit else ''}; the exit code tells"
    )


def _tell(
    console: Console, result: SuiteResult, chosen: ChosenCases, seconds: float, *, code: ExitCode
) -> None:
    """Print failures and the last line, or all of it as JSON; *code* is the command's."""
    ordered = in_order(result.outcomes, chosen.cases)
    for line in failure_lines(ordered):
        console.data(line)
    for path, number in result.written.items():
        console.say(f"{path}: {counted(number, 'expected value')} written")
    console.data(summary_line(result, deselected=chosen.deselected, seconds=seconds))
    console.print_json(
        {
            "tests": [each.to_mapping() for each in ordered],
            "passed": result.count("passed"),
            "failed": result.count("failed"),
            "interrupted": result.count("interrupted"),
            "not_run": result.not_run,
            "deselected": chosen.deselected,
            "left_out": chosen.left_out,
            "seconds": round(seconds, 3),
            "exit_code": int(code),
        }
    )


def _seeds_of(
    console: Console, found: FoundScenarios, text: str | None, *, last_failed: bool
) -> Callable[[Path], Sequence[int | None]]:
    """Return the function that tells a scenario's seeds; none for one that did not fail last time."""
    given: Sequence[int | None] = (None,) if text is None else parse_seeds(text)
    known = {str(real_path(outline.path)) for outline in found.outlines}
    # Other folders' failures are remembered, too.
    failed = [each for each in read_failed() if each[0] in known] if last_failed else []
    if not failed:
        if last_failed:
            console.say("none of these failed last time: all tests are meant")
        return lambda path: given
    by_path: dict[str, list[int | None]] = {}
    for place, seed in failed:
        by_path.setdefault(place, []).append(seed)
    return lambda path: [
        seed for seed in by_path.get(str(real_path(path)), []) if text is None or seed in given
    ]


def _chosen(
    console: Console,
    found: FoundScenarios,
    settings: CaseSettings,
    *,
    expression: str,
    seeds_of: Callable[[Path], Sequence[int | None]],
) -> ChosenCases:
    is_meant = parse_expression(expression) if expression else lambda names: True
    chosen = choose_cases(found, settings, seeds_of=seeds_of, is_meant=is_meant, warn=console.warn)
    console.say(collected_line(len(chosen.cases), found, deselected=chosen.deselected))
    if not chosen.cases:
        raise InputError(
            "no tests: "
            + (
                f"none of {len(found.outlines)} scenarios is meant by -k, --last-failed and --seeds"
                if found.outlines
                else "no scenarios there; name files, or folders with scenarios"
            )
        )
    return chosen


def _check_owners(cases: Sequence[SuiteCase]) -> None:
    """
    Refuse a baseline that two tests would write, or one with another seed than its scenario's.

    Raises:
        InputError: There is one.
    """
    owners: dict[Path, SuiteCase] = {}
    for case in cases:
        if case.baseline is None:
            continue
        if case.has_given_seed:
            raise InputError(
                f"{case.name}: failed last time with a seed of --seeds, and --update-baselines writes"
                " figures of the scenario's own: leave out --last-failed"
            )
        other = owners.setdefault(real_path(case.baseline.path), case)
        if other is not case:
            text = f"is the baseline of {other.name} and of {case.name}: each needs its own"
            raise InputError(f"{case.baseline.path}: {text}")


def _run(console: Console, cases: Sequence[SuiteCase], options: SuiteOptions) -> SuiteResult:
    width = max(len(printed_name(case)) for case in cases)
    number = 0

    def tell(outcome: CaseOutcome) -> None:
        nonlocal number
        number += 1
        console.data(case_line(outcome, number=number, total=len(cases), width=width))

    return run_cases(cases, options, tell)


def in_order(outcomes: Sequence[CaseOutcome], cases: Sequence[SuiteCase]) -> list[CaseOutcome]:
    """Return what came of tests in the tests' own order."""
    places = {case.key: place for place, case in enumerate(cases)}
    return sorted(outcomes, key=lambda each: places[each.case.key])


def junit_cases(outcomes: Sequence[CaseOutcome], cases: Sequence[SuiteCase]) -> Iterator[JunitCase]:
    """Yield all tests as JUnit XML holds them, those that an interruption left out as well."""
    ended = {outcome.case.key: outcome for outcome in outcomes}
    for case in cases:
        if (outcome := ended.get(case.key)) is not None:
            yield junit_case(outcome)
        else:
            yield JunitCase(
                classname=str(case.path),
                name=_junit_name(case),
                seconds=0.0,
                skipped="not run: interrupted before",
                properties=(("seed", str(case.seed)), ("repeat", case.repeat_command)),
            )


def _junit_name(case: SuiteCase) -> str:
    return f"{case.scenario_name}[seed={case.seed}]" if case.has_given_seed else case.scenario_name


def junit_case(outcome: CaseOutcome) -> JunitCase:
    """Return a test that ended as JUnit XML holds it."""
    case = outcome.case
    is_failed = outcome.outcome == "failed"
    return JunitCase(
        classname=str(case.path),
        name=_junit_name(case),
        seconds=outcome.seconds,
        failure=outcome.reasons[0] if is_failed else "",
        details="\n".join(details(outcome)) if is_failed else "",
        skipped="interrupted" if outcome.outcome == "interrupted" else "",
        properties=(
            ("seed", str(case.seed)),
            ("verdict", outcome.verdict),
            ("repeat", case.repeat_command),
            *((("run", outcome.directory),) if outcome.directory else ()),
        ),
    )
