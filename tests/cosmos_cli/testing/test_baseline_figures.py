"""Figures of a run by the names of a baseline, and the baseline that is written anew."""

import math
from typing import get_args

import pytest
import yaml
from harness.synthetic_run import SyntheticRun

from cosmos_cli.errors import InputError
from cosmos_cli.evidence.tabulate import gather
from cosmos_cli.models.baseline import Statistic, read_baseline
from cosmos_cli.testing.baseline_update import update_baseline
from cosmos_cli.testing.figures import ComparedFigure, compare_figures
from madns_runtime.plain_values import is_real
from madns_runtime.recording.records import Field, StreamSchema

BASELINE = """\
# What the run of the ring comes to.
figures:
  ticks: {path: timing.ticks, expected: 400}   # of both agents
  first check: {path: "checks[0].got", expected: 3}
  status: {path: status, expected: complete}
  trips:
    stream: round_trips
    field: round_trip_us
    statistic: count
    expected: 400
  mean trip: {stream: round_trips, field: round_trip_us, statistic: mean, expected: 340, relative: 0.2}
  one trip: {stream: round_trips, field: round_trip_us, statistic: rms, agents: [agent-02], expected: 340, tolerance: 60}
  last packet: {stream: round_trips, field: packet, statistic: last, expected: 199}
"""
DOCUMENT = {"timing": {"ticks": 400}, "checks": [{"got": 3}], "status": "complete"}


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    made = SyntheticRun(tmp_path_factory.mktemp("runs")).write()
    gather(made.run, 10.0, lambda *told: None)
    return made.run


@pytest.fixture
def baseline(tmp_path):
    def write(text):
        path = tmp_path / "b.yaml"
        path.write_text(text)
        return read_baseline(path)

    return write


def test_figures_of_run_json_and_of_streams_are_compared_within_their_tolerance(baseline, run):
    compared = compare_figures(baseline(BASELINE), run, DOCUMENT)

    assert {each.name: each.passed for each in compared} == dict.fromkeys(
        ["ticks", "first check", "status", "trips", "mean trip", "one trip", "last packet"], True
    )
    assert {each.name: each.allowed for each in compared}["mean trip"] == pytest.approx(68)


@pytest.mark.parametrize("statistic", get_args(Statistic))
def test_every_statistic_gives_a_number(baseline, run, statistic):
    figure = f"{{stream: round_trips, field: round_trip_us, statistic: {statistic}}}"
    (compared,) = compare_figures(baseline(f"figures: {{a: {figure}}}"), run, DOCUMENT)

    assert is_real(compared.got)


@pytest.mark.parametrize(
    ("figure", "words"),
    [
        ("{path: timing.tics, expected: 1}", "run.json has no timing.tics: there is no tics"),
        ("{path: timing, expected: 1}", "no single value"),
        ("{path: 'checks[7].got', expected: 1}", "there is no 7"),
        ("{stream: nil, field: x, statistic: mean, expected: 1}", "no stream nil; there are"),
        ("{stream: ticks, field: x, statistic: mean, expected: 1}", "no field x in ticks; there"),
        (
            "{stream: ticks, field: missed, statistic: mean, agents: [x], expected: 1}",
            "no agent is named x",
        ),
        (
            "{stream: ticks, field: missed, statistic: mean, agents: ['*', agnet-02], expected: 0}",
            "no agent is named agnet-02",
        ),
        ("{path: timing.ticks}", "has no expected value: write it with cosmos test"),
        ("{path: timing.ticks, expected: 399}", "expected 399, got 400"),
        ("{path: timing.ticks, expected: '400'}", "expected '400', got 400"),
        ("{path: timing.ticks, expected: true}", "expected true, got 400"),
    ],
)
def test_what_does_not_hold_says_why(baseline, run, figure, words):
    (compared,) = compare_figures(baseline(f"figures: {{a: {figure}}}"), run, DOCUMENT)

    assert not compared.passed
    assert words in compared.reason()


@pytest.mark.parametrize("path", ['devices["imu.1"].read', 'devices["imu.1"]["a [b]"]', "names.0"])
def test_a_key_with_a_dot_stands_in_brackets_and_quotes(baseline, run, path):
    document = {"devices": {"imu.1": {"read": 7, "a [b]": 7}}, "names": [7]}

    (compared,) = compare_figures(
        baseline(f"figures: {{a: {{path: '{path}', expected: 7}}}}"), run, document
    )

    assert compared.passed


def test_a_dot_outside_of_quotes_parts_two_keys(baseline, run):
    (compared,) = compare_figures(
        baseline("figures: {a: {path: devices.imu.1, expected: 7}}"),
        run,
        {"devices": {"imu.1": 7}},
    )

    assert "there is no imu" in compared.reason()


@pytest.mark.parametrize("got", [math.nan, math.inf, None])
def test_what_is_no_number_never_passes(got):
    assert not ComparedFigure(name="a", expected=1.0, got=got, allowed=1e9).passed


def test_records_are_counted_by_a_field_of_any_kind_that_they_have(baseline, tmp_path):
    made = SyntheticRun(tmp_path / "runs").write()
    kinds = {"i": "int", "f": "float", "b": "bool", "s": "str", "j": "json"}
    schema = StreamSchema("x", tuple(Field(name, "", kind) for name, kind in kinds.items()))
    recorder = made.recorder("agents/agent-01", "agent-01", schema)
    recorder.record("x", (2**60, 1.5, True, "a", [1]))
    recorder.record("x", (None, None, None, None, None))
    recorder.record("x", (3, 2.5, False, "", {}))
    recorder.close()
    gather(made.run, 10.0, lambda *told: None)
    text = "".join(f"  {name}: {{stream: x, field: {name}, statistic: count}}\n" for name in kinds)

    compared = compare_figures(baseline(f"figures:\n{text}"), made.run, {})

    assert {each.name: each.got for each in compared} == dict.fromkeys(kinds, 2)


def test_a_table_that_is_damaged_gives_no_figure_and_ends_no_suite(baseline, tmp_path):
    made = SyntheticRun(tmp_path / "runs").write()
    gather(made.run, 10.0, lambda *told: None)
    table = made.run.tables / "round_trips.parquet"
    data = table.read_bytes()
    table.write_bytes(data[:200] + bytes(400) + data[600:])
    found = baseline("figures: {a: {stream: round_trips, field: packet, statistic: mean}}")

    (compared,) = compare_figures(found, made.run, {})

    assert compared.got is None
    assert "round_trips.parquet: damaged" in compared.reason()


def test_no_record_of_an_agent_that_there_is_counts_as_0_and_has_no_other_figure(
    baseline, tmp_path
):
    made = SyntheticRun(tmp_path / "runs").write()
    made.recorder("agents/agent-01", "agent-01", StreamSchema("x", (Field("x_m", "m"),))).close()
    gather(made.run, 10.0, lambda *told: None)
    of_x = "stream: x, field: x_m"
    text = (
        f"figures:\n  all: {{{of_x}, statistic: count}}\n  other: {{{of_x}, statistic: count, agents: ['*-02']}}\n"
        f"  nobody: {{{of_x}, statistic: count, agents: [agent-9]}}\n  mean: {{{of_x}, statistic: mean}}\n"
    )

    compared = {each.name: each for each in compare_figures(baseline(text), made.run, {})}

    assert (compared["all"].got, compared["other"].got) == (0, 0)
    assert compared["nobody"].reason() == "nobody: no agent is named agent-9"
    assert compared["mean"].reason() == "mean: nobody of * recorded x"


@pytest.mark.filterwarnings("error::RuntimeWarning")
@pytest.mark.parametrize("statistic", ["mean", "rms", "sd"])
def test_a_statistic_of_values_that_diverged_never_passes_and_is_no_number(
    baseline, tmp_path, statistic
):
    made = SyntheticRun(tmp_path / "runs").write()
    schema = StreamSchema("x", (Field("tick", "", "int"), Field("x_m", "m")))
    recorder = made.recorder("agents/agent-01", "agent-01", schema)
    for tick in range(3):
        recorder.record("x", (tick, 1.7e308))
    recorder.close()
    gather(made.run, 10.0, lambda *told: None)
    text = f"figures: {{d: {{stream: x, field: x_m, statistic: {statistic}, expected: 1}}}}"

    (figure,) = compare_figures(baseline(text), made.run, {})

    assert (figure.got, figure.passed) == (None, False)
    assert "so large, up to 1.7e+308, that it is not finite" in figure.why_none


def test_new_values_are_written_and_nothing_else_is_touched(baseline):
    text = BASELINE.replace("expected: 400}", "expected: 12}").replace("\n    expected: 400", "")
    text = text.replace(", expected: 3}", "}").replace("expected: complete", 'expected: "a \\" b"')
    found = baseline(text)
    values = {"ticks": 400, "first check": 3, "status": "complete", "trips": 400, "mean trip": 1e-7}
    compared = [
        ComparedFigure(name=name, expected=figure.expected, got=values.get(name, figure.expected))
        for name, figure in found.figures.items()
    ]

    assert update_baseline(found, compared) == 5
    written = found.path.read_text()
    assert "  ticks: {path: timing.ticks, expected: 400}   # of both agents\n" in written
    assert '  first check: {expected: 3, path: "checks[0].got"}\n' in written
    assert "    expected: 400\n    stream: round_trips\n" in written
    assert written.startswith("# What the run of the ring comes to.\n")
    before, after = yaml.safe_load(text)["figures"], yaml.safe_load(written)["figures"]
    assert [*after] == [*before]
    for name, figure in after.items():
        assert figure.pop("expected") == pytest.approx(
            values.get(name, found.figures[name].expected)
        )
        before[name].pop("expected", None)
    assert after == before


def test_values_within_their_tolerance_are_left(baseline):
    found = baseline("figures: {a: {path: x, expected: 1.0, tolerance: 0.5}}")
    close = ComparedFigure(name="a", expected=1.0, got=1.2, allowed=0.5)

    assert update_baseline(found, [close]) == 0
    assert "expected: 1.0" in found.path.read_text()


def test_what_is_written_keeps_the_ends_of_lines_and_the_mark_of_the_file(tmp_path, run):
    path = tmp_path / "b.yaml"
    path.write_bytes(b"\xef\xbb\xbffigures:\r\n  a:\r\n    path: x\r\n    tolerance: 1\r\n")
    found = read_baseline(path)

    assert update_baseline(found, compare_figures(found, run, {"x": 9})) == 1
    assert path.read_bytes() == (
        b"\xef\xbb\xbffigures:\r\n  a:\r\n    expected: 9\r\n    path: x\r\n    tolerance: 1\r\n"
    )


@pytest.mark.parametrize("got", [6878137.123456789, 1 / 3, 1e-7 / 3, float(2**60 + 1024), 12.5])
@pytest.mark.parametrize("tolerance", ["", ", tolerance: 1e-17", ", relative: 1e-15"])
def test_what_was_written_holds_for_the_same_value_however_small_the_tolerance(
    baseline, run, got, tolerance
):
    found = baseline(f"figures: {{a: {{path: x{tolerance}}}}}")
    compared = compare_figures(found, run, {"x": got})

    assert update_baseline(found, compared) == 1
    (again,) = compare_figures(read_baseline(found.path), run, {"x": got})
    assert again.passed


def test_what_is_written_has_few_digits_where_the_tolerance_lets_it(baseline, run):
    found = baseline("figures: {a: {path: x, relative: 0.01}, b: {path: y, tolerance: 1e-6}}")

    update_baseline(found, compare_figures(found, run, {"x": 1 / 3, "y": 2 / 3}))

    assert "expected: 0.3333333333, path: x" in found.path.read_text()
    assert "expected: 0.6666666667, path: y" in found.path.read_text()


@pytest.mark.parametrize(
    ("expected", "got", "told"),
    [
        (1.0, 1.0 + 2**-50, "expected 1.0, got 1.0000000000000009"),
        (12345678901.0, 12345678902, "expected 12345678901.0, got 12345678902"),
        ("true", True, "expected 'true', got true"),
        (True, "true", "expected true, got 'true'"),
    ],
)
def test_values_that_look_the_same_in_few_digits_are_told_apart(expected, got, told):
    assert ComparedFigure(name="a", expected=expected, got=got).reason() == f"a: {told}"


@pytest.mark.parametrize(("expected", "got"), [(0.8, 0.7), (0.3, 0.4), (1.1, 1.2)])
def test_a_value_at_the_edge_of_its_tolerance_is_within(expected, got):
    assert ComparedFigure(name="a", expected=expected, got=got, allowed=0.1).passed
    assert not ComparedFigure(name="a", expected=expected, got=got, allowed=0.0999999).passed


def test_a_figure_without_a_value_is_refused_at_its_place(baseline):
    found = baseline("figures: {a: {path: x}}")
    missing = ComparedFigure(name="a", expected=None, got=None, why_none="run.json has no x")

    with pytest.raises(InputError, match="b.yaml:1:11: figures.a: run.json has no x"):
        update_baseline(found, [missing])


@pytest.mark.parametrize(
    "figures",
    [
        "figures:\n  a:\n    path: x\n    expected:   # written by the first run\n  b: {path: y, expected: }\n",
        "figures:\n  a: {path: x, expected}\n  b: {expected: ~, path: y}\n",
        "figures:\n  a: &close {path: x, tolerance: 1}\n  b:\n    <<: *close\n    path: y\n",
        "figures:\n  a: &close {path: x, expected: 3}\n  b: {<<: *close, path: y}\n",
    ],
)
def test_an_empty_value_is_filled_and_what_figures_share_stays_shared(baseline, figures):
    found = baseline(figures)
    compared = [
        ComparedFigure(name="a", expected=None, got=12.5),
        ComparedFigure(name="b", expected=None, got='new: "1" #'),
    ]

    assert update_baseline(found, compared) == 2
    written = read_baseline(found.path)
    assert {name: each.expected for name, each in written.figures.items()} == {
        "a": 12.5,
        "b": 'new: "1" #',
    }
    assert [each.tolerance for each in written.figures.values()] == [
        each.tolerance for each in found.figures.values()
    ]


@pytest.mark.parametrize(
    ("figures", "line"),
    [
        ("figures:\n  a:\n    path: x\n    expected: |\n      two\n      lines\n", 2),
        ('figures:\n  a:\n    path: x\n    expected: "two\n      lines"\n', 2),
        ("figures:\n  a: {path: x, expected: !!int 3}\n", 2),
        ("figures:\n  b: {path: y, expected: &three 3}\n  a: {path: x, expected: *three}\n", 3),
        ("figures:\n  b: &same {path: y, expected: 3}\n  a: *same\n", 3),
    ],
)
def test_a_value_that_cannot_be_replaced_leaves_the_file_as_it_is(baseline, figures, line):
    found = baseline(figures)

    with pytest.raises(
        InputError, match=f"b.yaml:{line}:3: figures.a: .* write `expected: 12.5` by hand"
    ):
        update_baseline(found, [ComparedFigure(name="a", expected=3.0, got=12.5)])
    assert found.path.read_text() == figures


def test_letters_that_other_programs_take_for_line_ends_are_none(baseline):
    found = baseline("# a\u2028b\x85c\r\nfigures:\n  a: {path: a, expected: 3.0}  # \u2029 x\n")
    before = found.path.read_bytes()

    assert update_baseline(found, [ComparedFigure(name="a", expected=3.0, got=12.5)]) == 1
    assert found.path.read_bytes() == before.replace(b"3.0", b"12.5")


@pytest.mark.parametrize(
    "got",
    [
        "\U0001f6f0 of \U0010ffff",
        "a\\ud83d\\ude00",
        "\x7f \x1b\x85\u2028\ufeff\ufffe",
        2**53 + 1,
        -(2**60) + 1,
    ],
)
def test_any_text_and_whole_number_is_written_and_holds(baseline, got):
    found = baseline("figures: {a: {path: x, expected: 1}}")

    assert update_baseline(found, [ComparedFigure(name="a", expected=1.0, got=got)]) == 1
    written = read_baseline(found.path).figures["a"].expected
    assert ComparedFigure(name="a", expected=written, got=got).passed


@pytest.mark.parametrize("old", ["'it''s'", "''", "''''", '"a \\" b"', '""', r"'a\'"])
def test_a_quoted_text_is_replaced_in_whole(baseline, old):
    found = baseline(f"figures: {{a: {{path: x, expected: {old}, tolerance: 0}}}}  # it's\n")

    update_baseline(found, [ComparedFigure(name="a", expected="it", got="new")])
    assert found.path.read_text() == (
        'figures: {a: {path: x, expected: "new", tolerance: 0}}  # it\'s\n'
    )


def test_a_link_to_a_baseline_stays_a_link(baseline, tmp_path):
    baseline("figures: {a: {path: x, expected: 1}}")
    link = tmp_path / "link.yaml"
    link.symlink_to("b.yaml")

    update_baseline(read_baseline(link), [ComparedFigure(name="a", expected=1.0, got=2.0)])

    assert link.is_symlink()
    assert "expected: 2" in (tmp_path / "b.yaml").read_text()


def test_what_was_written_into_a_baseline_while_the_tests_ran_stays(baseline):
    found = baseline("figures: {a: {path: x, expected: 1}}")
    theirs = "figures: {a: {path: x, expected: 1, tolerance: 5}}  # a person's\n"
    found.path.write_text(theirs)

    with pytest.raises(InputError, match="b.yaml: was changed while the tests ran; nothing is"):
        update_baseline(found, [ComparedFigure(name="a", expected=1.0, got=2.0)])
    assert found.path.read_text() == theirs


def test_last_value_of_an_agent_is_its_last_that_is_there(baseline, tmp_path):
    """As of a sensor that drops out at the end: a record without a value has none."""
    made = SyntheticRun(tmp_path).write()
    for agent, heights in (("agent-01", [900.0, None]), ("agent-02", [100.0, 200.0])):
        recorder = made.recorder(
            f"agents/{agent}", agent, StreamSchema("height", (Field("t_s", "s"), Field("h_m", "m")))
        )
        for number, height in enumerate(heights):
            recorder.record("height", (float(number), height))
        recorder.close()
    gather(made.run, 10.0, lambda *told: None)
    found = baseline("figures: {a: {stream: height, field: h_m, statistic: last, expected: 900}}")

    (compared,) = compare_figures(found, made.run, {})

    assert compared.got == 900.0
