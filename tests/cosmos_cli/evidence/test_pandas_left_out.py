"""pandas, where it is installed, costs no command its import, and is there for who asks for it."""

import subprocess
import sys

import pytest

pytestmark = pytest.mark.process

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
