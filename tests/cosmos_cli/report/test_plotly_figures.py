"""Values of figures as plotly.js gets them: quantity, unit, limits, and what cannot be drawn."""

import dataclasses
import warnings

import numpy as np
import pytest
from test_report_browser import CHROMIUM, INSPECT, WATCH, browse

from cosmos_cli.report.html import render_page
from cosmos_cli.report.plotly_figures import to_plotly
from cosmos_cli.report.style import BAD, log_axis
from madns_runtime.analysis import values
from madns_runtime.analysis.plain import from_plain, to_plain
from madns_runtime.analysis.values import (
    Axis,
    Band,
    Bars,
    EventBand,
    Figure,
    FigureChoice,
    Heading,
    HeatMap,
    Histogram,
    LimitLine,
    ReportRemark,
    Section,
    Series,
    SpaceFigure,
    SpacePath,
    TableBlock,
    headings,
)

X = np.arange(5.0)
LINE = Series(x=X, y=X)


def figure(*marks, **more):
    return Figure(title="speed", choices=[FigureChoice(marks=marks)], **more)


EVERY = (
    figure(
        Band(x=X, low=X, high=X + 2.0, name="range"),
        *(
            Series(x=X, y=X + 1.0, name=form, form=form)
            for form in ("line", "dotted", "steps", "points")
        ),
        y=Axis(quantity="speed", unit="m/s"),
        limits=[LimitLine(value=3.5, name="allowed")],
        events=[EventBand(start=1.0, end=2.0, name="red light")],
    ),
    figure(Histogram(edges=X, counts=[1, 2, 3, 4]), x=Axis(quantity="gap", unit="m")),
    figure(
        HeatMap(x=X, y=X[:2], values=np.ones((2, 5)), scale=Axis(quantity="density", unit="1/m"))
    ),
    figure(
        Series(x=np.cos(X), y=np.sin(X)),
        x=Axis(quantity="east", unit="m"),
        y=Axis(unit="m"),
        is_to_scale=True,
    ),
    figure(
        Bars(names=["a", "b"], values=[1.0, None]),
        Bars(names=["a", "b"], values=[3.0, 4.0], panel=1),
        x=Axis(),
        panels=[Axis(quantity="mean", unit="m"), Axis(quantity="max", unit="m")],
    ),
    SpaceFigure(
        title="paths in space",
        unit="m",
        paths=[SpacePath(points=np.ones((3, 3)) * X[:3, None], name="a")],
        spots=SpacePath(points=np.zeros((1, 3)), tone="warm"),
        spot_names=["start"],
    ),
)


def test_axes_tell_quantity_and_unit():
    layout = to_plotly(EVERY[1]).layout

    assert layout["xaxis"]["title"]["text"] == "gap, m"
    assert to_plotly(EVERY[0]).layout["yaxis"]["title"]["text"] == "m/s"


def test_what_lies_beyond_a_limit_is_drawn_as_bad_and_the_limit_where_it_is_seen():
    points = Series(x=X, y=X, form="points")
    drawn = to_plotly(figure(points, limits=[LimitLine(value=2.5)]))
    far = to_plotly(figure(points, limits=[LimitLine(value=99.0)]))

    colours = drawn.choices[0][1][0]["marker"]["color"]
    assert [colour == BAD for colour in colours] == [False, False, False, True, True]
    assert [shape["y0"] for shape in drawn.layout["shapes"]] == [2.5]
    assert far.layout["shapes"] == []
    assert far.choices[0][1][0]["marker"]["color"] != BAD


def test_each_panel_has_the_limits_of_its_own_and_those_of_the_abscissa():
    drawn = to_plotly(
        figure(
            Series(x=X, y=X, form="points"),
            Series(x=X, y=10.0 * X, form="points", panel=1),
            panels=[Axis(quantity="speed", unit="m/s"), Axis(quantity="gap", unit="m")],
            limits=[
                LimitLine(value=2.5, name="speed"),
                LimitLine(value=25.0, name="gap", panel=1),
                LimitLine(value=3.5, name="late", is_of_x=True),
            ],
        )
    )

    lines = {
        (shape.get("label", {}).get("text"), shape["xref"], shape["yref"], shape["x0"], shape["y0"])
        for shape in drawn.layout["shapes"]
    }
    assert lines == {
        ("speed", "x domain", "y", 0, 2.5),
        ("late", "x", "y domain", 3.5, 0),
        ("gap", "x2 domain", "y2", 0, 25.0),
        (None, "x2", "y2 domain", 3.5, 0),
    }
    for trace in drawn.choices[0][1]:
        colours = trace["marker"]["color"]
        assert [colour == BAD for colour in colours] == [False, False, False, True, True]


def test_limit_of_a_panel_that_is_not_there_is_refused():
    with pytest.raises(ValueError, match="no panel 2; it has 1"):
        figure(LINE, limits=[LimitLine(value=1.0, panel=2)])


def test_event_stands_behind_the_marks_over_the_whole_height():
    (event, _limit) = to_plotly(EVERY[0]).layout["shapes"]

    assert (event["x0"], event["x1"], event["yref"], event["layer"]) == (1.0, 2.0, "paper", "below")


def test_map_has_one_scale_on_both_axes():
    assert to_plotly(EVERY[3]).layout["yaxis"]["scaleanchor"] == "x"


def test_what_a_mask_hides_is_a_gap():
    values = np.ma.masked_greater(np.arange(5), 2)
    gaps = [0.0, 1.0, 2.0, np.nan, np.nan]

    np.testing.assert_array_equal(Series(x=X, y=values).y, gaps)
    np.testing.assert_array_equal(
        HeatMap(x=X, y=[0.0], values=values[np.newaxis], scale=Axis()).values, [gaps]
    )


def test_values_come_through_a_process_of_their_own_as_they_were():
    section = Section(
        title="s",
        blocks=[*EVERY, TableBlock(title="t", headings=headings("a", "b"), rows=[["x", np.inf]])],
    )

    back = from_plain(to_plain([section]))[0]

    assert to_plain(back) == to_plain(section)
    np.testing.assert_array_equal(back.blocks[0].choices[0].marks[0].high, X + 2.0)
    assert back.blocks[-1].rows[0] == ["x", np.inf]


@pytest.mark.parametrize(
    ("make", "told"),
    [
        (lambda: Series(x=[1, 2], y=[1]), "Series: expected one length, got x 2, y 1"),
        (lambda: Series(x=[[1]], y=[1]), "Series.x: expected 1 dimensions, got 2"),
        (
            lambda: Series(x=[1, 2], y=np.fft.fft([1.0, 2.0])),
            "Series.y: expected real numbers, got complex128",
        ),
        (
            lambda: Series(x=np.array(["2026-01-01"], "datetime64[s]"), y=[1]),
            "Series.x: expected real numbers, got datetime64",
        ),
        (lambda: Histogram(edges=[1], counts=[1]), "one edge more"),
        (lambda: Histogram(edges=[0, 2, 1], counts=[1, 1]), "edges that ascend"),
        (lambda: Histogram(edges=[0, np.nan], counts=[1]), "edges that ascend"),
        (lambda: HeatMap(x=X, y=X, values=np.ones((2, 5)), scale=Axis()), r"shape \(5, 5\)"),
        (lambda: Bars(names=["a"], values=[]), "1 names and 0 values"),
        (lambda: SpacePath(points=np.ones((3, 2))), r"shape \(N, 3\)"),
        (lambda: figure(), "expected a mark"),
        (lambda: figure(Series(x=X, y=X, panel=1)), "no panel 1"),
        (
            lambda: TableBlock(title="t", headings=headings("a"), rows=[[1, 2]]),
            "2 cells, the head 1",
        ),
        (lambda: Section(title=None, blocks=[]), "Section.title: expected a text, got NoneType"),
        (lambda: Section(title="s", blocks=[], tables="path"), "Section.tables: expected a list"),
        (
            lambda: Section(title="s", blocks=[], tables=[[]]),
            r"Section.tables\[0\]: expected a table",
        ),
        (lambda: Series(x=X, y=X, name=3), "Series.name: expected a text, got int"),
        (lambda: Series(x=X, y=X, tone="mauve"), "Series.tone: expected one of palette, .*'mauve'"),
        (lambda: Series(x=X, y=X, form="dots"), "Series.form: expected one of line, .*'dots'"),
        (lambda: Series(x=X, y=X, panel=0.0), "Series.panel: expected a whole number, got 0.0"),
        (lambda: FigureChoice(marks=[1]), r"FigureChoice.marks\[0\]: expected a mark, .*got int"),
        (lambda: FigureChoice(marks=Series(x=X, y=X)), "FigureChoice.marks: expected a list"),
        (lambda: FigureChoice(marks=[], name=3), "FigureChoice.name: expected a text, got int"),
        (lambda: figure(LINE, x="time"), "Figure.x: expected an Axis, got str"),
        (lambda: figure(LINE, events=None), "Figure.events: expected a list, got NoneType"),
        (lambda: figure(LINE, limits=[1.0]), r"limits\[0\]: expected LimitLine, got float"),
        (lambda: figure(LINE, columns=0), "expected columns, got 0"),
        (lambda: Axis(quantity=3), "Axis.quantity: expected a text, got int"),
        (lambda: LimitLine(value=None), "LimitLine.value: expected a number, got None"),
        (lambda: LimitLine(value=10**400), "LimitLine.value: expected a number, got 1000"),
        (lambda: EventBand(start="0", end=1.0), "EventBand.start: expected a number, got '0'"),
        (lambda: Bars(names=["a"], values=["x"]), "Bars.values: expected a number, got 'x'"),
        (lambda: Bars(names=[1], values=[1]), r"Bars.names\[0\]: expected a text, got int"),
        (lambda: HeatMap(x=X, y=X, values=np.ones((5, 5)), scale="m"), "scale: expected an Axis"),
        (lambda: SpaceFigure(title="t", unit="m", paths=[1]), r"paths\[0\]: expected a SpacePath"),
        (
            lambda: SpaceFigure(title="t", unit="m", paths=[], sphere_radius=0),
            "sphere_radius: expected more than 0, got 0",
        ),
        (lambda: Heading(text=3), "Heading.text: expected a text, got int"),
        (lambda: TableBlock(title=3, headings=[], rows=[]), "TableBlock.title: expected a text"),
        (
            lambda: TableBlock(title="t", headings=headings("a"), rows=["x"]),
            "row 0: expected a list of cells, got str",
        ),
        (
            lambda: TableBlock(title="t", headings=[], rows={}),
            "expected a list of rows, got dict",
        ),
    ],
)
def test_what_does_not_fit_together_is_refused_where_it_is_made(make, told):
    with pytest.raises(ValueError, match=told):
        make()


def test_figure_that_cannot_be_drawn_costs_a_remark_and_not_the_page():
    odd = figure(Series(x=X, y=X))
    object.__setattr__(odd.choices[0].marks[0], "tone", "mauve")

    page = render_page({"run": "r"}, [Section(title="s", blocks=[odd, EVERY[1]])])

    assert "The figure speed could not be drawn: KeyError" in page
    assert 'id="plot0"' in page
    assert 'id="plot1"' not in page


def test_every_value_of_figures_is_drawn_here():
    drawn = {type(mark).__name__ for f in EVERY[:-1] for c in f.choices for mark in c.marks}

    assert drawn == {kind.__name__ for kind in values.Mark.__args__}
    assert all(dataclasses.is_dataclass(kind) for kind in (*values.Block.__args__, ReportRemark))


def test_numbers_of_any_size_are_drawn_without_a_word_of_our_source():
    huge = np.array([-1.7e308, 5e-324, 1.7e308])
    axes = {"x": Axis(is_logarithmic=True), "y": Axis(is_logarithmic=True)}
    drawn = [
        figure(Series(x=huge, y=huge), limits=[LimitLine(value=10**20)], **axes),
        figure(Histogram(edges=huge[1:], counts=[1e308]), events=[EventBand(start=0, end=10**30)]),
        figure(Bars(names=["a", "b"], values=[2**70, np.inf])),
    ]

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.simplefilter("ignore", ResourceWarning)  # of what other tests left unclosed
        page = render_page({"run": "r"}, [Section(title="s", blocks=drawn)])

    assert "The figure speed" not in page
    assert page.count('class="plot"') == len(drawn)


def test_value_between_two_gaps_is_drawn_as_a_point():
    nan = np.nan
    y = np.array([1.0, nan, 2.0, 3.0, nan, nan, 4.0])
    made = to_plotly(figure(Series(x=np.arange(7.0), y=y), Series(x=X, y=X))).choices[0][1]

    assert [trace["mode"] for trace in made] == ["lines+markers", "lines"]
    assert (made[0]["marker"]["size"] > 0).tolist() == [True, *5 * [False], True]


def test_single_value_is_drawn_as_a_point():
    (trace,) = to_plotly(figure(Series(x=X[:1], y=X[:1], form="steps"))).choices[0][1]

    assert trace["mode"] == "lines+markers"
    assert (trace["marker"]["size"] > 0).tolist() == [True]


@pytest.mark.parametrize(
    ("low", "high"), [(62, 95), (500, 509), (110, 190), (2.1, 4.9), (0.031, 0.033), (6e4, 9.9e4)]
)
def test_logarithmic_axis_has_numbers_however_short_it_is(low, high):
    ticks = log_axis(low, high)["tickvals"]

    assert sum(low <= tick <= high for tick in ticks) >= 2


@pytest.mark.parametrize(("low", "high"), [(5e-324, 1e-323), (7.0, 7.0), (5e-324, 1.7e308)])
def test_logarithmic_axis_of_what_cannot_be_told_apart_is_one(low, high):
    assert log_axis(low, high)["tickvals"]


def test_long_names_below_bars_stand_upright_and_short_ones_level():
    def angle(*names):
        made = figure(
            Bars(names=names, values=[1.0] * len(names)),
            x=Axis(),
            panels=[Axis(quantity="mean"), Axis(quantity="max")],
        )
        return to_plotly(made).layout["xaxis1"]["tickangle"]

    assert angle("agent-01", "agent-02", "agent-03") == 0
    assert (
        angle("agent-01", "an-agent-of-a-very-long-name-01", "an-agent-of-a-very-long-name-02")
        == -90
    )
    assert angle(*(f"agent-{number:02} (IRIDIUM 7)" for number in range(6))) == -90


def test_upright_names_take_no_room_from_their_bars():
    def height(name):
        return to_plotly(figure(Bars(names=[name], values=[1.0]), x=Axis())).height_px

    assert height("agent-01") == height("agent-02a")
    assert height("agent-01 (A SATELLITE OF THIS NAME)") > height("agent-01") + 50


def test_names_of_bands_that_would_lie_on_each_other_are_left_out():
    long = "annotate text=something that happened here, again and again, and once more"
    bands = [EventBand(start=t, end=t + 0.1, name=long) for t in np.arange(0.0, 60.0, 2.0)]
    bands += [EventBand(start=70.0, end=75.0, name="kill")]
    made = figure(Series(x=np.arange(100.0), y=np.ones(100)), events=bands)

    shapes = to_plotly(made).layout["shapes"]
    told = [shape["label"]["text"] for shape in shapes if "label" in shape]

    assert len(shapes) == len(bands)
    assert 2 <= len(told) <= 4
    assert told[-1] == "kill"
    assert all(len(text) <= 48 for text in told)


def test_names_of_bands_beside_each_other_are_told_where_both_have_room():
    drop, freeze = "device_fault device=gyro fault=drop value=1.0", "device_fault fault=freeze"
    bands = [EventBand(start=3, end=6, name=drop), EventBand(start=6, end=8, name=freeze)]
    made = figure(Series(x=np.arange(11.0), y=np.ones(11)), events=bands)

    told = [shape["label"]["text"] for shape in to_plotly(made).layout["shapes"]]

    assert told == [drop, freeze]


def test_event_stands_behind_the_marks_of_every_panel_and_is_named_once():
    made = figure(
        Series(x=X, y=X),
        Series(x=X, y=X, panel=1),
        panels=[Axis(quantity="position"), Axis(quantity="velocity")],
        events=[EventBand(start=1.0, end=2.0, name="red light")],
    )

    first, second = to_plotly(made).layout["shapes"]

    assert (first["x0"], first["x1"]) == (second["x0"], second["x1"]) == (1.0, 2.0)
    assert (first["xref"], first["yref"]) == ("x", "y domain")
    assert (second["xref"], second["yref"]) == ("x2", "y2 domain")
    assert first["label"]["text"] == "red light"
    assert "label" not in second


def test_arrays_are_rows_of_a_table_and_columns_of_bars():
    whole = TableBlock(title="t", headings=headings("a", "b"), rows=np.array([[1, 2], [3, 4]]))
    single = TableBlock(title="t", headings=headings("a", "b"), rows=[np.array([1.5, 2.5])])
    bars = Bars(names=np.array(["x", "y"]), values=np.array([1, 2]))

    assert whole.rows == [[1, 2], [3, 4]]
    assert single.rows == [[1.5, 2.5]]
    assert (bars.names, bars.values) == (["x", "y"], [1.0, 2.0])
    assert "<td" in render_page({"run": "r"}, [Section(title="s", blocks=[whole, single])])


@pytest.mark.browser
@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here")
def test_every_value_of_figures_draws_in_a_browser(tmp_path):
    page = tmp_path / "report.html"
    text = render_page({"run": "r"}, [Section(title="s", blocks=EVERY)])
    inspect = INSPECT.replace(".gl-container canvas", ".gl-container canvas, .heatmaplayer image")
    text = text.replace("<style>", WATCH + "<style>", 1).replace("</body>", inspect + "</body>", 1)
    page.write_text(text)

    dom = browse(page, "--dump-dom")

    assert 'data-inspected="yes"' in dom
    for told in ('data-failed="0"', 'data-errors=""', 'data-empty=""', 'data-violations="0"'):
        assert told in dom, dom[:500]


def test_tables_and_remarks_of_other_values_are_refused_where_they_are_made():
    with pytest.raises(ValueError, match=r"headings\[0\]: expected a Heading, got str"):
        TableBlock(title="t", headings=["a"], rows=[[1]])
    with pytest.raises(ValueError, match="ReportRemark.text: expected a text, got int"):
        ReportRemark(text=5)


CUBE = [[100.0, 0.0, 0.0], [101.0, 1.0, 1.0]]
CUBOID = [[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]], [[4.0, 0.5, 2.0]]


@pytest.mark.parametrize(
    ("drawn", "sides"),
    [
        ({"paths": [SpacePath(points=CUBE)]}, (1.0, 1.0, 1.0)),  # far from the origin
        ({"paths": [], "spots": SpacePath(points=CUBE)}, (1.0, 1.0, 1.0)),
        (
            {"paths": [SpacePath(points=CUBOID[0])], "spots": SpacePath(points=CUBOID[1])},
            (1.0, 0.25, 0.5),
        ),
        ({"paths": [SpacePath(points=CUBE)], "sphere_radius": 101.0}, (1.0, 1.0, 1.0)),
        ({"paths": [SpacePath(points=[[0.0, 0.0, 0.0], [2.0, 1.0, 0.0]])]}, (1.0, 0.5, 0.0)),
        ({"paths": [SpacePath(points=[*CUBE, [np.nan, np.inf, 0.0]])]}, (1.0, 1.0, 1.0)),
        ({"paths": [SpacePath(points=[[np.nan] * 3])]}, (1.0, 1.0, 1.0)),
        ({"paths": [SpacePath(points=[[-1.7e308] * 3, [1.7e308] * 3])]}, (1.0, 1.0, 1.0)),
        ({"paths": []}, (1.0, 1.0, 1.0)),
    ],
)
def test_a_scene_has_the_proportions_of_all_that_is_drawn_in_it(drawn, sides):
    with np.errstate(over="ignore"):  # as where a page is written
        scene = to_plotly(SpaceFigure(title="t", unit="m", **drawn)).layout["scene"]

    assert scene["aspectratio"] == pytest.approx(dict(zip("xyz", sides, strict=True)))


def test_keys_of_a_document_that_would_become_one_text_are_refused():
    assert from_plain(to_plain({1: 2, "a": {2.5: [1]}})) == {"1": 2, "a": {"2.5": [1]}}

    with pytest.raises(TypeError, match="keys are texts in JSON, and two of one are '1'"):
        to_plain({"far": {1: 2, "1": 3}})
