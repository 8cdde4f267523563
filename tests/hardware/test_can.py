"""`can`: by a stand-in for the kernel's sockets (tests/guest has a kernel's own), and on python-can's virtual bus."""

from __future__ import annotations

import errno
import importlib
import os
import socket
import struct
import sys
import threading

import pytest

from madns_runtime.errors import MachineError, PluginError
from madns_runtime.hardware.drivers import can as driver
from madns_runtime.hardware.kind_registry import prepare
from madns_runtime.hardware.kinds.can import CanParameters
from tests.hardware.driving import frames, opened

ENGINE = 0x123
LONG = 0x1ABC_DEF0 | 0x8000_0000


def frame(identifier: int, data: bytes) -> bytes:
    return identifier.to_bytes(4, "little") + data


def test_bus_that_is_not_there_is_told():
    with (
        pytest.raises(MachineError, match="no CAN sockets|there is no such interface"),
        opened("can", interface="vcan77"),
    ):
        pass


@pytest.fixture
def kernel(monkeypatch):
    """Ends of a pair that keeps the borders of messages, as a CAN socket does."""
    own, other = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    options = []
    state = {"error": 0, "lost": 0, "without_room": []}

    class Raw:
        def __init__(self, *family):
            self.__dict__.update({n: getattr(own, n) for n in ("setblocking", "fileno", "close")})

        def send(self, raw):
            if state["without_room"] and (number := state["without_room"].pop()):
                raise OSError(number, "No buffer space available")
            return own.send(raw)

        def recvmsg(self, size, ancillary_size):
            raw, _, flags, address = own.recvmsg(size)
            content = struct.pack("=I", state["lost"])
            told = [(socket.SOL_SOCKET, driver.SO_RXQ_OVFL, content)] if state["lost"] else []
            return raw, told, flags, address

        def getsockopt(self, level, name):
            assert (level, name) == (socket.SOL_SOCKET, socket.SO_ERROR)
            return state["error"]

        def setsockopt(self, *option):
            options.append(option)

        def bind(self, address):
            if address != ("can0",):
                raise OSError(19, "No such device")

    class Sockets:
        socket = Raw

        def __getattr__(self, name):
            return getattr(socket, name)

    monkeypatch.setattr(driver, "socket", Sockets())
    yield other, options, state
    own.close()
    other.close()


def test_frames_on_the_wire_are_the_kernels(kernel):
    other, options, state = kernel
    wanted = [{"identifier": 0x100, "mask": 0x700}]
    with opened("can", filters=wanted, safe_frames_hex=["123#00FF", "1ABCDEF0#"]) as device:
        assert options[0][2] == struct.pack("=II", 0x100, 0x700)
        device.write({"sent": frame(ENGINE, b"ab")}, 0.0)
        assert other.recv(100) == struct.pack("=IB3x8s", ENGINE, 2, b"ab")
        remote = struct.pack("=IB3x8s", 0x4000_0123, 0, b"")
        other.send(remote)
        other.send(struct.pack("=IB3x8s", LONG, 3, b"xyz"))
        assert frames(device, 1) == [frame(LONG, b"xyz")]
        assert device.read() is None
        assert device.health() == {"frames_lost": 0, "frames_left_out": 1}
        state["lost"], counted = 7, {}
        device.count = lambda name, number: counted.update({name: counted.get(name, 0) + number})
        other.send(struct.pack("=IB3x8s", ENGINE, 0, b""))
        assert frames(device, 1) == [frame(ENGINE, b"")]
        assert device.health()["frames_lost"] == 7
        assert device.read() is None
        assert counted == {"frames_lost": 7}
        device.make_safe()
        assert other.recv(100)[:7] == struct.pack("=IB2x", ENGINE, 2)
        assert other.recv(100)[:4] == struct.pack("=I", LONG)
        with pytest.raises(PluginError, match="4 bytes of identifier"):
            device.write({"sent": b"abc"}, 0.0)
        with pytest.raises(
            PluginError, match="one of 29 with bit 31 set beside them; got 0x00001abc"
        ):
            device.write({"sent": frame(0x1ABC, b"")}, 0.0)


@pytest.fixture
def clock(monkeypatch):
    """A clock that goes on only where somebody waits; it holds how long, s."""
    slept_s = []
    monkeypatch.setattr(driver, "sleep", slept_s.append)
    monkeypatch.setattr(driver, "monotonic", lambda: sum(slept_s))
    return slept_s


@pytest.mark.parametrize("number", [errno.ENOBUFS, errno.EAGAIN])
def test_a_full_queue_is_waited_for(kernel, clock, number):
    other, _, state = kernel
    with opened("can", safe_frames_hex=["123#00FF"]) as device:
        state["without_room"] = [number] * 3
        device.write({"sent": frame(ENGINE, b"ab")}, 0.0)
        state["without_room"] = [number] * 2
        device.make_safe()

    assert [other.recv(100)[8:10] for _ in range(2)] == [b"ab", b"\x00\xff"]
    assert len(clock) == 5


def test_a_queue_that_stays_full_refuses_frames_and_is_waited_for_once(kernel, clock):
    other, _, state = kernel
    with opened("can", safe_frames_hex=["123#00FF"]) as device:
        state["without_room"] = [errno.ENOBUFS] * 10_000
        with pytest.raises(PluginError, match="sent: can0: its queue is full"):
            device.write({"sent": frame(ENGINE, b"1")}, 0.0)
        assert sum(clock) == pytest.approx(driver.SEND_S, abs=driver.SEND_PAUSE_S)
        waits = len(clock)
        with pytest.raises(PluginError, match="sent: can0: its queue is full"):
            device.write({"sent": frame(ENGINE, b"2")}, 0.0)
        assert len(clock) == waits, "no wait before each frame of a dead bus"
        with pytest.raises(MachineError, match="its queue is full"):
            device.make_safe()
        assert len(clock) == 2 * waits, "but before one that makes safe"
        state["without_room"] = []
        device.write({"sent": frame(ENGINE, b"3")}, 0.0)
        assert other.recv(100)[8:9] == b"3"
        state["without_room"] = [errno.ENETDOWN]
        with pytest.raises(MachineError, match="the interface is down"):
            device.write({"sent": frame(ENGINE, b"4")}, 0.0)


@pytest.mark.parametrize(
    "error",
    [
        lambda can: can.CanOperationError("Failed to transmit", errno.ENOBUFS),
        lambda can: can.CanOperationError("Transmit buffer full"),
        lambda can: OSError(errno.ENOBUFS, "No buffer space available"),
    ],
)
def test_python_cans_words_for_a_full_queue_are_known(clock, monkeypatch, error):
    can = pytest.importorskip("can")

    def send(*_):
        raise error(can)

    shared = {"library": "python-can", "python_can_interface": "virtual", "interface": "bus-2"}
    with opened("can", **shared) as device:
        monkeypatch.setattr(device._bus._bus, "send", send)
        with pytest.raises(PluginError, match="sent: bus-2: its queue is full"):
            device.write({"sent": frame(ENGINE, b"")}, 0.0)


def test_an_interface_that_is_not_there(kernel):
    with (
        pytest.raises(MachineError, match="can7: there is no such interface; see `ip link`"),
        opened("can", interface="can7"),
    ):
        pass


def test_an_interface_that_is_down(kernel):
    kernel[2]["error"] = errno.ENETDOWN
    with (
        pytest.raises(MachineError, match="can0: the interface is down; `sudo ip link set can0 up"),
        opened("can", interface="can0"),
    ):
        pass


@pytest.mark.parametrize(
    "text",
    ["123", "xyz#00", "123#0", "FFF#00", "123#" + "00" * 9, "#", "0x123#00", "1_23#00", " 123#00", "#00"],
)  # fmt: skip
def test_a_safe_frame_that_is_none_is_refused_before_the_run(text):
    with pytest.raises(PluginError, match="safe_frames_hex: expected a frame such as 123#00FF"):
        prepare("can", {"safe_frames_hex": [text]}, None)


def test_python_cans_virtual_bus_wakes_its_reader():
    pytest.importorskip("can")
    shared = {"library": "python-can", "python_can_interface": "virtual", "interface": "bus-1"}
    with opened("can", **shared) as one, opened("can", **shared) as other:
        for number in range(200):
            one.write({"sent": frame(number, bytes([number]))}, 0.0)
        assert frames(other, 200) == [frame(number, bytes([number])) for number in range(200)]
        assert other.read() is None
        one.write({"sent": frame(LONG, b"")}, 0.0)
        assert frames(other, 1) == [frame(LONG, b"")]


def test_what_python_can_cannot_read_closes_the_bus_and_is_told(monkeypatch):
    """As of a serial adapter that hands on half a frame: the listener ended without a word, and nothing came any more."""
    pytest.importorskip("can")
    shared = {"library": "python-can", "python_can_interface": "virtual", "interface": "bus-3"}
    with opened("can", **shared) as device:

        def recv(_):
            raise ValueError("invalid literal for int() with base 16: '12X'")

        monkeypatch.setattr(device._bus._bus, "recv", recv)
        device._bus._listener.join(60.0)
        with pytest.raises(MachineError, match="bus-3: cannot read what came: ValueError: invalid"):
            device.read()


def test_a_frame_of_can_fd_is_left_out():
    can = pytest.importorskip("can")
    shared = {"library": "python-can", "python_can_interface": "virtual", "interface": "bus-4"}
    with opened("can", **shared) as device, can.Bus(interface="virtual", channel="bus-4") as other:
        other.send(can.Message(arbitration_id=1, is_extended_id=False, is_fd=True, data=bytes(64)))
        other.send(can.Message(arbitration_id=2, is_extended_id=False, data=b"x"))

        assert frames(device, 1) == [frame(2, b"x")]
        assert device.health()["frames_left_out"] == 1


def test_a_bus_that_python_can_does_not_know_and_a_missing_python_can(monkeypatch):
    pytest.importorskip("can")
    with (
        pytest.raises(MachineError, match="can0: .*nosuch"),
        opened("can", library="python-can", python_can_interface="nosuch"),
    ):
        pass
    monkeypatch.setitem(sys.modules, "can", None)
    monkeypatch.delitem(sys.modules, "madns_runtime.hardware.drivers.python_can")
    with (
        pytest.raises(MachineError, match="python-can is not installed here; pip install"),
        opened("can", library="python-can"),
    ):
        pass


def test_a_library_that_does_not_return_writes_to_no_other_file_once_the_bus_is_closed(
    monkeypatch, tmp_path
):
    can = pytest.importorskip("can")
    python_can = importlib.import_module("madns_runtime.hardware.drivers.python_can")
    goes_on = threading.Event()

    class Stuck:
        def recv(self, timeout):
            goes_on.wait(60.0)
            return can.Message(arbitration_id=1)

        def shutdown(self):
            pass

    monkeypatch.setattr(can, "Bus", lambda **options: Stuck())
    monkeypatch.setattr(python_can, "LISTEN_S", 0.001)
    bus = python_can.PythonCanBus(CanParameters(library="python-can"))
    bus.close()
    files = [os.open(tmp_path / str(n), os.O_RDWR | os.O_CREAT) for n in range(8)]

    goes_on.set()
    bus._listener.join(60.0)

    assert [os.fstat(file).st_size for file in files] == [0] * 8
    for file in [*files, bus.fileno()]:
        os.close(file)
