"""`serial` on pseudo-terminals: framings, unplugging, garbage at full rate, one owner, RS-485."""

from __future__ import annotations

import contextlib
import os
import random
import threading
import tty

import pytest

from madns_runtime.errors import MachineError, PluginError
from madns_runtime.hardware.framing import FRAMERS
from madns_runtime.hardware.kind_registry import prepare
from tests.hardware.driving import frames, opened

pytest.importorskip("serial")


@pytest.fixture
def line():
    own, other = os.openpty()
    tty.setraw(other)
    yield own, os.ttyname(other)
    for fd in (own, other):
        with contextlib.suppress(OSError):
            os.close(fd)


FRAMES = {
    "lines": b"ready 1",
    "nmea": b"GPGGA,123519,4807.038,N",
    "ubx": b"\x01\x07\x00\xb5\x62payload",
    "cobs": b"\x00\x01\x00two",
    "length_prefixed": b"\x00any\n",
}


@pytest.mark.parametrize("framing", FRAMES)
def test_frames_come_and_go_in_each_framing(line, framing):
    fd, port = line
    wire = FRAMERS[framing](1024).wrap(FRAMES[framing])
    with opened("serial", port=port, framing=framing) as device:
        os.write(fd, wire[:3])
        os.write(fd, wire[3:] + wire)
        assert frames(device, 2) == [FRAMES[framing]] * 2
        device.write({"sent": FRAMES[framing]}, 0.0)
        assert os.read(fd, 4096) == wire


def test_raw_bytes_and_a_length_of_one_byte(line):
    fd, port = line
    with opened("serial", port=port, framing="raw") as device:
        os.write(fd, b"\x00\xff")
        assert b"".join(frames(device, 1)) == b"\x00\xff"
    shape = {"framing": "length_prefixed", "length_bytes": 1, "length_order": "big"}
    with opened("serial", port=port, **shape) as device:
        device.write({"sent": b"abc"}, 0.0)
        assert os.read(fd, 100) == b"\x03abc"
        with pytest.raises(PluginError, match="at most 255 bytes, got 300"):
            device.write({"sent": bytes(300)}, 0.0)


def test_an_unplugged_line_is_told_by_name(line):
    fd, port = line
    with opened("serial", port=port) as device:
        assert device.read() is None
        os.close(fd)
        with pytest.raises(MachineError, match=rf"{port} is gone"):
            device.read()


def test_garbage_at_full_rate_costs_no_memory_and_hides_no_frame(line):
    fd, port = line
    random_bytes = random.Random(1).randbytes(1 << 18)
    wire = FRAMERS["ubx"](64)

    def send() -> None:
        view = memoryview(random_bytes + bytes(100) + wire.wrap(b"\x01\x02good"))
        while view:
            view = view[os.write(fd, view[:4096]) :]

    with opened("serial", port=port, framing="ubx", frame_bytes_max=64) as device:
        sender = threading.Thread(target=send)
        sender.start()
        found = b""
        while found != b"\x01\x02good":
            found = frames(device, 1)[0]
        sender.join()
        assert device.health()["garbage_bytes"] > 0.9 * len(random_bytes)
        assert len(device._framer._buffer) < 200


def test_a_line_has_one_owner(line):
    _, port = line
    with (
        opened("serial", port=port),
        pytest.raises(MachineError, match=f"{port}: another program has it open"),
        opened("serial", port=port),
    ):
        pass


@pytest.mark.parametrize(
    ("parameters", "told"),
    [
        ({"port": "/dev/ttyNONE0"}, "there is no such device; is it plugged in"),
        ({"port": "/dev/null"}, "/dev/null: "),
    ],
)
def test_a_port_that_does_not_open_is_told_with_its_cure(parameters, told):
    with pytest.raises(MachineError, match=told), opened("serial", **parameters):
        pass


def test_rs485_where_the_driver_cannot_is_told_with_its_cure(line):
    # A pty has no lines to switch: what the driver of an adapter without RS-485 answers, too.
    with (
        pytest.raises(MachineError, match="does not switch the direction of RS-485.*rs422"),
        opened("serial", port=line[1], electrical="rs485"),
    ):
        pass
    with opened("serial", port=line[1], electrical="rs422") as device:
        device.write({"sent": b"x"}, 0.0)
        assert os.read(line[0], 10) == b"x\r\n"


def test_rs485_settings_reach_the_port(line, monkeypatch):
    import serial

    seen = []
    monkeypatch.setattr(
        serial.Serial, "rs485_mode", property(lambda self: None, lambda self, s: seen.append(s))
    )
    settings = {"rs485_rts_level_for_tx": False, "rs485_delay_before_tx_s": 0.002}
    with opened("serial", port=line[1], electrical="rs485", **settings):
        pass
    [settings] = seen
    assert (settings.rts_level_for_tx, settings.rts_level_for_rx) == (False, True)
    assert settings.delay_before_tx == 0.002


def test_the_safe_frame_is_sent_and_checked_before_the_run(line):
    fd, port = line
    with opened("serial", port=port, framing="cobs", safe_frame_hex="0a00") as device:
        device.make_safe()
        assert os.read(fd, 10) == b"\x02\x0a\x01\x00"
    with pytest.raises(PluginError, match="safe_frame_hex: expected hexadecimal digits"):
        prepare("serial", {"port": port, "safe_frame_hex": "xyz"}, None)
    with pytest.raises(PluginError, match="at most 1 bytes, got 2"):
        parameters = {"port": port, "safe_frame_hex": "0a00", "frame_bytes_max": 1}
        prepare("serial", parameters, None)
