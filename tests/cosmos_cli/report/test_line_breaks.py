"""Lines of figures end where nothing was recorded and where an angle wraps, and go on behind."""

from pathlib import Path

import numpy as np
import pytest
from harness.synthetic_run import SyntheticRun, make_config

from cosmos_cli.collect.finish import finish_run
from cosmos_cli.report.build import build_sections
from cosmos_cli.report.plotly_figures import to_plotly
from madns_runtime.analysis.breaks import gap_starts, wrap_starts
from madns_runtime.analysis.lines import grouped_lines
from madns_runtime.analysis.sampling import (
    POINTS_PER_FIGURE,
    SERIES_PER_FIGURE,
    TimeEnvelope,
    envelope_series,
)
from madns_runtime.analysis.values import Axis, Figure, FigureChoice, Floats, Form, Series
from madns_runtime.recording.records import Field, StreamSchema

ELEMENTS = StreamSchema(
    "elements", (Field("tick", "", "int"), Field("a_m", "m"), Field("argp_deg", "deg"))
)
BEACON = StreamSchema("beacon", (Field("t_s", "s"), Field("power_w", "W")))
EVERY_SECOND = np.arange(100.0)
AWAY = np.concatenate((np.arange(40.0), np.arange(60.0, 100.0)))


def drawn(x: Floats, y: Floats, *, unit: str = "m", **given: object) -> tuple[Floats, Floats]:
    (figure,) = grouped_lines({"agent-01": (x, y)}, title="some", y=Axis(unit=unit), **given)
    (mark,) = figure.choices[0].marks
    return mark.x, mark.y


def strokes(x: Floats, y: Floats) -> list[tuple[float, float]]:
    """Return the abscissae of both ends of each stretch without a line."""
    ends = np.flatnonzero(np.isnan(y))
    return [(float(x[end - 1]), float(x[end + 1])) for end in ends]


def report_marks(made: SyntheticRun, title: str) -> list[tuple[Floats, Floats]]:
    summary = finish_run(made.run, made.result(), made.expected)
    blocks = [b for s in build_sections(made.run, summary.document) for b in s.blocks]
    (figure,) = [b for b in blocks if isinstance(b, Figure) and b.title == title]
    return [(mark.x, mark.y) for mark in figure.choices[0].marks]


def test_argument_of_perigee_has_no_stroke_across_its_panel_where_it_wraps(tmp_path: Path) -> None:
    made = SyntheticRun(tmp_path, make_config(1)).write(with_states=True)
    recorder = made.recorder("agents/agent-01", "agent-01", ELEMENTS)
    for tick in range(40):
        recorder.record("elements", (tick, 7.158e6, (350.0 + tick) % 360.0))
    recorder.close()

    axis, perigee = report_marks(made, "Classical orbital elements, osculating")

    assert not np.isnan(axis[1]).any()
    assert len(strokes(*perigee)) == 1
    assert np.nanmax(np.abs(np.diff(perigee[1]))) < 2.0


def test_line_of_a_stream_stops_where_nothing_was_recorded_for_a_time(tmp_path: Path) -> None:
    made = SyntheticRun(tmp_path, make_config(1)).write()
    recorder = made.recorder("agents/agent-01", "agent-01", BEACON)
    for t_s in AWAY:
        recorder.record("beacon", (float(t_s), 2.0))
    recorder.close()

    (power,) = report_marks(made, "power")

    assert strokes(*power) == [(39.0, 60.0)]


@pytest.mark.parametrize("form", ["line", "joined points"])
def test_gap_is_where_it_was_also_among_thinned_samples(form: str) -> None:
    x = np.concatenate((np.arange(40_000.0), np.arange(60_000.0, 100_000.0)))

    ((from_s, to_s),) = strokes(*drawn(x, np.sin(x), form=form))

    assert 39_900.0 < from_s < 40_000.0
    assert 60_000.0 <= to_s < 60_100.0


def test_steps_hold_over_a_gap() -> None:
    assert not np.isnan(drawn(AWAY, AWAY, form="steps")[1]).any()


@pytest.mark.parametrize(
    "x",
    [
        pytest.param(EVERY_SECOND, id="regular"),
        pytest.param(np.delete(EVERY_SECOND, [20, 50, 80]), id="single samples missing"),
        pytest.param(np.random.default_rng(3).exponential(size=500).cumsum(), id="by chance"),
        pytest.param(np.array([0.0, 1.0, 2.0, 50.0]), id="few"),
        pytest.param(np.zeros(20), id="all at once"),
        pytest.param(np.empty(0), id="none"),
    ],
)
def test_samples_without_a_gap_are_one_line(x: Floats) -> None:
    assert not len(gap_starts(x, 1500))


def test_a_slower_rate_is_no_row_of_gaps() -> None:
    x = np.concatenate((np.arange(0.0, 100.0, 0.1), np.arange(100.0, 190.0)))

    assert len(gap_starts(x, 1500)) <= 1


def test_gaps_are_no_more_than_can_be_seen() -> None:
    x = np.setdiff1d(np.arange(100_000.0), np.arange(0.0, 100_000.0, 30.0)[:, None] + [0, 1, 2])

    assert len(gap_starts(x, 400)) <= 100


@pytest.mark.parametrize(
    ("angles", "unit"),
    [
        (np.arange(0.0, 720.0, 10.0) % 360.0, "deg"),
        ((np.arange(180.0, 700.0, 10.0) % 360.0) - 180.0, "deg"),
        (np.arange(0.0, 12.5, 0.1) % (2.0 * np.pi), "rad"),
    ],
)
def test_angles_wrap_once_per_turn(angles: Floats, unit: str) -> None:
    starts = wrap_starts(angles, unit)

    assert len(starts) == 1
    assert abs(angles[starts[0]] - angles[starts[0] - 1]) > 6.0


@pytest.mark.parametrize(
    ("values", "unit"),
    [
        (np.array([0.0, 400.0, 0.0]), "m"),  # no angle
        (np.array([0.0, 400.0, 0.0]), "deg"),  # counts its turns
        (np.array([0.0, 170.0, 0.0]), "deg"),
        (np.array([np.nan, np.nan]), "deg"),
        (np.empty(0), "deg"),
    ],
)
def test_what_jumps_and_does_not_wrap_is_one_line(values: Floats, unit: str) -> None:
    assert not len(wrap_starts(values, unit))


def test_an_angle_of_more_turns_than_can_be_drawn_is_points() -> None:
    x = np.arange(50_000.0)
    (figure,) = grouped_lines({"a": (x, (100.0 * x) % 360.0)}, title="some", y=Axis(unit="deg"))
    (mark,) = figure.choices[0].marks

    assert mark.form == "points"
    assert len(mark.x) <= 1500


def test_envelope_of_all_agents_stops_while_all_were_away() -> None:
    envelope = TimeEnvelope(100.0, 1.0, 10.0, samples=30_000)
    t_s = np.concatenate((np.linspace(0.0, 40.0, 15_000), np.linspace(60.0, 100.0, 15_000)))
    envelope.add(t_s, np.full(30_000, 5.0))

    for series in envelope_series(envelope):
        ((before_s, after_s),) = strokes(series.x, series.y)
        assert before_s == pytest.approx(40.0, abs=1.0)
        assert after_s == pytest.approx(60.0, abs=1.0)


def plain(times: Floats, form: Form = "line", **more: object) -> tuple[Floats, Floats]:
    """Return what is drawn of a series that somebody's own figure has as it is."""
    mark = Series(x=times, y=times + 1.0, form=form)
    made = to_plotly(Figure(title="own", choices=[FigureChoice(marks=[mark])], **more))
    ((_, (trace,)),) = made.choices
    return trace["x"], trace["y"]


@pytest.mark.parametrize("form", ["line", "dotted", "joined points"])
def test_line_of_somebodys_own_series_over_simulated_time_stops_at_a_gap(form: Form) -> None:
    x, y = plain(AWAY, form)

    assert strokes(x, y) == [(39.0, 60.0)]
    assert set(AWAY + 1.0) == set(y[np.isfinite(y)])


@pytest.mark.parametrize("form", ["points", "steps"])
def test_what_has_no_line_or_holds_has_no_gap(form: str) -> None:
    assert np.array_equal(plain(AWAY, form)[0], AWAY)


def test_line_over_anything_but_time_goes_through() -> None:
    assert np.array_equal(plain(AWAY, x=Axis(quantity="east", unit="km"))[0], AWAY)


def test_line_that_is_broken_already_has_no_second_break() -> None:
    (figure,) = grouped_lines({"a": (AWAY, AWAY + 1.0)}, title="some", y=Axis(unit="m"))
    assert isinstance(figure, Figure)
    (mark,) = figure.choices[0].marks
    ((_, (trace,)),) = to_plotly(figure).choices

    assert np.array_equal(trace["x"], mark.x)
    assert strokes(trace["x"], trace["y"]) == [(39.0, 60.0)]


def test_lines_of_a_figure_are_bounded_and_the_rest_is_told() -> None:
    x = np.arange(200.0)
    series = {f"agent-{number:04}": (x, x) for number in range(1, 1001)}

    figure, remark = grouped_lines(series, title="some", y=Axis(unit="m"))

    marks = [mark for choice in figure.choices for mark in choice.marks]
    assert len(marks) == SERIES_PER_FIGURE == 666
    assert sum(len(mark.x) for mark in marks) <= POINTS_PER_FIGURE
    assert remark.text == "some: 334 of 1000 are not drawn, those behind agent-0666."


def test_lines_up_to_the_bound_are_all_drawn() -> None:
    x = np.arange(3.0)
    series = {str(number): (x, x) for number in range(SERIES_PER_FIGURE)}

    (figure,) = grouped_lines(series, title="some", y=Axis(unit="m"))

    assert sum(len(choice.marks) for choice in figure.choices) == SERIES_PER_FIGURE
