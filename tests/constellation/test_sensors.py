"""Sensors: what they measure of a known truth, with which errors, and when flight software hears of it."""

import math
from datetime import datetime
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
from constellation_fakes import FakeContext, parameters

from madns_runtime.config import from_mapping
from madns_runtime.plugin.api import Tick
from madns_runtime.simulations.constellation.actions import SensorFault
from madns_runtime.simulations.constellation.agent import ConstellationAgent
from madns_runtime.simulations.constellation.equipment import Sensors
from madns_runtime.simulations.constellation.messages import Initial, Segment
from madns_runtime.simulations.constellation.orbit.constants import EGM_96
from madns_runtime.simulations.constellation.orbit.earth import days_since_j2000
from madns_runtime.simulations.constellation.orbit.quaternions import rotate, rotation_between
from madns_runtime.simulations.constellation.orbit.sun import sun_m
from madns_runtime.simulations.constellation.vehicle.sensors.environment import Scene
from madns_runtime.simulations.constellation.vehicle.sensors.instruments import star_tracker
from madns_runtime.simulations.constellation.vehicle.sensors.sensor import SensorSuite
from madns_runtime.simulations.constellation.vehicle.sensors.sensor_errors import (
    BLOCK,
    ErrorModel,
    Errors,
    key_of,
)

EPOCH = "2026-03-20T12:00:00Z"
CHANCE = bytes(range(32))
HZ = 10.0
LEO = (7.158e6, 0.0, 0.0, 0.0, 1000.0, 7390.0)
TURNED = (0.0, 0.0, math.sqrt(0.5), math.sqrt(0.5))
"""Body x on inertial y."""
SUN_M = np.array(sun_m(days_since_j2000(datetime.fromisoformat(EPOCH))))
SUN = SUN_M / np.linalg.norm(SUN_M)
LIT = (*(7.158e6 * SUN), 0.0, 0.0, 0.0)
UNTOUCHED = SimpleNamespace(ballistic_m2_kg=None, given_m_s=lambda t_s: ((0.0,) * 3, (0.0,) * 3))
"""Neither thrust nor drag; what an accelerometer feels of them is in test_accelerometer.py."""
RIGID = (*LEO, *TURNED, 0.001, -0.002, 0.003)


class Bench:
    """A suite of sensors on a still vehicle."""

    def __init__(self, *, chance=CHANCE, epoch=EPOCH, hz=HZ, joined_s=-1.0, **sensors):
        self.context = FakeContext(
            "agent-01", ("agent-01",), parameters(), tick_hz=hz, clock_s=joined_s
        )
        settings = from_mapping(Sensors, sensors)
        scene = Scene(epoch, UNTOUCHED, EGM_96.radius_m)
        self.suite = SensorSuite(settings, scene, context=self.context, chance=chance)

    def run(self, ticks, state=LEO, *, hz=HZ):
        """Return the readings of the ticks with these numbers."""
        return [self.suite.step(tick, tick / hz, state) for tick in ticks]

    def values(self, name, ticks, state=LEO):
        return np.array([r[name].values for r in self.run(ticks, state) if name in r])


def test_gnss_measures_position_and_velocity_with_noise_of_their_own():
    bench = Bench(gnss={"rate_hz": HZ, "noise": 5.0, "velocity_noise_m_s": 0.1})

    errors = bench.values("gnss", range(4000)) - LEO

    assert errors.mean(axis=0) == pytest.approx(0.0, abs=0.4)
    assert errors.std(axis=0) == pytest.approx([5.0] * 3 + [0.1] * 3, rel=0.05)
    assert abs(np.corrcoef(errors.T) - np.eye(6)).max() < 0.06


def test_a_gyro_measures_body_rates():
    assert Bench(gyro={}).run([0], RIGID)[0]["gyro"].values == RIGID[10:]


def test_a_magnetometer_measures_some_microteslas_in_body_axes():
    still, turned = Bench(magnetometer={}), Bench(magnetometer={})

    inertial = still.values("magnetometer", [0])[0]
    body = turned.values("magnetometer", [0], RIGID)[0]

    assert 2.0e-5 < np.linalg.norm(inertial) < 3.0e-5  # over the equator, 780 km up
    assert body == pytest.approx(rotate(TURNED, inertial))


def test_the_magnetic_pole_turns_with_the_earth():
    north = (1.0, 0.0, 7.158e6, 0.0, 7460.0, 0.0)
    hours = Bench(magnetometer={"rate_hz": 1.0}).values(
        "magnetometer", range(0, 86_164 * 10, 21_541 * 10), north
    )

    # A quarter of a turn each: the field's horizontal part goes round.
    angles = np.unwrap(np.arctan2(hours[:, 1], hours[:, 0]))
    assert np.diff(angles) == pytest.approx(math.pi / 2, abs=1e-3)


def test_a_star_tracker_errs_by_small_rotations():
    bench = Bench(star_tracker={"rate_hz": HZ, "noise": 1e-4})

    found = bench.values("star_tracker", range(2000), RIGID)

    errors = np.array([rotation_between(TURNED, q) for q in found])
    assert np.linalg.norm(found, axis=1) == pytest.approx(1.0, abs=1e-12)
    assert errors.std(axis=0) == pytest.approx([1e-4] * 3, rel=0.08)


def test_a_star_trackers_errors_are_about_the_body_axes():
    scene = Scene(EPOCH, UNTOUCHED, EGM_96.radius_m)
    scene.move(0.0, RIGID)

    measured = star_tracker(scene, [1e-3, 0.0, 0.0])

    assert rotation_between(TURNED, measured) == pytest.approx([1e-3, 0.0, 0.0], abs=1e-12)


def test_a_sun_sensor_points_at_the_sun_and_sees_nothing_in_the_shadow():
    dark = (*(-7.158e6 * SUN), 0.0, 0.0, 0.0)
    bench = Bench(sun_sensor={})

    assert bench.values("sun_sensor", [0], LIT)[0] == pytest.approx(SUN, abs=1e-6)
    assert bench.run([10], dark) == [{}]
    assert bench.suite.summary()["sun_sensor"] == {"samples": 1, "dropped": 0, "blind": 1}


def test_a_biased_star_tracker_tells_an_attitude_yet():
    bench = Bench(star_tracker={"rate_hz": HZ})
    fault = SensorFault(sensor="star_tracker", fault="biased", bias=(0.1,))
    bench.suite.begin_failure(1, fault)

    values = bench.values("star_tracker", range(3), RIGID)

    assert np.linalg.norm(values, axis=1) == pytest.approx(1.0)


def test_a_sun_sensor_errs_by_an_angle():
    bench = Bench(sun_sensor={"rate_hz": HZ, "noise": 0.01})

    found = bench.values("sun_sensor", range(2000), LIT)

    angles = np.arccos(found @ SUN)
    assert np.sqrt((angles**2).mean() / 2) == pytest.approx(0.01, rel=0.05)


def test_a_clock_reads_time_with_its_offset():
    bench = Bench(clock={"bias": 1e-3})

    read = bench.values("clock", [0, 10, 20])[:, 0]

    assert np.diff(read) == pytest.approx(1.0)
    assert 0.0 < abs(read[0]) < 5e-3
    assert "clock_sensor" in bench.context.records


# What all sensors share ------------------------------------------------------------------------


def test_a_sensor_measures_at_its_rate():
    bench = Bench(clock={"rate_hz": 2.5})

    readings = bench.run(range(20))

    assert [tick for tick, reading in enumerate(readings) if reading] == [0, 4, 8, 12, 16]


@pytest.mark.parametrize("rate_hz", [11.0, 1000.0, 1e300])
def test_a_rate_above_the_ticks_measures_once_a_tick(rate_hz):
    bench = Bench(clock={"rate_hz": rate_hz, "bias_walk": 1.0})

    assert all("clock" in reading for reading in bench.run(range(20)))
    assert bench.suite.summary()["clock"]["samples"] == 20


def test_days_of_fast_ticks_lose_no_sample():
    hz = 700.0
    bench = Bench(hz=hz, clock={"rate_hz": hz})
    first = round(3 * 86_400 * hz)

    assert all("clock" in reading for reading in bench.run(range(first, first + 500), hz=hz))


def test_measurements_still_under_way_at_the_end_are_counted():
    bench = Bench(clock={"rate_hz": HZ, "latency_s": 0.25}, sun_sensor={})
    bench.run(range(10), LIT)

    summary = bench.suite.summary()
    assert summary["clock"] == {"samples": 7, "dropped": 0, "blind": 0, "under_way": 3}
    assert "under_way" not in summary["sun_sensor"]


def test_latency_delays_a_measurement_and_keeps_its_time():
    bench = Bench(clock={"rate_hz": 5.0, "latency_s": 0.25})

    known = [(tick, r["clock"].t_s) for tick, r in enumerate(bench.run(range(9))) if r]

    assert known == [(3, 0.0), (5, 0.2), (7, 0.4)]
    assert [row[:2] for row in bench.context.records["clock_sensor"]] == known


def test_several_measurements_of_one_tick_are_recorded_and_the_newest_is_read():
    bench = Bench(clock={"rate_hz": HZ, "latency_s": 0.2})

    readings = bench.run([0, 1, 2, 7])

    assert readings[-1]["clock"].t_s == 0.2
    assert [row[:2] for row in bench.context.records["clock_sensor"]] == [
        (2, 0.0),
        (7, 0.1),
        (7, 0.2),
    ]


def test_dropouts_are_counted_and_have_the_share_asked_for():
    bench = Bench(clock={"rate_hz": HZ, "dropout": 0.25})

    readings = bench.run(range(4000))

    counts = bench.suite.summary()["clock"]
    assert counts["samples"] == sum(1 for reading in readings if reading)
    assert counts["samples"] + counts["dropped"] == 4000
    assert counts["dropped"] / 4000 == pytest.approx(0.25, abs=0.03)


# The size of errors --------------------------------------------------------------------------------

FREE = {
    "gnss": 3,
    "gyro": 3,
    "accelerometer": 3,
    "magnetometer": 3,
    "star_tracker": 3,
    "sun_sensor": 2,
    "clock": 1,
}
"""By sensor: in how many directions a measurement can err."""
SIGMA = 1e-4
IN_THE_SUN = (*LIT, *TURNED, 0.001, -0.002, 0.003)


@cache
def measured(name, ticks, chance=CHANCE, **settings):
    bench = Bench(chance=chance, **{name: {"rate_hz": HZ, **settings}})
    return bench.values(name, ticks, IN_THE_SUN)


def errors_of(name, ticks, *, chance=CHANCE, **settings):
    """Return the errors of a sensor's measurements, shape (N, 3 or 1): against one that has none."""
    noisy, exact = measured(name, ticks, chance, **settings), measured(name, ticks)
    if name == "star_tracker":
        return np.array([rotation_between(*pair) for pair in zip(exact, noisy, strict=True)])
    return (noisy - exact)[:, :3]


@pytest.mark.parametrize(("name", "free"), FREE.items())
def test_white_noise_has_the_size_asked_for_and_no_memory(name, free):
    errors = errors_of(name, range(1, 3001), noise=SIGMA)

    assert np.sqrt((errors**2).sum(axis=1).mean() / free) == pytest.approx(SIGMA, rel=0.06)
    assert errors.mean(axis=0) == pytest.approx(0.0, abs=0.1 * SIGMA)
    correlation = (errors[1:] * errors[:-1]).sum() / (errors**2).sum()
    assert abs(correlation) < 0.07


@pytest.mark.slow
@pytest.mark.parametrize(("name", "free"), FREE.items())
@pytest.mark.parametrize(("what", "size"), [("bias", SIGMA), ("bias_walk", SIGMA * 5.0)])
def test_biases_have_the_size_asked_for_over_many_agents(name, free, what, size):
    # A walk of 25 s has five times the size that it has after one second.
    squares = []
    for agent in range(150):
        chance = agent.to_bytes(32, "little")
        error = errors_of(name, (0, 250), chance=chance, **{what: SIGMA})[-1]
        squares.append((error**2).sum())

    assert np.sqrt(np.mean(squares) / free) == pytest.approx(size, rel=0.2)


NOISY = {"rate_hz": HZ, "noise": 1.0, "bias": 2.0, "bias_walk": 0.5, "dropout": 0.1}


def test_missed_ticks_change_nothing_of_later_measurements():
    every, some = Bench(gnss=NOISY), Bench(gnss=NOISY)
    later = range(3 * BLOCK + 7, 3 * BLOCK + 40)

    every.run(range(3 * BLOCK + 7))
    some.run([0, 5, BLOCK + 3])

    assert every.run(later) == some.run(later)


def test_who_rejoins_measures_as_if_it_had_been_there_and_has_walked_before_its_first_tick(
    monkeypatch,
):
    first = round(1000.0 * HZ)
    always, again = Bench(gnss=NOISY), Bench(gnss=NOISY, joined_s=1000.0)
    expected = always.run(range(first, first + 40))
    draws = []
    monkeypatch.setattr(Errors, "_draws", lambda self, block: draws.append(block))

    assert again.run(range(first, first + 40)) == expected
    assert draws == []


def test_another_sensor_changes_nothing_of_the_first():
    alone, together = Bench(gnss=NOISY), Bench(gnss=NOISY, clock=NOISY, magnetometer=NOISY)

    assert (alone.values("gnss", range(50)) == together.values("gnss", range(50))).all()


def test_two_sensors_have_errors_of_their_own():
    bench = Bench(gyro={"noise": 1.0}, accelerometer={"noise": 1.0})

    reading = bench.run([0, 10], (*LEO, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0))[1]

    assert reading["gyro"].values != reading["accelerometer"].values


def test_another_setting_leaves_the_noise_as_it_is():
    white = Bench(clock={"rate_hz": HZ, "noise": 1.0}).values("clock", range(30))
    walking = {"rate_hz": HZ, "noise": 1.0, "bias": 1.0, "bias_walk": 1e-12, "dropout": 1e-9}
    both = Bench(clock=walking).values("clock", range(30))

    assert np.ptp(both - white) == pytest.approx(0.0, abs=1e-9)


def model(**rest):
    plain = {"white": (0.0,), "bias": (0.0,), "walk": (0.0,), "dropout": 0.0, "period_s": 0.25}
    return ErrorModel(**{**plain, **rest})


def test_a_bias_walks_with_the_square_root_of_time():
    ends = []
    for agent in range(400):
        errors = Errors(model(walk=(0.5,)), key_of(CHANCE, str(agent)))
        assert errors.at(0) == [0.0]
        ends.append(errors.at(400)[0])

    # 400 samples of 0.25 s are 100 s.
    assert np.std(ends) == pytest.approx(0.5 * 10.0, rel=0.12)
    assert np.mean(ends) == pytest.approx(0.0, abs=1.0)


def test_a_walk_is_continuous_over_blocks_and_the_same_from_anywhere():
    whole = Errors(model(walk=(1.0,)), CHANCE[:16])
    values = [whole.at(number)[0] for number in range(3 * BLOCK)]
    late = Errors(model(walk=(1.0,)), CHANCE[:16])

    assert max(abs(b - a) for a, b in zip(values, values[1:], strict=False)) < 0.5 * 4.5
    assert late.at(3 * BLOCK - 1)[0] == pytest.approx(values[-1], abs=1e-12)


def test_a_bias_is_no_sample_of_the_noise():
    bias = Errors(model(bias=(1.0,)), CHANCE[:16]).at(0)
    noise = Errors(model(white=(1.0,)), CHANCE[:16])

    assert bias not in [noise.at(number) for number in range(2 * BLOCK)]


def test_a_bias_stays_the_same_for_the_whole_run():
    errors = Errors(model(bias=(3.0,)), CHANCE[:16])

    assert {errors.at(number)[0] for number in (0, 1, BLOCK, 50 * BLOCK)} == {
        errors.at(50 * BLOCK)[0]
    }


# On the agent -------------------------------------------------------------------------------------


def agent(seed, **sensors):
    params = parameters(vehicles=[{"sensors": sensors}])
    context = FakeContext("agent-01", ("agent-01",), params, tick_hz=HZ)
    context.random = np.random.default_rng([seed, 1])
    states = np.tile(LEO, (61, 1))
    segment = Segment(revision=0, t0_s=0.0, knot_s=1.0, states=states)
    initial = Initial(satellite="X", frame="TEME", epoch_utc=EPOCH, segment=segment)
    made = ConstellationAgent()
    made.setup(context, initial.to_message())
    return made, context


def fly(made, until):
    for index in range(until):
        made.step(Tick(index, index / HZ, 1 / HZ, 0.0, 0))


def test_measurements_are_recorded_apart_from_truth_and_repeat_under_a_seed():
    runs = []
    for seed in (1, 1, 2):
        made, context = agent(seed, gnss=NOISY, magnetometer={"noise": 1e-8})
        fly(made, 100)
        runs.append(dict(context.records))

    assert runs[0] == runs[1]
    assert runs[0]["state"] == runs[2]["state"]
    assert runs[0]["gnss"] != runs[2]["gnss"]
    assert len(runs[0]["magnetometer"]) == 10
    assert made.finish()["sensors"]["magnetometer"]["samples"] == 10


def test_without_truth_nothing_is_measured():
    made, context = agent(1, clock={"rate_hz": HZ})

    fly(made, 700)

    assert len(context.records["clock_sensor"]) == 601


def test_a_vehicle_without_sensors_draws_no_chance():
    made, context = agent(1)
    context.random = None

    fly(made, 10)

    assert "sensors" not in made.finish()
