"""Kind `analog` on files of Industrial I/O: the kernel's drivers of a magnetometer and a DAC, on chips of i2c-stub."""

from __future__ import annotations

from pathlib import Path

import pytest
import smbus2
from guest_devices import (
    NAME,
    PATIENCE_S,
    driven,
    load,
    lose_and_regain,
    status_is,
    unload,
    verify,
    wait_until,
    write_file,
)

from tests.hardware.driving import opened

HMC5843, DS4424 = 0x1E, 0x10
FOLDER = Path("/sys/bus/iio/devices")
FIELD = [{"name": f"field_{axis}", "file": f"in_magn_{axis}_raw", "unit": "G"} for axis in "xyz"]
CURRENT = [
    {"name": "is", "file": "out_current0_raw", "unit": "1"},
    {"name": "current", "file": "out_current0_raw", "is_output": True, "unit": "1",
     "low": -100, "high": 100, "safe": 5},
]  # fmt: skip


class Chips:
    """Two chips on a bus, and their drivers."""

    def __init__(self, bus: int) -> None:
        self.bus = bus
        self.adapter = Path(f"/sys/bus/i2c/devices/i2c-{bus}")
        self._added: set[int] = set()

    def add(self, name: str, address: int) -> str:
        write_file(self.adapter / "new_device", f"{name} {address:#x}")
        self._added.add(address)
        place = self.adapter / f"{self.bus}-{address:04x}"
        return wait_until(lambda: [path.name for path in place.glob("iio:device*")])[0]

    def remove(self, address: int) -> None:
        self._added.discard(address)
        write_file(self.adapter / "delete_device", f"{address:#x}")

    def remove_all(self) -> None:
        for address in list(self._added):
            self.remove(address)


@pytest.fixture
def chips():
    load("i2c-stub", f"chip_addr={HMC5843:#x},{DS4424:#x}")
    names = Path("/sys/bus/i2c/devices").glob("i2c-*/name")
    [name] = [path for path in names if "stub" in path.read_text()]
    bus = int(name.parent.name.removeprefix("i2c-"))
    with smbus2.SMBus(bus) as registers:
        registers.write_i2c_block_data(HMC5843, 0x0A, list(b"H43"))
        registers.write_byte_data(HMC5843, 0x09, 0x01)  # data are ready
        registers.write_i2c_block_data(HMC5843, 0x03, [0, 100, 0xFF, 0x9C, 1, 0])
    load("ds4424")
    load("hmc5843_i2c")
    chips = Chips(bus)
    yield chips
    chips.remove_all()
    unload("i2c-stub")


def test_a_magnetometer_is_read_in_its_unit(chips):
    device_name = chips.add("hmc5843", HMC5843)
    scale = float((FOLDER / device_name / "in_magn_scale").read_text())
    with opened("analog", device=device_name, inputs=FIELD) as device:
        assert device.identity == "hmc5843"
        values = device.read().values
    assert scale != 1.0, "the driver's own"
    assert list(values.values()) == pytest.approx([100 * scale, -100 * scale, 256 * scale])


def test_a_current_is_held_to_its_limits_and_made_safe(chips, tmp_path):
    device = chips.add("ds4424", DS4424)
    raw = FOLDER / device / "out_current0_raw"
    with driven(tmp_path, "analog", {"device": device, "inputs": CURRENT}) as bench:
        bench.until(status_is(bench, "ok"), PATIENCE_S)
        bench.hardware[NAME].write("current", -1000.0)
        bench.until(lambda: bench.hardware[NAME]["is"].value == -100.0)
        assert int(raw.read_text()) == -100
        result = bench.close()["here/device"]
    assert int(raw.read_text()) == 5
    assert result["report"]["current_limited"] == 1


def test_a_converter_that_is_pulled_out_is_lost_and_comes_back(chips, tmp_path):
    device = chips.add("hmc5843", HMC5843)
    with driven(tmp_path, "analog", {"device": device, "inputs": FIELD}) as bench:
        lose_and_regain(
            bench,
            lambda: chips.remove(HMC5843),
            lambda: chips.add("hmc5843", HMC5843),
            why="No such",
        )


def test_it_is_verified(chips, tmp_path):
    device = chips.add("ds4424", DS4424)
    rows = verify(tmp_path, "analog", {"device": device, "inputs": CURRENT})
    for name in (
        "rate",
        "shapes",
        "descriptors",
        "outputs",
        "kill -9",
        "hang",
        "safe after kill -9",
    ):
        assert rows[name]["passed"], rows[name]
    assert int((FOLDER / device / "out_current0_raw").read_text()) == 5
