"""`sense_hat`: through the emulator's own library where it is installed, and a stand-in for the HAT's."""

from __future__ import annotations

import math
import os
import sys
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
from harness.sense_emulator import fed_emulator

from madns_runtime.errors import MachineError
from madns_runtime.hardware.calibration.result import ChannelSamples
from madns_runtime.hardware.calibration.strength import calibrate_turned
from madns_runtime.hardware.contract import Sample
from madns_runtime.hardware.kind_registry import prepare
from madns_runtime.hardware.values import to_numbers
from tests.hardware.driving import opened


class Stick:
    def __init__(self):
        self.events = []
        self.is_closed = False

    def get_events(self):
        found, self.events = self.events, []
        return found

    def close(self):
        self.is_closed = True


class SenseHat:
    """As sense_hat's: accelerations in g, rates in rad/s, fields in uT."""

    made: list[SenseHat] = []

    def __init__(self):
        self.stick = Stick()
        self.asked = []
        self.pixels = None
        self.raw = {"x": 0.0, "y": 0.0, "z": 1.0}
        SenseHat.made.append(self)

    def set_rotation(self, r=0, redraw=True):
        self.rotation = r
        self.has_redrawn = redraw

    def set_imu_config(self, compass_enabled, gyro_enabled, accel_enabled):
        self.imu = (compass_enabled, gyro_enabled, accel_enabled)

    def get_gyroscope_raw(self):
        return {"x": 0.1, "y": -0.2, "z": 0.3}

    def get_accelerometer_raw(self):
        return self.raw

    def get_compass_raw(self):
        return {"x": 20.0, "y": 0.0, "z": -40.0}

    def get_temperature(self):
        self.asked.append("temperature")
        return 31.5

    def get_pressure(self):
        return 1013.25

    def get_humidity(self):
        return 45.0

    def set_pixels(self, pixels):
        assert len(pixels) == 64
        assert all(len(pixel) == 3 and all(isinstance(n, int) for n in pixel) for pixel in pixels)
        self.pixels = pixels

    def clear(self):
        self.pixels = [[0, 0, 0]] * 64


@pytest.fixture
def hats(monkeypatch):
    module = ModuleType("sense_hat")
    module.SenseHat = SenseHat
    monkeypatch.setitem(sys.modules, "sense_hat", module)
    SenseHat.made.clear()
    return SenseHat.made


def test_units_are_those_of_the_channels(hats):
    with opened("sense_hat", rotation=90, magnetometer=True) as device:
        values = device.read().values
        assert hats[0].rotation == 90
    assert values["accelerometer"] == pytest.approx([0.0, 0.0, 9.80665])
    assert values["gyroscope"] == pytest.approx([0.1, -0.2, 0.3])
    assert values["magnetometer"] == pytest.approx([20e-6, 0.0, -40e-6])
    assert (values["temperature"], values["pressure"], values["humidity"]) == (31.5, 1013.25, 45.0)
    channels = {c.name: c for c in prepare("sense_hat", {}, None).channels}
    for name, value in values.items():
        to_numbers(channels[name], value)
    assert channels["gyroscope"].limits == pytest.approx((-math.radians(2000), math.radians(2000)))


def test_what_is_not_asked_for_is_not_read(hats):
    parameters = {"gyroscope": False, "magnetometer": False, "environment_period_s": 60.0}
    with opened("sense_hat", **parameters) as device:
        assert hats[0].imu == (False, False, True)
        device.read()
        assert sorted(device.read().values) == ["accelerometer"]
        assert hats[0].asked == ["temperature"]
        hats[0].raw = None
        with pytest.raises(MachineError, match="gives nothing; is the user in the group i2c"):
            device.read()


def test_joystick_events_come_one_by_one(hats):
    with opened("sense_hat") as device:
        hats[0].stick.events = [
            SimpleNamespace(direction="left", action="pressed"),
            SimpleNamespace(direction="left", action="released"),
        ]
        assert device.read().values["joystick"] == (2, 1)
        assert device.read().values["joystick"] == (2, 0)
        assert "joystick" not in device.read().values
    assert hats[0].stick.is_closed


def test_a_picture_is_shown_and_switched_off(hats):
    with opened("sense_hat") as device:
        device.write({"matrix": tuple(float(n) for n in range(192))}, 0.0)
        assert hats[0].pixels[0] == [0, 1, 2]
        assert hats[0].pixels[63] == [189, 190, 191]
        device.make_safe()
        assert hats[0].pixels == [[0, 0, 0]] * 64


def test_joystick_that_is_held_while_it_is_read_rarely_keeps_a_bounded_number_of_events(hats):
    counts = {}
    with opened("sense_hat") as device:
        device.count = lambda name, number: counts.update({name: counts.get(name, 0) + number})
        held = [SimpleNamespace(direction="up", action="held")] * 999
        hats[0].stick.events = [SimpleNamespace(direction="up", action="pressed"), *held]
        assert device.read().values["joystick"] == (0, 2)  # the oldest give way
        kept = 1
        while "joystick" in device.read().values:
            kept += 1
    assert kept == 256
    assert counts["joystick_lost"] == 1000 - kept


@pytest.mark.parametrize("may_move", [True, False])
def test_opening_it_leaves_the_picture_as_it_is(hats, may_move):
    """By default the library reads the picture that is shown, and draws it anew, turned."""
    with opened("sense_hat", may_move=may_move, rotation=90):
        assert hats[0].rotation == 90
        assert not hats[0].has_redrawn


def test_a_missing_library_or_hat_is_told_with_its_cure(hats, monkeypatch):
    def broken():
        raise OSError("Cannot detect RPi-Sense FB device")

    sys.modules["sense_hat"].SenseHat = broken
    with (
        pytest.raises(MachineError, match="does not answer: Cannot detect.*is it plugged in"),
        opened("sense_hat"),
    ):
        pass
    monkeypatch.setitem(sys.modules, "sense_hat", None)
    with (
        pytest.raises(MachineError, match="sense_hat is not installed; sudo apt install sense-hat"),
        opened("sense_hat"),
    ):
        pass
    monkeypatch.setitem(sys.modules, "sense_emu", None)
    with (
        pytest.raises(MachineError, match="sense_emu is not installed; pip install sense-emu"),
        opened("sense_hat", emulated=True),
    ):
        pass


def test_a_hat_whose_inertial_sensors_do_not_begin_is_told_with_its_cure(hats, monkeypatch):
    def failing(self, *_):
        raise OSError("IMU Init Failed")

    monkeypatch.setattr(SenseHat, "set_imu_config", failing)
    with (
        pytest.raises(MachineError, match="does not answer: IMU Init Failed; is it plugged in"),
        opened("sense_hat"),
    ):
        pass
    monkeypatch.setitem(sys.modules, "sense_emu", sys.modules["sense_hat"])
    with (
        pytest.raises(MachineError, match="IMU Init Failed; start sense_emu_gui"),
        opened("sense_hat", emulated=True),
    ):
        pass


@pytest.fixture
def emulator():
    with fed_emulator() as imu:
        yield imu
    name = f"/dev/shm/rpi-sense-emu-client-{os.getpid()}"
    if os.path.exists(name):
        os.unlink(name)


def test_the_emulator_gives_samples_of_the_declared_shapes(emulator):
    channels = {c.name: c for c in prepare("sense_hat", {}, None).channels}
    with opened("sense_hat", emulated=True, joystick=False) as device:
        assert device.identity == "emulator"
        sample = device.read()
        assert isinstance(sample, Sample)
        assert {"accelerometer", "gyroscope", "magnetometer", "temperature"} <= set(sample.values)
        for name, value in sample.values.items():
            assert all(map(math.isfinite, to_numbers(channels[name], value)))
        device.write({"matrix": (255.0, 0.0, 0.0) * 64}, 0.0)
        assert device._hat.get_pixel(3, 3)[0] > 200
        device.make_safe()
        assert device._hat.get_pixel(3, 3) == [0, 0, 0]


TURNED = 64
"""Samples of the emulated compass: each takes 10 ms."""


def compass_samples(imu, field, hard_iron=(0.0, 0.0, 0.0)):
    """Feed the emulator a field that is turned to all sides, and return what the HAT's compass says of it."""
    heights = np.linspace(-0.98, 0.98, TURNED)
    angles = 2.4 * np.arange(TURNED)
    widths = np.sqrt(1.0 - heights**2)
    ways = np.column_stack([widths * np.cos(angles), widths * np.sin(angles), heights])
    only = {"gyroscope": False, "accelerometer": False, "joystick": False}
    found = []
    with opened("sense_hat", emulated=True, environment_period_s=60.0, **only) as device:
        for way in ways:
            imu.set_imu_values((0, 0, 1), (0, 0, 0), field * way + hard_iron, (0, 0, 0))
            found.append(device.read().values["magnetometer"])
    return ChannelSamples(
        name="magnetometer", unit="T", t_s=0.1 * np.arange(TURNED), values=np.array(found)
    )


def test_the_emulated_compass_is_calibrated_against_the_field(emulator):
    found = calibrate_turned(compass_samples(emulator, 0.48, (0.1, -0.05, 0.2)), 48e-6)

    # It is fed in gauss, and told in uT.
    assert found.is_usable, found.remarks
    assert found.scale.values == pytest.approx((1.0, 1.0, 1.0), abs=2e-3)
    assert found.bias.values == pytest.approx((10e-6, -5e-6, 20e-6), abs=0.2e-6)


def test_a_compass_that_was_fed_in_the_wrong_unit_is_found_to_be_clipped(emulator):
    # 48 uT for gauss: it comes back as the 4 gauss at which the emulator ends.
    found = calibrate_turned(compass_samples(emulator, 48.0), 48e-6)

    assert not found.is_usable
    assert all("clipped" in text for text in found.remarks)
