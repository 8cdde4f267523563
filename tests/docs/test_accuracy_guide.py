"""docs/accuracy.md says what the benchmark prints, and its example flies."""

import importlib.util
import math
import sys
from datetime import UTC, datetime

import numpy as np
import pytest
from guides import ROOT, blocks

from madns_runtime.simulations.constellation.orbit.constants import EGM_96
from madns_runtime.simulations.constellation.parameters import PROPAGATORS, CustomPropagator
from madns_runtime.simulations.constellation.truth.propagation import (
    PropagationParameters,
    propagate,
)

GUIDE = (ROOT / "docs/accuracy.md").read_text("utf-8")
NOT_INSTALLED = {name for name in ("numba",) if importlib.util.find_spec(name) is None}
"""Propagators that the benchmark leaves out here."""
ROUNDING = {("Between knots", "0.1")}
"""Rows that are the machine's own rounding: a nanometre is one bit of a coordinate."""


@pytest.fixture(scope="module")
def load():
    """Loads a benchmark as if it were run, beside its neighbours."""
    folder = str(ROOT / "benchmarks")
    sys.path.insert(0, folder)
    loaded = []

    def load_benchmark(name):
        specification = importlib.util.spec_from_file_location(name, ROOT / f"benchmarks/{name}.py")
        module = importlib.util.module_from_spec(specification)
        sys.modules[name] = module
        loaded.append(name)
        specification.loader.exec_module(module)
        return module

    yield load_benchmark
    sys.path.remove(folder)
    for name in {*loaded, "accuracy", "accuracy_edges"}:
        sys.modules.pop(name, None)


def table_under(title):
    """Return the rows of a section's table, without its head."""
    body = GUIDE.split(f"## {title}\n")[1].split("\n## ")[0]
    rows = [line for line in body.splitlines() if line.startswith("|")][2:]
    return [[cell.strip() for cell in row.strip("|").split("|")] for row in rows]


def test_the_guide_names_the_command_and_holds_every_table(load):
    sections = load("accuracy").SECTIONS

    assert "    python benchmarks/truth.py --accuracy\n" in GUIDE
    for section in sections:
        assert load("accuracy").heading(section) in GUIDE
        assert table_under(section.title)
    assert GUIDE.count("\n## ") == len(sections)


@pytest.mark.slow
@pytest.mark.parametrize(
    "title", ["Between knots", "Drag", "Attitude between knots", "Flown on from records"]
)
def test_printed_figures_are_those_of_the_guide(load, title):
    (section,) = (each for each in load("accuracy").SECTIONS if each.title == title)
    expected = {row[0]: row[1:] for row in table_under(title) if row[0] not in NOT_INSTALLED}

    found = {name: figures for name, *figures in section.rows()}

    assert list(found) == list(expected)
    for name, figures in found.items():
        decades_max = 0.8 if (title, name) in ROUNDING else 0.35  # one printed digit may be another
        for got, said in zip(figures, expected[name], strict=True):
            assert abs(math.log10(float(got) / float(said))) < decades_max, (name, got, said)


def test_the_guide_lists_every_propagator():
    listed = {line.split("`")[1] for line in GUIDE.splitlines() if line.startswith("| `")}

    assert listed == set(PROPAGATORS)


def test_the_propagator_of_ones_own_flies(tmp_path):
    (tmp_path / "straight.py").write_text(blocks(GUIDE, "python")[0])
    settings = CustomPropagator(kind="custom", implementation="straight.py:Straight")
    parameters = PropagationParameters(
        settings=settings,
        gravity=EGM_96,
        epoch_utc=datetime(2000, 1, 1, tzinfo=UTC),
        base_directory=str(tmp_path),
    )

    found = propagate(np.array([[7e6, 0, 0, 1, 2, 3]] * 2), 5.0, np.array([5.0, 15.0]), parameters)

    assert found[1].tolist() == [[7e6, 0, 0, 1, 2, 3], [7e6 + 10, 20, 30, 1, 2, 3]]


@pytest.mark.nightly
def test_the_benchmark_races_judges_and_says_who_is_left_out(load, capsys, monkeypatch):
    truth = load("truth")
    monkeypatch.setattr(truth, "BASILISK_COUNT_MAX", 2)
    monkeypatch.setattr(truth, "ALONE_ROUNDS", 20)

    times_ms = {count: truth.race(count, 1) for count in (2, 3)}
    alone_ms = {kind: truth.alone(settings) for kind, settings in truth.alone_settings()}
    truth.print_times(times_ms)
    truth.print_alone(alone_ms)
    truth.print_goals(times_ms, {"scipy": {"p50": 1.0, "p99": 2.5}}, {"numba": 1e-6})

    text = capsys.readouterr().out
    assert "Basilisk is left out beyond 2 vehicles" in text
    assert "scipy" in alone_ms
    assert "basilisk 0.1 s, rigid" not in times_ms[3]
    assert "not measured  default over basilisk 0.1 s, rigid, at 93 vehicles" in text
    assert "met           agreement over 4 h: <= 1e-05 m: 1.0e-06 m" in text
    assert "NOT MET       one vehicle anew, scipy, p99: <= 2 ms: 2.500 ms" in text
