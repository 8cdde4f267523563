"""Figures of radio: what became of messages, over time and by sender."""

from __future__ import annotations

from collections import Counter

import numpy as np

from madns_runtime.analysis.lines import GROUP_SIZE, generic_blocks
from madns_runtime.analysis.sampling import as_array
from madns_runtime.analysis.tables import Columns, RecordedRun, RecordedTable
from madns_runtime.analysis.values import (
    Axis,
    Block,
    Figure,
    FigureChoice,
    Histogram,
    ReportRemark,
    TableBlock,
    headings,
)

FIELDS = ("sent_s", "sender", "outcome", "arrives_s", "distance_m")
CONTACT_FIELDS = ("event", "agent", "station", "rise_s", "set_s", "elevation_deg_max")
DELIVERED = "delivered"
BINS = 60
ROWS_READ_MAX = 65_536
SENDERS_SHOWN_MAX = 100


class _Counts:
    """Messages by outcome, over time and by sender; delays and distances of those that arrived."""

    def __init__(self, duration_s: float) -> None:
        self.edges_s = np.linspace(0.0, max(duration_s, 1e-9), BINS + 1)
        self.over_time: dict[str, np.ndarray] = {}
        self.by_sender: dict[str, Counter[str]] = {}
        self.delay_s_max = 0.0
        self.distance_m_max = 0.0

    def add(self, columns: Columns) -> None:
        sent_s, outcomes = as_array(columns["sent_s"]), columns["outcome"].astype(str)
        bins = np.clip(np.searchsorted(self.edges_s, sent_s, "right") - 1, 0, BINS - 1)
        for outcome in np.unique(outcomes).tolist():
            counts = np.bincount(bins[outcomes == outcome], minlength=BINS)
            self.over_time[outcome] = self.over_time.get(outcome, np.zeros(BINS, int)) + counts
        pairs = Counter(zip(columns["sender"].tolist(), outcomes.tolist(), strict=True))
        for (sender, outcome), count in pairs.items():
            self.by_sender.setdefault(str(sender), Counter())[outcome] += count
        is_delivered = outcomes == DELIVERED
        delay_s = (as_array(columns["arrives_s"]) - sent_s)[is_delivered]
        distance_m = as_array(columns["distance_m"])[is_delivered]
        self.delay_s_max = max(self.delay_s_max, float(np.nanmax(delay_s, initial=0.0)))
        self.distance_m_max = max(self.distance_m_max, float(np.nanmax(distance_m, initial=0.0)))

    def outcomes(self) -> list[str]:
        """Return what became of messages: delivered first, then the commonest."""
        totals = {name: int(counts.sum()) for name, counts in self.over_time.items()}
        return sorted(totals, key=lambda name: (name != DELIVERED, -totals[name], name))


def link_blocks(table: RecordedTable, run: RecordedRun) -> list[Block]:
    """Return messages by outcome over time, and the counts of each sender."""
    if not table.has(*FIELDS):
        return generic_blocks(table, run)
    if not table.rows:
        return [ReportRemark(text="No message was sent.")]
    duration_s = run.document.get("duration_s")
    counts = _Counts(float(duration_s) if isinstance(duration_s, int | float) else 1.0)
    for columns in table.batches("host", FIELDS, ROWS_READ_MAX):
        counts.add(columns)
    return [_over_time(counts), _table(counts)]


def message_blocks(table: RecordedTable, run: RecordedRun) -> list[Block]:
    """Return nothing where the host's account of links is drawn: it tells the same and more."""
    return [] if "host_links" in run.tables else generic_blocks(table, run)


def refusal_blocks(table: RecordedTable, run: RecordedRun) -> list[Block]:
    """Return how many messages each vehicle was refused, and why."""
    if not table.has("reason"):
        return generic_blocks(table, run)
    counts = {
        agent: Counter(columns["reason"].astype(str).tolist())
        for agent, columns in table.each(("reason",))
    }
    reasons = sorted({reason for found in counts.values() for reason in found})
    rows: list[list[object]] = [
        [agent, sum(found.values()), *(found[reason] for reason in reasons)]
        for agent, found in counts.items()
    ]
    names = (reason.replace("_", " ") for reason in reasons)
    return [
        TableBlock(
            title="Refused messages, as told to their senders",
            headings=headings("sender", "refused", *names),
            rows=rows,
        )
    ]


def contact_blocks(table: RecordedTable, run: RecordedRun) -> list[Block]:
    """Return the passes over each ground station; nothing for a run without stations."""
    if not table.has(*CONTACT_FIELDS):
        return generic_blocks(table, run)
    if not table.rows:
        return []
    columns = table.read("host", CONTACT_FIELDS)
    is_over = columns["event"].astype(str) == "set"
    stations, agents = columns["station"].astype(str), columns["agent"].astype(str)
    lasted_s = as_array(columns["set_s"]) - as_array(columns["rise_s"])
    height_deg = as_array(columns["elevation_deg_max"])
    rows: list[list[object]] = []
    for station in sorted(set(stations.tolist())):
        passes = np.flatnonzero(is_over & (stations == station))
        begun = int(((stations == station) & ~is_over).sum())
        seen = len(set(agents[stations == station].tolist()))
        ends: list[float | None] = [None, None, None]
        if len(passes):
            of_them = lasted_s[passes]
            ends = [float(of_them.mean()), float(of_them.max()), float(height_deg[passes].max())]
        rows.append([station, begun, len(passes), seen, *ends])
    return [
        TableBlock(
            title="Passes over ground stations",
            headings=headings(
                "station",
                "begun",
                "ended",
                "vehicles",
                "mean duration, s",
                "longest, s",
                "highest elevation, deg",
            ),
            rows=rows,
        )
    ]


def _over_time(counts: _Counts) -> Figure:
    marks = [
        Histogram(
            edges=counts.edges_s,
            counts=counts.over_time[outcome],
            name=outcome.replace("_", " "),
            tone="palette" if index < GROUP_SIZE else "muted",
        )
        for index, outcome in enumerate(counts.outcomes())
    ]
    width_s = counts.edges_s[1] - counts.edges_s[0]
    return Figure(
        title="Messages by outcome",
        note="Every message to every receiver.",
        x=Axis(quantity="sent at simulated time", unit="s"),
        y=Axis(quantity=f"messages in {width_s:g} s"),
        choices=[FigureChoice(marks=marks)],
    )


def _table(counts: _Counts) -> TableBlock:
    outcomes = counts.outcomes()
    rows: list[list[object]] = [
        [sender, sum(found.values()), *(found[name] for name in outcomes)]
        for sender, found in sorted(counts.by_sender.items())[:SENDERS_SHOWN_MAX]
    ]
    totals = [int(counts.over_time[name].sum()) for name in outcomes]
    rows.append(["all", sum(totals), *totals])
    note = f"Longest delay {counts.delay_s_max:.4g} s, longest link {counts.distance_m_max / 1e3:.5g} km."
    if len(counts.by_sender) > SENDERS_SHOWN_MAX:
        note += f" The first {SENDERS_SHOWN_MAX} of {len(counts.by_sender)} senders."
    return TableBlock(
        title="Messages by sender",
        headings=headings("sender", "messages", *(name.replace("_", " ") for name in outcomes)),
        rows=rows,
        note=note,
    )
