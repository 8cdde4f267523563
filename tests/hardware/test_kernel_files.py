"""`analog` and `pwm` on trees of files as the kernel lays them out."""

from __future__ import annotations

import errno
import os
import shutil

import pytest

from madns_runtime.errors import ConfigurationError, MachineError, PluginError
from madns_runtime.hardware.drivers import pwm
from madns_runtime.hardware.kind_registry import prepare
from tests.hardware.driving import opened


@pytest.fixture
def converter(tmp_path):
    folder = tmp_path / "iio:device0"
    folder.mkdir()
    files = {
        "name": "ads1115\n",
        "in_voltage0_raw": "1000\n",
        "in_voltage0_scale": "0.125\n",
        "in_voltage1_raw": "-5\n",
        "in_voltage_scale": "2.0\n",
        "in_voltage_offset": "10\n",
        "in_voltage0-voltage1_raw": "7\n",
        "in_accel_x_raw": "3\n",
        "in_accel_scale": "0.5\n",
        "out_voltage0_raw": "0\n",
        "out_voltage0_scale": "0.5\n",
    }
    for name, text in files.items():
        (folder / name).write_text(text)
    return folder


def test_scales_and_offsets_are_found_as_linux_names_them(converter):
    inputs = [
        {"name": "own", "file": "in_voltage0_raw"},
        {"name": "shared", "file": "in_voltage1_raw"},
        {"name": "difference", "file": "in_voltage0-voltage1_raw", "scale": 1.0},
        {"name": "x", "file": "in_accel_x_raw", "unit": "m/s2"},
        {"name": "given", "file": "in_voltage0_raw", "scale": 2.0, "offset": -1000.0},
    ]
    with opened("analog", root=str(converter.parent), inputs=inputs) as device:
        assert device.identity == "ads1115"
        assert device.read().values == {
            "own": (1000 + 10) * 0.125,
            "shared": (-5 + 10) * 2.0,
            "difference": 7.0,
            "x": 1.5,
            "given": 0.0,
        }


@pytest.mark.parametrize("text", ["0.000000", "nan", "inf"])
def test_a_scale_that_makes_no_value_is_refused_by_its_file(converter, text):
    (converter / "out_voltage0_scale").write_text(text)
    outputs = [{"name": "volts", "file": "out_voltage0_raw", "is_output": True}]
    with (
        pytest.raises(MachineError, match=f"out_voltage0_scale: .* other than 0, got {text}"),
        opened("analog", root=str(converter.parent), inputs=outputs),
    ):
        pass


def test_analog_outputs_are_written_raw_and_made_safe(converter):
    volts = {
        "name": "volts",
        "file": "out_voltage0_raw",
        "is_output": True,
        "low": 0,
        "high": 100,
        "safe": 5,
    }
    with opened("analog", root=str(converter.parent), inputs=[volts]) as device:
        device.write({"volts": 50.0}, 0.0)
        assert (converter / "out_voltage0_raw").read_text() == "100"
        device.make_safe()
        assert (converter / "out_voltage0_raw").read_text() == "10"
        assert device.read().values == {}
        shutil.rmtree(converter)
        with pytest.raises(MachineError, match="No such file"):
            device.read()
        with pytest.raises(MachineError, match="does not take '100'"):
            device.write({"volts": 50.0}, 0.0)
        assert not converter.exists()


def test_no_whole_digit_brings_an_analog_output_beyond_its_limits(converter):
    volts = {"name": "volts", "file": "out_voltage0_raw", "is_output": True, "low": 0, "high": 0.9}
    with opened("analog", root=str(converter.parent), inputs=[volts]) as device:
        device.write({"volts": 0.9}, 0.0)  # 1.8 digits of 0.5

    assert (converter / "out_voltage0_raw").read_text() == "1"


def test_a_value_that_the_converter_does_not_take_is_refused_and_it_stays_open(
    converter, monkeypatch
):
    def refuse(fd, data):
        raise OSError(errno.EINVAL, os.strerror(errno.EINVAL))

    volts = {"name": "volts", "file": "out_voltage0_raw", "is_output": True, "scale": 1e-9}
    with opened("analog", root=str(converter.parent), inputs=[volts]) as device:
        with pytest.raises(PluginError, match="expected a value that the converter can hold"):
            device.write({"volts": 1e305}, 0.0)
        monkeypatch.setattr(os, "write", refuse)
        with pytest.raises(PluginError, match="does not take '6000000000': Invalid argument"):
            device.write({"volts": 6.0}, 0.0)


def test_an_unplugged_converter_and_one_that_says_no_number(converter):
    inputs = [{"name": "own", "file": "in_voltage0_raw"}]
    with opened("analog", root=str(converter.parent), inputs=inputs) as device:
        (converter / "in_voltage0_raw").write_text("\x1b[31mhigh")
        with pytest.raises(MachineError, match=r"expected a number, got '\\x1b\[31mhigh'"):
            device.read()
        shutil.rmtree(converter)
        with pytest.raises(MachineError, match="in_voltage0_raw: No such file"):
            device.read()


def test_one_limit_alone_is_refused(converter):
    inputs = [{"name": "own", "file": "in_voltage0_raw", "low": 0.0}]
    with pytest.raises(PluginError, match="own: expected low and high, or neither"):
        prepare("analog", {"inputs": inputs}, None)


@pytest.fixture
def chip(tmp_path):
    folder = tmp_path / "pwmchip0"
    line = folder / "pwm0"
    line.mkdir(parents=True)
    (folder / "export").write_text("")
    for name in ("period", "duty_cycle", "enable"):
        (line / name).write_text("0\n")
    return folder


def test_a_duty_is_set_told_and_made_safe(chip):
    line = chip / "pwm0"
    with opened("pwm", root=str(chip.parent), safe=0.075, low=0.05, high=0.1) as device:
        assert (line / "period").read_text() == "20000000"
        assert (line / "duty_cycle").read_text() == "1500000"
        assert (line / "enable").read_text() == "1"
        device.write({"duty": 0.1}, 0.0)
        assert device.read().values["duty_set"] == 0.1
        device.make_safe()
        assert (line / "duty_cycle").read_text() == "1500000"
    assert (line / "duty_cycle").read_text() == "1500000"


def test_a_pwm_line_is_asked_for_and_one_that_never_comes_is_told(chip):
    with (
        pytest.raises(MachineError, match=r"pwm3/period: .*No such file"),
        opened("pwm", root=str(chip.parent), line=3),
    ):
        pass
    assert (chip / "export").read_text() == "3"
    shutil.rmtree(chip)
    with (
        pytest.raises(MachineError, match="pwmchip0/export"),
        opened("pwm", root=str(chip.parent)),
    ):
        pass


def test_a_pwm_period_of_no_whole_nanosecond_is_refused():
    with pytest.raises(
        ConfigurationError, match=r"pwm\.parameters\.period_s: expected at least 1e-09"
    ):
        prepare("pwm", {"period_s": 4e-10}, None)


def test_a_safe_duty_beyond_the_limits_is_refused(chip):
    with pytest.raises(PluginError, match="duty: safe value"):
        prepare("pwm", {"low": 0.05, "high": 0.1}, None)


@pytest.mark.parametrize("wanted", ["normal", "inversed"])
def test_a_pwm_line_that_another_program_left_the_other_way_round_is_turned(
    chip, monkeypatch, wanted
):
    line = chip / "pwm0"
    found = {"normal": "inversed", "inversed": "normal"}[wanted]
    state = {"polarity": found, "period": "1000", "duty_cycle": "250", "enable": "1"}
    for name, text in state.items():
        (line / name).write_text(f"{text}\n")
    written = []

    def write(path, text):
        written.append((path.name, text))
        path.write_text(text)

    monkeypatch.setattr(pwm, "write_text", write)
    with opened("pwm", root=str(chip.parent), polarity=wanted, safe=0.0, period_s=1e-3):
        pass

    turned = [("enable", "0"), ("duty_cycle", "0"), ("period", "1000000"), ("polarity", wanted)]
    assert written == [*turned, ("duty_cycle", "0"), ("enable", "1")]
    del written[:]
    with opened("pwm", root=str(chip.parent), polarity=wanted, period_s=1e-3):
        assert {name for name, _ in written} == {"duty_cycle", "period", "enable"}
        assert ("enable", "0") not in written


def test_a_duty_is_told_by_the_polarity_that_is_asked_for_where_none_may_move(chip):
    for name, text in {"polarity": "inversed", "period": "1000", "duty_cycle": "250"}.items():
        (chip / "pwm0" / name).write_text(f"{text}\n")

    with opened("pwm", may_move=False, root=str(chip.parent)) as device:
        assert device.read().values == {"duty_set": 0.75}
    assert (chip / "pwm0/polarity").read_text() == "inversed\n"


def test_opening_leaves_a_pwm_line_as_it_is_where_none_may_move(chip):
    line = chip / "pwm0"
    (line / "period").write_text("1000\n")
    (line / "duty_cycle").write_text("250\n")
    with opened("pwm", may_move=False, root=str(chip.parent)) as device:
        assert device.read().values["duty_set"] == 0.25
    assert (line / "duty_cycle").read_text() == "250\n"
    assert (line / "enable").read_text() == "0\n"
