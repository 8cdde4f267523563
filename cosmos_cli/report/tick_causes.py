"""Figures of why ticks were missed or late: by agent, over time, and with what can be done about it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from cosmos_cli.evidence.datagrams import whole_count
from cosmos_cli.evidence.tick_causes import TOLD_CAUSES, WORDS, recorded_causes
from cosmos_cli.report.timing import reached_s
from madns_runtime.analysis.tables import RecordedRun, RecordedTable
from madns_runtime.analysis.values import (
    Axis,
    Bars,
    Block,
    Figure,
    FigureChoice,
    Floats,
    Heading,
    Histogram,
    TableBlock,
    Tone,
    headings,
)
from madns_runtime.plain_values import mapping_at

TIME_BINS = 60
DRAWN_CAUSES_MAX = 4
"""More are drawn together: a figure has five colours that stay apart."""
OTHERS = "others"
AGENTS_DRAWN_MAX = 200

Counts = Mapping[str, int]
"""Ticks by cause."""


def cause_blocks(table: RecordedTable, run: RecordedRun) -> list[Block]:
    """Return the causes of missed and late ticks with their cures, by agent, and over time."""
    agents = _by_agent(table, run)
    if not agents:
        return []
    totals = {cause: sum(of.get(cause, 0) for of in agents.values()) for cause in TOLD_CAUSES}
    causes = sorted((cause for cause in TOLD_CAUSES if totals[cause]), key=lambda c: -totals[c])
    drawn = causes if len(causes) <= DRAWN_CAUSES_MAX + 1 else causes[:DRAWN_CAUSES_MAX]
    return [
        _cure_table(causes, totals),
        *_over_time(table, run, drawn),
        _agent_figure(agents, drawn),
        _agent_table(agents, causes),
    ]


def _by_agent(table: RecordedTable, run: RecordedRun) -> dict[str, Counts]:
    """Return what run.json tells of each agent; it knows more than the records, such as the last ticks of a run."""
    told = mapping_at(run.document, "timing", "causes_by_agent")
    if told:
        return {
            name: {cause: whole_count(n) for cause, n in mapping_at(told, name).items()}
            for name in told
        }
    return {name: of.causes for name, of in recorded_causes(table).items()}


def _cure_table(causes: Sequence[str], totals: Counts) -> TableBlock:
    total = sum(totals.values())
    return TableBlock(
        title="Causes and cures",
        headings=(
            Heading(text="cause", is_number=False),
            Heading(text="ticks"),
            Heading(text="share, %"),
            Heading(text="what it was", is_number=False),
            Heading(text="what can be done", is_number=False),
        ),
        rows=[
            [
                cause,
                totals[cause],
                100 * totals[cause] / total,
                WORDS[cause].meaning,
                WORDS[cause].cure,
            ]
            for cause in causes
        ],
        note="One cause each; missed ticks and the late one that follows them have one together and count as the"
        " missed ones.",
    )


def _over_time(table: RecordedTable, run: RecordedRun, drawn: Sequence[str]) -> Iterator[Figure]:
    columns = {name: table.read(name, ("missed", "cause")) for name in table.sources}
    times = {name: run.time_of(table, name)[0] for name in table.sources}
    end_s = max((float(t_s.max()) for t_s in times.values() if t_s.size), default=0.0)
    edges = np.linspace(0.0, max(end_s, reached_s(run), 1e-9), TIME_BINS + 1)
    counts: dict[str, Floats] = {cause: np.zeros(TIME_BINS) for cause in (*drawn, OTHERS)}
    for name, of in columns.items():
        causes = of["cause"].astype(str)
        ticks = np.maximum(np.nan_to_num(run.values(table, name, "missed")), 1.0)
        others = ~np.isin(causes, drawn)
        for cause in counts:
            chosen = others if cause == OTHERS else causes == cause
            counts[cause] += np.histogram(times[name][chosen], edges, weights=ticks[chosen])[0]
    marks = [
        Histogram(edges=edges, counts=values, name=cause, tone=_tone(cause))
        for cause, values in counts.items()
        if values.any()
    ]
    if marks:
        yield Figure(
            title="Missed and late ticks over time, by cause",
            note="Of all agents together.",
            y=Axis(quantity="ticks", from_zero=True),
            choices=[FigureChoice(marks=marks)],
        )


def _agent_figure(agents: Mapping[str, Counts], drawn: Sequence[str]) -> Figure:
    names = list(agents)
    note = ""
    if len(names) > AGENTS_DRAWN_MAX:
        worst = sorted(names, key=lambda name: -sum(agents[name].values()))[:AGENTS_DRAWN_MAX]
        note = f"The {AGENTS_DRAWN_MAX} agents with the most of {len(names)}; the table has all."
        names = [name for name in names if name in set(worst)]
    heights = {cause: [agents[name].get(cause, 0) for name in names] for cause in drawn}
    heights[OTHERS] = [
        sum(count for cause, count in agents[name].items() if cause not in drawn) for name in names
    ]
    return Figure(
        title="Missed and late ticks by agent and cause",
        note=note,
        x=Axis(),
        y=Axis(quantity="ticks", from_zero=True),
        choices=[
            FigureChoice(
                marks=[
                    Bars(names=names, values=values, name=cause, tone=_tone(cause))
                    for cause, values in heights.items()
                    if any(values)
                ]
            )
        ],
    )


def _tone(cause: str) -> Tone:
    return "muted" if cause == OTHERS else "palette"


def _agent_table(agents: Mapping[str, Counts], causes: Sequence[str]) -> TableBlock:
    return TableBlock(
        title="Missed and late ticks by agent",
        headings=headings("agent", "all", *causes),
        rows=[
            [name, sum(of.values()), *(of.get(cause, 0) for cause in causes)]
            for name, of in agents.items()
        ],
    )
