"""Figures of a run by the names of a baseline, and their comparison with what is expected."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Any, cast

import numpy as np

from cosmos_cli.errors import InputError
from cosmos_cli.evidence.run_directory import RunDirectory
from cosmos_cli.evidence.table_labels import run_labels
from cosmos_cli.evidence.tables import TableReader, open_tables
from cosmos_cli.models.agent_labels import AgentLabels
from cosmos_cli.models.baseline import Baseline, BaselineFigure
from cosmos_cli.testing.check_lines import shown
from madns_runtime.analysis.distribution import Distribution
from madns_runtime.analysis.sampling import as_array
from madns_runtime.conditions.condition import HOST, ValueBounds
from madns_runtime.plain_values import is_real

ROWS_MAX = 200_000
"""Records that are read at a time."""

FigureValue = float | bool | str | None


@dataclass(frozen=True, slots=True, kw_only=True)
class ComparedFigure:
    """One figure of a baseline beside what came."""

    name: str
    expected: FigureValue
    got: FigureValue
    why_none: str = ""
    """Why nothing came."""
    allowed: float = 0.0
    """Largest difference that passes."""

    @property
    def passed(self) -> bool:
        """Whether what came is what is expected, within the tolerance; texts and truth values are the same or not."""
        if self.expected is None or self.got is None:
            return False
        if is_real(self.expected) and is_real(self.got):
            return ValueBounds.equals(self.expected, self.allowed).holds(self.got)
        return type(self.expected) is type(self.got) and self.expected == self.got

    def reason(self) -> str:
        """Return why it does not pass."""
        if self.expected is None and self.got is None and self.why_none:
            return f"{self.name}: {self.why_none}"
        if self.expected is None:
            return (
                f"{self.name}: has no expected value: write it with cosmos test --update-baselines"
            )
        within = f" within {self.allowed:.10g}" if self.allowed else ""
        expected, got = shown(self.expected), shown(self.got)
        if expected == got:  # they differ in later digits, or one is a text
            expected, got = _exactly(self.expected), _exactly(self.got)
        told = f"{self.name}: expected {expected}{within}, got {got}"
        return f"{told}: {self.why_none}" if self.why_none else told

    def to_mapping(self) -> dict[str, Any]:
        """Return plain values for --json."""
        return {
            "name": self.name,
            "expected": self.expected,
            "allowed": self.allowed,
            "got": self.got,
            "passed": self.passed,
        }


def compare_figures(
    baseline: Baseline, run: RunDirectory, document: Mapping[str, Any]
) -> list[ComparedFigure]:
    """
    Return every figure of a baseline beside a run's.

    Args:
        baseline: The figures.
        run: The run, its tables written.
        document: Its run.json.
    """
    tables = open_tables(run.tables)
    labels, config = run_labels(run), run.read_config()
    names = () if config is None else (HOST, *config.agents.resolved_names())
    compared = []
    for name, figure in baseline.figures.items():
        got, why_none = (
            _at_path(document, figure) if figure.path else _of_stream(figure, tables, labels, names)
        )
        expected = figure.expected
        share = figure.relative * abs(expected) if is_real(expected) else 0.0
        compared.append(
            ComparedFigure(
                name=name,
                expected=expected,
                got=got,
                why_none=why_none,
                allowed=max(figure.tolerance, share),
            )
        )
    return compared


def _exactly(value: FigureValue) -> str:
    """Return a value in words that no other has: a number in all its digits, a text in quotes."""
    return str(value) if is_real(value) else repr(value) if isinstance(value, str) else shown(value)


def _at_path(document: Mapping[str, Any], figure: BaselineFigure) -> tuple[FigureValue, str]:
    path, value = figure.path, cast("Any", document)
    for step in figure.path_steps:
        if isinstance(value, list) and step.isdecimal() and int(step) < len(value):
            value = value[int(step)]
        elif isinstance(value, Mapping) and step in value:
            value = value[step]
        else:
            return None, f"run.json has no {path}: there is no {step}"
    if isinstance(value, bool | str | int | float):
        return value, ""
    return None, f"run.json has no single value at {path}"


def _of_stream(
    figure: BaselineFigure,
    tables: Mapping[str, TableReader],
    labels: AgentLabels,
    agents: Sequence[str],
) -> tuple[FigureValue, str]:
    table = tables.get(figure.stream)
    if table is None:
        return None, f"no stream {figure.stream}; there are {', '.join(tables) or 'none'}"
    known = [field.name for field in table.fields]
    if figure.field not in known:
        return None, f"no field {figure.field} in {figure.stream}; there are {', '.join(known)}"
    meant = {*figure.agents, *labels.labelled(figure.agents)}
    everybody = (*agents, *table.sources)
    nobody = [one for one in figure.agents if not _named(everybody, {one, *labels.labelled([one])})]
    if nobody:
        return None, f"no agent is named {', '.join(nobody)}"
    sources = _named(table.sources, meant)
    if not sources and not (figure.statistic == "count" and _named(agents, meant)):
        return None, f"nobody of {', '.join(figure.agents)} recorded {figure.stream}"
    try:
        return _statistic(figure, table, sources)
    except InputError as error:  # its table is damaged: the other tests go on
        return None, str(error)


def _named(names: Iterable[str], patterns: Collection[str]) -> list[str]:
    return [name for name in names if any(fnmatchcase(name, pattern) for pattern in patterns)]


def _statistic(
    figure: BaselineFigure, table: TableReader, sources: list[str]
) -> tuple[FigureValue, str]:
    if figure.statistic == "count":
        return _count(figure.field, table, sources), ""
    samples = Distribution()
    newest: list[float] = []
    for source in sources:
        last = math.nan
        for columns in table.batches(source, (figure.field,), ROWS_MAX):
            values = as_array(columns[figure.field])
            samples.add(Distribution.of(values))
            there = values[~np.isnan(values)]
            last = float(there[-1]) if len(there) else last
        newest.append(last)
    summary = samples.summary()
    if summary is None:
        return None, "no value of it is a number"
    if figure.statistic == "last":
        finite = [value for value in newest if math.isfinite(value)]
        return (max(finite), "") if finite else (None, "no last value is a number")
    if figure.statistic == "rms":
        got = math.hypot(summary.mean, summary.sd)
    else:
        got = getattr(summary, figure.statistic or "mean")
    if not math.isfinite(got):
        return None, f"its values are so large, up to {summary.max:g}, that it is not finite"
    return got, ""


def _count(field: str, table: TableReader, sources: list[str]) -> int:
    """Return how many records have a value of a field, a number or not."""
    count = 0
    for source in sources:
        for columns in table.batches(source, (field,), ROWS_MAX):
            values = columns[field]
            if values.dtype == object:
                count += sum(each is not None for each in values.tolist())
            else:
                count += int(np.count_nonzero(~np.isnan(values.astype(np.float64))))
    return count
