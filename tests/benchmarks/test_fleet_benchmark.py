"""What the benchmark of fleets makes of what it measures; nothing is measured here."""

import importlib.util
import sys
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"


@pytest.fixture(scope="module")
def fleet():
    """Load it from its file: a folder of tests has its name."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "path", [*sys.path, str(BENCHMARKS)])
        spec = importlib.util.spec_from_file_location("fleet_benchmark", BENCHMARKS / "fleet.py")
        module = importlib.util.module_from_spec(spec)
        patch.setitem(sys.modules, spec.name, module)
        spec.loader.exec_module(module)
        yield module


def test_fetching_has_the_start_of_the_program_in_it(fleet):
    whole = fleet.Cost(wall_s=5.0, cpu_s=8.0)
    again = fleet.Cost(wall_s=4.0, cpu_s=9.0)
    start = fleet.Cost(wall_s=0.5, cpu_s=0.25)

    assert fleet.fetching(whole, again, start) == fleet.Cost(wall_s=1.5, cpu_s=0.25)


def test_what_took_no_time_is_no_divisor(fleet):
    costs = {name: [fleet.Cost(wall_s=2.0, cpu_s=1.0)] for name in (*fleet.JOBS, fleet.COLLECT)}
    own = costs | {"fetch": [fleet.Cost(wall_s=1.0, cpu_s=0.0)]}

    table = fleet.table({10: {fleet.COSMOS: own, "pyinfra": costs}})

    assert "2.00 (1.00) 2.00x (-)" in table
