"""Kind `i2c` through smbus2: on the kernel's own bus of stand-in chips (i2c-stub), and on that of a USB bridge."""

from __future__ import annotations

import glob
import subprocess
from pathlib import Path

import pytest
import smbus2
from bridge import bridge
from guest_devices import (
    NAME,
    PATIENCE_S,
    assert_refused,
    device_events,
    driven,
    errors_told,
    load,
    lose_and_regain,
    status_is,
    unload,
    verify,
    wait_until,
    write_file,
)

from tests.hardware.driving import opened

CHIP, FREE, HELD = 0x1D, 0x1E, 0x10
NOBODY = 0x77
VALVE = 0x20
MAP = {
    "identity_address": 0x0F,
    "identity_value": 0x33,
    "setup": [{"address": 0x21, "value": 0x57}],
    "registers": [
        {"name": "acceleration", "address": 0x28, "type": "i16_le", "count": 3, "shift": 4, "scale": 0.5},
        {"name": "memory", "address": 0x40, "count": 64},
        {"name": "valve", "address": VALVE, "direction": "out", "scale": 0.01, "low": 0, "high": 1, "safe": 0.25},
    ],
}  # fmt: skip


def load_stub() -> int:
    """Load the bus, and return its number."""
    load("i2c-stub", f"chip_addr={CHIP:#x},{FREE:#x},{HELD:#x}")
    names = Path("/sys/bus/i2c/devices").glob("i2c-*/name")
    [name] = [path for path in names if "stub" in path.read_text()]
    return int(name.parent.name.removeprefix("i2c-"))


@pytest.fixture
def bus():
    number = load_stub()
    with smbus2.SMBus(number) as chips:
        chips.write_byte_data(CHIP, 0x0F, 0x33)
    yield number
    unload("i2c-stub")


def register(bus: int, address: int) -> int:
    with smbus2.SMBus(bus) as chips:
        return chips.read_byte_data(CHIP, address)


def test_registers_are_read_and_written_across_the_border_of_a_block(bus):
    with smbus2.SMBus(bus) as chips:
        raw = (1600).to_bytes(2, "little") + (-16).to_bytes(2, "little", signed=True) + bytes(2)
        chips.write_i2c_block_data(CHIP, 0x28, list(raw))
        for start in (0, 32):
            chips.write_i2c_block_data(CHIP, 0x40 + start, list(range(start, start + 32)))
    with opened("i2c", bus=bus, address=CHIP, map=MAP) as device:
        assert device.identity == "0x33"
        values = device.read().values
        assert values["acceleration"] == [50.0, -0.5, 0.0]
        assert values["memory"] == [float(number) for number in range(64)]
        assert register(bus, 0x21) == 0x57
        device.write({"valve": 0.75}, 0.0)
        assert register(bus, VALVE) == 75
        device.make_safe()
        assert register(bus, VALVE) == 25


def test_another_chip_none_and_one_that_the_kernel_has_are_told_apart(bus):
    assert_refused(
        "i2c", "expected 0x33 in register 0x0f, found 0x00", bus=bus, address=FREE, map=MAP
    )
    assert_refused(
        "i2c",
        f"i2c-{bus}, address 0x77: does not answer; see what",
        bus=bus,
        address=NOBODY,
        map=MAP,
    )
    adapter = f"/sys/bus/i2c/devices/i2c-{bus}"
    load("ds4424")
    write_file(f"{adapter}/new_device", f"ds4424 {HELD:#x}")
    try:
        assert_refused(
            "i2c", "a driver of the kernel has this address", bus=bus, address=HELD, map=MAP
        )
    finally:
        write_file(f"{adapter}/delete_device", f"{HELD:#x}")
    assert_refused("i2c", "/dev/i2c-99: there is no such bus", bus=99, address=CHIP, map=MAP)


def test_a_run_holds_an_output_to_its_limits_and_makes_it_safe(bus, tmp_path):
    with driven(tmp_path, "i2c", {"bus": bus, "address": CHIP, "map": MAP}) as bench:
        bench.until(status_is(bench, "ok"), PATIENCE_S)
        bench.hardware[NAME].write("valve", 7.0)
        bench.until(lambda: register(bus, VALVE) == 100)
        result = bench.close()["here/device"]

    assert register(bus, VALVE) == 25
    assert result["report"]["valve_limited"] == 1
    assert result["errors"] == 0
    assert [event["event"] for event in device_events(tmp_path)].count("made_safe") == 1


def test_a_bus_in_use_stays_and_one_that_comes_late_is_found(bus, tmp_path):
    parameters = {"bus": bus, "address": CHIP, "map": {**MAP, "identity_value": None}}
    with driven(tmp_path / "held", "i2c", parameters) as bench:
        bench.until(status_is(bench, "ok"), PATIENCE_S)
        removed = subprocess.run(["modprobe", "--remove", "i2c-stub"], check=False, timeout=30)
        assert removed.returncode != 0, "the kernel lets nobody take a bus away that is open"
        bench.run(1.0)
        assert bench.hardware[NAME].status == "ok"
    unload("i2c-stub")
    with driven(tmp_path / "late", "i2c", parameters) as bench:
        bench.until(lambda: bool(errors_told(bench)), PATIENCE_S)
        assert f"/dev/i2c-{bus}: there is no such bus" in errors_told(bench)[0]
        bench.until(status_is(bench, "lost"), PATIENCE_S)
        assert load_stub() == bus
        bench.until(status_is(bench, "ok"), PATIENCE_S)


@pytest.fixture
def bridged():
    """A bus of a USB bridge, which can be pulled out, and whose chip may not answer."""
    load("hid-cp2112")
    with bridge() as cable:
        yield cable


def plug(cable) -> int:
    assert cable.ask("plug") == "done"
    names = "/sys/bus/i2c/devices/i2c-*/name"
    [name] = wait_until(lambda: [n for n in glob.glob(names) if "CP2112" in Path(n).read_text()])
    number = int(Path(name).parent.name.removeprefix("i2c-"))
    wait_until(Path(f"/dev/i2c-{number}").exists)
    return number


SMALL = {"registers": [{"name": "who", "address": 0x0F}]}


def test_a_bridge_that_is_pulled_out_is_lost_and_comes_back(bridged, tmp_path):
    number = plug(bridged)
    with driven(tmp_path, "i2c", {"bus": number, "address": CHIP, "map": SMALL}) as bench:
        lose_and_regain(
            bench, lambda: bridged.ask("pull"), lambda: plug(bridged), why=f"/dev/i2c-{number}"
        )
        assert bench.hardware[NAME]["who"].value == 0x33


def test_a_chip_that_ceases_to_answer_is_lost_and_comes_back(bridged, tmp_path):
    number = plug(bridged)
    with driven(tmp_path, "i2c", {"bus": number, "address": CHIP, "map": SMALL}) as bench:
        lose_and_regain(
            bench,
            lambda: bridged.ask("chip 0"),
            lambda: bridged.ask("chip 1"),
            why="nothing answers there",
        )


def test_it_is_verified(bus, tmp_path):
    rows = verify(tmp_path, "i2c", {"bus": bus, "address": CHIP, "map": MAP})
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
    assert register(bus, VALVE) == 25
