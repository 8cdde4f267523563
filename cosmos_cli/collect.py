"""
The end of a run: what was recorded is gathered, judged, reported and packaged.

`finish_run` does it for the run that just ended, `collect_run` again for any run, also one whose host
or operator was killed. Both may be repeated: what is recorded is only read. What machines recorded is
brought here before, by `cosmos_cli.retrieve`; where that failed is among the problems. Whatever cannot
be written, as on a full disk, is named in the verdict; run.json and the manifest come last, in the
space that the reserve kept free.
"""

from __future__ import annotations

import contextlib
import dataclasses
import datetime
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cosmos_cli.bundle import pack_run
from cosmos_cli.earlier import Earlier
from cosmos_cli.errors import ExitCode, RunFailedError
from cosmos_cli.expectation import HOST, Expected, find_missing, mapping_at
from cosmos_cli.fleet.onboard.living import words_of
from cosmos_cli.gather import Gathered, Progress, gather
from cosmos_cli.manifest import build_manifest
from cosmos_cli.problem import Problem, problems_of_run
from cosmos_cli.report.html import write_report
from cosmos_cli.retrieve.sources import Sources
from cosmos_cli.rundir import RunDirectory, write_json
from cosmos_cli.runjson import Evidence
from cosmos_cli.statistics import clock_statistics, round_trip_statistics, tick_statistics
from cosmos_cli.still_running import still_running
from cosmos_cli.tables import open_tables
from cosmos_cli.verdict import Verdict
from madns_runtime.processes import ProcessEntry, list_processes

LivingProcesses = Callable[[], Sequence[ProcessEntry]]


@dataclass(frozen=True, slots=True, kw_only=True)
class RunSummary:
    """A judged run."""

    run: RunDirectory
    verdict: Verdict
    document: Mapping[str, Any]
    """run.json."""
    is_packed: bool = True
    """Whether the package holds all of this."""

    @property
    def exit_code(self) -> ExitCode:
        """What the command ends with."""
        return self.verdict.exit_code

    @property
    def missing(self) -> tuple[str, ...]:
        """One line a source whose data are not all there."""
        return tuple(self.document["data"]["missing"])

    @property
    def last_line(self) -> str:
        """The verdict, and where the evidence lies."""
        return f"{self.verdict.text} | {self.run.path}"


def say_nothing(what: str, share: float) -> None:
    """Be the progress of those who want none."""


def finish_run(  # noqa: PLR0913 - the launcher's whole account of a run; four are optional and by name
    run: RunDirectory,
    result: Mapping[str, Any] | None,
    expected: Expected,
    *,
    interrupted: bool = False,
    problems: Sequence[Problem] = (),
    has_report: bool = True,
    progress: Progress = say_nothing,
) -> RunSummary:
    """
    Gather, judge, report and package a run whose processes have ended.

    Args:
        run: The run; `begin_run` wrote its run.json and plan.json.
        result: What the host reported at its end; None if it could not.
        expected: Who should have recorded what.
        interrupted: Whether the operator ended it.
        problems: What did not go as it should while it ran; a machine's ends with 3. Of the step
            collect: whose records have not all come.
        has_report: Whether report.html is written; `cosmos report` can do it later.
        progress: Called with what is being done and how far it is, 0 to 1.

    Raises:
        MachineError: A record stream cannot be read.
        RunFailedError: Not even run.json can be written.
    """
    earlier = Earlier.read(run)
    changed = earlier.changed_files(run)
    end = _RunEnd(result, interrupted, tuple(problems))
    if result is not None:
        # On a full disk the summary below still tells what matters of it.
        with contextlib.suppress(OSError):
            write_json(run.result_json, result)
    config = run.read_config()
    gathered = gather(run, config.agents.tick_hz if config else None, progress)
    changed |= earlier.changed_streams(run, gathered.by_path())
    if not run.plan_json.is_file():
        changed.setdefault(run.plan_json.name, "missing; what was planned is not known")
    gathered = dataclasses.replace(
        gathered,
        faults=(*gathered.faults, *(f"{name}: {what}" for name, what in changed.items())),
        was={name: earlier.entries[name] for name in changed if name in earlier.entries},
    )
    evidence = _evidence(run, gathered, end, expected)
    return _conclude(run, gathered, evidence, has_report=has_report, progress=progress)


def collect_run(
    run: RunDirectory,
    *,
    problems: Sequence[Problem] = (),
    progress: Progress = say_nothing,
    processes: LivingProcesses = list_processes,
) -> RunSummary:
    """
    Gather, judge, report and package a run again: finished, cut off, or its host killed.

    Args:
        run: The run.
        problems: What was met while its records were brought here from machines.
        progress: Called with what is being done and how far it is, 0 to 1.
        processes: Tells what lives on this computer.

    Raises:
        InputError: Processes of the run still live; the message names them.
        MachineError: A record stream cannot be read.
        RunFailedError: Not even run.json can be written.
    """
    refuse_living(run, processes())
    before = run.read_json(run.run_json) or {}
    result = run.read_json(run.result_json) or run.read_left_result()
    return finish_run(
        run,
        result,
        _expected(run, before, result),
        interrupted=before.get("status") == "interrupted",
        problems=(*problems_of_run(before.get("problems")), *problems),
        progress=progress,
    )


def _expected(
    run: RunDirectory, before: Mapping[str, Any], result: Mapping[str, Any] | None
) -> Expected:
    """Join what the plan, the result and an earlier collection know: any of them may have been lost."""
    planned, earlier = Expected.read(run), Earlier.read(run)
    agents = (
        *planned.agents,
        *mapping_at(result, "agents"),
        *mapping_at(before, "simulation", "agents"),
        *earlier.sources("agents"),
    )
    machines = (*planned.machines, *earlier.sources("machines"))
    return dataclasses.replace(
        planned, agents=tuple(dict.fromkeys(agents)), machines=tuple(dict.fromkeys(machines))
    )


def refuse_living(run: RunDirectory, processes: Sequence[ProcessEntry]) -> None:
    """
    See that nothing of a run lives on this computer.

    Raises:
        InputError: It does; the message names who.
    """
    living = [
        words_of(entry)
        for entry in processes
        if Path(entry.run_directory).resolve().is_relative_to(run.path)
    ]
    if living:
        raise still_running(run.name, {"": living})


@dataclass(frozen=True, slots=True)
class _RunEnd:
    result: Mapping[str, Any] | None
    interrupted: bool
    problems: tuple[Problem, ...]


def _evidence(run: RunDirectory, gathered: Gathered, end: _RunEnd, expected: Expected) -> Evidence:
    tables = open_tables(run.tables)
    unretrieved = _unretrieved(run, end.problems)
    missing = find_missing(expected, gathered.scans, end.result, unretrieved)
    return Evidence(
        run=run.name,
        started=run.read_json(run.run_json) or {},
        config=run.read_config(),
        expected=expected,
        result=end.result,
        host_machine=Sources.read(run).host_machine,
        interrupted=end.interrupted,
        problems=end.problems,
        scans=gathered.scans,
        ticks=tick_statistics(tables.get("ticks")),
        round_trip_ms=round_trip_statistics(tables),
        clock=clock_statistics(tables.get("clock")),
        missing=(*missing, *gathered.faults),
    )


def _unretrieved(run: RunDirectory, problems: Sequence[Problem]) -> dict[str, str]:
    """Return whose records may lie on a machine still, and why: by machine, agent, and the host."""
    why = {p.machine: p.text for p in problems if p.machine and p.step == "collect"}
    sources = Sources.read(run)
    away = ((name, sources.machine_of(name)) for name in (HOST, *sources.machine_of_agent))
    return {**why, **{name: f"not retrieved from {m}" for name, m in away if m in why}}


def _conclude(
    run: RunDirectory,
    gathered: Gathered,
    evidence: Evidence,
    *,
    has_report: bool,
    progress: Progress,
) -> RunSummary:
    _, document = evidence.judged()
    # The verdict first: whoever loses patience with the report or kills it here still has that.
    with contextlib.suppress(OSError):
        write_json(run.run_json, document)
    if has_report:
        progress("writing the report", 0.0)
        evidence = _with_report(run, evidence, document)
    # From here on what matters most is written, and the reserve makes room for it.
    run.free_reserve()
    summary = _write_summary(run, gathered, evidence)
    progress("packing", 0.0)
    packed = _attempt(evidence, run.bundle, lambda: pack_run(run, _start_s(document)))
    if packed is not evidence:
        summary = _write_summary(run, gathered, packed)
        return dataclasses.replace(summary, is_packed=False)
    return summary


def _with_report(run: RunDirectory, evidence: Evidence, document: Mapping[str, Any]) -> Evidence:
    try:
        return _attempt(evidence, run.report_html, lambda: write_report(run, document))
    except Exception as error:  # noqa: BLE001 - a defect of the report must not cost a run its verdict
        text = (
            f"report.html: not written: {type(error).__name__}: {error}; please report this defect"
        )
        problem = Problem(text=text, step="collect")
        return dataclasses.replace(evidence, problems=(*evidence.problems, problem))


def _attempt(evidence: Evidence, path: Path, write: Callable[[], object]) -> Evidence:
    """Return *evidence*, with one more gap if the file cannot be written."""
    try:
        write()
    except OSError as error:
        gap = f"{path.name}: not written: {error.strerror or error}"
        return dataclasses.replace(evidence, missing=(*evidence.missing, gap))
    return evidence


def _write_summary(run: RunDirectory, gathered: Gathered, evidence: Evidence) -> RunSummary:
    verdict, document = evidence.judged()
    try:
        write_json(run.run_json, document)
        write_json(run.manifest_json, build_manifest(run, gathered.by_path(), gathered.was))
    except OSError as error:
        raise RunFailedError(
            f"{run.path}: the summary cannot be written: {error.strerror or error}; the verdict was: "
            f"{verdict.text}; make room and repeat with: cosmos collect {run.path}"
        ) from error
    return RunSummary(run=run, verdict=verdict, document=document)


def _start_s(document: Mapping[str, Any]) -> int:
    """Return the run's start in seconds since 1970; 0 if it is not known."""
    try:
        return int(datetime.datetime.fromisoformat(str(document["started_utc"])).timestamp())
    except ValueError:
        return 0
