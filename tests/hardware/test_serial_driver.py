"""The driver of `serial` on a real pseudo-terminal."""

from __future__ import annotations

import contextlib
import os
import time
import tty

import pytest

from madns_runtime.errors import MachineError
from madns_runtime.hardware.drivers import serial as driver
from madns_runtime.hardware.drivers.serial import SerialDevice
from madns_runtime.hardware.kinds.serial import SerialParameters


@pytest.fixture
def line():
    ours, theirs = os.openpty()
    tty.setraw(theirs)
    device = SerialDevice(SerialParameters(port=os.ttyname(theirs)))
    device.open()
    os.close(theirs)
    yield device, ours
    device.close()
    with contextlib.suppress(OSError):  # a test may have pulled it out
        os.close(ours)


def received(device):
    sample = device.read()
    return None if sample is None else sample.values["received"]


def wait_for(device):
    deadline_s = time.monotonic() + 120
    while (frame := received(device)) is None:
        assert time.monotonic() < deadline_s
    return frame


def test_an_idle_line_is_not_gone(line):
    device, ours = line
    assert [received(device) for _ in range(5)] == [None] * 5

    os.write(ours, b"one\ntwo\n")

    assert wait_for(device) == b"one"
    assert received(device) == b"two"
    assert [received(device) for _ in range(5)] == [None] * 5


def test_a_wake_costs_one_look_at_the_line(line, monkeypatch):
    device, ours = line
    looks = []
    read = os.read
    monkeypatch.setattr(driver.os, "read", lambda fd, size: looks.append(fd) or read(fd, size))
    os.write(ours, b"one\n")
    assert wait_for(device) == b"one"
    looks.clear()

    assert received(device) is None  # the loop asks until nothing is left

    assert looks == []


def test_half_a_frame_is_kept_until_its_end_comes(line):
    device, ours = line
    os.write(ours, b"hal")
    time.sleep(0.01)
    assert received(device) is None
    os.write(ours, b"ves\n")
    assert wait_for(device) == b"halves"


def test_what_came_and_what_was_no_frame_outlive_the_opening(line):
    device, ours = line
    counts = {}
    device.count = lambda name, number: counts.update({name: counts.get(name, 0) + number})
    os.write(ours, b"x" * 2000 + b"\ngood\n")
    assert wait_for(device) == b"good"

    assert counts == {"received_bytes": 2006, "garbage_bytes": 2001, "bad_checksums": 0}


def test_what_was_taken_from_a_line_and_not_handed_on_when_it_is_closed_is_counted(line):
    device, ours = line
    counts = {}
    device.count = lambda name, number: counts.update({name: counts.get(name, 0) + number})
    os.write(ours, b"one\ntwo\nthree\nhal")
    assert wait_for(device) == b"one"
    device.close()

    assert counts == {
        "received_bytes": 17,
        "garbage_bytes": len(b"hal"),
        "bad_checksums": 0,
        "frames_left": 2,
    }


def test_a_line_that_is_pulled_out_is_gone(line):
    device, ours = line
    os.close(ours)
    with pytest.raises(MachineError, match="/dev/pts/.* is gone"):
        for _ in range(3):
            device.read()


@pytest.mark.parametrize("number", ["A50285BI", ""])
def test_the_identity_is_the_adapters_own_number_and_no_hubs(tmp_path, monkeypatch, number):
    # As Linux has it: a hub, and the controller behind all of them, are USB devices with numbers of their own.
    controller = tmp_path / "devices" / "usb1"
    adapter = controller / "1-1"
    port = adapter / "1-1:1.0" / "ttyUSB7"
    port.mkdir(parents=True)
    for device, own in ((controller, "0000:01:00.0"), (adapter, number)):
        (device / "idVendor").write_text("0403\n")
        if own:
            (device / "serial").write_text(f"{own}\n")
    (tmp_path / "tty" / "ttyUSB7").mkdir(parents=True)
    (tmp_path / "tty" / "ttyUSB7" / "device").symlink_to(port)
    monkeypatch.setattr(driver, "TTY_FOLDER", str(tmp_path / "tty"))

    assert driver._adapter_serial("/dev/ttyUSB7") == number
