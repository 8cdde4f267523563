"""`cosmos judge`: a finished run judged again by expectations, its own or those of a scenario file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from cosmos_cli.collect.finished_run import (
    collected_document,
    is_as_listed,
    listed_files,
    refuse_foreign_tables,
    refuse_living,
)
from cosmos_cli.commands.run_arguments import RunArgument, RunsOption
from cosmos_cli.errors import ExitCode, InputError
from cosmos_cli.evidence.expectations.judge import JudgedExpectations
from cosmos_cli.evidence.expectations.of_run import (
    expectations_for,
    judge_run,
    planned_expectations,
)
from cosmos_cli.evidence.run_directory import RunDirectory, runs_root
from cosmos_cli.evidence.run_documents import fault_of, fault_of_plan, fault_of_summary
from cosmos_cli.evidence.run_search import find_run
from cosmos_cli.evidence.tables import open_tables
from cosmos_cli.evidence.verdict import conclusion_of_expectations
from cosmos_cli.models.loading import load_scenario
from cosmos_cli.report.cells import format_cell, format_measured
from cosmos_cli.ui.console import Column, Console, JsonOption, QuietOption
from madns_runtime.plain_values import mapping_at
from madns_runtime.processes import list_processes

COLUMNS = (
    Column("check"),
    Column("got", is_number=True),
    Column("limit", is_number=True),
    Column("unit"),
    Column(""),
    Column("agent"),
    Column("at s", is_number=True),
    Column("expected"),
)


def judge(
    run: RunArgument = "last",
    scenario: Annotated[
        Path | None,
        typer.Option(
            "-s", "--scenario", metavar="FILE", help="Judge by the checks of this scenario."
        ),
    ] = None,
    folder: RunsOption = None,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> int:
    """
    Judge a finished run again by the expectations of its scenario, or of another.

    Nothing of the run is changed. Ends with 0 if all hold, 4 if one is broken, and 5 if data of the run are missing
    or none of the expectations could be judged; of a run that failed (1), whose machines did (3) or that was
    interrupted (130) with that code, whatever holds.
    """
    console = Console(json=as_json, quiet=quiet, instead="the exit code is the verdict's")
    found = find_run(runs_root(folder), run)
    document = _collected(found)
    tables = open_tables(found.tables)
    if scenario is None:
        expectations = planned_expectations(found.read_json(found.plan_json))
        if not expectations:
            raise InputError(
                f"{found.name}: its scenario has no `checks:` (those of its simulation stand in `cosmos report"
                f" {found.shell_path}`); name a scenario that has: cosmos judge {found.shell_path} -s FILE"
            )
    else:
        file = load_scenario(scenario, warn=console.warn)
        expectations = expectations_for(found, file, tables)
    judged = judge_run(found, tables, expectations, document)
    missing = (*_missing(document), *judged.gaps())
    code, text = conclusion_of_expectations(judged.results, missing, document)
    nulls = _not_finite(document)
    console.print_json(_told(found, judged, code, text, missing) | {"records_not_finite": nulls})
    if not as_json:
        _print(console, judged, missing)
    if nulls:
        were = "1 value was" if nulls == 1 else f"{nulls} values were"
        console.say(f"{were} NaN or infinite when recorded, and null since: no check sees them")
    (console.say if as_json else console.data)(f"{text} | {found.path}")
    return int(code)


def _collected(run: RunDirectory) -> Mapping[str, Any]:
    refuse_living(run, list_processes())
    document = collected_document(run, str(run.path))
    if fault := fault_of_summary(document):
        raise InputError(
            f"{run.run_json}: {fault}; make it anew with: cosmos collect {run.shell_path}"
        )
    # A check that cannot be read would be one that is not judged.
    if fault := fault_of_plan(run.plan_json):
        raise InputError(
            f"{run.plan_json}: {fault}; put it back as it was: what was expected stands there alone"
        )
    # Without it, a table that is gone would be one without records.
    fault = fault_of(run.manifest_json)
    if fault is not None:
        raise InputError(
            f"{run.manifest_json}: {fault}; make it anew with: cosmos collect {run.shell_path}"
        )
    files = listed_files(run)
    plan = files.get(run.plan_json.name)
    if plan is not None and not is_as_listed(plan, run.plan_json):
        raise InputError(
            f"{run.plan_json}: changed since the run was collected, and what was expected with it; put it back as it"
            f" was, or have the change noted with: cosmos collect {run.shell_path}"
        )
    tables = {n: entry for n, entry in files.items() if n.startswith(f"{run.tables.name}/")}
    cut = [name for name, entry in tables.items() if not is_as_listed(entry, run.path / name)]
    if cut:
        what = f"{run.path / cut[0]}" + (f" and {len(cut) - 1} more" if cut[1:] else "")
        text = "missing, or not as it was collected"
        raise InputError(f"{what}: {text}; make it anew with: cosmos collect {run.shell_path}")
    refuse_foreign_tables(run)
    return document


def _not_finite(document: Mapping[str, Any]) -> int:
    """Return how many values of the run were NaN or infinite: in its records they are null, which checks skip."""
    count = mapping_at(document, "records").get("not_finite")
    return count if isinstance(count, int) else 0


def _missing(document: Mapping[str, Any]) -> tuple[str, ...]:
    """Return what is missing of the run's data, but for what its own expectations came to."""
    data = document.get("data")
    listed = data.get("missing") if isinstance(data, Mapping) else None
    texts = listed if isinstance(listed, list) else []
    return tuple(str(text) for text in texts if not str(text).startswith("checks: "))


def _told(
    run: RunDirectory,
    judged: JudgedExpectations,
    code: ExitCode,
    text: str,
    missing: Sequence[str],
) -> dict[str, Any]:
    return {
        "run": run.name,
        "verdict": text,
        "exit_code": int(code),
        "checks": [result.to_mapping() for result in judged.results],
        "checks_not_judged": judged.told_not_judged(),
        "remarks": list(judged.remarks()),
        "missing": list(missing),
    }


def _print(console: Console, judged: JudgedExpectations, missing: Sequence[str]) -> None:
    rows = [
        [
            result.name,
            format_measured(result.got, result.limit),
            format_cell(result.limit),
            result.unit or "",
            "holds" if result.passed else "BROKEN",
            result.agent or "",
            "" if result.t_s is None else format_cell(result.t_s),
            result.expected,
        ]
        for result in judged.results
    ]
    if rows:
        console.table(COLUMNS, rows)
    for remark in judged.remarks():
        console.data(remark)
    for line in missing:
        console.data(f"missing: {line}")
