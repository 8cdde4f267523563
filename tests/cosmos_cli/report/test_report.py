import base64
import dataclasses
import json
import re

import numpy as np
import pytest
from harness.synthetic_run import RECORDING, STATE, T0_UTC, SyntheticRun, make_config

from cosmos_cli.collect.finish import finish_run
from cosmos_cli.evidence.run_directory import write_json
from cosmos_cli.report.build import MACHINE_CHAPTERS, build_sections, figures_of
from cosmos_cli.report.cells import format_cell, format_measured
from cosmos_cli.report.html import encode_array, render_page
from cosmos_cli.report.plotly_figures import to_plotly
from madns_runtime.analysis.chapters import Chapter
from madns_runtime.analysis.distribution import summarise
from madns_runtime.analysis.sampling import (
    BinCounts,
    BinnedRms,
    TimeEnvelope,
    evenly,
    thin,
    thin_pieces,
)
from madns_runtime.analysis.values import (
    Figure,
    FigureChoice,
    ReportRemark,
    Section,
    Series,
    SpaceFigure,
    TableBlock,
)
from madns_runtime.recording.record_files import RecordFiles
from madns_runtime.recording.recorder import Recorder
from madns_runtime.recording.records import EVENTS, LATE_TICKS, LOG, Field, StreamSchema

INVARIANTS = StreamSchema(
    "invariants",
    (
        Field("t_s", "s"),
        Field("agent", "", "str"),
        Field("energy_j_kg", "J/kg"),
        Field("energy_drift", "1"),
        Field("momentum_z_drift", "1"),
    ),
)
ELEMENTS = StreamSchema(
    "elements", (Field("tick", "", "int"), Field("a_m", "m"), Field("i_deg", "deg"))
)
OWN = StreamSchema("thrust", (Field("t_s", "s"), Field("force_n", "N"), Field("mode", "", "str")))
HTML_BYTES_MAX = 4.9e6 + 4e6


def build(made, **changes):
    summary = finish_run(made.run, made.result(**changes), made.expected)
    sections = build_sections(made.run, summary.document)
    return summary.document, {section.title: section.blocks for section in sections}


def titles(blocks, kind=Figure | SpaceFigure):
    return [block.title for block in blocks if isinstance(block, kind)]


def remarks(blocks):
    return [block.text for block in blocks if isinstance(block, ReportRemark)]


def table_of(blocks, start):
    return next(b for b in blocks if isinstance(b, TableBlock) and b.title.startswith(start))


def test_counter_run_gets_the_figures_of_the_benchmark(tmp_path):
    _, sections = build(SyntheticRun(tmp_path, make_config(7)).write())

    assert titles(sections["Round trips"]) == [
        "Round trips of all agents over time",
        "Round trips by agent",
        "Round trip statistics by agent",
    ]
    groups = next(b for b in sections["Round trips"] if b.title == "Round trips by agent")
    assert [len(choice.marks) for choice in groups.choices] == [5, 2]
    assert {"Real time", "State of health", "Processes", "Clock"} <= set(sections)


def test_statistics_are_of_all_samples_and_not_of_the_drawn_ones(tmp_path):
    made = SyntheticRun(tmp_path, make_config(1, ticks=5000, tick_hz=100.0)).write()
    lines = made.stream("agent-01", "round_trips").read_bytes().splitlines()[1:-1]
    samples_ms = np.array([json.loads(line)[2] for line in lines]) / 1000

    _, sections = build(made)

    row = table_of(sections["Round trips"], "Round trips by agent").rows[0]
    expected = [
        samples_ms.mean(),
        samples_ms.std(),
        samples_ms.min(),
        samples_ms.max(),
        np.ptp(samples_ms),
        *np.percentile(samples_ms, (99, 99.9)),
    ]
    assert row[1] == 5000
    np.testing.assert_allclose(row[2:9], expected, atol=5e-5)
    drawn = next(b for b in sections["Round trips"] if b.title == "Round trips by agent")
    assert len(drawn.choices[0].marks[0].x) <= 1500


def test_missed_ticks_by_agent_sum_up_to_those_of_the_run(tmp_path):
    """No tick follows the last ones that are missed, and no record tells of those of an agent that was killed."""
    made = SyntheticRun(tmp_path, make_config(3, ticks=200))
    for name, ticks in zip(made.names, (195, 200, 120), strict=True):
        made.write_agent(name, last=ticks)
    late = made.recorder("agents/agent-01", "agent-01", LATE_TICKS)
    late.record("late_ticks", (195, 9000, 5, "wake_up"))
    late.close()
    result = made.result()
    result["agents"]["agent-01"]["ticks"] |= {"run": 195, "missed": 5}
    del result["agents"]["agent-03"]

    document, sections = build(made, agents=result["agents"])

    rows = table_of(sections["Real time"], "Ticks by agent").rows
    missed = {row[0]: row[2] for row in rows}
    assert missed == {"agent-01": 5, "agent-02": 0, "agent-03": 80}
    assert sum(missed.values()) == document["timing"]["missed"]
    assert "Missed ticks by agent" in titles(sections["Real time"])


def test_an_agent_that_never_ran_a_tick_is_the_one_that_missed_them(tmp_path):
    made = SyntheticRun(tmp_path, make_config(3, ticks=200))
    for name in ("agent-01", "agent-03"):
        made.write_agent(name, last=200)
    result = made.result()
    result["agents"]["agent-01"]["ticks"]["causes"] = {}
    del result["agents"]["agent-02"]

    document, sections = build(made, agents=result["agents"])

    rows = table_of(sections["Real time"], "Ticks by agent").rows
    assert [row[:3] for row in rows] == [
        ["agent-01", 200, 0],
        ["agent-02", 0, 200],
        ["agent-03", 200, 0],
    ]
    assert document["timing"]["missed"] == 200
    assert "Missed ticks by agent" in titles(sections["Real time"])


def test_constellation_gets_orbits_elements_and_conserved_quantities(tmp_path):
    made = SyntheticRun(tmp_path).write(with_states=True)
    host = made.recorder("host", "host", INVARIANTS)
    for t_s in (5.0, 10.0):
        for name in made.names:
            host.record("invariants", (t_s, name, -2.78e7, 1e-12, -2e-12))
    host.close()
    for name in made.names:
        recorder = made.recorder(f"agents/{name}", name, ELEMENTS)
        for tick in range(5):
            recorder.record("elements", (tick, 7.158e6 + tick, 86.4))
        recorder.close()

    _, sections = build(made)

    assert titles(sections["Orbits"]) == [
        "Orbits",
        "Position and velocity",
        "Specific angular momentum",
        "Classical orbital elements, osculating",
    ]
    assert table_of(sections["Orbits"], "Elements").rows[0][1:] == [7158.004, 86.4]
    conserved = table_of(sections["Health of the model"], "Conserved")
    assert conserved.rows[0] == ["agent-01", "-27.800000", 1e-12, 2e-12]


def test_orbit_figure_is_the_only_one_that_needs_webgl(tmp_path):
    document, sections = build(SyntheticRun(tmp_path).write(with_states=True))

    kinds = [
        {trace["type"] for _, traces in to_plotly(block).choices for trace in traces}
        for blocks in sections.values()
        for block in blocks
        if isinstance(block, Figure | SpaceFigure)
    ]
    assert sum(bool(k & {"scatter3d", "surface"}) for k in kinds) == 1
    assert not any("scattergl" in k for k in kinds)


def test_drawn_orbit_passes_through_the_flown_one(tmp_path):
    _, sections = build(SyntheticRun(tmp_path).write(with_states=True))

    orbits = next(b for b in sections["Orbits"] if b.title == "Orbits")
    whole = next(path for path in orbits.paths if path.name == "osculating orbits")
    radius_km = np.linalg.norm(whole.points, axis=1)
    # A circular orbit was flown; its ellipse must have one radius, to rounding of the state.
    np.testing.assert_allclose(radius_km[np.isfinite(radius_km)], 7158.0, atol=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize(("ticks", "is_cut"), [(400, False), (1700, False), (3000, True)])
def test_orbits_of_a_long_run_are_drawn_as_orbits_and_what_is_left_out_is_told(
    tmp_path, ticks, is_cut
):
    # A record every 50 s, 6026 s per orbit.
    config = make_config(1, ticks=ticks, tick_hz=0.02)
    _, sections = build(SyntheticRun(tmp_path, config).write(with_states=True))

    figure = next(b for b in sections["Orbits"] if b.title == "Position and velocity")
    trace = figure.choices[0].marks[0]
    assert len(trace.x) <= 400
    assert np.diff(trace.x).max() <= 6026.0 / 24.0
    assert trace.x[-1] == (ticks - 1) * 50.0
    assert ("From" in figure.note) == (trace.x[0] > 0.0) == is_cut


def test_tables_that_cannot_be_read_are_named_and_the_others_shown(tmp_path):
    made = SyntheticRun(tmp_path).write(with_states=True)
    build(made)
    (made.run.tables / "state.parquet").write_bytes(b"PAR1")
    (made.run.tables / "clock.parquet").unlink()

    document = made.run.read_json(made.run.run_json)
    first, *others = build_sections(made.run, document)

    assert first.title == "Tables that are missing"
    assert first.blocks[0].text.startswith("tables/clock.parquet, tables/state.parquet cannot be")
    assert "Orbits" not in [section.title for section in others]
    assert "Real time" in [section.title for section in others]


def test_report_without_the_plan_says_why_the_simulation_tells_nothing(tmp_path):
    made = SyntheticRun(tmp_path).write()
    document, sections = build(made)
    assert "Round trips" in sections
    made.run.plan_json.unlink()

    after = {section.title: section.blocks for section in build_sections(made.run, document)}

    assert "Round trips" not in after
    assert remarks(after["Figures of the simulation"]) == [
        f"{made.run.plan_json}: missing; which simulation it was stands there, and its own figures are not drawn"
    ]


def test_machine_without_a_sensor_is_told_plainly(tmp_path):
    _, sections = build(SyntheticRun(tmp_path).write())

    assert remarks(sections["State of health"]) == [
        "loopback has no temperature sensor: nothing to draw."
    ]


def test_machine_with_a_sensor_gets_its_temperature(tmp_path):
    made = SyntheticRun(tmp_path).write(health_count=0)
    made.write_health(4, temperature_c=48.5)

    _, sections = build(made)

    assert "Core temperature by machine" in titles(sections["State of health"])
    row = table_of(sections["State of health"], "Core temperature").rows[0]
    assert row == ["loopback", 4, 48.5, 0.0, 48.5, 48.5]


def test_stream_of_ones_own_plug_in_gets_a_figure_for_each_number(tmp_path):
    made = SyntheticRun(tmp_path).write()
    recorder = made.recorder("agents/agent-01", "agent-01", OWN)
    for index in range(20):
        recorder.record("thrust", (index / 10, index * 0.5, "burn"))
    recorder.close()

    _, sections = build(made)

    (figure,) = sections["Stream thrust"]
    assert figure.title == "force"
    assert to_plotly(figure).layout["yaxis"]["title"]["text"] == "N"
    assert figure.choices[0].marks[0].y.tolist() == [i * 0.5 for i in range(20)]


def fails(_table, _run):
    raise ZeroDivisionError("no reason")


def fails_when_it_is_read(_table, _run):
    yield ReportRemark(text="a first one")
    raise ZeroDivisionError("no reason")


@pytest.mark.parametrize(
    ("builder", "told"),
    [
        (fails, "ZeroDivisionError: no reason"),
        (fails_when_it_is_read, "ZeroDivisionError: no reason"),
        (lambda _table, _run: ReportRemark(text="x"), "TypeError: 'ReportRemark' object is not"),
        (lambda _table, _run: None, "TypeError: 'NoneType' object is not iterable"),
    ],
)
def test_builder_that_fails_costs_a_remark_and_not_the_report(tmp_path, monkeypatch, builder, told):
    monkeypatch.setitem(MACHINE_CHAPTERS, "clock", Chapter("Clock", builder))

    _, sections = build(SyntheticRun(tmp_path).write())

    (remark,) = remarks(sections["Clock"])
    assert remark.startswith(f"The figures of clock could not be drawn: {told}")
    assert "Round trips" in sections


def test_warnings_and_errors_are_told_in_words(tmp_path):
    made = SyntheticRun(tmp_path)
    made.write()
    log = made.recorder("agents/agent-01", "agent-01", LOG)
    log.record("log", (1.0, T0_UTC, "warning", "the <battery> is low"))
    log.record("log", (1.0, T0_UTC, "info", "nothing to see"))
    log.close()

    document, sections = build(made)

    rows = table_of(sections["What was said"], "Warnings").rows
    assert [row[1:] for row in rows] == [["agent-01", "warning", "the <battery> is low"]]
    page = made.run.report_html.read_text()
    assert "the &lt;battery&gt; is low" in page


def test_sentences_of_boards_whose_clocks_are_years_off_come_in_order_of_time(
    tmp_path, monkeypatch
):
    monkeypatch.setattr("cosmos_cli.report.build.SENTENCES_MAX", 3)
    made = SyntheticRun(tmp_path)
    made.write()

    def say(folder, source, zero, *records):
        recorder = made.recorder(folder, source, EVENTS, LOG)
        recorder.record("events", {"t_s": 0.0, "utc": zero, "event": "start"})
        for t_s, utc, text in records:
            recorder.record("log", {"t_s": t_s, "utc": utc, "level": "warning", "text": text})
        recorder.close()

    say(
        "agents/agent-01",
        "agent-01",
        "1999-01-01T00:00:10.000Z",
        (None, "1999-01-01T00:00:08.000Z", "third, before time zero"),
        (1.0, "1999-01-01T00:00:11.000Z", "fifth"),
    )
    say(
        "agents/agent-02",
        "agent-02",
        "2055-01-01T00:00:10.000Z",
        (None, "2055-01-01T00:00:05.000Z", "first, before time zero"),
        (0.5, "2055-01-01T00:00:10.500Z", "fourth"),
    )
    say("host", "host", T0_UTC, (None, "2024-05-06T07:08:06.000Z", "second, before time zero"))

    _, sections = build(made)

    table = table_of(sections["What was said"], "Warnings")
    assert [row[3].split(",")[0] for row in table.rows] == ["first", "second", "third"]
    assert table.note.startswith("The first 3 of 5")


def test_sentence_without_end_is_cut_and_says_so(tmp_path):
    made = SyntheticRun(tmp_path)
    made.write()
    log = made.recorder("agents/agent-01", "agent-01", LOG)
    log.record("log", (1.0, T0_UTC, "error", "x" * 100_000))
    log.close()

    _, sections = build(made)

    (row,) = table_of(sections["What was said"], "Warnings").rows
    assert row[3] == "x" * 4000 + "... (96000 more characters)"
    assert made.run.report_html.read_text().count("x" * 5000) == 0


def test_failed_run_is_red_and_names_who_why_and_what_is_missing(tmp_path):
    made = SyntheticRun(tmp_path).write()
    made.kill("agent-02")

    build(made, status="aborted", who="agent-02", reason="killed by SIGKILL")

    page = made.run.report_html.read_text()
    assert 'class="verdict bad"' in page
    assert "ABORTED: agent-02: killed by SIGKILL" in page
    assert " s planned" in page
    assert " s simulated" not in page
    assert "Data that are missing" in page
    assert "agent-02: " in page


@pytest.mark.parametrize(
    "account",
    [
        {"datagrams": {"agents": {"agent-01": 3}}},
        {"datagrams": {"host": [1], "agents": {"agent-01": {"refused": 2, "by_reason": [1]}}}},
        {"devices": {"imu": {"counts": {"reads": "many"}}}},
    ],
    ids=str,
)
def test_account_of_a_run_json_that_was_changed_costs_no_report(tmp_path, account):
    made = SyntheticRun(tmp_path).write()
    document, _ = build(made)

    sections = build_sections(made.run, document | account)

    assert "Real time" in [section.title for section in sections]
    assert render_page(document | account, sections)


def test_run_that_recorded_nothing_still_has_a_report(tmp_path):
    made = SyntheticRun(tmp_path)

    finish_run(made.run, None, made.expected)

    page = made.run.report_html.read_text()
    assert "FAILED: host" in page
    assert 'id="plot0"' not in page


def test_page_asks_nobody_for_anything(tmp_path):
    made = SyntheticRun(tmp_path).write()
    build(made)
    page = made.run.report_html.read_text()

    without_plotly = re.sub(r"<script>.*?</script>", "", page, count=1, flags=re.S)
    assert not re.findall(r"(?:src|href)\s*=", without_plotly)
    assert "default-src 'none'" in page


def test_text_that_looks_like_a_place_of_the_page_is_shown_as_it_is(tmp_path):
    """A log line such as {{plotly}} had the library written into the midst of the page."""
    made = SyntheticRun(tmp_path).write()
    document, _ = build(made)

    def page_of(text):
        trace = Series(name=text, x=[1], y=[1])
        figures = [
            Figure(title=text, choices=[FigureChoice(name=text, marks=[trace])] * 2),
            ReportRemark(text=text),
        ]
        told = {"run": text, "verdict": text, "remarks": [text]}
        return render_page({**document, **told}, [Section(title=text, blocks=figures)])

    evil = "{{plotly}}{{body}}{{script}}{{figures}}{{css}}"
    page, plain = page_of(evil), page_of("plain")

    assert page.count(evil) >= 5
    assert abs(len(page) - len(plain)) < 100 * len(evil)  # the library alone has a million
    for part in ("<script", "<style", "<body"):
        assert page.count(part) == plain.count(part)


def test_hostile_text_cannot_leave_its_place(tmp_path):
    made = SyntheticRun(tmp_path).write()
    document, sections = build(made)
    evil = "</script><script>alert(1)</script>"
    document = {**document, "run": evil, "verdict": evil}
    trace = Series(name=evil, x=[1], y=[1])
    figure = Figure(title=evil, choices=[FigureChoice(name=evil, marks=[trace])] * 2)

    page = render_page(document, [Section(title=evil, blocks=[figure, ReportRemark(text=evil)])])

    assert "<script>alert" not in page
    assert page.count("<script") == 3


@pytest.mark.slow
def test_page_of_many_agents_stays_small(tmp_path):
    made = SyntheticRun(tmp_path, make_config(93, ticks=400, tick_hz=10.0)).write(with_states=True)

    build(made)

    assert made.run.report_html.stat().st_size < HTML_BYTES_MAX


def test_thinning_keeps_every_peak_and_the_order():
    random = np.random.default_rng(1)
    x, y = np.arange(100_000.0), random.normal(size=100_000)
    y[[17, 50_003, 99_999]] = (90.0, -80.0, 70.0)

    thin_x, thin_y = thin(x, y, 1000)

    assert len(thin_x) <= 1000
    assert np.all(np.diff(thin_x) > 0)
    assert {90.0, -80.0, 70.0} <= set(thin_y)
    assert np.array_equal(y[thin_x.astype(int)], thin_y)


def test_thinning_survives_gaps_and_shows_them():
    y = np.full(1000, np.nan)
    y[400:600] = np.arange(200.0)

    _, thin_y = thin(np.arange(1000.0), y, 100)

    assert np.nanmin(thin_y) == 0.0
    assert np.nanmax(thin_y) == 199.0
    assert np.isnan(thin_y[0])
    assert np.isnan(thin_y[-1])


def test_pieces_are_thinned_by_themselves_with_a_break_between():
    x = np.arange(1000.0)
    x[400:] += 5000.0

    thin_x, thin_y = thin_pieces(x, x, np.array([400]), 100)

    (gap,) = np.flatnonzero(np.isnan(thin_y))
    assert len(thin_x) <= 100
    assert (thin_y[gap - 1], thin_x[gap], thin_y[gap + 1]) == (399.0, 5400.0, 5400.0)


def test_no_line_is_drawn_through_the_time_that_an_agent_was_away(tmp_path):
    made = SyntheticRun(tmp_path, make_config(1)).write(with_states=True)
    again = RecordFiles(
        made.run.path / "agents/agent-01", run=made.run.name, source="agent-01", incarnation=2
    )
    recorder = Recorder(again, RECORDING)
    for schema in (STATE, ELEMENTS):
        recorder.open_stream(schema)
    recorder.set_t0(T0_UTC)
    for tick in range(5000, 5010):
        recorder.record("state", (tick, 7.158e6, 0.0, 0.0, 0.0, 7462.0, 0.0))
        recorder.record("elements", (tick, 7.158e6, 86.4))
    recorder.close()
    first = made.recorder("agents/agent-01", "agent-01", ELEMENTS)
    first.record("elements", (0, 7.158e6, 86.4))
    first.close()

    _, sections = build(made)

    orbits, *others = [b for b in sections["Orbits"] if isinstance(b, Figure | SpaceFigure)]
    flown = next(path.points for path in orbits.paths if path.name.startswith("agent-01"))
    assert np.isnan(flown[:, 0]).sum() == 1
    for figure in others:
        assert [np.isnan(mark.y).sum() for mark in figure.choices[0].marks] == [
            1 for _ in figure.choices[0].marks
        ]


def test_thinning_keeps_every_peak_beside_what_is_infinite():
    decibels = np.tile([-np.inf, 1.0, 5.0, np.inf, 2.0], 20)

    kept = thin(np.arange(100.0), decibels, 20)[1]

    np.testing.assert_array_equal(kept, np.tile([1.0, 5.0], 10))


def test_values_that_are_none_lie_in_no_bin():
    t_s, values = np.array([1.0, 2.0, np.nan, 9.0]), np.array([1.0, np.nan, 7.0, 3.0])
    histogram, rms = BinCounts(np.array([0.0, 2.0, 8.0])), BinnedRms(10.0, bins=2)
    envelope = TimeEnvelope(10.0, 0.1, 10.0, samples=4)

    for each in (rms, envelope):
        each.add(t_s, values)
    histogram.add(values)

    assert histogram.counts.tolist() == [1, 2]
    assert rms.rows() == [(5.0, 1.0, 1.0), (10.0, 3.0, 3.0)]
    middles, curves = envelope.curves()
    assert middles.tolist() == [1.5, 9.5]
    assert curves["max"].tolist() == [1.0, 3.0]


def test_quantiles_of_numbers_as_far_apart_as_they_can_be_lie_between_them():
    summary = summarise(np.array([-1.5e308, 1.5e308]))

    assert (summary.p50, summary.max) == (0.0, 1.5e308)


def test_few_samples_are_not_thinned():
    x = np.arange(10.0)

    assert thin(x, x, 100)[0] is x


def test_even_indices_hold_both_ends():
    chosen = evenly(1001, 11)

    assert chosen.tolist() == list(range(0, 1001, 100))
    assert evenly(3, 10).tolist() == [0, 1, 2]
    assert evenly(0, 10).tolist() == []


def test_envelope_has_the_exact_maximum_and_close_quantiles():
    random = np.random.default_rng(3)
    t_s, values = np.sort(random.uniform(0, 100, 50_000)), random.exponential(100.0, 50_000) + 1
    envelope = TimeEnvelope(100.0, 1.0, values.max(), samples=50_000)

    for start in range(0, 50_000, 7_000):
        envelope.add(t_s[start : start + 7_000], values[start : start + 7_000])
    middles, curves = envelope.curves()

    width_s = middles[1] - middles[0]
    first = values[t_s < width_s]
    assert curves["max"][0] == first.max()
    np.testing.assert_allclose(curves["p50"][0], np.percentile(first, 50), rtol=0.08)
    assert np.all(curves["p50"] <= curves["p99"])
    assert np.all(curves["p99"] <= curves["max"])


def test_histogram_counts_what_lies_outside_in_its_outermost_bins():
    histogram = BinCounts(np.array([0.0, 1.0, 2.0]))

    histogram.add(np.array([-5.0, 0.5, 1.5, 1.7, 9.0]))

    assert histogram.counts.tolist() == [2, 3]


@pytest.mark.parametrize(
    ("values", "dtype"),
    [
        (np.linspace(0, 3600, 500), "f4"),
        (7.158e6 + np.linspace(0, 1e-3, 500), "f8"),
        (np.array([np.nan, 1.0, 2.0]), "f4"),
        (np.array([]), "f4"),
        (np.full(5, 0.1), "f8"),
    ],
)
def test_array_is_stored_as_short_as_its_curve_allows(values, dtype):
    encoded = encode_array(values)

    assert encoded["dtype"] == dtype
    back = np.frombuffer(base64.b64decode(encoded["bdata"]), dtype=f"<{dtype}")
    spread = np.ptp(values[np.isfinite(values)]) if values.size else 0.0
    np.testing.assert_allclose(back, values, rtol=0, atol=1e-3 * spread)


def test_array_whose_spread_is_no_float_keeps_its_values():
    values = np.array([1.0, 2.0, -1e308, 1e308])

    encoded = encode_array(values)

    assert encoded["dtype"] == "f8"
    assert np.frombuffer(base64.b64decode(encoded["bdata"])).tolist() == values.tolist()


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (None, "–"),
        (float("nan"), "–"),
        (0, "0"),
        (18000, "18\u202f000"),
        (0.001, "0.001"),
        (2e-5, "2e-05"),
        (7143.84, "7143.8"),
        (True, "yes"),
        ("text", "text"),
    ],
)
def test_cell_reads_as(value, text):
    assert format_cell(value) == text


@pytest.mark.parametrize(
    ("trip_ms", "text"),
    [(0.38251, "0.383 ms"), (999.4, "999 ms"), (1000.0, "1000 ms"), (None, "–")],
)
def test_a_round_trip_is_told_in_figures_and_not_in_powers_of_ten(trip_ms, text):
    told = {name: value for name, value, _ in figures_of({"round_trip_ms": {"p50": trip_ms}})}

    assert told["round trip p50"] == text


def foreign(tmp_path, *schemas):
    """Return a run of a plug-in of one's own, whose streams bear the names of shipped ones."""
    config = dataclasses.replace(make_config(2), simulation="./mine.py:simulation")
    made = SyntheticRun(tmp_path, config).write()
    for folder, source, schema, rows in schemas:
        recorder = made.recorder(folder, source, schema)
        for row in rows:
            recorder.record(schema.name, row)
        recorder.close()
    return made


@pytest.mark.process
def test_foreign_streams_with_the_names_of_shipped_ones_are_drawn_as_what_they_are(tmp_path):
    numbers = [(tick, *(float(tick + axis) for axis in range(6))) for tick in range(10)]
    elements = [(tick, 1.0, 2.0) for tick in range(10)]
    made = foreign(
        tmp_path,
        ("agents/agent-01", "agent-01", STATE, numbers),
        ("agents/agent-01", "agent-01", ELEMENTS, elements),
    )

    _, sections = build(made)

    assert {"Orbits", "Control"}.isdisjoint(sections)
    assert len(sections["Stream state"]) == 6
    assert [b.title for b in sections["Stream elements"]][0].startswith("a")
    assert {type(mark) for b in sections["Stream state"] for mark in b.choices[0].marks} == {Series}


@pytest.mark.process
def test_host_stream_with_a_column_of_agents_is_one_line_for_each(tmp_path):
    truth = StreamSchema(
        "truth", (Field("t_s", "s"), Field("agent", "", "str"), Field("position_m", "m"))
    )
    rows = [
        (t_s / 10, name, offset + t_s)
        for t_s in range(20)
        for name, offset in (("rover-1", 0.0), ("rover-2", 100.0))
    ]

    _, sections = build(foreign(tmp_path, ("host", "host", truth, rows)))

    (figure,) = sections["Stream host_truth"]
    first, second = figure.choices[0].marks
    assert [first.name, second.name] == ["rover-1", "rover-2"]
    np.testing.assert_array_equal(first.y, np.arange(20.0))
    np.testing.assert_array_equal(second.y, np.arange(20.0) + 100.0)
    assert (np.diff(first.x) > 0).all()


@pytest.mark.process
def test_packets_and_lost_of_a_foreign_summary_are_no_packets(tmp_path):
    mine = StreamSchema("net", (Field("packet", "", "int"), Field("size_b", "B")))
    made = foreign(tmp_path, ("agents/agent-01", "agent-01", mine, [(7, 1.0), (3, 2.0)]))

    agents = made.result()["agents"]
    for agent in agents.values():
        agent["simulation"] = {"lost": 3}
    document, sections = build(made, agents=agents)

    assert document["packets"] == {}
    (figure, *_) = [b for b in sections["Stream net"] if b.title.startswith("size")]
    np.testing.assert_array_equal(figure.choices[0].marks[0].x, [0.0, 1.0])


@pytest.mark.parametrize(
    ("got", "limit", "text"),
    [
        (20.0004, 20.0, "20.0004"),
        (20.0004, 20, "20.0004"),
        (20.0, 20.0, "20"),
        (20.0004, 21.0, "20"),
        (3, 2, "3"),
        (None, 2.0, "not measured"),
        (1.0, None, "1"),
    ],
)
def test_what_was_measured_is_told_apart_from_its_limit(got, limit, text):
    assert format_measured(got, limit) == text


def test_expectations_and_agents_that_are_too_many_to_be_drawn_are_told(tmp_path):
    made = SyntheticRun(tmp_path, make_config(22, ticks=4)).write()
    given = {"words": "below 1", "stream": "ticks", "field": "lateness_us", "statistic": "max"}
    given |= {"agents": list(made.names), "bounds": {"high": 1.0}, "unit": "us"}
    checks = [{**given, "name": f"low-{number}"} for number in range(14)]
    plan = made.run.read_json(made.run.plan_json)
    write_json(made.run.plan_json, {**plan, "expectations": checks})
    summary = finish_run(made.run, made.result(), made.expected, has_report=False)

    sections = build_sections(made.run, summary.document)

    (section,) = [one for one in sections if one.title == "Expectations"]
    figures = [block for block in section.blocks if isinstance(block, Figure)]
    (remark,) = [block.text for block in section.blocks if isinstance(block, ReportRemark)]
    assert [figure.title for figure in figures] == [f"low-{n}: below 1" for n in range(12)]
    assert figures[0].note == "The first 20 of 22, the one that is told before the others."
    assert remark == "Not drawn: low-12: below 1; low-13: below 1."
