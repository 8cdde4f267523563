"""
A table of what the host recorded in a form of its own, made through the simulation's descriptor.

The simulation says how its records are read; here rows become a Parquet file like a run's other tables. Code of a
simulation that is not shipped runs, and its rows are written, in a process of its own with a deadline: it may hang, print
or end the process.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import wraps
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from cosmos_cli.collect.unread_files import find_unread
from cosmos_cli.errors import InputError
from cosmos_cli.evidence.run_directory import RunDirectory
from cosmos_cli.evidence.streams import RecordFile
from cosmos_cli.evidence.table_labels import TableLabels
from cosmos_cli.evidence.table_layout import TableLayout
from cosmos_cli.evidence.tables import TableWriter
from cosmos_cli.models.separate_process import SeparateDefect, SeparateFailure, work_separately
from madns_runtime import errors as runtime_errors
from madns_runtime.analysis.field_checks import real_array
from madns_runtime.config import RunConfig
from madns_runtime.errors import MadnsError, MissingExtraError, PluginError
from madns_runtime.partial_file import check_replaceable, remove_partial
from madns_runtime.plain_values import first_few, shown
from madns_runtime.plugin.api import Tabulated
from madns_runtime.plugin.code_places import place_of
from madns_runtime.plugin.descriptor_faults import COLUMNS_OF_TABLES
from madns_runtime.plugin.isolation import call_plugin
from madns_runtime.plugin.registry import is_shipped, load_function, resolve
from madns_runtime.recording.records import Field, StreamSchema
from madns_runtime.recording.stream_rules import check_schema

NAME = "truth"
TIME = Field("t_s", "s")
ROWS_OF_AGENT_MAX = 20_000_000
"""Times at which one agent may be tabulated: 55 hours at 100 Hz."""

NAMES_MAX = 10
"""Agents that are named in a message."""

TABULATING = "tabulating "
"""Begin of a stage's name; the agent's follows."""

Times = NDArray[np.float64]
Progress = Callable[[str, float], None]
Layout = Callable[[tuple[Field, ...]], TableLayout]


@dataclass(frozen=True, slots=True, kw_only=True)
class Written:
    """Account of a table that was written."""

    rows: int
    gaps: dict[str, int]
    """Agents of which nothing is on record at some of the times, and at how many."""


def times_of(config: RunConfig, ran_s: float | None, rate_hz: float) -> Times:
    """
    Return the times of a run at a rate, from simulated time zero on.

    Args:
        config: The run's.
        ran_s: How long it ran, s; None if that is not known.
        rate_hz: Times in a second.

    Raises:
        InputError: They are too many.
    """
    duration_s = config.time.duration_s if ran_s is None else min(config.time.duration_s, ran_s)
    last = duration_s * rate_hz + 1e-6
    if last >= ROWS_OF_AGENT_MAX:
        raise InputError(
            f"--rate-hz {rate_hz:g}: {math.floor(last) + 1 if last < math.inf else last} times of each agent are"
            f" more than {ROWS_OF_AGENT_MAX}; take a lower rate"
        )
    count = int(last) + 1
    # As a tick's time is made of its number, so that both have the same digits.
    return np.arange(count) / rate_hz


@dataclass(frozen=True, slots=True, kw_only=True)
class Wanted:
    """A table that is to be written: of which agents, at which times, where, and how its fields become columns."""

    agents: tuple[str, ...]
    times_s: Times
    path: Path
    layout: Layout


def write_host_table(
    run: RunDirectory, config: RunConfig, wanted: Wanted, progress: Progress
) -> Written:
    """
    Write a table of what the host recorded of agents, in a form of its simulation's own.

    Raises:
        InputError: The simulation records nothing of the kind, or in a file that is not read; or the table cannot be
            written.
        MachineError: The record cannot be read.
        PluginError: The simulation's `tabulate` does not keep its contract, ended its process or came to no end.
        MissingExtraError: It needs an optional dependency that is not installed.
    """
    if is_shipped(config.simulation):
        return _write_here(run, config, wanted, progress)

    def work(tell: Callable[[str], None]) -> Mapping[str, Any]:
        tell(f"importing {config.simulation}")
        try:
            written = _write_here(run, config, wanted, lambda _what, _share: None, tell)
        except MissingExtraError as error:
            return {"missing": error.given}
        except (InputError, MadnsError) as error:
            return {"raised": [type(error).__name__, str(error)]}
        return {"written": [written.rows, written.gaps]}

    told: dict[str, None] = {}

    def hear(stage: str) -> None:
        if stage.startswith(TABULATING) and stage not in told:
            progress(stage, min(len(told) / len(wanted.agents), 1.0))
            told[stage] = None

    try:
        answer = work_separately(work, limit_s=config.timeouts.loading_s, hear=hear)
    except SeparateFailure as error:
        raise PluginError(str(error)) from None
    except SeparateDefect as defect:
        raise RuntimeError(str(defect)) from None
    finally:
        remove_partial(wanted.path)  # of a process that was killed
    if "missing" in answer:
        raise MissingExtraError(*answer["missing"])
    if "raised" in answer:
        name, text = answer["raised"]
        raise getattr(runtime_errors, name, InputError)(text)
    rows, gaps = answer["written"]
    return Written(rows=rows, gaps=gaps)


def _write_here(
    run: RunDirectory,
    config: RunConfig,
    wanted: Wanted,
    progress: Progress,
    tell: Callable[[str], None] = lambda stage: None,
) -> Written:
    """Write the table in this process; *tell* hears of every part, and of which agent it is."""
    parts = tabulated(run, config, wanted.agents, wanted.times_s)

    def telling() -> Iterator[Tabulated]:
        tell(f"tabulate() of {config.simulation}")
        for part in parts:
            tell(f"{TABULATING}{part.agent}")
            yield part

    return write_table(
        telling(), wanted.layout, wanted.path, agents=len(wanted.agents), progress=progress
    )


def tabulated(
    run: RunDirectory, config: RunConfig, agents: tuple[str, ...], times_s: Times
) -> Iterator[Tabulated]:
    """
    Return the rows of *agents*, part by part, for `write_table`.

    Raises:
        InputError: The simulation records nothing of the kind, or in a file that is not read.
        MachineError: The record cannot be read; raised, as the next, while parts are taken.
        PluginError: The simulation's `tabulate` does not keep its contract.
    """
    base = Path(config.base_directory)
    where = resolve(config.simulation, base).tabulate
    if where is None:
        raise InputError(f"{config.simulation}: its host records nothing that could be tabulated")
    for path, why in find_unread(run).items():
        if path.parent == run.path / "host":
            raise InputError(f"{path}: {why}")
    return _parts(load_function(where, base), run.path / "host", agents, times_s)


def write_table(
    parts: Iterator[Tabulated], layout: Layout, path: Path, *, agents: int, progress: Progress
) -> Written:
    """
    Write a table of the rows of so many agents, laid out by *layout*.

    Raises:
        InputError: It cannot be written.
    """
    try:
        check_replaceable(path)
        return _write(parts, layout, path, agents=agents, progress=progress)
    except (OSError, pa.ArrowException) as error:
        why = getattr(error, "strerror", None) or error
        raise InputError(f"{path}: cannot be written: {why}") from error


def _parts(
    function: Callable[..., Any], folder: Path, agents: tuple[str, ...], times_s: Times
) -> Iterator[Tabulated]:
    """Yield what the simulation tabulates, part by part: its faults are told as its own."""
    parts = call_plugin("tabulate", function, folder, agents, times_s, finish=iter)
    told: dict[str, int] = {}
    fields: tuple[Field, ...] | None = None

    def judge(part: Any) -> Tabulated | None:
        fault = _missing(told, agents, times_s)
        if part is not None:
            fault = _fault_of(part, fields, agents) or _fault_of_times(part, told, times_s)
        if fault:
            raise PluginError(f"{place_of(function)}: tabulate() {fault}")
        return None if part is None else _as_floats(part)

    @wraps(function)  # whose file and line are told
    def advance() -> object:
        return next(parts, None)

    while (part := call_plugin("tabulate", advance, finish=judge)) is not None:
        fields = part.fields
        told[part.agent] = told.get(part.agent, 0) + len(part.times_s)
        yield part


def _missing(told: Mapping[str, int], agents: tuple[str, ...], times_s: Times) -> str | None:
    """Return whose rows are not there, or not all; *told* has how many there are."""
    if missing := [agent for agent in agents if agent not in told]:
        return f"yielded no rows of {first_few(missing, NAMES_MAX)}"
    if short := [agent for agent in agents if told[agent] < len(times_s)]:
        return (
            f"must yield a row for each of {len(times_s)} times, with NaN where nothing is on record;"
            f" yielded {told[short[0]]} of {first_few(short, NAMES_MAX)}"
        )
    return None


def _fault_of_times(part: Tabulated, told: Mapping[str, int], times_s: Times) -> str | None:
    first = told.get(part.agent, 0)
    if np.array_equal(part.times_s, times_s[first : first + len(part.times_s)]):
        return None
    return (
        f"must yield rows at the times that it is asked for, in their order; of {part.agent} row"
        f" {first} is wanted for {times_s[first]:g} s"
        if first < len(times_s)
        else f"yielded more rows of {part.agent} than the {len(times_s)} times that it is asked for"
    )


def _fault_of(part: Any, fields: tuple[Field, ...] | None, agents: tuple[str, ...]) -> str | None:
    if not isinstance(part, Tabulated):
        return f"must yield madns_runtime.plugin.api.Tabulated, got {shown(part)}"
    if part.agent not in agents:
        return (
            f"must yield rows of the agents that it is asked for, got those of {shown(part.agent)}"
        )
    if fields is not None and part.fields != fields:
        return f"must yield the same fields for every agent, got others for {part.agent}"
    # Whether numbers were rounded for a stream of the host's is nothing to a table.
    stated: Any = part.fields
    plain = (replace(f, digits=None) if isinstance(f, Field) else f for f in stated)
    try:
        check_schema(StreamSchema(NAME, (TIME, *plain)))
    except PluginError as error:
        return f"must give fields that a table can hold: {error}"
    names = [field.name for field in part.fields]
    if taken := [name for name in names if name in COLUMNS_OF_TABLES]:
        return f"must call no field {taken[0]}, as a column of tables is"
    rows = {np.shape(part.columns[name]) for name in names if name in part.columns}
    if set(part.columns) != set(names) or rows != {(len(part.times_s),)}:
        return f"must yield a value a time of each of {', '.join(names)}, for {part.agent}"
    return None


def _as_floats(part: Any) -> Tabulated:
    """Return rows with every column as floats, as their simulation should give them."""
    rows: Tabulated = replace(
        part,
        times_s=real_array(part.times_s, "times_s"),
        columns={name: real_array(column, name) for name, column in part.columns.items()},
    )
    return rows


def _write(
    parts: Iterator[Tabulated], layout: Layout, path: Path, *, agents: int, progress: Progress
) -> Written:
    writer: TableWriter | None = None
    file: RecordFile | None = None
    gaps: dict[str, int] = {}
    done = 0
    try:
        for part in parts:
            if writer is None:
                writer = TableWriter(path, layout(part.fields))
            if file is None or file.source != part.agent:
                done += file is not None
                progress(f"{TABULATING}{part.agent}", min(done / agents, 1.0))
                if file is not None:
                    writer.end_file(file)
                file = _source(part, path)
            writer.add(file, {TIME.name: part.times_s, **part.columns}, len(part.times_s))
            absent = int(np.isnan(part.columns[part.fields[0].name]).sum())
            if absent:
                gaps[part.agent] = gaps.get(part.agent, 0) + absent
        if writer is None or file is None:
            raise InputError("nothing to tabulate: no agent was chosen")
        writer.end_file(file)
        writer.close()
    except BaseException:
        if writer is not None:
            writer.abandon()
        raise
    return Written(rows=writer.rows, gaps=gaps)


def layout_with(labels: TableLabels) -> Layout:
    """Return how the fields that a simulation tabulates become columns, with *labels* beside them."""
    return lambda fields: TableLayout(
        name=NAME,
        role="agent",
        source_column="agent",
        fields=(TIME, *fields),
        tick_hz=None,
        labels=labels,
        units={},
    )


def _source(part: Tabulated, path: Path) -> RecordFile:
    """Return an agent's rows as the table's writer knows them: as if the agent had a stream of them."""
    return RecordFile(
        path=path,
        role="agent",
        source=part.agent,
        stream=NAME,
        incarnation=1,
        fields=(TIME, *part.fields),
    )
