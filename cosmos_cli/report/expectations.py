"""The report's chapter on expectations: what each came to, and its limit drawn in the field's figure."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

from cosmos_cli.evidence.expectations.of_run import planned_expectations
from cosmos_cli.evidence.run_directory import RunDirectory
from cosmos_cli.evidence.verdict import is_number
from cosmos_cli.models.expectation import Expectation, scaled
from cosmos_cli.report.cells import format_measured
from madns_runtime.analysis.lines import grouped_lines
from madns_runtime.analysis.tables import OF_OTHER, RecordedRun, RecordedTable
from madns_runtime.analysis.values import (
    Axis,
    Block,
    Figure,
    Heading,
    LimitLine,
    ReportRemark,
    Section,
    TableBlock,
)
from madns_runtime.conditions.condition import AGENT, HOST, ValueBounds
from madns_runtime.recording.records import Field
from madns_runtime.units import conversion

FIGURES_MAX = 12
AGENTS_DRAWN_MAX = 20
"""Agents of a figure, the one that is told in the result first."""
OF_VALUES = ("each", "last", "max", "min", "mean", "rms", "p99")
"""Statistics whose limit lies on the field's own axis; of others the bounds under `when` do."""
HEADINGS = ("check", "got", "limit", "unit", "", "agent", "at t, s", "expected")
NUMBERS = ("got", "limit", "at t, s")


def expectation_sections(run: RunDirectory, recorded: RecordedRun) -> list[Section]:
    """Return the chapter; none of a run that expected nothing."""
    listed = recorded.document.get("checks")
    results = {
        str(check.get("name")): check
        for check in (listed if isinstance(listed, list) else [])
        if isinstance(check, Mapping) and check.get("expected")
    }
    if not results:
        return []
    table = TableBlock(
        title="What was expected, and what came",
        headings=[Heading(text=text, is_number=text in NUMBERS) for text in HEADINGS],
        rows=[_row(check) for check in results.values()],
        note="Of several agents the one that breaks the limit most, or is nearest to it.",
    )
    expectations = planned_expectations(run.read_json(run.plan_json))
    drawn = list(_figures(expectations, results, recorded))
    return [Section(title="Expectations", blocks=[table, *drawn[:FIGURES_MAX], *_more(drawn)])]


def _more(drawn: Sequence[Block]) -> list[Block]:
    """Return a remark on the figures that are too many to be shown; nothing of fewer."""
    rest = [block.title for block in drawn[FIGURES_MAX:] if isinstance(block, Figure)]
    return [ReportRemark(text=f"Not drawn: {'; '.join(rest)}.")] if rest else []


def _row(check: Mapping[str, Any]) -> list[object]:
    got = check.get("got")
    return [
        check.get("name"),
        format_measured(got if is_number(got) else None, check.get("limit")),
        check.get("limit"),
        check.get("unit") or "",
        "holds" if check.get("passed") is True else "BROKEN",
        check.get("agent") or "",
        check.get("t_s"),
        check.get("expected"),
    ]


def _figures(
    expectations: Sequence[Expectation],
    results: Mapping[str, Mapping[str, Any]],
    recorded: RecordedRun,
) -> Iterator[Block]:
    for each in expectations:
        result, table = results.get(each.name), _table(each, recorded)
        if result is None or table is None or each.event:
            continue
        field = next((known for known in table.fields if known.name == each.field), None)
        if field is not None and field.kind in ("float", "int"):
            yield from _figure(each, result, table, field, recorded)


def _table(expectation: Expectation, recorded: RecordedRun) -> RecordedTable | None:
    is_host = expectation.is_of_host or expectation.agents == (HOST,)
    before = (f"{HOST}_",) if is_host else ("", "machine_", "device_")
    found = (recorded.tables.get(f"{each}{expectation.stream}") for each in before)
    return next((table for table in found if table is not None), None)


def _figure(
    expectation: Expectation,
    result: Mapping[str, Any],
    table: RecordedTable,
    field: Field,
    recorded: RecordedRun,
) -> list[Block]:
    series, x = recorded.series(table, field.name)
    worst = str(result.get(AGENT))
    names = expectation.agents or table.sources
    named = list(
        dict.fromkeys(key for name in (worst, *names) for key in _lines_of(name, series, table))
    )
    few = f"The first {AGENTS_DRAWN_MAX} of {len(named)}, the one that is told before the others."
    return grouped_lines(
        {name: series[name] for name in named[:AGENTS_DRAWN_MAX]},
        title=f"{expectation.name}: {expectation.words}",
        x=x,
        y=Axis(unit=field.unit),
        note=few if len(named) > AGENTS_DRAWN_MAX else "",
        limits=_limits(expectation, field.unit),
        returns=recorded.series_returns(table, series),
    )


def _lines_of(name: str, series: Iterable[str], table: RecordedTable) -> list[str]:
    """Return the lines of one who is judged: its own, or one for each other that its records are about."""
    if name == table.role == HOST:
        return list(series)
    return [key for key in series if key == name or key.startswith(f"{name}{OF_OTHER}")]


def _limits(expectation: Expectation, unit: str) -> list[LimitLine]:
    is_value = expectation.statistic in OF_VALUES
    bounds: ValueBounds | None = expectation.bounds if is_value else expectation.when
    factor = conversion(expectation.unit, unit) if expectation.unit else 1.0
    if bounds is None or factor is None:
        return []
    bounds = scaled(bounds, factor)
    found = []
    if bounds.high is not None:
        found.append(LimitLine(value=bounds.high, name=expectation.name))
    if bounds.low is not None:
        found.append(LimitLine(value=bounds.low, name=expectation.name, is_least=True))
    return found
