"""The parts of the latency of a loop through hardware, from made-up records."""

from types import SimpleNamespace

import numpy as np
import pytest

from madns_runtime.simulations.constellation.analysis.loop_latency import loop_blocks

VEHICLES = [
    {
        "stimuli": [{"source": "magnetic_field", "channel": "mcu.field"}],
        "sensors": {"gyro": {"device": "imu.gyro"}, "gnss": {"rate_hz": 1}},
    }
]


class Recorded:
    """A table of one stream by source."""

    def __init__(self, **sources):
        self.sources = sources
        self.rows = sum(len(next(iter(columns.values()))) for columns in sources.values())

    def has(self, *names):
        return all(name in columns for columns in self.sources.values() for name in names)

    def each(self, names):
        for source, columns in self.sources.items():
            yield source, {name: np.asarray(columns[name], dtype=float) for name in names}


def recorded_run(**tables):
    config = SimpleNamespace(parameters={"vehicles": VEHICLES})
    return SimpleNamespace(tables=tables, config=config)


def parts_of(blocks):
    """Return count, median and largest of each part, ms."""
    return {name: (count, p50, most) for name, count, p50, _, most in blocks[0].rows}


def test_each_part_of_the_loop_is_told_by_itself():
    answers = Recorded(a={"answer_us": [1000, 2000]}, b={"answer_us": [3000, float("nan")]})
    run = recorded_run(
        **{
            "flight_answers": answers,
            "device_mcu.field": Recorded(mcu={"lateness_us": [100, 300]}),
            "device_imu.gyro": Recorded(imu={"age_us": [500]}),
            "device_imu.other": Recorded(imu={"age_us": [9_000_000]}),
            "host_maneuvers": Recorded(
                host={"propagation_s": [0.004, float("nan")], "network_s": [0.001, 0.002]}
            ),
        }
    )

    parts = parts_of(loop_blocks(answers, run))

    assert parts["truth to device"] == pytest.approx((2, 0.2, 0.3))
    assert parts["device to reading"] == pytest.approx((1, 0.5, 0.5))
    assert parts["reading to command"] == pytest.approx((3, 2.0, 3.0))
    assert parts["command to truth"] == pytest.approx((1, 5.0, 5.0))


def test_parts_that_a_run_does_not_have_are_left_out():
    answers = Recorded(a={"answer_us": [1000.0]})

    blocks = loop_blocks(answers, recorded_run(flight_answers=answers))

    assert list(parts_of(blocks)) == ["reading to command"]
    assert blocks[1].choices[0].marks[0].counts.sum() == 1


def test_nothing_is_told_where_nothing_was_answered():
    empty = Recorded(a={"answer_us": []})

    assert loop_blocks(empty, recorded_run(flight_answers=empty)) == []
