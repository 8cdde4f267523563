"""Columns become Arrow arrays as pyarrow itself would make them, and no command imports what that takes and nobody uses."""

import subprocess
import sys

import numpy as np
import pyarrow as pa
import pytest

from cosmos_cli.evidence.arrow_values import (
    floats_array,
    numbers_array,
    one_code,
    to_arrow,
    to_codes,
    to_times,
)

PROGRAM = """
import sys
import numpy as np
import pyarrow as pa
from cosmos_cli.evidence.arrow_values import to_arrow

array, _ = to_arrow(np.arange(3.0), "float")
assert array.to_pylist() == [0.0, 1.0, 2.0]
assert pa.array(["a"]).to_pylist() == ["a"]
assert "pandas" not in sys.modules
sys.path.insert(0, sys.argv[1])
import pandas
assert pandas.NAME == "a stand-in"
"""
RUN = """
import sys
from cosmos_cli.start import main

sys.argv = ["cosmos", "run", "swarm.yaml", "--quiet", "--no-report"]
try:
    main()
finally:
    print(sorted({"numpy.ma", "pandas", "pyarrow.compute"} & set(sys.modules)))
"""
SCENARIO = """
name: swarm
simulation: counter
agents: {count: 2, tick_hz: 10}
time: {mode: lockstep, duration_s: 1}
deadline: {max_miss_ratio: 1}
"""


@pytest.mark.process
def test_pandas_is_not_imported_and_can_be(tmp_path):
    (tmp_path / "pandas.py").write_text('NAME = "a stand-in"\n')
    folder = tmp_path / "first"
    folder.mkdir()
    (folder / "pandas.py").write_text("raise SystemExit('imported')\n")

    subprocess.run(
        [sys.executable, "-c", PROGRAM, str(tmp_path)],
        env={"PYTHONPATH": str(folder)},
        check=True,
    )


@pytest.mark.process
def test_a_run_imports_nothing_that_computes_with_arrow_or_masks(tmp_path):
    (tmp_path / "swarm.yaml").write_text(SCENARIO)

    run = subprocess.run(
        [sys.executable, "-P", "-c", RUN], cwd=tmp_path, check=True, stdout=subprocess.PIPE
    )

    assert run.stdout.splitlines()[-1] == b"[]"
    assert list(tmp_path.glob("runs/*/tables/*.parquet"))


@pytest.mark.parametrize(
    ("values", "kind", "expected"),
    [
        (np.array([1.5, np.nan, -np.inf]), "float", [1.5, None, -np.inf]),
        (np.array([1, -(2**62)]), "float", [1.0, -(2.0**62)]),
        (np.array([1, -(2**63)]), "int", [1, -(2**63)]),
        (np.array([1, 2], np.int32), "int", [1, 2]),
        (np.array([1.0, np.nan, 0.5, 2.0**63, -np.inf]), "int", [1, None, None, None, None]),
        (np.array([None, -(2**63), 2**63 - 1], object), "int", [None, -(2**63), 2**63 - 1]),
        (np.array([-(2.0**63), 2.0**63, 0.5, -(2.0**64)]), "int", [-(2**63), None, None, None]),
        (np.arange(11) % 3 == 0, "bool", [i % 3 == 0 for i in range(11)]),
        (np.array([], np.float64), "float", []),
        (np.array([], np.bool_), "bool", []),
        (np.arange(12.0)[::5], "float", [0.0, 5.0, 10.0]),
        (np.array([None, "a", 1], object), "str", [None, "a", None]),
        (np.array([None, "a", [1], np.nan], object), "json", [None, "a", "[1]", None]),
    ],
)
def test_columns_keep_their_values(values, kind, expected):
    array, places = to_arrow(values, kind)

    array.validate(full=True)
    assert array.to_pylist() == expected
    is_lost = [
        new is None and not (old is None or old != old)
        for old, new in zip(values.tolist(), expected, strict=True)
    ]
    assert places.tolist() == np.flatnonzero(is_lost).tolist()


def test_numbers_are_what_pyarrow_makes_of_them():
    values = np.linspace(-1, 1, 1001)
    is_null = np.abs(values) < 0.3

    assert numbers_array(values).equals(pa.array(values))
    assert numbers_array(values, is_null=is_null).equals(pa.array(values, mask=is_null))
    values[is_null] = np.nan
    assert floats_array(values).equals(pa.array(values, from_pandas=True))


def test_codes_are_those_of_pyarrow():
    texts = ["b", None, "a", "b", None]

    for made in (texts, [], [None, None]):
        codes = to_codes(made)
        codes.validate(full=True)
        assert codes.equals(pa.array(made, pa.string()).dictionary_encode())
    assert one_code("a", 3).to_pylist() == ["a", "a", "a"]
    assert one_code(None, 2).to_pylist() == [None, None]


def test_times_are_utc_and_that_which_never_was_is_null():
    times = to_times(np.array([0, -1, 7]), never_us=-1)

    assert times.equals(pa.array([0, None, 7], pa.int64()).cast(pa.timestamp("us", tz="UTC")))
