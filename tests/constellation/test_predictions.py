"""What a sensor's model predicted, scored against what the hardware measured, from made-up records."""

from types import SimpleNamespace

import numpy as np
import pytest

from madns_runtime.recording.records import Field
from madns_runtime.simulations.constellation.analysis.predictions import prediction_blocks

NAMES = ("wx_body_rad_s", "wy_body_rad_s", "wz_body_rad_s")
FIELDS = (
    Field("tick", "", "int"),
    Field("t_s", "s"),
    *(Field(name, "rad/s") for name in NAMES),
)
COUNT = 400
TRUTH = np.linspace(0.0, 0.1, 3 * COUNT).reshape(COUNT, 3)


class Table:
    """Records of one sensor of one agent."""

    fields = FIELDS
    sources = ("agent-01",)
    rows = COUNT

    def __init__(self, name, values):
        self.name = name
        self.columns = {"tick": np.arange(COUNT), "t_s": np.arange(COUNT) / 10}
        self.columns |= dict(zip(NAMES, values.T, strict=True))

    def read(self, source, names):
        return {name: self.columns[name] for name in names}


def scores(**tables):
    made = {name: Table(name, values) for name, values in tables.items()}
    run = SimpleNamespace(tables=made, time_of=lambda table, agent: (table.columns["t_s"], None))
    return prediction_blocks(made["gyro"], run)


def noise(sigma, seed):
    return np.random.default_rng(seed).normal(0.0, sigma, (COUNT, 3))


def test_a_device_that_errs_as_its_model_scores_one():
    (block,) = scores(
        gyro=TRUTH + noise(1e-3, 1), gyro_truth=TRUTH, gyro_model=TRUTH + noise(1e-3, 2)
    )

    ((agent, count, predicted, measured, score, within),) = block.rows
    assert (agent, count) == ("agent-01", COUNT)
    assert predicted == pytest.approx(1e-3 * np.sqrt(3), rel=0.1)
    assert measured == pytest.approx(1e-3 * np.sqrt(3), rel=0.1)
    assert score == pytest.approx(1.0, rel=0.1)
    assert within == 1.0


def test_a_device_that_is_worse_than_its_model_scores_by_how_much():
    (block,) = scores(
        gyro=TRUTH + noise(1e-2, 1), gyro_truth=TRUTH, gyro_model=TRUTH + noise(1e-3, 2)
    )

    assert block.rows[0][4] == pytest.approx(10.0, rel=0.1)
    assert block.rows[0][5] < 0.2


def test_a_model_without_errors_has_no_score():
    (block,) = scores(gyro=TRUTH + noise(1e-3, 1), gyro_truth=TRUTH, gyro_model=TRUTH)

    assert block.rows[0][4] is None


def test_without_a_model_beside_it_nothing_is_scored():
    assert scores(gyro=TRUTH, gyro_truth=TRUTH) == []
