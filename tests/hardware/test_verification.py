"""What `verification` finds of the shipped kinds, and of drivers that leak, hang, lie or break."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from harness.firmware import build_firmware, needs_emulator

from madns_runtime.config import DeviceLaunch
from madns_runtime.hardware.claims import DeviceClaims
from madns_runtime.hardware.contract import DeviceKind
from madns_runtime.hardware.kind_registry import registered_kinds
from madns_runtime.hardware.verification.order import STEPS
from tests.hardware.bench import is_late
from tests.hardware.test_simulated_kinds import record

pytestmark = pytest.mark.process

DRIVER = """
import os, sys, threading, time
from madns_runtime.hardware.contract import Channel, Device, DeviceKind, Sample

class Line(Device):
    kind = DeviceKind(
        name="line", summary="one of a user's", needs_hardware=False,
        channels=(
            Channel(name="level", unit="m", limits=(0.0, 1.0)),
            Channel(name="valve", direction="out", limits=(0.0, 1.0), safe=0.0),
        ),
    )
    kept = []

    def open(self):
        print("a word of the driver's")
        FAULT_OPEN
        return "line-1"

    def read(self):
        FAULT_READ
        return Sample(values={"level": 0.5}, taken_s=time.monotonic())

    def write(self, values, due_s):
        FAULT_WRITE
"""


LATE_GUARDIAN = """
from time import monotonic
from madns_runtime.hardware.guardian import Guardian
ended = Guardian._driver_ended
Guardian._driver_ended = lambda self, *ended_driver: self._reactor.call_at(
    monotonic() + 1.0, lambda: ended(self, *ended_driver)
)
import madns_runtime.hardware.verification.__main__ as verification
raise SystemExit(verification.main())
"""


def verify(
    folder,
    kind,
    *,
    cycles=100,
    may_write=False,
    steps=STEPS,
    how=("-m", "madns_runtime.hardware.verification"),
    **parameters,
):
    order = {"kind": kind, "parameters": parameters, "directory": str(folder), "cycles": cycles}
    order["steps"] = steps
    order["may_write"] = may_write
    ended = subprocess.run(
        [sys.executable, *how],
        input=json.dumps({**order, "rate_hz": 50.0, "sampling_s": 0.4}),
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": f"{folder}{os.pathsep}{os.environ.get('PYTHONPATH', '')}"},
        timeout=120,
        check=False,
    )
    assert ended.returncode == 0, ended.stderr
    return {finding["name"]: finding for finding in json.loads(ended.stdout)}


def failed(findings, *, but=()):
    """Return what does not hold; what was measured and is late is the fault of this machine's load."""
    return {
        name: each["got"]
        for name, each in findings.items()
        if each["passed"] is False and (name in but or not is_late(each))
    }


STAND_INS = {
    "gpiod": """
import enum, types

def names(kind, *all): return enum.Enum(kind, all)

line = types.SimpleNamespace(
    Value=names("Value", "INACTIVE", "ACTIVE"),
    Direction=names("Direction", "AS_IS", "INPUT", "OUTPUT"),
    Edge=names("Edge", "NONE", "RISING", "FALLING", "BOTH"),
    Bias=names("Bias", "AS_IS", "PULL_UP", "PULL_DOWN", "DISABLED"),
    Clock=names("Clock", "MONOTONIC", "REALTIME"),
)

class LineSettings(types.SimpleNamespace): pass

class Request:
    def __init__(self, config): self.config = config
    def get_values(self, lines): return [line.Value.INACTIVE for _ in lines]
    def set_value(self, number, value):
        assert self.config[number].direction is line.Direction.OUTPUT
        assert isinstance(value, line.Value)
    def release(self): pass

def request_lines(path, consumer=None, config=None):
    assert path == "/dev/gpiochip0"
    return Request(config)
""",
    "smbus2": """
class SMBus:
    def __init__(self, bus): self.memory = bytearray(256)
    def read_i2c_block_data(self, address, register, length): return list(self.memory[register:register + length])
    def write_i2c_block_data(self, address, register, data): self.memory[register:register + len(data)] = bytes(data)
    def close(self): pass
""",
    "spidev": """
class SpiDev:
    def open(self, bus, device): pass
    def xfer2(self, data): return [0] * len(data)
    def close(self): pass
""",
    "sense_hat": """
class Stick:
    def get_events(self): return []
    def close(self): pass
class SenseHat:
    def __init__(self): self.stick = Stick()
    def set_rotation(self, degrees, redraw=True): pass
    def set_imu_config(self, *what): pass
    def get_raw(self): return {"x": 0.0, "y": 0.0, "z": 1.0}
    get_gyroscope_raw = get_accelerometer_raw = get_compass_raw = get_raw
    def get_temperature(self): return 30.0
    def get_pressure(self): return 1000.0
    def get_humidity(self): return 40.0
    def set_pixels(self, pixels): assert len(pixels) == 64
    def clear(self): pass
""",
}
MAP = {
    "registers": [
        {"name": "rate", "address": 1, "count": 3, "type": "i16_le"},
        {"name": "angle", "address": 9, "direction": "out", "low": 0, "high": 9, "safe": 0},
    ]
}


KINDS = {
    "analog": {"inputs": [{"name": "volts", "file": "in_voltage0_raw"}]},
    "can": {"library": "python-can", "python_can_interface": "virtual"},
    "emulated_mcu": {"firmware": "report.elf"},
    "gnss_receiver": {"link": "gps"},
    "gpio": {
        "lines": [{"name": "door", "offset": 1}, {"name": "heater", "offset": 2, "mode": "output"}]
    },
    "i2c": {"address": 0x19, "map": MAP},
    "null": {},
    "playback": {"directory": "imu"},
    "pwm": {},
    "sense_hat": {},
    "serial": {"port": "pty", "framing": "cobs", "safe_frame_hex": "00"},
    "spi": {"map": MAP},
    "synthetic": {},
}
HAS_OUTPUTS = set(KINDS) - {"analog", "playback", "synthetic"}


def prepare_stand_ins(folder):
    """Lay the libraries that stand in for those of buses, and the kernel's files, into a folder."""
    for name, text in STAND_INS.items():
        (folder / f"{name}.py").write_text(text)
    line = folder / "pwmchip0" / "pwm0"
    line.mkdir(parents=True)
    for name in ("period", "duty_cycle", "enable"):
        (line / name).write_text("0")
    (folder / "iio:device0").mkdir()
    (folder / "iio:device0" / "in_voltage0_raw").write_text("7")
    record(folder / "imu", {"gyro": 0.0, "level": 0.0})


def test_every_shipped_kind_is_here():
    assert set(KINDS) == set(registered_kinds())


NIGHTLY = {"emulated_mcu": [pytest.mark.nightly, needs_emulator]}
"""Kinds of which a hundred starts take half a minute."""


@pytest.mark.parametrize(
    "kind", [pytest.param(kind, marks=NIGHTLY.get(kind, ())) for kind in KINDS]
)
def test_shipped_kinds_pass(tmp_path, kind):
    if kind in ("can", "serial"):
        pytest.importorskip(kind)
    prepare_stand_ins(tmp_path)
    if kind == "emulated_mcu":
        build_firmware(tmp_path, "report", Path(__file__).parent / "firmware" / "report.c")
    where = {"root": str(tmp_path)} if kind in ("analog", "pwm") else {}

    findings = verify(tmp_path, kind, may_write=True, **KINDS[kind], **where)

    assert failed(findings) == {}
    assert findings["opened and closed"]["got"] == "100 times"
    for how in ("kill -9", "hang", "hang in a call"):
        assert "open again" in findings[how]["got"]
    for what in ("after kill -9", "after hang", "after hang in a call", "at its end"):
        safe = findings[f"safe {what}"]
        assert (safe["passed"] or is_late(safe)) if kind in HAS_OUTPUTS else safe["passed"] is None
    if kind == "serial":
        assert findings["garbage"]["passed"]
        assert "is gone" in findings["unplugged"]["got"]
    if kind == "null":
        assert "2 values written" in findings["outputs"]["got"]


def test_a_guardian_that_hears_late_leaves_it_to_the_next_process(tmp_path):
    findings = verify(
        tmp_path, "null", may_write=True, steps=("process",), how=("-c", LATE_GUARDIAN)
    )
    assert (
        failed(findings, but=("safe after kill -9", "safe after hang", "safe after hang in a call"))
        == {}
    )


@pytest.mark.parametrize(
    ("place", "code", "name", "got"),
    [
        ("OPEN", "pass", None, None),
        ("OPEN", "self.kept.append(os.open('/dev/null', 0))", "descriptors", "+20"),
        ("OPEN", "threading.Thread(target=time.sleep, args=(99,), daemon=True).start()", "threads", "+20"),
        ("OPEN", "self.kept.append(b'x' * 500_000)", "memory", "MiB"),
        ("OPEN", "raise OSError('no chip')", "opening", "OSError: no chip"),
        ("OPEN", "sys.exit(3)", "opening", "it called sys.exit(3)"),
        ("OPEN", "os._exit(3)", "opening", "its process ended with 3"),
        ("READ", "return Sample(values={'level': 7.0}, taken_s=time.monotonic())", "limits", "level "),
        ("READ", "return Sample(values={'level': [1, 2]}, taken_s=time.monotonic())", "shapes", "expected a number"),
        ("OPEN", "return 5", "opening", "expected a text as the device's identity, got 5"),
        ("OPEN", "self.health = lambda: 5", "opening", "expected a mapping of what is known"),
        ("OPEN", "self.fileno = lambda: os.open(__file__, 0)", "opening", "got a regular file's"),
        ("READ", "return Sample(values={'level': 0.5}, taken_s=0.0, device_s='noon')", "shapes", "device_s: expected"),
        ("READ", "return Sample(values={'level': 0.5}, taken_s=time.monotonic() - 9.0)", "age", "9000 ms of the you"),
        ("READ", "return Sample(values={}, taken_s=time.monotonic())", "rate", "0.0 Hz: 0 samples in "),
        ("READ", "return 7", "shapes", "expected a Sample or None, got int"),
        ("READ", "time.sleep(0.1)", "rate", "Hz"),
        ("READ", "return None", "rate", "0.0 Hz: 0 samples in "),
        ("WRITE", "raise ValueError('stuck')", "outputs", "ValueError: stuck"),
    ],
)  # fmt: skip
def test_what_a_users_driver_does_wrong_is_found(tmp_path, place, code, name, got):
    text = DRIVER
    for each in ("OPEN", "READ", "WRITE"):
        text = text.replace(f"FAULT_{each}", code if each == place else "pass")
    (tmp_path / "line.py").write_text(text)

    steps = STEPS if name is None else ("opening", "samples", "outputs")
    findings = verify(tmp_path, "./line.py", cycles=20, steps=steps)

    wrong = failed(findings, but=(name,))
    if name is None:
        assert wrong == {}
        safe = findings["safe after kill -9"]
        assert safe["passed"] or is_late(safe)
    else:
        assert got in wrong[name]


@pytest.mark.parametrize(
    "parameters",
    [
        {"framing": "length_prefixed", "length_bytes": 4},
        {"framing": "length_prefixed", "length_order": "big"},
        {"framing": "lines", "frame_bytes_max": 4},
    ],
)
def test_a_stand_in_sends_frames_as_the_line_has_them(tmp_path, parameters):
    findings = verify(tmp_path, "serial", steps=("samples",), port="pty", **parameters)

    assert failed(findings) == {}
    assert "Hz" in findings["rate"]["got"], "some came"
    assert findings["shapes"]["passed"]


@pytest.mark.parametrize("may_write", [False, True])
def test_a_driver_is_told_whether_its_outputs_may_move_before_each_opening(tmp_path, may_write):
    text = DRIVER.replace("needs_hardware=False", "needs_hardware=True").replace(
        "FAULT_READ", "pass"
    )
    note = "print(self.may_move, file=open(__file__ + '.told', 'a'))"
    (tmp_path / "line.py").write_text(
        text.replace("FAULT_OPEN", note).replace("FAULT_WRITE", "pass")
    )

    verify(tmp_path, "./line.py", cycles=1, may_write=may_write, steps=("opening", "samples"))

    assert set((tmp_path / "line.py.told").read_text().split()) == {str(may_write)}


def test_outputs_are_made_safe_after_a_write_that_failed_and_what_never_came_is_told(tmp_path):
    text = DRIVER.replace("FAULT_OPEN", "pass").replace("FAULT_WRITE", "raise OSError('stuck')")
    text = text.replace("FAULT_READ", "pass").replace(
        "        channels=(\n", "        channels=(\n            Channel(name='heat'),\n"
    )
    safe = "    def make_safe(self):\n        open(__file__ + '.safe', 'w').close()\n"
    (tmp_path / "line.py").write_text(f"{text}\n{safe}")

    findings = verify(tmp_path, "./line.py", steps=("samples", "outputs"))

    assert failed(findings) == {"outputs": "OSError: stuck"}
    assert (tmp_path / "line.py.safe").exists()
    assert findings["inputs"]["passed"] is None
    assert findings["inputs"]["got"] == "no value came of heat"


@pytest.mark.parametrize(
    ("classes", "told"),
    [((), "it has none"), (("One", "Two"), "it has One, Two: say which, as ./many.py:NAME")],
)
def test_a_file_without_a_name_has_one_class(tmp_path, classes, told):
    head = "from madns_runtime.hardware.contract import Channel, Device, DeviceKind\n"
    body = "class {0}(Device):\n    kind = DeviceKind(name='{0}', summary='', channels=(Channel(name='a'),))\n"
    (tmp_path / "many.py").write_text(head + "".join(body.format(name) for name in classes))
    [declaration] = verify(tmp_path, "./many.py").values()
    assert told in declaration["got"]


def test_a_part_of_the_machine_that_a_run_has_is_left_alone(tmp_path, monkeypatch):
    monkeypatch.setenv("COSMOS_STATE_DIR", str(tmp_path / "state"))
    text = DRIVER.replace("needs_hardware=False", "needs=Needs(exclusive=('door 4',))")
    text = text.replace("import Channel", "import Channel, Needs").replace("FAULT_READ", "pass")
    text = text.replace("FAULT_OPEN", "open(__file__ + '.opened', 'w').close()").replace(
        "FAULT_WRITE", "pass"
    )
    (tmp_path / "line.py").write_text(text)
    launch = DeviceLaunch(name="door", place="pi22", kind="gate", base_directory="", rate_hz=1.0)
    claims = DeviceClaims("0007-hwil")
    claims.claim(launch, DeviceKind(name="gate", summary="", channels=()), ("door 4",))

    findings = verify(
        tmp_path, "./line.py", may_write=True, steps=("opening", "samples", "outputs")
    )

    claims.release()
    assert "door 4 is in use by run 0007-hwil" in failed(findings)["opening"]
    assert not (tmp_path / "line.py.opened").exists()


def test_a_kind_that_does_not_load_is_one_finding(tmp_path):
    findings = verify(tmp_path, "seriall")
    assert list(findings) == ["declaration"]
    assert "did you mean serial?" in findings["declaration"]["got"]
