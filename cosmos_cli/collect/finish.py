"""
The end of a run: what was recorded is gathered, judged, reported and packaged.

`finish_run` does it for the run that just ended, `collect_run` again for any run, also one whose host
or operator was killed. Both may be repeated: what is recorded is only read. What machines recorded is
brought here before, by `cosmos_cli.collect.retrieve`; where that failed is among the problems. Whatever cannot
be written, as on a full disk, is named in the verdict; run.json and the manifest come last, in the
space that the reserve kept free.
"""

from __future__ import annotations

import contextlib
import dataclasses
import datetime
import errno
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from cosmos_cli.collect.finished_run import refuse_living
from cosmos_cli.collect.machine_sources import RecordingMachines
from cosmos_cli.collect.previous_manifest import Earlier
from cosmos_cli.collect.unread_files import find_unread, told_unread
from cosmos_cli.errors import FAILED_RUNS, ExitCode, RunFailedError
from cosmos_cli.evidence.completeness import ExpectedRecords, find_missing
from cosmos_cli.evidence.devices import expected_devices, read_devices, recorded_files
from cosmos_cli.evidence.expectations.of_run import judge_run, planned_expectations
from cosmos_cli.evidence.manifest import build_manifest, first_still_packed, pack_run
from cosmos_cli.evidence.remarks import declared_streams, undeclared_remarks
from cosmos_cli.evidence.run_directory import (
    RESERVE_BYTES,
    RunDirectory,
    was_interrupted,
    write_json,
)
from cosmos_cli.evidence.run_documents import (
    MISSING,
    Problem,
    fault_of,
    fault_of_plan,
    problems_of_run,
)
from cosmos_cli.evidence.run_json import Evidence
from cosmos_cli.evidence.statistics import (
    clock_statistics,
    round_trip_statistics,
    tick_statistics,
    with_told_misses,
)
from cosmos_cli.evidence.table_labels import TableLabels
from cosmos_cli.evidence.tables import open_tables
from cosmos_cli.evidence.tabulate import Gathered, Progress, gather
from cosmos_cli.evidence.tick_causes import recorded_causes
from cosmos_cli.evidence.timeline_remarks import timeline_remarks
from cosmos_cli.evidence.told_counts import with_told_counts
from cosmos_cli.evidence.verdict import Verdict
from cosmos_cli.report.html import write_report
from madns_runtime.conditions.condition import HOST
from madns_runtime.hardware.action_socket import SOCKET_NAME as ACTIONS_SOCKET
from madns_runtime.hardware.order_socket import SOCKET_NAME as ORDERS_SOCKET
from madns_runtime.plain_values import mapping_at
from madns_runtime.processes import ProcessEntry, list_processes

LivingProcesses = Callable[[], Sequence[ProcessEntry]]
"""Lists the processes that live on this computer."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RunSummary:
    """A judged run."""

    run: RunDirectory
    verdict: Verdict
    document: Mapping[str, Any]
    """run.json."""
    is_packed: bool = True
    """Whether the package holds all of this."""
    kept_member: str = ""
    """Name in an earlier package of a file that is no longer here as it was, for which that package was kept."""

    @property
    def exit_code(self) -> ExitCode:
        """Exit code of the command."""
        return self.verdict.exit_code

    @property
    def missing(self) -> tuple[str, ...]:
        """One line per source whose data are not all there."""
        return tuple(self.document["data"]["missing"])

    @property
    def last_line(self) -> str:
        """The verdict, and where the evidence lies."""
        return f"{self.verdict.text} | {self.run.path}"

    def refuse_failed(self) -> None:
        """
        See that it can be worked with: it did not fail, lose a machine or end by an interruption.

        Raises:
            RunFailedError: It did; with its exit code.
        """
        if self.exit_code in FAILED_RUNS:
            raise RunFailedError(self.last_line, exit_code=self.exit_code, run=self.run.path)


def finish_run(  # noqa: PLR0913 - the launcher's whole account of a run; five are optional and by name
    run: RunDirectory,
    result: Mapping[str, Any] | None,
    expected: ExpectedRecords,
    *,
    interrupted: bool = False,
    problems: Sequence[Problem] = (),
    has_report: bool = True,
    progress: Progress = lambda what, share: None,
    bytes_max: int | None = None,
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
        bytes_max: The most that files with holes may hold and be read; None for what the plan allows.

    Raises:
        RunFailedError: Not even run.json can be written.
    """
    _remove_sockets(run)
    earlier = Earlier.read(run)
    unread = find_unread(run, earlier, bytes_max)
    changed = {**told_unread(run, unread), **earlier.changed_files(run, unread)}
    end = _RunEnd(result, interrupted, tuple(problems))
    if result is not None:
        # On a full disk the summary below still tells what matters of it.
        with contextlib.suppress(OSError):
            write_json(run.result_json, result)
    config = run.read_config()
    tick_hz = config.agents.tick_hz if config else None
    gathered = gather(
        run,
        tick_hz,
        progress,
        labels=TableLabels.of(config, result, run.read_json(run.plan_json)),
        without=unread,
    )
    gathered = dataclasses.replace(gathered, scans=with_told_counts(gathered.scans, result))
    changed |= earlier.changed_streams(run, gathered.by_path(), gathered.unread)
    for name, fault in _unusable(run, result).items():
        changed.setdefault(name, fault)
    if earlier.fault:
        changed[run.manifest_json.name] = earlier.fault
    gone = {*changed, *(path.relative_to(run.path).as_posix() for path in gathered.unread)}
    gathered = dataclasses.replace(
        gathered,
        faults=(*gathered.faults, *(f"{name}: {what}" for name, what in changed.items())),
        was={name: entry for name, entry in earlier.entries.items() if name in gone},
    )
    return _conclude(
        run,
        gathered,
        _evidence(run, gathered, end, expected),
        has_report=has_report,
        progress=progress,
    )


def _unusable(run: RunDirectory, result: Mapping[str, Any] | None) -> dict[str, str]:
    """Return by file why what was planned, and what the host reported, is not known though the file is there."""
    found: dict[str, str] = {}
    plan_fault = fault_of_plan(run.plan_json)
    if plan_fault is not None:
        found[run.plan_json.name] = f"{plan_fault}; what was planned is not known"
    for path in (run.result_json, run.left_result_json) if result is None else ():
        fault = fault_of(path)
        if fault not in (None, MISSING):
            name = path.relative_to(run.path).as_posix()
            found[name] = f"{fault}; what the host reported is not known"
    return found


def _remove_sockets(run: RunDirectory) -> None:
    """Remove the sockets for orders that a killed process of the run left: nobody listens any more."""
    for name in (ORDERS_SOCKET, ACTIONS_SOCKET):
        with contextlib.suppress(OSError):
            if (run.path / name).is_socket():
                (run.path / name).unlink()


def collect_run(
    run: RunDirectory,
    *,
    problems: Sequence[Problem] = (),
    progress: Progress = lambda what, share: None,
    processes: LivingProcesses = list_processes,
    bytes_max: int | None = None,
) -> RunSummary:
    """
    Gather, judge, report and package a run again: finished, cut off, or its host killed.

    Args:
        run: The run.
        problems: What was met while its records were brought here from machines.
        progress: Called with what is being done and how far it is, 0 to 1.
        processes: Tells what lives on this computer.
        bytes_max: The most that files with holes may hold and be read; None for what the plan allows.

    Raises:
        InputError: Processes of the run still live; the message names them.
        RunFailedError: Not even run.json can be written.
    """
    refuse_living(run, processes())
    before = run.read_json(run.run_json) or {}
    result = run.read_json(run.result_json) or run.read_left_result()
    return finish_run(
        run,
        result,
        _expected(run, before, result),
        interrupted=was_interrupted(before),
        problems=(*_problems_before(run, before), *problems),
        progress=progress,
        bytes_max=bytes_max,
    )


def _problems_before(run: RunDirectory, before: Mapping[str, Any]) -> tuple[Problem, ...]:
    """Return what the run itself met; that this is not known any more is a problem, too, and stays one."""
    fault = fault_of(run.run_json)
    if fault in (None, MISSING):
        return problems_of_run(before.get("problems"))
    return (Problem(text=f"run.json {fault}; what the run itself met is not known"),)


def _expected(
    run: RunDirectory, before: Mapping[str, Any], result: Mapping[str, Any] | None
) -> ExpectedRecords:
    """Join what the plan, the result and an earlier collection know: any of them may have been lost."""
    planned, earlier = ExpectedRecords.read(run), Earlier.read(run)
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


@dataclass(frozen=True, slots=True)
class _RunEnd:
    result: Mapping[str, Any] | None
    interrupted: bool
    problems: tuple[Problem, ...]


def _evidence(
    run: RunDirectory, gathered: Gathered, end: _RunEnd, expected: ExpectedRecords
) -> Evidence:
    tables = open_tables(run.tables)
    plan = run.read_json(run.plan_json) or {}
    sources, config = RecordingMachines.read(run), run.read_config()
    expected = dataclasses.replace(expected, devices=expected_devices(plan))
    missing = find_missing(
        expected,
        gathered.scans,
        end.result,
        _unretrieved(sources, end.problems),
        recorded_files(run, plan, end.result),
    )
    causes = recorded_causes(tables.get("late_ticks"))
    ticks = tick_statistics(
        tables.get("ticks"), config.deadline.overrun_ms if config is not None else None
    )
    return Evidence(
        run=run.name,
        started=run.read_json(run.run_json) or {},
        config=config,
        expected=expected,
        result=end.result,
        host_machine=sources.host_machine,
        machine_of_agent=sources.machine_of_agent,
        devices=read_devices(run, plan, end.result),
        interrupted=end.interrupted,
        problems=end.problems,
        scans=gathered.scans,
        ticks=with_told_misses(ticks, {name: of.missed for name, of in causes.items()}),
        recorded_causes=causes,
        round_trip_ms=round_trip_statistics(tables),
        clock=clock_statistics(tables.get("clock")),
        missing=(*missing, *gathered.faults),
        expectations=judge_run(run, tables, planned_expectations(plan), end.result or {}),
        timeline_remarks=timeline_remarks(config, tables),
        undeclared_remarks=undeclared_remarks(declared_streams(plan), gathered.scans),
    )


def _unretrieved(sources: RecordingMachines, problems: Sequence[Problem]) -> dict[str, str]:
    """Return whose records may lie on a machine still, and why: by machine, agent, and the host."""
    why = {p.machine: p.text for p in problems if p.machine and p.step != "run"}
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
    _keep_result(run, evidence.result)
    summary = _write_summary(run, gathered, evidence)
    progress("packing", 0.0)
    if member := first_still_packed(run, gathered.was):
        return dataclasses.replace(summary, is_packed=False, kept_member=member)
    pack = partial(pack_run, run, _start_s(document), without=gathered.unread)
    packed = _attempt(evidence, run.bundle, pack)
    if packed is not evidence:
        summary = _write_summary(run, gathered, packed)
        return dataclasses.replace(summary, is_packed=False)
    return summary


def _keep_result(run: RunDirectory, result: Mapping[str, Any] | None) -> None:
    """Write the host's result if no disk took it before: whoever collects again would take its host for killed."""
    if result is None or run.result_json.exists():
        return
    if len(json.dumps(result, default=str)) > RESERVE_BYTES // 4:  # the verdict needs room, too
        return
    with contextlib.suppress(OSError):
        write_json(run.result_json, result)


def _with_report(run: RunDirectory, evidence: Evidence, document: Mapping[str, Any]) -> Evidence:
    try:
        return _attempt(evidence, run.report_html, lambda: write_report(run, document))
    except Exception as error:  # noqa: BLE001 - a defect of the report must not cost a run its verdict
        text = (
            f"report.html: not written: {type(error).__name__}: {error}; please report this defect"
        )
        return dataclasses.replace(
            evidence, problems=(*evidence.problems, Problem(text=text, step="collect"))
        )


def _attempt(evidence: Evidence, path: Path, write: Callable[[], object]) -> Evidence:
    """Return *evidence*, with one more gap if the file cannot be written."""
    try:
        write()
    except OSError as error:
        return dataclasses.replace(
            evidence,
            missing=(*evidence.missing, f"{path.name}: not written: {error.strerror or error}"),
        )
    return evidence


def _write_summary(run: RunDirectory, gathered: Gathered, evidence: Evidence) -> RunSummary:
    verdict, document = evidence.judged()
    try:
        write_json(run.run_json, document)
        manifest = build_manifest(run, gathered.by_path(), gathered.was, without=gathered.unread)
        write_json(run.manifest_json, manifest)
    except OSError as error:
        cure = "make room and repeat" if error.errno in (errno.ENOSPC, errno.EDQUOT) else "repeat"
        raise RunFailedError(
            f"{run.path}: the summary cannot be written: {error.strerror or error}; the verdict was: "
            f"{verdict.text}; {cure} with: cosmos collect {run.shell_path}"
        ) from error
    return RunSummary(run=run, verdict=verdict, document=document)


def _start_s(document: Mapping[str, Any]) -> int:
    """Return the run's start in seconds since 1970; 0 if it is not known."""
    try:
        return int(datetime.datetime.fromisoformat(str(document["started_utc"])).timestamp())
    except ValueError:
        return 0
