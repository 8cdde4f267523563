"""What a kind declares wrongly is told, of which channel and what is expected there, by whoever looks first."""

from __future__ import annotations

import pytest

from cosmos_cli.errors import InputError
from cosmos_cli.models.loading import load_scenario
from madns_runtime.errors import PluginError
from madns_runtime.hardware.kind_registry import prepare

DRIVER = """
import time
from dataclasses import dataclass

from madns_runtime.hardware.contract import Channel, Device, DeviceKind, Needs, Sample


class Parameters:
    pass


class Meter(Device):
    kind = DeviceKind(name="meter", DECLARED, needs_hardware=False)
"""
ONE = 'channels=(Channel(name="a"),)'
SCENARIO = """
name: meter
simulation: counter
agents: {count: 1, tick_hz: 10}
time: {duration_s: 1}
hardware:
  devices: [{name: a, kind: ./meter.py:Meter}]
"""


@pytest.mark.process
@pytest.mark.parametrize(
    ("declared", "told"),
    [
        ('channels=(Channel(name="a"))', "a tuple of one ends with a comma"),
        ('channels=lambda p: Channel(name="a")', "a tuple of one ends with a comma"),
        ("channels=None", "channels: expected a tuple of channels, got None"),
        ('channels=("a",)', r"channels\[0\]: expected a Channel, got 'a'"),
        (ONE[:-3] + ", shape=3),)", r"channels\[0\] \('a'\).shape: expected a list, got 3"),
        (ONE[:-3] + ", limits=(0, 1, 2)),)", "limits: expected 2 items, got 3"),
        (ONE[:-3] + ", limits=('0', '1')),)", "limits\\[0\\]: expected float, got '0'"),
        (ONE[:-3] + ", direction='input'),)", "direction: expected one of .'in', 'out'."),
        (ONE[:-3] + ", unit=3),)", "unit: expected str, got 3"),
        (ONE[:-3] + ", shape=(2,), components=('x', 'x')),)", "distinct names, got a_x, a_x"),
        ('channels=(Channel(name="_a"),)', "expected a name such as gyro, a letter and"),
        ('channels=(Channel(name="länge"),)', "expected a name such as gyro, a letter and"),
        (f'channels=(Channel(name="{"a" * 41}"),)', "at most 39 letters, digits and _, got 'a"),
        ('channels=(Channel(name="incarnation"),)', "which tables add, got 'incarnation'"),
        (ONE[:-3] + ", unit='m\\n'),)", r"stream a: expected the unit of a to be a text"),
        ('channels=(Channel(name="number"),)', "number: no number may be called number"),
        (
            'channels=(Channel(name="lateness_us", direction="out"),)',
            "no number may be called lateness_us",
        ),
        (
            ONE[:-3] + ", direction='out', shape=(3,), safe=[0, 0]),)",
            "a: 3 elements, and 2 safe values",
        ),
        (
            ONE[:-3] + ", direction='out', safe=float('nan')),)",
            "expected a finite safe value, got nan",
        ),
        (
            ONE + ", follows_simulated_time=True",
            r"\./meter.py:Meter: follows_simulated_time needs a subclass of SimulatedDevice \(sample_at\), got Meter",
        ),
        (ONE + ", rate_hz=0", "rate_hz: expected a number above 0, got 0"),
        (ONE + ", rate_hz=5000.0", r"rate_hz: expected at most rate_hz_max \(1000\), got 5000"),
        (
            ONE + ", files='firmware'",
            "files: expected a tuple of parameters' names, got 'firmware'",
        ),
        (ONE + ", files=('firmware',)", "files: there is no parameter 'firmware'"),
        (ONE + ", parameters=Parameters", "parameters: expected a dataclass, got Parameters"),
        (ONE + ", needs={'groups': ('i2c',)}", r"needs: expected Needs\(...\), got {'groups'"),
        (ONE + ", needs=Needs(groups='i2c')", "needs.groups: expected a list, got 'i2c'"),
        (ONE + ", needs=lambda p: Needs(groups='i2c')", "needs.groups: expected a list, got 'i2c'"),
    ],
)
def test_it_is_refused_on_the_machine_and_at_its_line_in_a_scenario(tmp_path, declared, told):
    if "summary" not in declared:
        declared = f'summary="measures", {declared}'
    (tmp_path / "meter.py").write_text(DRIVER.replace("DECLARED", declared))
    with pytest.raises(PluginError, match=told):
        prepare("./meter.py:Meter", {}, tmp_path)

    (tmp_path / "meter.yaml").write_text(SCENARIO)
    with pytest.raises(InputError, match=told) as caught:
        load_scenario(tmp_path / "meter.yaml", ())
    (fault,) = caught.value.faults
    assert (fault.line, fault.path) == (7, "hardware.devices[0].kind")


def test_a_driver_that_is_no_device_is_told_as_its_file_calls_it(tmp_path):
    text = DRIVER.replace("DECLARED", f'summary="s", {ONE}, follows_simulated_time=True')
    text += "\nknown = dataclasses.replace(Meter.kind, device=Meter)"
    text += "\nnamed = dataclasses.replace(Meter.kind, device=':Meter')\n"
    (tmp_path / "meter.py").write_text(f"import dataclasses\n{text}")

    with pytest.raises(PluginError, match=r"meter.py:known: follows_simulated_time needs a "):
        prepare("./meter.py:known", {}, tmp_path)
    program = prepare(
        "./meter.py:named", {}, tmp_path
    )  # its class is imported by its process alone
    with pytest.raises(
        PluginError, match=r"^meter: \S+meter.py:\d+: Meter: follows_simulated_time "
    ):
        program.make()


def test_lists_and_whole_numbers_are_taken_for_what_they_mean(tmp_path):
    declared = 'summary="s", channels=[Channel(name="a", direction="out", shape=[2], limits=[0, 1], safe=[0, 0])]'
    (tmp_path / "meter.py").write_text(DRIVER.replace("DECLARED", declared))

    [channel] = prepare("./meter.py:Meter", {}, tmp_path).channels

    assert (channel.shape, channel.limits, channel.safe) == ((2,), (0.0, 1.0), (0.0, 0.0))


@pytest.mark.parametrize(
    ("kind", "parameters", "told"),
    [
        ("serial", {"framing": "ubx", "safe_frame_hex": "06"}, "safe_frame_hex: expected class"),
        (
            "serial",
            {"framing": "length_prefixed", "length_bytes": 1, "safe_frame_hex": "00" * 256},
            "safe_frame_hex: expected at most 255 bytes, got 256",
        ),
        ("i2c", {"identity_value": 3}, "identity_value needs identity_address"),
        ("i2c", {"type": "f32_be", "shift": 4}, "a: shift is of integers, and f32_be is none"),
        ("i2c", {"offset": float("nan")}, "a: expected a finite offset, got nan"),
        (
            "spi",
            {"direction": "out", "safe": float("inf")},
            "a: expected a finite safe value, got inf",
        ),
    ],
)
def test_settings_of_ours_that_would_fail_in_the_run_are_refused_before_it(kind, parameters, told):
    if kind == "serial":
        given = {"port": "/dev/ttyUSB0", **parameters}
    else:
        identity = {k: v for k, v in parameters.items() if k.startswith("identity")}
        register = {k: v for k, v in parameters.items() if k not in identity}
        given = {"map": {"registers": [{"name": "a", "address": 1, **register}], **identity}}
        given |= {"address": 0x19} if kind == "i2c" else {}
    with pytest.raises(PluginError, match=told):
        prepare(kind, given, None)


def test_a_length_of_one_byte_bounds_the_frames_that_an_agent_may_send():
    given = {"port": "/dev/ttyUSB0", "framing": "length_prefixed", "length_bytes": 1}

    channels = {each.name: each for each in prepare("serial", given, None).channels}

    assert channels["sent"].frame_bytes_max == 255
