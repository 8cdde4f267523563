"""`i2c` and `spi`: register maps behind stand-ins for smbus2 and spidev, with numbers of data sheets."""

from __future__ import annotations

import errno
import os
import sys
from types import ModuleType

import pytest

from madns_runtime.errors import ConfigurationError, MachineError, PluginError
from madns_runtime.hardware.kind_registry import prepare
from tests.hardware.driving import opened

CHIP = bytearray(256)
FAULT: list[int] = []
CALLS: list[tuple] = []


def _act(call):
    CALLS.append(call)
    if FAULT:
        raise OSError(FAULT[0], os.strerror(FAULT[0]))


class SMBus:
    """As smbus2's: blocks of at most 32 bytes, one device at 0x19."""

    def __init__(self, bus):
        if bus != 1:
            raise OSError(errno.ENOENT, "No such file or directory")
        self.is_open = True

    def read_i2c_block_data(self, address, register, length, force=None):
        assert self.is_open
        if length > 32:
            raise ValueError("Desired block length over 32 bytes")
        _act(("read", register, length))
        if address != 0x19:
            raise OSError(errno.EREMOTEIO, "Remote I/O error")
        return list(CHIP[register : register + length])

    def write_i2c_block_data(self, address, register, data, force=None):
        assert self.is_open
        if len(data) > 32:
            raise ValueError("Data length cannot exceed 32 bytes")
        _act(("write", register, bytes(data)))
        CHIP[register : register + len(data)] = bytes(data)

    def close(self):
        self.is_open = False


class SpiDev:
    """As spidev's: a chip that takes bit 7 for reading and bit 6 for going on, as an LIS3DH."""

    def __init__(self):
        self.mode = self.max_speed_hz = 0

    def open(self, bus, device):
        if (bus, device) != (0, 0):
            raise OSError(errno.ENOENT, "No such file or directory")

    def xfer2(self, data):
        _act((self.mode, self.max_speed_hz, tuple(data)))
        register, count = data[0] & 0x3F, len(data) - 1
        assert count == 1 or data[0] & 0x40
        if data[0] & 0x80:
            return [0xFF, *CHIP[register : register + count]]
        CHIP[register : register + count] = bytes(data[1:])
        return [0] * len(data)

    def close(self):
        pass


@pytest.fixture(autouse=True)
def chip(monkeypatch):
    CHIP[:] = bytes(256)
    FAULT.clear()
    CALLS.clear()
    for name, thing in (("smbus2", SMBus), ("spidev", SpiDev)):
        module = ModuleType(name)
        setattr(module, thing.__name__, thing)
        monkeypatch.setitem(sys.modules, name, module)
        driver = f"madns_runtime.hardware.drivers.{'i2c' if name == 'smbus2' else 'spi'}"
        monkeypatch.delitem(sys.modules, driver, raising=False)
    yield
    for name in ("i2c", "spi"):
        sys.modules.pop(f"madns_runtime.hardware.drivers.{name}", None)


# LSM303DLHC, section 7: OUT_X_L_A 0x28 (bit 7 goes on), 12 bits left-justified, 1 mg per digit at 2 g full scale.
ACCELERATION = {
    "name": "acceleration",
    "address": 0xA8,
    "type": "i16_le",
    "count": 3,
    "shift": 4,
    "scale": 9.80665e-3,
    "unit": "m/s2",
}
# BMP280, section 4.3: press_msb 0xF7, 20 bits left-justified in 24.
PRESSURE = {"name": "pressure_raw", "address": 0xF7, "type": "u24_be", "shift": 4}


def test_numbers_of_data_sheets():
    CHIP[0xA8:0xAE] = b"\x00\x40\x00\xc0\x10\x00"  # 1.024 g, -1.024 g, 1 mg
    CHIP[0xF7:0xFA] = bytes((0x65, 0x5A, 0xC0))  # 415148, the example of section 3.12
    registers = [ACCELERATION, PRESSURE]
    with opened("i2c", address=0x19, map={"registers": registers}) as device:
        values = device.read().values
    assert values["acceleration"] == pytest.approx([10.0420096, -10.0420096, 0.00980665])
    assert values["pressure_raw"] == 415148.0


def test_identity_and_setup_are_written_in_order():
    CHIP[0x0F] = 0x33
    parameters = {
        "registers": [{"name": "status", "address": 0x27}],
        "identity_address": 0x0F,
        "identity_value": 0x33,
        "setup": [{"address": 0x20, "value": 0x57}, {"address": 0x23, "value": 0x08}],
    }
    with opened("i2c", address=0x19, map=parameters) as device:
        assert device.identity == "0x33"
        assert [call for call in CALLS if call[0] == "write"] == [
            ("write", 0x20, b"\x57"),
            ("write", 0x23, b"\x08"),
        ]
    CALLS.clear()
    CHIP[0x0F] = 0x32
    with (
        pytest.raises(MachineError, match="expected 0x33 in register 0x0f, found 0x32"),
        opened("i2c", address=0x19, map=parameters),
    ):
        pass
    assert [call[0] for call in CALLS] == ["read"]  # nothing was written to another chip


def test_more_than_a_block_is_read_in_pieces():
    CHIP[0x10:0x50] = bytes(range(64))
    register = {"name": "table", "address": 0x10, "count": 64}
    with opened("i2c", address=0x19, map={"registers": [register]}) as device:
        assert device.read().values["table"] == list(map(float, range(64)))
    assert CALLS == [("read", 0x10, 32), ("read", 0x30, 32)]


@pytest.mark.parametrize(
    ("number", "told"),
    [
        (errno.EREMOTEIO, "does not answer; see what is on the bus with `i2cdetect"),
        (errno.ENXIO, "does not answer; see"),
        (errno.ENODEV, "does not answer; see"),
        (errno.EBUSY, "a driver of the kernel has this address"),
        (errno.ETIMEDOUT, "times out: nothing answers there, .* or a chip holds the bus"),
        (errno.EIO, "does not answer: Input/output error"),
    ],
)
def test_what_the_bus_answers_is_told_with_its_cure(number, told):
    registers = [{"name": "a", "address": 0}]
    with opened("i2c", address=0x19, map={"registers": registers}) as device:
        FAULT.append(number)
        with pytest.raises(MachineError, match=f"/dev/i2c-1, address 0x19: {told}"):
            device.read()


def test_a_bus_that_is_not_there():
    shape = {"registers": [{"name": "a", "address": 0}]}
    with (
        pytest.raises(MachineError, match="/dev/i2c-7: there is no such bus; is dtparam"),
        opened("i2c", address=0x19, bus=7, map=shape),
    ):
        pass
    with (
        pytest.raises(MachineError, match=r"/dev/spidev3\.0: there is no such bus"),
        opened("spi", bus=3, map=shape),
    ):
        pass


OUTPUT = {
    "name": "angle",
    "address": 0x30,
    "type": "i16_be",
    "scale": 0.1,
    "direction": "out",
    "low": -90,
    "high": 90,
    "safe": -1,
}


def test_outputs_are_scaled_and_made_safe():
    with opened("i2c", address=0x19, map={"registers": [OUTPUT]}) as device:
        device.write({"angle": 45.5}, 0.0)
        assert CHIP[0x30:0x32] == (455).to_bytes(2, "big")
        device.make_safe()
        assert CHIP[0x30:0x32] == (-10).to_bytes(2, "big", signed=True)
        device.write({"angle": 1e9}, 0.0)
        assert CHIP[0x30:0x32] == (32767).to_bytes(2, "big")
        assert device.read().values == {}  # outputs alone: it is there


@pytest.mark.parametrize(
    ("low", "high", "scale", "value", "raw"),
    [
        (0, 6, 4.0, 6.0, 1),  # 1.5 digits: 2 would be 8
        (-6, 6, -4.0, -6.0, 1),
        (3, 9, 4.0, 3.0, 1),  # 0.75 digits
        (0.0, 0.7, 0.1, 0.7, 7),  # 6.999999999999999 digits
        (5, 7, 4.0, 5.5, 1),  # no digit is inside: the nearest
    ],
)
def test_no_whole_digit_brings_a_value_beyond_its_limits(low, high, scale, value, raw):
    output = {**OUTPUT, "low": low, "high": high, "scale": scale, "safe": None}
    with opened("i2c", address=0x19, map={"registers": [output]}) as device:
        device.write({"angle": value}, 0.0)

    assert int.from_bytes(CHIP[0x30:0x32], "big", signed=True) == raw


def test_a_period_keeps_a_register_from_being_read_each_time():
    slow = {"name": "slow", "address": 1, "period_s": 100.0}
    registers = [slow, {"name": "fast", "address": 2}]
    with opened("i2c", address=0x19, map={"registers": registers}) as device:
        assert sorted(device.read().values) == ["fast", "slow"]
        assert sorted(device.read().values) == ["fast"]


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"low": None}, "angle: expected low and high, or neither"),
        ({"scale": 0.0}, "angle: expected a scale other than 0"),
        ({"address": 300}, "address"),
        ({"safe": 91.0}, "angle: safe value"),
        ({"type": "u8", "safe": 26.0}, "angle: safe value 26.0 is beyond the limits"),
        ({"type": "u8", "low": 30, "high": 90}, "angle: u8 holds 0 to 25.5, none of 30 to 90"),
        ({"type": "u8", "shift": 8}, "angle: shift: expected less than the 8 bits of u8, got 8"),
    ],
)
def test_a_faulty_map_is_refused(change, told):
    shape = {"registers": [{**OUTPUT, **change}]}
    with pytest.raises((PluginError, ConfigurationError), match=told):
        prepare("i2c", {"address": 0x19, "map": shape}, None)


@pytest.mark.parametrize(
    ("change", "limits"),
    [
        ({"low": None, "high": None}, (-3276.8, 3276.7)),
        ({"low": -90, "high": 1e4}, (-90, 3276.7)),
        ({"scale": -0.5, "offset": 10, "type": "u8", "shift": 4}, (2.5, 10)),
        ({"type": "f32_le"}, (-90, 90)),
        ({"direction": "in", "safe": None, "low": None, "high": None}, None),
    ],
)
def test_an_output_is_limited_to_what_its_register_holds(change, limits):
    shape = {"registers": [{**OUTPUT, "safe": 3, **change}]}
    (channel,) = prepare("i2c", {"address": 0x19, "map": shape}, None).channels

    assert channel.limits == (limits and pytest.approx(limits))


def test_spi_reads_and_writes_with_the_bits_of_the_chip():
    CHIP[0x28:0x2E] = b"\x00\x40\x00\xc0\x10\x00"
    shape = {"registers": [{**ACCELERATION, "address": 0x28}, {**OUTPUT, "address": 0x20}]}
    settings = {"mode": 3, "speed_hz": 5_000_000, "increment_bits": 0x40}
    with opened("spi", map=shape, **settings) as device:
        values = device.read().values
        device.make_safe()
    assert values["acceleration"] == pytest.approx([10.0420096, -10.0420096, 0.00980665])
    assert CALLS[0] == (3, 5_000_000, (0xE8, 0, 0, 0, 0, 0, 0))
    assert CALLS[1] == (3, 5_000_000, (0x60, 0xFF, 0xF6))


def test_a_missing_library_is_told_with_its_cure(monkeypatch):
    monkeypatch.setitem(sys.modules, "smbus2", None)
    shape = {"registers": [{"name": "a", "address": 0}]}
    program = prepare("i2c", {"address": 0x19, "map": shape}, None)
    with pytest.raises(MachineError, match=r"smbus2 is not installed here; pip install 'smbus2>=0"):
        program.make()


def test_a_number_beyond_what_a_float_of_32_bits_holds_is_held_to_it():
    register = {"name": "level", "address": 0x10, "type": "f32_le", "direction": "out"}
    with opened("i2c", address=0x19, map={"registers": [register]}) as device:
        device.write({"level": -1e300}, 0.0)

    assert bytes(CHIP[0x10:0x14]) == b"\xff\xff\x7f\xff"


@pytest.mark.parametrize(("kind", "held"), [("i16_be", b"\x80\x00"), ("u16_be", b"\0\0")])
def test_a_number_beyond_all_bounds_is_held_to_what_the_register_can_hold(kind, held):
    register = {"name": "level", "address": 0x10, "type": kind, "direction": "out", "scale": 1e-9}
    with opened("i2c", address=0x19, map={"registers": [register]}) as device:
        device.write({"level": -1e305}, 0.0)

    assert bytes(CHIP[0x10:0x12]) == held


@pytest.mark.parametrize(
    ("kind", "value", "held"),
    [
        ("u16_be", 1e6, b"\xff\xf0"),
        ("u16_le", 4095.0, b"\xf0\xff"),
        ("i16_be", 1e6, b"\x7f\xf0"),
        ("i16_be", -1e6, b"\x80\x00"),
    ],
)
def test_bits_below_a_number_that_stands_left_stay_zero(kind, value, held):
    register = {"name": "level", "address": 0x10, "type": kind, "direction": "out", "shift": 4}
    with opened("i2c", address=0x19, map={"registers": [register]}) as device:
        device.write({"level": value}, 0.0)

    assert bytes(CHIP[0x10:0x12]) == held


def test_a_map_whose_blocks_would_begin_beyond_the_last_register_is_refused():
    """An address is one byte: beyond 0xff the bus would begin anew at 0x00."""
    trace = {"name": "trace", "address": 0x20, "type": "u32_le", "count": 56}
    prepare("i2c", {"address": 0x19, "map": {"registers": [trace]}}, None)

    trace["count"] = 57
    with pytest.raises(
        PluginError, match="trace: 228 bytes from register 0x20 on, in blocks of 32"
    ):
        prepare("i2c", {"address": 0x19, "map": {"registers": [trace]}}, None)
