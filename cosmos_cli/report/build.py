"""The report's content: from a run's tables and summary to sections."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from operator import itemgetter
from pathlib import PurePosixPath
from typing import Any

from cosmos_cli.evidence.datagrams import WORDS
from cosmos_cli.evidence.run_directory import RunDirectory
from cosmos_cli.evidence.run_documents import fault_of_plan
from cosmos_cli.evidence.run_log import cut_text, posix_s
from cosmos_cli.evidence.simulation_calls import call_simulation, check_blocks, json_document
from cosmos_cli.evidence.table_labels import run_labels
from cosmos_cli.evidence.tables import no_tables, open_recorded_run
from cosmos_cli.evidence.verdict import is_number
from cosmos_cli.report.clock_zeros import zeros_s
from cosmos_cli.report.devices import device_sections, is_told_in_words
from cosmos_cli.report.expectations import expectation_sections
from cosmos_cli.report.health import health_blocks, process_blocks
from cosmos_cli.report.second_names import with_second_names
from cosmos_cli.report.tick_causes import cause_blocks
from cosmos_cli.report.timeline import (
    note_agents_refusals,
    read_actions,
    timeline_sections,
    with_bands,
)
from cosmos_cli.report.timing import clock_blocks, reached_s, tick_blocks
from madns_runtime.analysis import chapters
from madns_runtime.analysis.chapters import Chapter
from madns_runtime.analysis.lines import generic_blocks
from madns_runtime.analysis.sampling import as_array
from madns_runtime.analysis.tables import RecordedRun, RecordedTable, Tables
from madns_runtime.analysis.values import Heading, ReportRemark, Section, TableBlock, headings
from madns_runtime.conditions.condition import HOST
from madns_runtime.errors import PluginError
from madns_runtime.plain_values import mapping_at
from madns_runtime.recording.records import CLOCK, HEALTH, LATE_TICKS, PROCESS, TICKS

SENTENCES_MAX = 60
LEVELS_TOLD = ("critical", "error", "warning")
NOT_MEASURED = "not measured"
CORE_FIELDS = 3
"""The first of each stream: later versions may record more, and earlier ones recorded less."""
TIME_CHAPTERS = {
    "ticks": Chapter("Real time", tick_blocks, TICKS.fields[:CORE_FIELDS]),
    "late_ticks": Chapter("Causes of missed and late ticks", cause_blocks, LATE_TICKS.fields),
}
MACHINE_CHAPTERS = {
    "machine_health": Chapter("State of health", health_blocks, HEALTH.fields[:CORE_FIELDS]),
    "host_health": Chapter(
        "State of health of the host", health_blocks, HEALTH.fields[:CORE_FIELDS]
    ),
    "process": Chapter("Processes", process_blocks, PROCESS.fields[:CORE_FIELDS]),
    "clock": Chapter("Clock", clock_blocks, CLOCK.fields[:CORE_FIELDS]),
}
"""Chapters on machines and clocks, which come after those of the simulation."""
TEXT_STREAMS = ("events", "log", "host_events", "host_log")
"""Told in words, not drawn."""


def build_sections(run: RunDirectory, document: Mapping[str, Any]) -> list[Section]:
    """
    Return the report's sections: real time, the simulation's own, other streams, machines, words.

    Args:
        run: A gathered run.
        document: run.json.
    """
    recorded = open_recorded_run(run, document)
    own = _simulation_sections(run, recorded)
    drawn = {name for section in own for name in section.tables}
    before = chapters.build_sections(TIME_CHAPTERS, recorded)
    after = chapters.build_sections(MACHINE_CHAPTERS, recorded)
    drawn |= {name for section in (*before, *after) for name in section.tables}
    others = {
        name: Chapter(f"Stream {name}", generic_blocks)
        for name in recorded.tables
        if name not in drawn and name not in TEXT_STREAMS and not is_told_in_words(name)
    }
    unknown = chapters.build_sections(others, recorded)
    actions = read_actions(run)
    note_agents_refusals(actions, recorded.tables.get("events"))
    expected = expectation_sections(run, recorded)
    every = (*expected, *before, *own, *unknown, *after)
    found = with_bands(every, actions, reached_s(recorded))
    drawn_sections = [section for section in found if section.blocks]
    return [
        *_gaps(run, recorded),
        *with_second_names(drawn_sections, run_labels(run)),
        *timeline_sections(actions),
        *device_sections(document, recorded, run.path),
        *_load_sections(document),
        *_words(recorded.tables),
    ]


def with_simulation(
    run: RunDirectory, document: Mapping[str, Any], warn: Callable[[str], None]
) -> dict[str, Any]:
    """Return run.json with what the run's simulation tells of it in numbers; *warn* hears why it could not."""
    recorded = open_recorded_run(run, document)
    if recorded.config is None:
        return dict(document)
    try:
        _, told = call_simulation(recorded.config, "document", recorded)
        told = {} if told is None else json_document(told, "document()")
    except PluginError as error:
        warn(f"{recorded.config.simulation} tells nothing itself: {error}")
        return dict(document)
    if both := [key for key in told if key in document]:
        warn(
            f"document() of {recorded.config.simulation} tells {', '.join(both)}, which run.json has:"
            " that is shown; give them other names"
        )
    return {**told, **document}


def _simulation_sections(run: RunDirectory, recorded: RecordedRun) -> list[Section]:
    """Return the sections that a run's simulation makes of it; a remark if it could not."""
    config = recorded.config
    if config is None:
        fault = fault_of_plan(run.plan_json) or "cannot be used"
        return _no_figures(
            f"{run.plan_json}: {fault}; which simulation it was stands there, and its own figures are not drawn"
        )
    try:
        _, found = call_simulation(config, "figures", recorded)
        if found is None:
            return []
        if not isinstance(found, list) or not all(isinstance(one, Section) for one in found):
            raise PluginError("figures() must return madns_runtime.analysis.values.Section")
        for section in found:
            check_blocks(section.blocks, f"figures(), in section {section.title!r:.80},")
    except PluginError as error:
        return _no_figures(f"{config.simulation} drew no figures of its own: {error}")
    return found


def _no_figures(why: str) -> list[Section]:
    return [Section(title="Figures of the simulation", blocks=[ReportRemark(text=why)])]


def _gaps(run: RunDirectory, recorded: RecordedRun) -> list[Section]:
    listed = mapping_at(run.read_json(run.manifest_json) or {}, "files")
    paths = [PurePosixPath(name) for name in listed]
    folder, tables = run.tables.name, recorded.tables
    unread = [str(p) for p in paths if p.parts[:1] == (folder,) and p.stem not in tables]
    unread += (f"{folder}/{name}" for name in no_tables(run.tables))
    if not unread:
        return []
    text = (
        f"{', '.join(dict.fromkeys(unread))} cannot be read: what they hold is not shown;"
        f" cosmos collect {run.shell_path} makes anew what was recorded."
    )
    return [Section(title="Tables that are missing", blocks=[ReportRemark(text=text)])]


def _load_sections(document: Mapping[str, Any]) -> list[Section]:
    """Return the chapters of refused datagrams and of long calls; none where there was nothing of the kind."""
    datagrams = list(_datagram_tables(mapping_at(document, "datagrams")))
    calls = list(_call_tables(mapping_at(document, "host_calls")))
    return [
        Section(title=title, blocks=blocks)
        for title, blocks in (("Datagrams refused", datagrams), ("Long calls of the host", calls))
        if blocks
    ]


def _datagram_tables(account: Mapping[str, Any]) -> Iterator[TableBlock]:
    agents = mapping_at(account, "agents")
    processes = {"host": mapping_at(account, "host")}
    processes |= {name: mapping_at(agents, name) for name in agents}
    refusing = {name: entry for name, entry in processes.items() if entry.get("refused")}
    if not refusing:
        return
    seen = {reason for entry in refusing.values() for reason in mapping_at(entry, "by_reason")}
    reasons = [reason for reason in WORDS if reason in seen] + sorted(seen - WORDS.keys())
    yield TableBlock(
        title="Datagrams refused, by process and reason",
        headings=headings("process", "received", "refused", *(WORDS.get(r, r) for r in reasons)),
        rows=[
            [
                name,
                entry.get("received"),
                entry.get("refused"),
                *(mapping_at(entry, "by_reason").get(reason, 0) for reason in reasons),
            ]
            for name, entry in refusing.items()
        ],
        note="Each was counted and dropped; none of what it held was used.",
    )


def _call_tables(account: Mapping[str, Any]) -> Iterator[TableBlock]:
    methods = mapping_at(account, "methods")
    if not methods:
        return
    yield TableBlock(
        title="Calls of the host's half that held its loop for long",
        headings=(
            Heading(text="method", is_number=False),
            *(Heading(text=text) for text in ("long calls", "longest, s", "at t, s")),
        ),
        rows=[
            [name, entry.get("long"), entry.get("longest_s"), entry.get("longest_t_s")]
            for name in methods
            if (entry := mapping_at(methods, name))
        ],
        note="While one of them went on, the host heard no agent and answered none.",
    )


def _words(tables: Tables) -> list[Section]:
    zeros = zeros_s(map(tables.get, TEXT_STREAMS))
    common_s = zeros.get(HOST, min(zeros.values(), default=0.0))
    found = [
        sentence
        for name in ("host_log", "log")
        for sentence in _sentences(tables.get(name), zeros, common_s)
    ]
    if not found:
        return []
    rows = [row for _, row in sorted(found, key=itemgetter(0))]
    note = "In order of simulated time; UTC is by the clock of whoever said it."
    cut = f"The first {SENTENCES_MAX} of {len(rows)}. " if len(rows) > SENTENCES_MAX else ""
    heads = ("UTC", "who", "level", "what was said")
    table = TableBlock(
        title="Warnings and errors",
        headings=[Heading(text=text, is_number=False) for text in heads],
        rows=rows[:SENTENCES_MAX],
        note=cut + note,
    )
    return [Section(title="What was said", blocks=[table])]


def _sentences(
    table: RecordedTable | None, zeros: Mapping[str, float], common_s: float
) -> Iterator[tuple[float, list[object]]]:
    """Yield the rows of a log's warnings, each with the simulated time of it, s: by its clock where it tells none."""
    if table is None or not table.has("t_s", "utc", "level", "text"):
        return
    for who, columns in table.each(("t_s", "utc", "level", "text")):
        zero_s = zeros.get(who, common_s)
        times_s = as_array(columns["t_s"]).tolist()
        texts = (columns[name] for name in ("utc", "level", "text"))
        for t_s, utc, level, text in zip(times_s, *texts, strict=True):
            if level in LEVELS_TOLD:
                since_s = t_s if math.isfinite(t_s) else posix_s(utc) - zero_s
                yield since_s, [utc, who, level, cut_text(str(text))]


def figures_of(document: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    """Return the handful of numbers that tell most of a run: name, value, remark."""
    timing, round_trip = mapping_at(document, "timing"), mapping_at(document, "round_trip_ms")
    lateness = mapping_at(timing, "lateness_ms")
    records, agents = mapping_at(document, "records"), mapping_at(document, "agents")
    reliable = mapping_at(document, "messages", "reliable")
    sync = mapping_at(document, "messages", "sync")
    best = mapping_at(document, "messages", "best")
    told = agents.get("lost")
    lost = told if isinstance(told, list) else ()
    return [
        ("agents", _number(agents.get("count")), f"{len(lost)} lost"),
        ("real-time factor", _number(document.get("rtf"), ".7g"), "simulated per wall second"),
        (
            "ticks missed",
            _number(timing.get("missed")),
            f"of {_number(timing.get('ticks'))}",
        ),
        (
            "lateness p99",
            _milliseconds(lateness.get("p99")),
            f"max {_milliseconds(lateness.get('max'))}" if lateness else NOT_MEASURED,
        ),
        (
            "round trip p50",
            _milliseconds(round_trip.get("p50")),
            _round_trip_remark(round_trip) if "p50" in round_trip else NOT_MEASURED,
        ),
        (
            "messages lost",
            f"{_number(reliable.get('lost'))} + {_number(sync.get('lost'))}",
            f"reliable + sync; telemetry {_number(best.get('lost'))}",
        ),
        (
            "records",
            _number(records.get("written")),
            f"{_number(records.get('dropped'))} dropped, {_number(records.get('truncated'))} streams cut,"
            f" {_number(records.get('not_finite'))} values not finite",
        ),
    ]


def _round_trip_remark(round_trip: Mapping[str, Any]) -> str:
    """Tell the tail; of the clock's exchanges, of which only the quickest are recorded, there is none."""
    name = "p99" if "p99" in round_trip else "max"
    return f"{name} {_milliseconds(round_trip.get(name))} ({round_trip.get('stream', 'none')})"


def _milliseconds(value: object) -> str:
    if value is None:
        return "–"
    is_long = is_number(value) and abs(value) >= 999.5  # three figures would be a power of ten
    return f"{_number(value, '.0f' if is_long else '.3g')} ms"


def _number(value: object, form: str = "") -> str:
    if isinstance(value, bool) or not isinstance(value, int | float):
        return "–"
    if form:
        return format(value, form)
    return f"{value:,}".replace(",", "\u202f")
