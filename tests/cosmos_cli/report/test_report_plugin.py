"""Figures and comparisons of a simulation of one's own: drawn, and done without where its code fails."""

import dataclasses
import json
import re
from pathlib import Path

import numpy as np
import pytest
from harness.synthetic_run import SyntheticRun, make_config

from cosmos_cli import app
from cosmos_cli.collect.finish import finish_run
from cosmos_cli.report.build import build_sections, with_simulation
from madns_runtime.analysis.values import Figure, ReportRemark, TableBlock
from madns_runtime.config import Timeouts
from madns_runtime.plugin.kept_names import KEPT_NAMES
from madns_runtime.recording.records import Field, StreamSchema

pytestmark = pytest.mark.process  # code that is not shipped is asked in a fork

DOCS = Path(__file__).parents[3] / "docs/plugins.md"
PATH = StreamSchema("path", (Field("t_s", "s"), Field("x_m", "m"), Field("y_m", "m")))
TICKS = 30
DESCRIPTOR = """
from dataclasses import dataclass

from madns_runtime.plugin.api import Simulation


@dataclass(frozen=True)
class Parameters:
    pass


simulation = Simulation(
    name="rover", parameters=Parameters, agent=":Agent", figures="./figures.py:figures", compare="./figures.py:compare",
    document="./figures.py:document"
)
"""


def example():
    """Return the code that the documentation shows."""
    section = DOCS.read_text(encoding="utf-8").split("## Figures of your own\n")[1]
    return re.search(r"```python\n(.*?)```", section, re.DOTALL)[1]


@pytest.fixture
def drive(own_places, tmp_path):
    (tmp_path / "rover.py").write_text(DESCRIPTOR)
    (tmp_path / "figures.py").write_text(example())

    def run_once(*, north_m=0.0, loading_s=60.0):
        config = dataclasses.replace(
            make_config(2, ticks=TICKS),
            simulation="./rover.py:simulation",
            base_directory=str(tmp_path),
            timeouts=Timeouts(loading_s=loading_s),
        )
        made = SyntheticRun(tmp_path / "runs", config).write(health_count=0)
        for number, name in enumerate(made.names):
            recorder = made.recorder(f"agents/{name}", name, PATH)
            for tick in range(TICKS):
                recorder.record("path", (tick / 10, 3.0 * tick, 4.0 * tick * number + north_m))
            recorder.close()
        finish_run(made.run, made.result(), made.expected, has_report=False)
        return made

    return run_once


def sections_of(made):
    document = made.run.read_json(made.run.run_json)
    return {section.title: section.blocks for section in build_sections(made.run, document)}


def test_documented_example_draws_its_own_figures_and_its_stream_is_not_drawn_twice(drive):
    sections = sections_of(drive())

    figure, table = sections["Paths"]
    assert "Stream path" not in sections
    assert isinstance(figure, Figure)
    assert figure.is_to_scale
    assert [mark.name for mark in figure.choices[0].marks] == ["agent-01", "agent-02"]
    np.testing.assert_array_equal(figure.choices[0].marks[1].y, 4.0 * np.arange(TICKS))
    assert isinstance(table, TableBlock)
    assert table.rows == [["agent-01", 3.0 * (TICKS - 1)], ["agent-02", 5.0 * (TICKS - 1)]]


def test_documented_example_compares_two_runs(drive, capsys):
    drive(), drive(north_m=7.0)

    assert app.run(["diff", "1", "2", "--json", "--quiet"]) == 0
    document = json.loads(capsys.readouterr().out)
    app.run(["diff", "1", "2", "--quiet"])
    told = capsys.readouterr().out

    assert document["rover"] == {"apart_m": {"agent-01": 7.0, "agent-02": 7.0}}
    assert "Rovers at the end, distance between A and B\nrover     m\nagent-01  7" in told


BROKEN = {
    "raises": (
        "def figures(run):\n    raise KeyError('gone')",
        "figures.py:2: figures(): KeyError",
    ),
    "is no module": ("def figures(run:\n", "SyntaxError"),
    "lacks its function": ("x = 1", "has no 'figures'"),
    "ends the process": ("import os\nos._exit(0)", "os._exit(0)"),
    "kills itself": (
        "import os, signal\ndef figures(run):\n    os.kill(os.getpid(), signal.SIGKILL)",
        "SIGKILL",
    ),
    "hangs": ("def figures(run):\n    while True:\n        pass", "was not done within 0.5 s"),
    "returns something else": ("def figures(run):\n    return [1]", "must return"),
    "returns what no page holds": (
        "from madns_runtime.analysis.values import *\n"
        "def figures(run):\n"
        "    table = TableBlock(title='t', headings=headings('a'), rows=[[object()]])\n"
        "    return [Section(title='s', blocks=[table])]",
        "figures hold numbers, texts and values of theirs",
    ),
    "draws a mark without its figure": (
        "from madns_runtime.analysis.values import *\n"
        "def figures(run):\n"
        "    return [Section(title='s', blocks=[Series(x=[1, 2], y=[1, 2])])]",
        "figures(), in section 's', must give blocks as a list of Figure, SpaceFigure, TableBlock and ReportRemark,"
        " got Series",
    ),
    "has a class of its own by the name of one of ours": (
        "from dataclasses import dataclass\n"
        "from madns_runtime.analysis.values import Section, TableBlock, headings\n"
        "@dataclass\nclass Axis:\n    length_m: float\n"
        "def figures(run):\n"
        "    table = TableBlock(title='t', headings=headings('a'), rows=[[Axis(3.0)]])\n"
        "    return [Section(title='s', blocks=[table])]",
        "figures hold numbers, texts and values of theirs, got Axis",
    ),
    "changes a table that was made": (
        "from madns_runtime.analysis.values import *\n"
        "def figures(run):\n"
        "    table = TableBlock(title='t', headings=headings('a'), rows=[[1]])\n"
        "    table.rows.append([1, 2])\n"
        "    return [Section(title='s', blocks=[table])]",
        "figures() of ./rover.py:simulation: table 't': row 1 has 2 cells, the head 1",
    ),
    "forgets to return": (
        "def figures(run):\n    []",
        "figures.py:1: figures() returned nothing: is there no `return`?",
    ),
    "draws what does not fit together": (
        "from madns_runtime.analysis.values import *\n"
        "def figures(run):\n    return [Series(x=[1, 2], y=[1])]",
        "figures.py:3: figures(): ValueError: Series: expected one length, got x 2, y 1",
    ),
}


@pytest.mark.parametrize("what", BROKEN)
def test_report_of_a_plug_in_that_fails_is_written_with_a_remark(drive, tmp_path, what):
    made = drive(loading_s=0.5 if what == "hangs" else 60.0)
    code, told = BROKEN[what]
    (tmp_path / "figures.py").write_text(code)

    sections = sections_of(made)

    (remark,) = sections["Figures of the simulation"]
    assert isinstance(remark, ReportRemark)
    assert told in remark.text
    assert [block.title for block in sections["Stream path"]] == ["x", "y"]
    assert "Real time" in sections


def test_report_of_a_plug_in_that_is_gone_is_written_with_a_remark(drive, tmp_path):
    made = drive()
    (tmp_path / "rover.py").unlink()

    sections = sections_of(made)

    assert "no file" in sections["Figures of the simulation"][0].text
    assert len(sections["Stream path"]) == 2


def test_comparison_of_a_plug_in_that_fails_is_told_and_the_records_are_compared(
    drive, tmp_path, capsys
):
    drive(), drive(north_m=7.0)
    (tmp_path / "figures.py").write_text("def compare(a, b):\n    return 1 / 0")

    assert app.run(["diff", "1", "2", "--json", "--quiet"]) == 0
    document = json.loads(capsys.readouterr().out)

    assert any("ZeroDivisionError" in remark for remark in document["remarks"])
    assert [stream["table"] for stream in document["streams"] if not stream["identical"]] == [
        "path"
    ]


ARRAYS = (
    "{'x_m': np.array([1.0, np.nan]), 'mean_m': float('nan'), 'count': np.int64(2),"
    " 'numbers': np.array([2**53 + 1]), 'is_there': np.array([True]), 'names': np.array(['agent-01']),"
    " 'masked_m': np.ma.masked_array([1.0, 2.0], [False, True])}"
)
PLAIN = {
    "x_m": [1.0, None],
    "mean_m": None,
    "count": 2,
    "numbers": [2**53 + 1],
    "is_there": [True],
    "names": ["agent-01"],
    "masked_m": [1.0, None],
}


def test_arrays_and_numbers_that_are_not_finite_are_lists_and_null_in_the_json(
    drive, tmp_path, capsys
):
    made = drive()
    drive(north_m=7.0)
    (tmp_path / "figures.py").write_text(
        "import numpy as np\nfrom madns_runtime.analysis.values import SimulationDifference\n"
        f"def document(run):\n    return {ARRAYS}\n"
        f"def compare(a, b):\n    return SimulationDifference(document={ARRAYS}, blocks=[])"
    )
    document = made.run.read_json(made.run.run_json)

    told = with_simulation(made.run, document, pytest.fail)
    assert app.run(["diff", "1", "2", "--json", "--quiet"]) == 0
    compared = json.loads(capsys.readouterr().out)

    assert {name: told[name] for name in PLAIN} == compared["rover"] == PLAIN
    assert set(compared) == {"rover", *KEPT_NAMES}, "no simulation may be called like a key"


def test_a_comparison_that_returns_nothing_is_a_remark(drive, tmp_path, capsys):
    drive(), drive(north_m=7.0)
    (tmp_path / "figures.py").write_text("def compare(a, b):\n    a.streams")

    assert app.run(["diff", "1", "2", "--json", "--quiet"]) == 0
    remarks = json.loads(capsys.readouterr().out)["remarks"]

    assert any("figures.py:1: compare() returned nothing" in remark for remark in remarks)


@pytest.mark.parametrize(
    ("values", "fault"),
    [
        ("document='x', blocks=[]", "compare()'s document must return a mapping, got str"),
        ("document={}, blocks='table'", "compare() must give blocks as a list of Figure"),
    ],
)
def test_a_comparison_of_other_values_is_a_remark(drive, tmp_path, capsys, values, fault):
    drive(), drive(north_m=7.0)
    (tmp_path / "figures.py").write_text(
        "from madns_runtime.analysis.values import SimulationDifference\n"
        f"def compare(a, b):\n    return SimulationDifference({values})"
    )

    assert app.run(["diff", "1", "2", "--json", "--quiet"]) == 0
    compared = json.loads(capsys.readouterr().out)

    assert any(fault in remark for remark in compared["remarks"])
    assert "rover" not in compared


def test_numbers_of_a_simulation_stand_in_the_json_and_never_over_the_run_s_own(drive, tmp_path):
    made = drive()
    (tmp_path / "figures.py").write_text(
        "def figures(run):\n"
        "    raise SystemExit('nobody asked for figures')\n"
        "def document(run):\n"
        "    return {'driven_m': 5.0, 'verdict': 'fine'}"
    )
    document = made.run.read_json(made.run.run_json)
    warnings = []

    told = with_simulation(made.run, document, warnings.append)

    assert told["driven_m"] == 5.0
    assert told["verdict"] == document["verdict"]
    (warning,) = warnings
    assert "rover.py:simulation tells verdict, which run.json has" in warning


@pytest.mark.parametrize(
    ("body", "fault"),
    [
        ("1 / 0", "ZeroDivisionError"),
        ("return [3]", "document() must return a mapping, got list"),
        ("{'driven_m': 5.0}", "figures.py:1: document() returned nothing: is there no `return`?"),
    ],
)
def test_a_simulation_that_fails_to_tell_its_numbers_is_named(drive, tmp_path, body, fault):
    made = drive()
    (tmp_path / "figures.py").write_text(f"def document(run):\n    {body}\n")
    document = made.run.read_json(made.run.run_json)
    warnings = []

    assert with_simulation(made.run, document, warnings.append) == document
    (warning,) = warnings
    assert fault in warning
