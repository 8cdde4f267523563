"""Drivers that return what they should not, or say that there is something to read when there is nothing."""

from __future__ import annotations

import os
import sys

import pytest

from madns_runtime.config import DeviceLaunch
from tests.hardware.bench import AGENT, SILENCE_S, DeviceBench, Terminal
from tests.hardware.test_device_processes import records

pytestmark = pytest.mark.process

DRIVER = """
import os
import time

from madns_runtime.errors import MachineError, PluginError
from madns_runtime.hardware.contract import Channel, Device, DeviceKind, Sample


def mute(kind):
    return type("Mute", (kind,), {"__str__": lambda self: 1 / 0})


class Probe(Device):
    kind = DeviceKind(name="probe", summary="s", channels=(Channel(name="level"),))

    def open(self):
        self.pipe = os.pipe()
        os.close(self.pipe[1])
        self.file = open(__file__)
        return IDENTITY

    def read(self):
        READ

    def health(self):
        return HEALTH

    def fileno(self):
        return FILENO
"""


LOST_S = 3.0
"""Without a sample for so long a device is lost here where that is what a test is about: within it its process must
have looked once, also on a busy machine."""


def probe(
    folder, *, identity='"p-1"', read=None, health="{}", fileno="None", lost_s=SILENCE_S
) -> DeviceBench:
    read = read or "return Sample(values={'level': 1.0}, taken_s=time.monotonic())"
    told = {"IDENTITY": identity, "READ": read, "HEALTH": health, "FILENO": fileno}
    text = DRIVER
    for name, value in told.items():
        text = text.replace(name, value)
    (folder / "probe.py").write_text(text)
    launch = DeviceLaunch(
        name="probe",
        place="pi22",
        kind="./probe.py:Probe",
        base_directory=str(folder),
        rate_hz=50.0,
        users=(AGENT,),
    )
    bench = DeviceBench(folder, (launch,), lost_s=lost_s)
    bench.start_time()
    return bench


def states(folder):
    """Return what the device told of its state once per second."""
    return records(folder, "device_state", "pi22/probe")


def settled(folder):
    """Return what it told after its first thousand reads."""
    return [row for row in states(folder) if row[0] is not None and row[-1].get("reads", 0) > 1000]


@pytest.mark.parametrize(
    ("wrong", "told"),
    [
        ({"identity": "5"}, "Probe.open: expected a text as the device's identity"),
        ({"fileno": "-1"}, "Probe.fileno: expected an open descriptor (a number), or None; got -1"),
        ({"fileno": "1 << 40"}, "expected an open descriptor (a number), or None; got 1099511627776"),
        ({"fileno": "900"}, "Probe.fileno: expected an open descriptor, got 900: Bad file descriptor"),
        ({"fileno": "{}['port']"}, "Probe.fileno raised KeyError: 'port' (probe.py:"),
        ({"fileno": "self.file"}, "expected an open descriptor (a number), or None; got <_io"),
        ({"fileno": "self.file.fileno()"}, "got a regular file's, which always is: return None"),
        ({"health": "[1]"}, "expected a mapping of what is known of its state, got [1]"),
        ({"read": "return Sample(values={'level': 1.0}, taken_s=None)"},
         "Probe.read: taken_s: expected a time until now, "),
        ({"read": "return Sample(values={'level': 1.0}, taken_s=1.0, device_s='1')"},
         "Probe.read: device_s: expected a time of the device's own clock, s, or None; got '1'"),
        ({"read": "return Sample(values=[1.0], taken_s=1.0)"},
         "Probe.read: expected values by channel in a Sample, got [1.0]"),
        ({"read": "raise KeyboardInterrupt"}, "Probe.read raised KeyboardInterrupt (probe.py:"),
        ({"read": "raise mute(MachineError)"}, "(its __str__ raised ZeroDivisionError)"),
        ({"read": "raise mute(PluginError)"}, "Probe.read: (its __str__ raised ZeroDivisionError)"),
        ({"read": "return Sample(values={'level': float('nan')}, taken_s=time.monotonic())", "lost_s": LOST_S},
         "no sample for 3 s, where rate_hz (50) promises one every 0.02 s; so far level_not_finite "),
    ],
)  # fmt: skip
def test_a_wrong_answer_is_told_and_ends_no_process(tmp_path, wrong, told):
    bench = probe(tmp_path, **wrong)
    try:
        bench.until(lambda: "lost" in bench.statuses("probe"))
    finally:
        result = bench.close()["pi22/probe"]

    assert told in result["why"]
    assert result["restarts"] == 0


def test_nothing_is_an_identity_and_a_health_and_what_json_does_not_carry_is_refused(tmp_path):
    # Asked again and again, it answers both by turns.
    health = "[None, {'v': object()}][self.__dict__.setdefault('told', []).append(0) or len(self.told) % 2]"
    bench = probe(tmp_path, identity="None", health=health)
    try:
        bench.until(lambda: len(states(tmp_path)) >= 2)
    finally:
        result = bench.close()["pi22/probe"]

    assert (result["errors"], result["restarts"]) == (0, 0)
    assert result["report"]["refused"] >= 1
    assert len(records(tmp_path, "device_state", "pi22/probe")) >= 2
    events = records(tmp_path, "events", "pi22/probe")
    assert events[0]["identity"] == ""
    [*_, why] = [event["why"] for event in events if event["event"] == "refused"]
    assert "health: " in why
    assert "object has no JSON form" in why


@pytest.mark.parametrize("then", ["pass", "raise SystemExit(0)", "raise ValueError('copy')"])
def test_a_copy_of_the_process_that_a_driver_forks_gives_no_samples_and_closes_nothing(
    tmp_path, monkeypatch, then
):
    # Pytest's own lies on a descriptor that a device's process closes, and uses again for a file of records.
    monkeypatch.setattr(sys, "stderr", sys.__stderr__)
    read = f"""self.reads = getattr(self, 'reads', 0) + 1
        if self.reads % 3 == 0 and os.fork() == 0:
            {then}
        return Sample(values={{'level': float(self.reads)}}, taken_s=time.monotonic())"""
    bench = probe(tmp_path, read=read)
    try:
        bench.until(lambda: bench.hardware["probe"]["level"].number >= 30)
    finally:
        result = bench.close()["pi22/probe"]

    assert (result["errors"], result["lost"], result["restarts"]) == (0, 0, 0)
    taken = [(row[1], row[3]) for row in records(tmp_path, "level", "pi22/probe")]
    assert taken == [(number, float(number)) for number, _ in taken]
    assert len(taken) >= 20


def test_a_descriptor_that_is_readable_for_nothing_is_told_once_and_takes_no_processor(tmp_path):
    """A pipe whose other end is closed: readable for ever, and nothing to read."""
    bench = probe(tmp_path, fileno="self.pipe[0]", read="self.reads = getattr(self, 'reads', 0) + 1",
                  health="{'reads': getattr(self, 'reads', 0)}")  # fmt: skip
    try:
        bench.until(lambda: len(settled(tmp_path)) >= 2)
    finally:
        bench.close()

    told = [e for e in records(tmp_path, "events", "pi22/probe") if e["event"] == "empty_reads"]
    assert len(told) == 1
    assert "if the other end is gone, read() should raise" in told[0]["why"]
    first, *_, last = settled(tmp_path)
    # The first thousand at once, then one each 2 ms: without a pause there are hundreds of thousands.
    assert last[-1]["reads"] - first[-1]["reads"] <= 500 * (last[0] - first[0]) + 10


def test_a_driver_that_ends_its_process_at_once_is_told_by_its_exit_code(tmp_path):
    bench = probe(tmp_path, read="os._exit(3)")
    try:
        bench.until(lambda: "lost" in bench.statuses("probe"))
    finally:
        result = bench.close()["pi22/probe"]

    assert result["why"] == "exit code 3"


def test_a_line_that_sends_no_frame_is_told_by_its_bytes(tmp_path):
    terminal = Terminal()
    launch = DeviceLaunch(
        name="line",
        place="pi22",
        kind="serial",
        base_directory=str(tmp_path),
        rate_hz=20.0,
        parameters={"port": terminal.port},
        users=(AGENT,),
    )
    bench = DeviceBench(tmp_path, (launch,), lost_s=LOST_S)
    try:
        os.write(terminal.fd, b"no line feed")
        bench.start_time()
        bench.until(lambda: "lost" in bench.statuses("line"))
        refusal = bench.manager.insert_fault("pi22/line", "bias", 1.0)
    finally:
        result = bench.close()["pi22/line"]
        terminal.close()

    assert refusal is not None
    assert refusal.startswith("pi22/line: bias is added to numbers, and the device has no input")

    told = (
        "no sample for 3 s, where rate_hz (20) promises one every 0.05 s; so far received_bytes 12"
    )
    assert result["why"] == told
