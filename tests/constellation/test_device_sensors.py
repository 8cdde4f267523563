"""Sensors that are hardware: which samples become readings, how they are corrected, and what is recorded beside."""

import math

import numpy as np
import pytest
from constellation_fakes import FakeContext, parameters

from madns_runtime.config import from_mapping
from madns_runtime.errors import PluginError
from madns_runtime.plugin.device_view import ChannelForm, ChannelReading
from madns_runtime.simulations.constellation.alignment import alignment_fault, matrix_of
from madns_runtime.simulations.constellation.equipment import Sensors
from madns_runtime.simulations.constellation.orbit.constants import EGM_96
from madns_runtime.simulations.constellation.orbit.quaternions import (
    conjugate,
    from_rotation,
    multiply,
    rotate,
    rotation_between,
)
from madns_runtime.simulations.constellation.vehicle.sensors.environment import Scene
from madns_runtime.simulations.constellation.vehicle.sensors.sensor import SensorSuite

EPOCH = "2026-03-20T12:00:00Z"
HZ = 10.0
RATES = (0.02, -0.01, 0.03)
STILL = (7.158e6, 0.0, 0.0, 0.0, 1000.0, 7390.0)
QUARTER = (0.0, 0.0, math.sqrt(0.5), math.sqrt(0.5))
"""A quarter of a turn about z: what lies along the device's y is along the body's x."""


class FakeDevice:
    """A device of two channels whose newest samples are set by hand."""

    name = "imu"

    def __init__(self, context, *, unit="deg/s", size=3, more=()):
        self._context = context
        self._forms = {"gyro": ChannelForm(unit, size), **dict(more)}
        self.inputs = tuple(self._forms)
        self.status = "ok"
        self._samples = {}

    def give(self, value, taken_s, channel="gyro", number=None):
        before = self._samples.get(channel, (None, 0.0, 0))[2]
        self._samples[channel] = (value, taken_s, number or before + 1)

    def form_of(self, channel):
        return self._forms[channel]

    def __getitem__(self, channel):
        value, taken_s, number = self._samples.get(channel, (None, -math.inf, 0))
        age_s = self._context.now_s() - taken_s
        return ChannelReading(value, age_s, number, self.status, math.nan)


class GivenPushes:
    """An impulse of 1 m/s along x per second, and no drag."""

    ballistic_m2_kg = None

    def given_m_s(self, t_s):
        return (0.0, 0.0, 0.0), (t_s, 0.0, 0.0)


class Bench:
    """A suite of sensors on a vehicle that turns steadily."""

    def __init__(self, sensors, **device):
        self.context = FakeContext("agent-01", ("agent-01",), parameters(), tick_hz=HZ)
        self.device = FakeDevice(self.context, **device)
        self.context.hardware = {"imu": self.device}
        self.scene = Scene(EPOCH, GivenPushes(), EGM_96.radius_m)
        self.suite = SensorSuite(
            from_mapping(Sensors, sensors), self.scene, context=self.context, chance=bytes(32)
        )

    def step(self, tick, *, has_truth=True):
        t_s = self.context.clock_s = tick / HZ
        return self.suite.step(tick, t_s, state_at(t_s) if has_truth else None)

    def recorded(self, stream):
        return [tuple(row) for row in self.context.records[stream]]


def state_at(t_s):
    """Return truth: a body that turns steadily, on a straight way."""
    x, y, z, vx, vy, vz = STILL
    turned = from_rotation([rate * t_s for rate in RATES])
    return (x + vx * t_s, y + vy * t_s, z + vz * t_s, vx, vy, vz, *turned, *RATES)


def gyro(**settings):
    return {"gyro": {"device": "imu.gyro", **settings}}


def test_the_newest_sample_is_a_reading_once_with_the_time_it_was_taken():
    bench = Bench(gyro())
    bench.device.give((180.0, 0.0, -90.0), 0.07)

    first, again = bench.step(1), bench.step(2)

    assert first["gyro"].t_s == 0.07
    assert first["gyro"].values == pytest.approx((math.pi, 0.0, -math.pi / 2), rel=1e-15)
    assert again == {}
    assert bench.recorded("gyro")[0][:2] == (1, 0.07)


def test_a_sample_that_was_overtaken_is_counted():
    bench = Bench(gyro())
    bench.device.give((1.0, 0.0, 0.0), 0.01)
    bench.step(1)
    bench.device.give((2.0, 0.0, 0.0), 0.15, number=4)

    reading = bench.step(2)["gyro"]

    assert reading.values[0] == pytest.approx(math.radians(2.0))
    assert bench.suite.summary()["gyro"]["skipped"] == 2


def test_a_sensor_is_silent_that_never_gave_anything_though_its_device_was_there():
    bench = Bench(gyro())
    found = [bench.suite.silent()]
    bench.step(1)
    found.append(bench.suite.silent())
    bench.device.give((1.0, 0.0, 0.0), 0.15)
    bench.step(2)
    found.append(bench.suite.silent())

    assert found == [[], ["gyro"], []]
    assert Bench({"gyro": {"noise": 1e-3}}).suite.silent() is None


@pytest.mark.parametrize("status", ["never", "stale", "lost"])
def test_a_device_that_is_not_well_gives_no_reading_and_is_counted(status):
    bench = Bench(gyro())
    bench.device.give((1.0, 0.0, 0.0), 0.01)
    bench.device.status = status

    readings = [bench.step(tick) for tick in range(1, 4)]

    assert readings == [{}, {}, {}]
    assert bench.suite.summary()["gyro"] == {
        "samples": 0,
        "skipped": 0,
        "absent": 3,
        "refused": 0,
        "unpaired": 0,
        "without_truth": 0,
    }
    assert bench.suite.silent() == []  # its device was not there: the limits of devices hold


def test_a_sample_is_scaled_freed_of_its_bias_and_turned_into_body_axes_in_this_order():
    settings = {"alignment": [[0, 1, 0], [-1, 0, 0], [0, 0, 1]], "scale": [2, 1, 0.5]}
    bench = Bench(gyro(bias=[1.0, 10.0, 0.0], **settings))
    bench.device.give((3.0, 4.0, 6.0), 0.05)

    values = bench.step(1)["gyro"].values

    assert np.degrees(values) == pytest.approx((-6.0, -5.0, 3.0))


def test_a_quaternion_aligns_as_its_matrix_does():
    assert np.allclose(matrix_of(QUARTER), [[0, 1, 0], [-1, 0, 0], [0, 0, 1]], atol=1e-15)
    assert matrix_of(QUARTER)[0] == pytest.approx(
        tuple(rotate(QUARTER, axis)[0] for axis in np.eye(3).tolist())
    )


def test_a_star_tracker_that_sits_turned_tells_the_attitude_of_the_body():
    bench = Bench(
        {"star_tracker": {"device": "imu.stars", "alignment": QUARTER}},
        more={"stars": ChannelForm("", 4)}.items(),
    )
    truth = state_at(0.1)[6:10]
    bench.device.give(multiply(truth, conjugate(QUARTER)), 0.1, "stars")

    values = bench.step(1)["star_tracker"].values

    assert rotation_between(truth, values) == pytest.approx((0.0, 0.0, 0.0), abs=1e-12)


def test_a_receiver_in_the_turning_earths_frame_tells_truth_in_that_of_the_run():
    bench = Bench(
        {"gnss": {"device": "imu.position", "velocity": "velocity"}},
        more={"position": ChannelForm("km", 3), "velocity": ChannelForm("m/s", 3)}.items(),
    )
    truth = np.array(state_at(0.1)[:6])
    bench.scene.move(0.1, tuple(truth))
    angle = bench.scene.gmst_rad
    turn = np.array(
        [
            [math.cos(angle), math.sin(angle), 0.0],
            [-math.sin(angle), math.cos(angle), 0.0],
            [0.0, 0.0, 1.0],
        ]
    )
    rate = np.array([0.0, 0.0, 7.292115e-5])
    bench.device.give(tuple(turn @ truth[:3] / 1e3), 0.1, "position")
    bench.device.give(tuple(turn @ (truth[3:] - np.cross(rate, truth[:3]))), 0.1, "velocity")

    values = bench.step(1)["gnss"].values

    # The Earth's rate as sidereal time has it and as WGS-84 does differ by 1.5e-11 rad/s: 1e-4 m/s here.
    assert values[:3] == pytest.approx(tuple(truth[:3]), abs=1e-6)
    assert values[3:] == pytest.approx(tuple(truth[3:]), abs=1e-3)


def test_a_position_waits_for_its_velocity():
    bench = Bench(
        {"gnss": {"device": "imu.position", "velocity": "velocity", "frame": "TEME"}},
        more={"position": ChannelForm("m", 3), "velocity": ChannelForm("m/s", 3)}.items(),
    )
    bench.device.give((7e6, 0.0, 0.0), 0.1, "position")
    assert bench.step(1) == {}
    bench.device.give((0.0, 7e3, 0.0), 0.1, "velocity")

    assert bench.step(2)["gnss"].values == (7e6, 0.0, 0.0, 0.0, 7e3, 0.0)


def receiver():
    return Bench(
        {"gnss": {"device": "imu.position", "velocity": "velocity", "frame": "TEME"}},
        more={"position": ChannelForm("m", 3), "velocity": ChannelForm("m/s", 3)}.items(),
    )


def test_positions_whose_velocity_has_stopped_are_counted_and_told():
    bench = receiver()
    readings = []
    for tick in range(1, 21):
        bench.device.give((7e6, 0.0, 0.0), tick / HZ, "position")
        if not 6 <= tick <= 15:
            bench.device.give((0.0, 7e3, 0.0), tick / HZ, "velocity")
        readings += bench.step(tick).values()

    counts = bench.suite.summary()["gnss"]
    assert len(readings) == counts["samples"] == 10
    assert (counts["unpaired"], counts["skipped"], counts["absent"]) == (10, 0, 0)
    (told,) = [text for level, text in bench.context.logs if level == "warning"]
    assert told.startswith("imu.velocity gave nothing to a sample of position by 0.7 s")


def test_a_velocity_that_was_only_late_makes_no_position_unpaired():
    bench = receiver()
    for tick in range(1, 9):
        bench.device.give((7e6, 0.0, 0.0), tick / HZ, "position")
        late = tick % 2  # at every other tick the velocity comes behind it
        if not late:
            bench.device.give((0.0, 7e3, 0.0), tick / HZ, "velocity")
        bench.step(tick)
        if late:
            bench.device.give((0.0, 7e3, 0.0), tick / HZ, "velocity")

    counts = bench.suite.summary()["gnss"]
    assert (counts["unpaired"], counts["samples"], counts["skipped"]) == (0, 4, 3)


def test_truth_is_recorded_beside_at_the_time_of_the_sample():
    bench = Bench(
        {"star_tracker": {"device": "imu.stars"}}, more={"stars": ChannelForm("1", 4)}.items()
    )
    for tick in range(5):
        bench.device.give((0.0, 0.0, 0.0, 1.0), max(0.0, tick / HZ - 0.037), "stars")
        bench.step(tick)

    rows = bench.recorded("star_tracker_truth")
    assert [row[0] for row in rows] == [0, 1, 2, 3, 4]
    assert [row[1] for row in rows] == [0.0, 0.063, 0.163, 0.263, 0.363]
    for row in rows:
        wrong = rotation_between(state_at(row[1])[6:10], row[2:])
        assert math.hypot(*wrong) < 2e-12
    assert "star_tracker_model" not in bench.context.streams


def test_a_sample_from_behind_the_last_tick_waits_for_its_truth():
    bench = Bench(gyro())
    bench.step(0)
    bench.context.clock_s = 0.1
    bench.device.give((0.0, 0.0, 0.0), 0.15)
    bench.suite.step(1, 0.1, state_at(0.1))
    assert bench.recorded("gyro_truth") == []
    assert bench.suite.summary()["gyro"]["without_truth"] == 1

    bench.step(2)

    ((tick, t_s, *rates),) = bench.recorded("gyro_truth")
    assert (tick, t_s) == (1, 0.15)
    assert rates == pytest.approx(RATES, abs=1e-9)
    assert bench.suite.summary()["gyro"]["without_truth"] == 0


def test_readings_come_without_truth_too_and_it_is_counted():
    bench = Bench(gyro())
    bench.device.give((1.0, 0.0, 0.0), 0.0)

    reading = bench.step(0, has_truth=False)

    assert set(reading) == {"gyro"}
    bench.step(1)
    assert bench.suite.summary()["gyro"]["without_truth"] == 1


def test_the_model_runs_beside_with_its_errors():
    bench = Bench(gyro(model={"noise": 1e-3}))
    for tick in range(1, 301):
        bench.device.give((0.0, 0.0, 0.0), tick / HZ)
        bench.step(tick)

    model = np.array(bench.recorded("gyro_model"))
    truth = np.array(bench.recorded("gyro_truth"))
    assert np.array_equal(model[:, :2], truth[:, :2])
    errors = model[:, 2:] - truth[:, 2:]
    assert np.std(errors) == pytest.approx(1e-3, rel=0.1)


def test_errors_of_other_sensors_are_the_same_when_one_is_hardware():
    noisy = {"noise": 1e-3, "rate_hz": HZ, "bias_walk": 1e-4}
    models = Bench({"gyro": noisy, "star_tracker": noisy, "gnss": {"noise": 5.0, "rate_hz": HZ}})
    mixed = Bench(
        {**gyro(), "star_tracker": noisy, "gnss": {"noise": 5.0, "rate_hz": HZ}},
    )
    for tick in range(600):
        models.step(tick)
        mixed.device.give((0.0, 0.0, 0.0), tick / HZ)
        mixed.step(tick)

    for stream in ("star_tracker", "gnss"):
        assert models.recorded(stream) == mixed.recorded(stream)


def test_truth_of_an_accelerometer_is_the_mean_since_the_reading_before():
    bench = Bench(
        {"accelerometer": {"device": "imu.force"}}, more={"force": ChannelForm("g", 3)}.items()
    )
    for tick in range(9):
        if tick % 4 == 0:
            bench.device.give((1.0, 0.0, 0.0), tick / HZ, "force")
        bench.step(tick)

    assert bench.recorded("accelerometer")[0][2:] == (9.80665, 0.0, 0.0)
    rows = bench.recorded("accelerometer_truth")
    assert [row[0] for row in rows] == [4, 8]
    assert [math.hypot(*row[2:]) for row in rows] == pytest.approx([1.0, 1.0], abs=1e-3)


@pytest.mark.parametrize(
    ("sensors", "device", "words"),
    [
        (gyro(), {"unit": "V"}, "expected a unit that converts to rad/s .* got 'V'"),
        (gyro(), {"unit": ""}, "declares none"),
        (gyro(), {"size": 2}, "expected values of 3 numbers, got 2"),
        ({"gyro": {"device": "imu.gyros"}}, {}, "one of the device's inputs of numbers"),
    ],
)
def test_a_channel_that_measures_something_else_is_refused_at_setup(sensors, device, words):
    with pytest.raises(PluginError, match=words):
        Bench(sensors, **device)


@pytest.mark.parametrize(
    ("alignment", "must_turn", "words"),
    [
        ((0.0, 0.0, 0.0, 2.0), False, "quaternion of length 1"),
        (((1, 0, 0), (2, 0, 0), (0, 0, 1)), False, "loses no direction"),
        (((0, 0, 0), (0, 1, 0), (0, 0, 1)), False, "loses no direction"),
        (((1, 0, 0), (0, 1, 0), (0, 0, -1)), True, "expected a rotation"),
        (((math.nan, 0, 0), (0, 1, 0), (0, 0, 1)), False, "finite"),
    ],
)
def test_an_alignment_that_is_none_is_refused(alignment, must_turn, words):
    assert words in alignment_fault(alignment, must_turn=must_turn)


def test_an_alignment_with_soft_iron_is_one_and_a_tracker_needs_a_rotation():
    soft_iron = ((1.02, 0.01, 0.0), (0.01, 0.97, 0.02), (0.0, 0.02, 1.1))

    assert alignment_fault(soft_iron, must_turn=False) is None
    assert alignment_fault(soft_iron, must_turn=True) is not None
    assert alignment_fault(QUARTER, must_turn=True) is None
    assert alignment_fault(matrix_of(QUARTER), must_turn=True) is None
