"""The shipped scenarios as tests: one of each sort shortened at every change, all at full length each night."""

import json
import shutil
from pathlib import Path

import pytest
from harness.cosmos_command import LOOSE, SCENARIOS, CosmosCommand

pytestmark = pytest.mark.process

QUICK_S = 1200.0
NIGHT_S = 4200.0
SAME = "benchmark_1h or benchmark_6min or benchmark_8h or orbits_1h or orbits_4h or orbits_6min or guidance_4h"
"""A minute of these is the same as of what they extend."""
REALTIME_MAX_S = 70
"""Until the latest check of any of them has begun."""
ALONE = "starlink1000 or planet93_100hz"
"""They want all processors of a small machine; benchmarks/scale.py flies them."""
FLOWN = "chain77 or ring93_gap"
"""tests/constellation/test_slots_benchmark.py flies them for their day, and wants more of them than their verdict."""
LIKE = (
    f"{SAME} or {FLOWN} or boards24 or benchmark_100hz or benchmark_at_once or table_2_2_corrected"
    " or transparency_truth or undisturbed or biased_gnss or liar or lossy or parted or hohmann10"
    " or guidance_apogee or (planet93 and not planet93_100hz)"
)
"""Beside each of these another is flown at every change that differs in figures alone."""
NIGHTLY = f"not (hardware or emulator or {ALONE} or {SAME} or {FLOWN})"


def suite(folder, *words, patience_s):
    """Run `cosmos test` on the shipped scenarios; return what came of each, by its file."""
    loose = [part for setting in LOOSE for part in ("--set", setting)]
    cosmos = CosmosCommand(folder)
    done = cosmos(*("test", SCENARIOS, *words, *loose, "--json", "--quiet"), patience_s=patience_s)
    document = json.loads(done.stdout)
    failed = {
        each["name"]: [*each["reasons"], *each["broken"]]
        for each in document["tests"]
        if each["outcome"] != "passed"
    }
    assert failed == {}, done.stderr
    assert done.returncode == document["exit_code"] == 0
    return {Path(each["scenario"]).stem: each for each in document["tests"]}


@pytest.mark.slow
@pytest.mark.timeout(QUICK_S + 60)
def test_one_shipped_scenario_of_each_sort_passes_shortened(tmp_path):
    meant = f"quick and not (compiler or {LIKE})"
    # Kept, so that what they recorded is looked at, as that of every run here.
    tests = suite(tmp_path, "-k", meant, "--keep", patience_s=QUICK_S)

    assert len(tests) >= 16
    assert all(figure["passed"] for figure in tests["hohmann5of10"]["figures"])
    assert len(tests["hohmann5of10"]["figures"]) == 4


@pytest.mark.slow
@pytest.mark.skipif(not shutil.which("cc"), reason="no C compiler here (Debian: gcc)")
@pytest.mark.timeout(QUICK_S + 60)
def test_each_shipped_scenario_that_is_compiled_passes_shortened(tmp_path):
    tests = suite(tmp_path, "-k", "quick and compiler", "--keep", patience_s=QUICK_S)

    assert set(tests) == {"detumble_models", "detumble_truth", "external_c"}


@pytest.mark.nightly
@pytest.mark.timeout(QUICK_S + 60)
def test_those_that_are_like_another_pass_shortened(tmp_path):
    tests = suite(tmp_path, "-k", f"quick and ({LIKE})", "--keep", patience_s=QUICK_S)

    assert len(tests) >= 20


@pytest.mark.nightly
@pytest.mark.timeout(NIGHT_S + 60)
def test_each_shipped_scenario_passes_at_full_length(tmp_path):
    tests = suite(
        tmp_path,
        *("-k", NIGHTLY, "--full-length", "--realtime-max", REALTIME_MAX_S),
        patience_s=NIGHT_S,
    )

    assert len(tests) >= 23
