"""Kind `can` on the kernel's virtual bus, by its own sockets and by python-can."""

from __future__ import annotations

import contextlib
import select
import socket
import struct

import pytest
from guest_devices import (
    NAME,
    PATIENCE_S,
    assert_refused,
    driven,
    lose_and_regain,
    program,
    run,
    status_is,
    unload,
    verify,
)

from madns_runtime.errors import MachineError
from tests.hardware.driving import frames, opened

BUS = "vcan0"
ENGINE, LONG = 0x123, 0x1ABC_DEF0 | socket.CAN_EFF_FLAG
WIRE = struct.Struct("=IB3x8s")
FEEDER = """
import socket, struct, sys, time
number = 0
while True:
    try:
        with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as raw:
            raw.bind((sys.argv[1],))
            while True:
                number += 1
                raw.send(struct.pack("=IB3x8s", 0x100, 8, number.to_bytes(8, "little")))
                time.sleep(0.02)
    except OSError:
        time.sleep(0.05)
"""
libraries = pytest.mark.parametrize("library", ["socket", "python-can"])


def add_bus():
    run("ip", "link", "add", BUS, "type", "vcan")
    run("ip", "link", "set", BUS, "up")


def delete_bus():
    run("ip", "link", "delete", BUS)


@pytest.fixture
def bus():
    add_bus()
    with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as raw:
        raw.bind((BUS,))
        raw.settimeout(PATIENCE_S)
        yield raw
    with contextlib.suppress(AssertionError):  # deleted by the test itself
        delete_bus()
    unload("vcan")


def receive(bus: socket.socket) -> tuple[int, bytes]:
    identifier, length, data = WIRE.unpack(bus.recv(72))
    return identifier, data[:length]


def frame(identifier: int, data: bytes) -> bytes:
    return identifier.to_bytes(4, "little") + data


@libraries
def test_frames_of_both_lengths_go_both_ways(bus, library):
    with opened("can", interface=BUS, library=library) as device:
        assert device.identity == BUS
        device.write({"sent": frame(ENGINE, b"ab")}, 0.0)
        device.write({"sent": frame(LONG, b"12345678")}, 0.0)
        device.write({"sent": frame(ENGINE, b"")}, 0.0)
        expected = [(ENGINE, b"ab"), (LONG, b"12345678"), (ENGINE, b"")]
        assert [receive(bus) for _ in expected] == expected
        bus.send(WIRE.pack(ENGINE | socket.CAN_RTR_FLAG, 0, b""))
        bus.send(WIRE.pack(ENGINE, 3, b"xyz"))
        bus.send(WIRE.pack(LONG, 0, b""))
        assert frames(device, 2) == [frame(ENGINE, b"xyz"), frame(LONG, b"")]
        assert device.read() is None
        assert device.health() == {"frames_lost": 0, "frames_left_out": 1}


@libraries
def test_the_kernel_filters(bus, library):
    filters = [{"identifier": 0x100, "mask": 0x700}, {"identifier": 0x1ABC_DEF0}]
    with opened("can", interface=BUS, library=library, filters=filters) as device:
        for identifier in (0x1FF, 0x200, LONG, 0x0FF, 0x100):
            bus.send(WIRE.pack(identifier, 1, b"a"))
        expected = [frame(number, b"a") for number in (0x1FF, LONG, 0x100)]
        assert frames(device, 3) == expected
        assert device.read() is None


@libraries
def test_a_burst_comes_through_whole_and_in_order(bus, library):
    count = 200
    with opened("can", interface=BUS, library=library) as device:
        for number in range(count):
            bus.send(WIRE.pack(ENGINE, 2, number.to_bytes(2, "little")))
        expected = [frame(ENGINE, number.to_bytes(2, "little")) for number in range(count)]
        assert frames(device, count, timeout_s=PATIENCE_S) == expected


def test_more_than_the_kernel_keeps_is_counted(bus):
    count = 5000
    with opened("can", interface=BUS) as device:
        for number in range(count):
            bus.send(WIRE.pack(ENGINE, 2, number.to_bytes(2, "little")))
        got = frames(device, 300)
        while device.read() is not None:
            got.append(None)
        assert len(got) < count
        bus.send(WIRE.pack(ENGINE, 1, b"!"))
        assert frames(device, 1) == [frame(ENGINE, b"!")]
        assert device.health()["frames_lost"] == count - len(got)


@libraries
def test_a_bus_that_is_not_there_or_down_is_told(bus, library):
    assert_refused(
        "can", "vcan7: .*(no such interface|No such device)", interface="vcan7", library=library
    )
    run("ip", "link", "set", BUS, "down")
    if library == "socket":
        assert_refused(
            "can", "vcan0: the interface is down; `sudo ip link set vcan0 up`", interface=BUS
        )
        return
    with opened("can", interface=BUS, library=library) as device:  # its thread hears of it
        select.select([device.fileno()], [], [], PATIENCE_S)
        with pytest.raises(MachineError, match="Network is down"):
            device.read()


@libraries
def test_what_hangs_on_the_bus_is_made_safe_at_the_end(bus, library, tmp_path):
    parameters = {"interface": BUS, "library": library, "safe_frames_hex": ["123#00FF"]}
    with driven(tmp_path, "can", parameters) as bench:
        bus.send(WIRE.pack(ENGINE, 1, b"a"))
        bench.until(status_is(bench, "never", "ok", "stale"), PATIENCE_S)
        bench.hardware[NAME].write("sent", frame(LONG, b"go"))
        assert receive(bus) == (LONG, b"go")
        bench.close()
    assert receive(bus) == (ENGINE, b"\x00\xff")


@libraries
def test_a_bus_that_goes_down_is_lost_and_comes_back(bus, library, tmp_path):
    parameters = {"interface": BUS, "library": library}
    with program(FEEDER, BUS), driven(tmp_path, "can", parameters) as bench:
        lose_and_regain(
            bench,
            lambda: run("ip", "link", "set", BUS, "down"),
            lambda: run("ip", "link", "set", BUS, "up"),
            why="down",
        )
        got = bench.hardware[NAME].frames("received")
        assert [each.number for each in got] == list(range(1, len(got) + 1))


@libraries
def test_a_bus_that_is_pulled_out_is_lost_and_comes_back(bus, library, tmp_path):
    parameters = {"interface": BUS, "library": library}
    with program(FEEDER, BUS), driven(tmp_path, "can", parameters) as bench:
        lose_and_regain(bench, delete_bus, add_bus, why="vcan0: ")


def test_it_is_verified(bus, tmp_path):
    parameters = {"interface": BUS, "safe_frames_hex": ["123#00FF"]}
    with program(FEEDER, BUS):
        rows = verify(tmp_path, "can", parameters)
    for name in (
        "shapes",
        "descriptors",
        "threads",
        "outputs",
        "kill -9",
        "hang",
        "safe at its end",
    ):
        assert rows[name]["passed"], rows[name]
