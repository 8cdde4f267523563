"""An emulated microcontroller with real firmware: its line, its sensors, its end."""

from __future__ import annotations

import os
import signal
import socket
import sys
import time
from collections import Counter
from functools import partial
from pathlib import Path

import pytest
from harness.firmware import build_firmware, needs_emulator
from harness.waiting import is_alive, wait_until

from madns_runtime.errors import ConfigurationError, MachineError, PluginError
from madns_runtime.hardware.drivers.qmp import MachineMonitor
from madns_runtime.hardware.kind_registry import prepare
from madns_runtime.timing import granted_clock
from tests.hardware.driving import opened

HERE = Path(__file__).parent
pytestmark = [pytest.mark.process, needs_emulator]


@pytest.fixture(scope="module")
def image(tmp_path_factory):
    return build_firmware(
        tmp_path_factory.mktemp("firmware"), "report", HERE / "firmware" / "report.c"
    )


def report(mcu):
    """Ask the firmware, and return whether its sensor answers, field, nT, and clock, us."""
    mcu.write({"sent": b"?"}, time.monotonic())
    line = b""
    while not line.endswith(b"\n"):
        line += frames_of(mcu)
    numbers = [int(number) for number in line.split()]
    return numbers[0], numbers[1:4], numbers[4]


def frames_of(mcu):
    """Return the next bytes of the line, whatever else there is to read."""
    return values_of(mcu, "received")


def values_of(mcu, channel):
    def look():
        sample = mcu.read()
        return sample is not None and sample.values.get(channel)

    return wait_until(look, channel)


def test_firmware_reads_by_registers_what_truth_has_set(image):
    with opened("emulated_mcu", firmware=image) as mcu:
        mcu.write({"magnetometer": [20e-6, 40e-6, 98e-6]}, time.monotonic())
        held = values_of(mcu, "magnetometer_held")
        answers, field_nt, _ = report(mcu)

    assert held == pytest.approx([20e-6, 40e-6, 98e-6], abs=1e-7)  # as its registers round it
    assert answers == 1
    # 1100 counts per gauss along x and y, 980 along z: 91 and 102 nT per count.
    assert field_nt == pytest.approx([20_000, 40_000, 98_000], abs=103)


def test_identity_tells_board_and_firmware(image):
    with opened("emulated_mcu", firmware=image) as mcu:
        assert mcu.identity.startswith("lm3s6965evb ")
        assert len(mcu.identity.split()[1]) == 12


def test_its_own_clock_goes_on(image):
    with opened("emulated_mcu", firmware=image) as mcu:
        _, _, before_us = report(mcu)
        _, _, after_us = report(mcu)

    assert 0 < before_us < after_us


def test_flood_is_taken_in_bounded_pieces(image):
    with opened("emulated_mcu", firmware=image, line_bytes_s=1e7) as mcu:
        mcu.write({"sent": b"F"}, time.monotonic())
        flood = b""
        while not flood.rstrip().endswith(b"1") and flood.count(b"\n") < 20_001:
            piece = frames_of(mcu)
            assert len(piece) <= 4096
            flood += piece

    assert flood.count(b"FLOODFLOODFLOOD\n") == 20_000


@pytest.mark.nightly
def test_what_a_flood_brings_beyond_the_lines_rate_is_lost_and_counted(image):
    counts = Counter()
    with opened("emulated_mcu", firmware=image, line_bytes_s=4096) as mcu:
        mcu.count = lambda name, number: counts.update({name: number})
        mcu.write({"sent": b"F"}, time.monotonic())
        began_s, taken = time.monotonic(), 0

        def read():
            nonlocal taken
            sample = mcu.read()
            taken += len(sample.values.get("received", b"")) if sample is not None else 0
            return taken + counts["lost_bytes"] >= 320_000

        wait_until(read, "the whole flood")
        passed_s = time.monotonic() - began_s
        lost = mcu.health()["lost_bytes"]

    assert counts["lost_bytes"] == lost > 0
    assert taken <= 4096 * (1 + passed_s)
    assert taken + lost <= 320_000 + 100  # and the one line that answers


def test_what_is_on_its_way_at_its_end_is_counted(image):
    counts = Counter()
    with opened("emulated_mcu", firmware=image, gather_s=1.0) as mcu:
        mcu.count = lambda name, number: counts.update({name: number})
        mcu.write({"sent": b"?"}, time.monotonic())
        wait_until(lambda: [mcu.read(), mcu._gathered.endswith(b"\n")][1])
        os.kill(mcu._process.pid, signal.SIGSTOP)
        for _ in range(200):
            mcu.write({"sent": b"x" * 2048}, time.monotonic())
        wanted = {"bytes_left": len(mcu._gathered), "bytes_unsent": len(mcu._unsent)}

    assert min(wanted.values()) > 0
    assert {name: counts[name] for name in wanted} == wanted


def test_killed_emulator_is_named(image):
    with opened("emulated_mcu", firmware=image) as mcu:
        os.kill(mcu._process.pid, signal.SIGKILL)

        with pytest.raises(MachineError, match="the emulator is gone"):
            wait_until(lambda: mcu.read() and False)


def test_frozen_emulator_is_named(image, monkeypatch):
    with opened("emulated_mcu", firmware=image) as mcu:
        os.kill(mcu._process.pid, signal.SIGSTOP)

        with pytest.raises(MachineError, match="answers nothing for 2 s"):
            wait_until(lambda: mcu.read() and False)


def test_emulator_that_waits_for_a_processor_is_not_silent(monkeypatch):
    """A busy machine is no fault of the emulator's; that it is stopped, or sleeps, is."""
    here, there = socket.socketpair()
    clock_s, delay_s, is_runnable = 0.0, 0.0, True
    monkeypatch.setattr(granted_clock, "monotonic", lambda: clock_s)
    monkeypatch.setattr(
        granted_clock,
        "GrantedClock",
        partial(
            granted_clock.GrantedClock,
            read=lambda _roots: {
                (7, 7): granted_clock.ThreadReading(is_runnable, clock_s - delay_s, delay_s)
            },
            clock=lambda: clock_s,
        ),
    )
    with here, there:
        monitor = MachineMonitor(here, lambda: [7])
        monitor.command("query-status", lambda _answer: None)
        for _ in range(200):
            clock_s, delay_s = clock_s + 0.1, delay_s + 0.1
            monitor.poll()
        is_runnable = False

        with pytest.raises(MachineError, match="answers nothing for 2 s"):
            for _ in range(30):
                clock_s += 0.1
                monitor.poll()


def test_emulator_ends_with_its_device(image):
    with opened("emulated_mcu", firmware=image) as mcu:
        pid = mcu._process.pid
        assert is_alive(pid)

    assert not is_alive(pid)


def test_missing_firmware_is_told_before_anything_starts(tmp_path):
    with (
        pytest.raises(MachineError, match=r"no firmware .*gone\.elf; build it first"),
        opened("emulated_mcu", firmware=tmp_path / "gone.elf"),
    ):
        pass


def test_board_that_is_unknown_is_told_in_the_emulators_words(image):
    with (
        pytest.raises(MachineError, match="it said: .*unsupported machine type"),
        opened("emulated_mcu", firmware=image, machine="nothing"),
    ):
        pass


def test_image_that_is_no_program_is_told(tmp_path):
    image = tmp_path / "empty.elf"
    image.write_bytes(b"\xff" * 4096)

    with (
        pytest.raises(MachineError, match="the emulator is gone.*Lockup"),
        opened("emulated_mcu", firmware=image) as mcu,
    ):
        wait_until(lambda: mcu.read() and False)


@pytest.mark.parametrize(
    ("data", "told"),
    [
        (b"", "is empty; build it first"),
        (b"\x7fELF\x02\x01\x01" + bytes(9) + b"\x02\x00\x3e\x00" + bytes(100), "another processor .e_machine 62"),
    ],
)  # fmt: skip
def test_image_that_this_computers_compiler_made_is_told(tmp_path, data, told):
    """As `cc` in the place of `arm-none-eabi-gcc` does: the emulator would run it, into a lockup."""
    image = tmp_path / "main.elf"
    image.write_bytes(data)
    with (
        pytest.raises(MachineError, match=rf"main\.elf is .*{told.removeprefix('is ')}"),
        opened("emulated_mcu", firmware=image),
    ):
        pass


def test_missing_emulator_is_told_with_what_installs_it(image):
    with (
        pytest.raises(MachineError, match="apt install qemu-system-nothing"),
        opened("emulated_mcu", firmware=image, program="qemu-system-nothing"),
    ):
        pass


TALKATIVE = """#!{python}
import json, os, re, socket, sys
line = socket.socket(fileno=int(re.search(r"id=monitor,fd=([0-9]+)", " ".join(sys.argv)).group(1)))
line.sendall(b'{{"QMP": {{}}}}\\n')
for number, asked in enumerate(line.makefile()):
    os.write(2, b"display: unknown command\\n" * 400)
    if number == 40:
        os.write(2, b"qemu-system-arm: the end\\n")
        sys.exit(1)
    line.sendall(b'{{"return": {{}}}}\\n')
"""
"""As an emulator whose model of a display tells each command that it does not know."""


def test_emulator_that_says_much_goes_on_and_its_last_words_are_told(tmp_path, image):
    program = tmp_path / "talkative"
    program.write_text(TALKATIVE.format(python=sys.executable))
    program.chmod(0o700)
    parameters = {"program": str(program), "sensors": [], "held_hz": 100}
    with (
        pytest.raises(
            MachineError, match="the emulator is gone.*it said: 'qemu-system-arm: the end'"
        ),
        opened("emulated_mcu", firmware=image, **parameters) as mcu,
    ):
        wait_until(lambda: mcu.read() and False)


def test_value_that_the_model_refuses_is_told(image):
    sensor = {
        "name": "magnetometer",
        "model": "lsm303dlhc_mag",
        "address": 0x1E,
        "properties": ["mag-x"],
        "limits": [-1.0, 1.0],
        "counts_per_unit": 1e9,
    }
    with opened("emulated_mcu", firmware=image, sensors=[sensor]) as mcu:
        mcu.write({"magnetometer": -1e-6}, time.monotonic())

        with pytest.raises(MachineError, match="the emulator refuses: .*-1000"):
            wait_until(lambda: mcu.read() and False)


def test_property_that_holds_no_number_is_named(image):
    sensor = {
        "name": "magnetometer",
        "model": "lsm303dlhc_mag",
        "properties": ["type"],
        "limits": [0.0, 1.0],
    }
    told = "sensor magnetometer: expected a number in type of lsm303dlhc_mag, got 'lsm303dlhc_mag'"
    with (
        opened("emulated_mcu", firmware=image, sensors=[sensor]) as mcu,
        pytest.raises(MachineError, match=told),
    ):
        wait_until(lambda: mcu.read() and False)


def test_channels_of_sensors_are_declared_both_ways():
    channels = {
        each.name: each for each in prepare("emulated_mcu", {"firmware": "x"}, HERE).channels
    }

    assert list(channels) == ["received", "sent", "magnetometer", "magnetometer_held"]
    assert channels["magnetometer"].direction == "out"
    assert channels["magnetometer"].limits == (0.0, 1.7e-4)
    assert channels["magnetometer_held"].unit == "T"


@pytest.mark.parametrize(
    ("parameters", "words"),
    [
        ({"firmware": "x", "held_hz": 0}, "held_hz"),
        ({"firmware": "x", "serial_port": 4}, "serial_port"),
        ({}, "firmware"),
    ],
)
def test_bad_parameters_are_refused(parameters, words):
    with pytest.raises((ConfigurationError, PluginError), match=words):
        prepare("emulated_mcu", parameters, HERE)
