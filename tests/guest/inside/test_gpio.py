"""
Kind `gpio` on a character device of the kernel, through gpiod.

Debian's kernel has no gpio-sim. Its driver of the CP2112, a USB bridge with eight lines, makes a chip as real: see
`bridge.py`. Edges are what that driver finds by looking now and then.
"""

from __future__ import annotations

import threading
from pathlib import Path

import gpiod
import pytest
from bridge import bridge
from guest_devices import (
    NAME,
    PATIENCE_S,
    assert_refused,
    driven,
    load,
    lose_and_regain,
    status_is,
    verify,
    wait_until,
)

from madns_runtime.errors import MachineError
from tests.hardware.driving import frames, opened

LABEL = "cp2112_gpio"
DOOR, HEATER, PULSE = 2, 3, 5
LINES = [
    {"name": "door", "offset": DOOR},
    {"name": "inverse", "offset": 4, "active_low": True},
    {"name": "heater", "offset": HEATER, "mode": "output", "safe": 1},
]


@pytest.fixture
def cable():
    load("hid-cp2112")
    with bridge() as cable:
        plug(cable)
        yield cable


def plug(cable):
    assert cable.ask("plug") == "done"
    wait_until(chips)


def chips():
    """Files of the chip: Linux 6.1 counts on where one was pulled out while its lines were in use."""
    return sorted(map(str, Path("/dev").glob("gpiochip*")))


def test_levels_are_read_and_outputs_set_from_safe_to_safe(cable):
    cable.ask(f"set {DOOR} 1")
    with opened("gpio", lines=LINES, chip=LABEL) as device:
        assert int(cable.ask("outputs"), 16) == 1 << HEATER
        assert cable.lines() == 1 << DOOR | 1 << HEATER, "safe from its opening on"
        assert device.read().values == {"door": 1.0, "inverse": 1.0}
        cable.ask("set 4 1")
        cable.ask(f"set {DOOR} 0")
        assert device.read().values == {"door": 0.0, "inverse": 0.0}
        device.write({"heater": 0.0}, 0.0)
        assert not cable.lines() & 1 << HEATER
        device.make_safe()
        assert cable.lines() & 1 << HEATER


def test_outputs_that_may_not_move_stay_inputs(cable):
    with opened("gpio", lines=LINES, chip=LABEL, may_move=False) as device:
        assert device.read().values["door"] == 0.0
        assert int(cable.ask("outputs"), 16) == 0


def test_edges_come_in_order_with_the_kernels_time(cable):
    with opened("gpio", lines=EDGES, chip=LABEL) as device:
        found = []
        for level in (1, 0, 1):
            timer = threading.Timer(0.2, cable.ask, [f"set {PULSE} {level}"])
            timer.start()
            found += frames(device, 1, "pulse", PATIENCE_S)
            timer.join()
        assert found == [1.0, 0.0, 1.0]
        assert device.read() is None


def test_a_line_in_use_and_one_that_is_not_there_are_told(cable):
    held = {DOOR: gpiod.LineSettings()}
    with gpiod.request_lines(chips()[0], consumer="somebody", config=held):
        assert_refused(
            "gpio", f"{LABEL}: another program has one of the lines", lines=LINES, chip=LABEL
        )
    assert_refused(
        "gpio", "it has not all of these lines", lines=[{"name": "far", "offset": 8}], chip=LABEL
    )
    for absent in ("/dev/gpiochip99", "pinctrl-none"):
        assert_refused("gpio", f"{absent}: there is no such chip", lines=LINES, chip=absent)


def test_a_run_makes_an_output_safe(cable, tmp_path):
    with driven(tmp_path, "gpio", {"lines": LINES, "chip": LABEL}) as bench:
        bench.until(status_is(bench, "ok"), PATIENCE_S)
        bench.hardware[NAME].write("heater", 0.0)
        bench.until(lambda: not cable.lines() & 1 << HEATER)
        bench.close()
    assert cable.lines() & 1 << HEATER


EDGES = [{"name": "pulse", "offset": PULSE, "mode": "edges", "edge": "both"}]


def test_a_chip_of_edges_alone_is_missed_too(cable, tmp_path):
    with opened("gpio", lines=EDGES, chip=LABEL) as device:
        assert device.health() == {}
        cable.ask("pull")
        with pytest.raises(MachineError, match="cp2112_gpio is gone"):
            device.health()


@pytest.mark.parametrize("lines", [LINES, [LINES[2]]], ids=["inputs", "outputs alone"])
def test_a_chip_that_is_pulled_out_is_lost_and_comes_back(cable, tmp_path, lines):
    with driven(tmp_path, "gpio", {"lines": lines, "chip": LABEL}) as bench:
        lose_and_regain(bench, lambda: cable.ask("pull"), lambda: plug(cable), why="is gone")


def test_it_is_verified(cable, tmp_path):
    rows = verify(tmp_path, "gpio", {"lines": LINES, "chip": LABEL})
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
    assert cable.lines() & 1 << HEATER
