"""Kind `serial` on a USB adapter (an FTDI chip's driver) and on 16550 ports: the guest's own cables join them."""

from __future__ import annotations

import time
from pathlib import Path

import pytest
import serial
from guest_devices import (
    NAME,
    PATIENCE_S,
    assert_refused,
    driven,
    lose_and_regain,
    program,
    status_is,
    verify,
    wait_until,
    write_file,
)

from tests.hardware.driving import frames, opened

ADAPTER, ITS_END = "/dev/ttyUSB0", "/dev/ttyS1"
PORT, OTHER = "/dev/ttyS2", "/dev/ttyS3"
FEEDER = """
import serial, sys, time
with serial.Serial(sys.argv[1], 115200) as line:
    number = 0
    while True:
        number += 1
        line.write(b"%d\\n" % number)
        time.sleep(0.05)
"""
cables = pytest.mark.parametrize(("port", "other"), [(ADAPTER, ITS_END), (PORT, OTHER)])


@pytest.fixture(autouse=True)
def adapter():
    wait_until(Path(ADAPTER).exists)


def usb_device() -> Path:
    """The adapter on its USB bus."""
    interface = Path("/sys/class/tty/ttyUSB0/device").resolve().parent
    return interface.parent


def empty(device, end):
    """Read what waited in a cable from an earlier test, and was echoed until the terminal was told not to: up to a word behind it."""
    end.write(b"\nbehind\n")
    while frames(device, 1, timeout_s=PATIENCE_S) != [b"behind"]:
        pass
    device.write({"sent": b"behind"}, 0.0)
    until_s = time.monotonic() + PATIENCE_S
    while not end.readline().endswith(b"behind\r\n"):
        assert time.monotonic() < until_s


@cables
def test_frames_go_both_ways_over_a_cable(port, other):
    with (
        serial.Serial(other, 115200, timeout=PATIENCE_S) as end,
        opened("serial", port=port) as device,
    ):
        empty(device, end)
        assert bool(device.identity) == (port == ADAPTER), "an adapter has a serial number"
        device.write({"sent": b"go"}, 0.0)
        assert end.readline() == b"go\r\n"
        end.write(b"one\ntwo\nth")
        end.write(b"ree\n")
        assert frames(device, 3, timeout_s=PATIENCE_S) == [b"one", b"two", b"three"]
        device.make_safe()


@cables
def test_bytes_that_mean_something_to_a_terminal_come_through(port, other):
    data = bytes(range(256))
    settings = {"port": port, "framing": "length_prefixed", "baud_rate": 115200}
    with serial.Serial(other, 115200, timeout=PATIENCE_S) as end:
        with opened("serial", port=port) as device:
            empty(device, end)
        with opened("serial", **settings) as device:
            end.write(len(data).to_bytes(2, "little") + data)
            assert frames(device, 1, timeout_s=PATIENCE_S) == [data]


def test_one_in_use_and_one_that_is_not_there_are_told():
    with opened("serial", port=PORT):
        assert_refused("serial", f"{PORT}: another program has it open", port=PORT)
    assert_refused(
        "serial", "ttyUSB9: there is no such device; is it plugged in", port="/dev/ttyUSB9"
    )


def test_a_direction_that_its_driver_does_not_switch_is_told():
    assert_refused(
        "serial", "does not switch the direction of RS-485", port=ADAPTER, electrical="rs485"
    )


def test_an_adapter_that_is_pulled_out_is_lost_and_comes_back(tmp_path):
    device = usb_device()
    with program(FEEDER, ITS_END), driven(tmp_path, "serial", {"port": ADAPTER}) as bench:
        lose_and_regain(
            bench,
            lambda: write_file(device / "authorized", "0"),
            lambda: write_file(device / "authorized", "1"),
            why="is gone",
        )
        bench.hardware[NAME].frames("received")


def test_a_port_whose_driver_lets_go_is_lost_and_comes_back(tmp_path):
    port = Path("/sys/class/tty/ttyS2/device").resolve()
    driver = (port / "driver").resolve()
    with program(FEEDER, OTHER), driven(tmp_path, "serial", {"port": PORT}) as bench:
        lose_and_regain(
            bench,
            lambda: write_file(driver / "unbind", port.name),
            lambda: write_file(driver / "bind", port.name),
            why="ttyS2",
        )


def test_what_hangs_on_the_line_is_made_safe_at_the_end(tmp_path):
    parameters = {"port": ADAPTER, "safe_frame_hex": b"stop".hex()}
    with serial.Serial(ITS_END, 115200, timeout=PATIENCE_S) as end:
        with driven(tmp_path, "serial", parameters) as bench:
            # What comes before it is opened is thrown away by the kernel.
            bench.until(lambda: end.write(b"here\n") and status_is(bench, "ok")(), PATIENCE_S)
            bench.hardware[NAME].write("sent", b"go")
            assert end.readline() == b"go\r\n"
            bench.close()
        assert end.readline() == b"stop\r\n"


def test_it_is_verified(tmp_path):
    parameters = {"port": ADAPTER, "safe_frame_hex": b"stop".hex()}
    with program(FEEDER, ITS_END):
        rows = verify(tmp_path, "serial", parameters)
    for name in ("shapes", "descriptors", "outputs", "kill -9", "hang", "safe at its end"):
        assert rows[name]["passed"], rows[name]
