"""The expectations of a run: kept in its plan, judged over its tables."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Literal

from cosmos_cli.errors import InputError
from cosmos_cli.evidence.expectations.judge import JudgedExpectations, judge_expectations
from cosmos_cli.evidence.remarks import declared_streams
from cosmos_cli.evidence.run_directory import RunDirectory
from cosmos_cli.evidence.run_documents import EXPECTATIONS
from cosmos_cli.evidence.table_labels import run_labels
from cosmos_cli.models.checks import Surroundings, resolve_checks
from cosmos_cli.models.expectation import Expectation
from cosmos_cli.models.known_streams import KnownDevice, KnownStreams
from cosmos_cli.models.loading import ScenarioFile
from madns_runtime.analysis.tables import RecordedRun, Tables
from madns_runtime.conditions.condition import AGENT, HOST
from madns_runtime.config import from_mapping
from madns_runtime.errors import ConfigurationError
from madns_runtime.plugin.api import DeclaredStream
from madns_runtime.recording.records import FRAMEWORK_STREAMS, Field


def planned_expectations(plan: Mapping[str, Any] | None) -> tuple[Expectation, ...]:
    """Return what a run's plan expects of it; what cannot be read is left out, as the plan's own fault is told."""
    listed = (plan or {}).get(EXPECTATIONS)
    found = []
    for item in listed if isinstance(listed, list) else ():
        try:
            found.append(from_mapping(Expectation, item))
        except ConfigurationError:
            continue
    return tuple(found)


def judge_run(
    run: RunDirectory,
    tables: Tables,
    expectations: Sequence[Expectation],
    told: Mapping[str, Any],
) -> JudgedExpectations:
    """
    Judge expectations over a gathered run's tables; none where its settings are lost.

    Args:
        run: The run.
        tables: Its own.
        expectations: What is judged.
        told: Its `status`, and `duration_s`, which a stop shortens, as its host or run.json tells them.
    """
    config = run.read_config()
    if config is None or not expectations:
        return JudgedExpectations()
    recorded = RecordedRun(document=told, tables=tables, config=config)
    return judge_expectations(
        expectations,
        tables,
        agents=config.agents.resolved_names(),
        is_lockstep=config.time.is_lockstep,
        duration_s=_had_s(recorded, config.agents.tick_hz),
    )


def _had_s(recorded: RecordedRun, tick_hz: float) -> float:
    """Return the simulated time that a run had, s: of one that ended early each tick that was begun stands for its period."""
    if recorded.document.get("status") == "complete":
        return recorded.duration_s
    begun = math.floor(max(recorded.end_s, 0.0) * tick_hz) + 1
    return min(begun / tick_hz, recorded.duration_s)


def recorded_devices(tables: Tables) -> tuple[KnownDevice, ...]:
    """Return the devices whose records a run has, by their tables, each with its own units."""
    found: dict[tuple[str, str], dict[str, tuple[Field, ...]]] = {}
    for table in tables.values():
        if table.role == "device":
            device, _, channel = table.name.removeprefix("device_").rpartition(".")
            for source in table.sources or ("",):
                found.setdefault((device, source), {})[channel] = tuple(
                    replace(each, unit=table.unit(source, each.name)) for each in table.fields
                )
    return tuple(
        KnownDevice(name=device, sources=(source,) if source else (), streams=streams)
        for (device, source), streams in found.items()
    )


def recorded_streams(tables: Tables) -> tuple[DeclaredStream, ...]:
    """Return the streams of a simulation that declares none, by what it recorded."""
    found = []
    for table in tables.values():
        name = table.name.removeprefix(f"{HOST}_") if table.role == HOST else table.name
        if table.role in (HOST, AGENT) and name not in FRAMEWORK_STREAMS:
            role: Literal["host", "agent"] = "host" if table.role == HOST else "agent"
            found.append(DeclaredStream(role=role, name=name, fields=table.fields))
    return tuple(found)


def expectations_for(
    run: RunDirectory, scenario: ScenarioFile, tables: Tables
) -> tuple[Expectation, ...]:
    """
    Return what the checks of a scenario file expect of a run, of its agents and streams.

    Args:
        run: A gathered run.
        tables: Of it.
        scenario: The file, which may be of another run or simulation.

    Raises:
        InputError: The file has no checks, or they name what the run does not have; every fault with its place.
    """
    config = run.read_config()
    if config is None:
        raise InputError(f"{run.plan_json}: not to be read: what {run.name} simulated is not known")
    if not scenario.scenario.checks:
        raise InputError(f"{scenario.path}: has no checks: nothing can be judged by it")
    declared = declared_streams(run.read_json(run.plan_json))
    streams = recorded_streams(tables) if declared is None else declared.every()
    around = Surroundings(
        agents=config.agents.resolved_names(),
        labels=run_labels(run),
        streams=KnownStreams(streams, recorded_devices(tables)),
        duration_s=config.time.duration_s,
    )
    resolved = resolve_checks(scenario.scenario.checks, around)
    if resolved.faults:
        told = [
            scenario.fault(("checks", *where), f"{text} (of {run.name})")
            for where, text in resolved.faults
        ]
        raise InputError(faults=told)
    return resolved.expectations
