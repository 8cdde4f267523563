"""What a comparison of two runs tells of a loop through hardware and of its predictions, from made-up records."""

import numpy as np
import pytest

from madns_runtime.analysis.distribution import Distribution
from madns_runtime.simulations.constellation.analysis.comparison import ConstellationDifference
from madns_runtime.simulations.constellation.analysis.comparison_tables import (
    comparison_blocks,
    to_document,
)
from madns_runtime.simulations.constellation.analysis.predictions import PredictionScore

GYRO = ("gyro", "body rates", "rad/s", "agent-01")
PART = "reading to command"


def compared():
    answers = Distribution.of(np.array([1000, *[2000] * 200, 3000])).summary()
    score = PredictionScore(measurements=40, predicted=2e-4, measured=3e-4, share_within=0.9)
    return ConstellationDifference(
        frame=("TEME", "TEME"), loops=({}, {PART: answers}), scores=({}, {GYRO: score})
    )


def test_latencies_stand_side_by_side_in_ms_and_a_run_without_a_loop_has_none():
    (table,) = [block for block in comparison_blocks(compared()) if "Latency" in block.title]

    ((part, *figures),) = table.rows
    assert part == PART
    assert figures[::2] == [None] * 4
    assert figures[1::2] == pytest.approx([202, 2.0, 2.0, 3.0])


def test_scores_stand_side_by_side_by_sensor_and_agent():
    (table,) = [block for block in comparison_blocks(compared()) if "Prediction" in block.title]

    ((*key, _, predicted, _, measured, _, score),) = table.rows
    assert tuple(key) == GYRO
    assert (predicted, measured, score) == pytest.approx((2e-4, 3e-4, 1.5))


def test_a_comparison_tells_both_as_plain_values():
    document = to_document(compared())

    assert document["loop_us"] == {
        PART: [None, {"count": 202, "p50": 2000, "p99": 2000, "max": 3000}]
    }
    (told,) = document["predictions"]
    assert (told["sensor"], told["agent"]) == ("gyro", "agent-01")
    assert told["scores"][0] is None
    assert told["scores"][1]["score"] == pytest.approx(1.5)


def test_runs_without_a_loop_are_told_neither():
    assert comparison_blocks(ConstellationDifference(frame=("TEME", "TEME"))) == []


def test_a_model_without_errors_gives_no_score():
    assert (
        PredictionScore(measurements=1, predicted=0.0, measured=1.0, share_within=0).score is None
    )
