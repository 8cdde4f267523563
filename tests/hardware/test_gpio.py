"""`gpio` behind a stand-in for gpiod's second interface: its own settings and errors, lines of the test's."""

from __future__ import annotations

import errno
import importlib
import os
import time

import pytest

from madns_runtime.errors import MachineError, PluginError
from madns_runtime.hardware.kind_registry import prepare
from tests.hardware.driving import frames, opened

gpiod = pytest.importorskip("gpiod")
driver = importlib.import_module("madns_runtime.hardware.drivers.gpio")
Value = gpiod.line.Value


class Event:
    def __init__(self, offset, is_rising, timestamp_ns):
        kinds = gpiod.EdgeEvent.Type
        self.line_offset, self.timestamp_ns = offset, timestamp_ns
        self.event_type = kinds.RISING_EDGE if is_rising else kinds.FALLING_EDGE


class Request:
    """Lines of a chip with ten: as gpiod's LineRequest, its descriptor readable while events wait."""

    def __init__(self, config):
        self.config = config
        self.values = {o: s.output_value for o, s in config.items()}
        self.events: list[Event] = []
        self.seen = dict.fromkeys(config, 0)
        self.fd, self._other = os.pipe()
        self.is_released = self.is_pulled_out = False

    def _need_chip(self):
        if self.is_pulled_out:
            raise OSError(errno.ENODEV, "No such device")

    def happen(self, *events):
        for event in events:
            event.line_seqno = self.seen[event.line_offset] = self.seen[event.line_offset] + 1
        self.events += events
        os.write(self._other, b"x" * len(events))

    def wait_edge_events(self, timeout=None):
        return bool(self.events)

    def read_edge_events(self, max_events=None):
        found, self.events = self.events, []
        os.read(self.fd, len(found))
        return found

    def get_values(self, lines):
        self._need_chip()
        return [self.values[line] for line in lines]

    def set_value(self, line, value):
        self._need_chip()
        assert self.config[line].direction == gpiod.line.Direction.OUTPUT
        self.values[line] = value

    def release(self):
        self.is_released = True
        os.close(self.fd)
        os.close(self._other)


@pytest.fixture
def requests(monkeypatch):
    made: list[Request] = []
    taken: set[int] = set()

    def request_lines(path, consumer=None, config=None, **options):
        if path != "/dev/gpiochip0":
            raise FileNotFoundError(errno.ENOENT, "No such file or directory")
        if max(config) > 9:
            raise ValueError("line offset of out range")  # gpiod's own word
        if taken & set(config):
            raise OSError(errno.EBUSY, "Device or resource busy")
        kinds = gpiod.line
        for line in config.values():  # Linux, gpiolib-cdev.c: "Bias requires explicit direction."
            if line.direction == kinds.Direction.AS_IS and line.bias != kinds.Bias.AS_IS:
                raise OSError(errno.EINVAL, "Invalid argument")
        made.append(Request(config))
        return made[-1]

    monkeypatch.setattr(gpiod, "request_lines", request_lines)
    request_lines.taken = taken
    made_by = request_lines
    yield made, made_by.taken


def test_levels_with_bias_and_outputs_with_their_safe_state(requests):
    made, _ = requests
    lines = [
        {"name": "door", "offset": 2, "bias": "pull_up", "active_low": True, "debounce_s": 0.01},
        {"name": "heater", "offset": 3, "mode": "output", "safe": 1},
    ]
    with opened("gpio", lines=lines) as device:
        [request] = made
        assert device.fileno() is None
        door, heater = request.config[2], request.config[3]
        assert door.bias == gpiod.line.Bias.PULL_UP
        assert door.active_low
        assert door.debounce_period.total_seconds() == 0.01
        assert heater.output_value == Value.ACTIVE  # safe from the first instant on
        request.values[2] = Value.ACTIVE
        assert device.read().values == {"door": 1.0}
        device.write({"heater": 0.0}, 0.0)
        assert request.values[3] == Value.INACTIVE
        device.make_safe()
        assert request.values[3] == Value.ACTIVE
    assert request.is_released


def test_an_output_that_may_not_move_keeps_its_bias_and_direction(requests):
    made, _ = requests
    lines = [{"name": "valve", "offset": 3, "mode": "output", "bias": "pull_down"}]
    with opened("gpio", may_move=False, lines=lines) as device:
        assert made[0].config[3].direction == gpiod.line.Direction.AS_IS
        assert device.read().values == {}
    with opened("gpio", lines=lines):
        assert made[1].config[3].bias == gpiod.line.Bias.PULL_DOWN


def test_edges_come_in_order_at_the_kernels_times(requests):
    made, _ = requests
    lines = [{"name": "pps", "offset": 4, "mode": "edges", "edge": "both"}]
    with opened("gpio", lines=lines) as device:
        [request] = made
        assert request.config[4].edge_detection == gpiod.line.Edge.BOTH
        assert request.config[4].event_clock == gpiod.line.Clock.MONOTONIC
        assert device.fileno() == request.fd
        assert device.read() is None
        now_ns = time.monotonic_ns()
        request.happen(Event(4, True, now_ns), Event(4, False, now_ns + 1000))
        first = device.read()
        assert first.values == {"pps": 1.0}
        assert first.taken_s == pytest.approx(now_ns * 1e-9)
        assert frames(device, 1, "pps") == [0.0]
        assert device.read() is None


def test_edges_for_which_the_kernel_had_no_room_are_counted(requests):
    lines = [{"name": name, "offset": o, "mode": "edges"} for o, name in ((4, "pps"), (5, "key"))]
    with opened("gpio", lines=lines) as device:
        [request], _ = requests
        counts = {}
        device.count = lambda name, number: counts.update({name: counts.get(name, 0) + number})
        request.happen(*(Event(4, True, number) for number in range(20)), Event(5, True, 30))
        del request.events[:5]  # as the kernel, which keeps the newest
        taken = frames(device, 15, "pps")
        request.happen(Event(4, True, 40))
        taken += frames(device, 1, "key") + frames(device, 1, "pps")

    assert (len(taken), counts) == (17, {"edges_lost": 5})


@pytest.mark.parametrize("mode", ["level", "output", "edges"])
def test_a_chip_that_is_pulled_out_is_missed(requests, mode):
    with opened("gpio", lines=[{"name": "led", "offset": 1, "mode": mode}]) as device:
        assert device.health() == {}
        if mode == "output":
            assert device.read().values == {}
        requests[0][0].is_pulled_out = True
        with pytest.raises(MachineError, match="gpiochip0 is gone: No such device"):
            device.health() if mode == "edges" else device.read()
        if mode == "output":
            with pytest.raises(MachineError, match="gpiochip0 is gone"):
                device.write({"led": 1.0}, 0.0)


@pytest.mark.parametrize(
    ("labels", "told"),
    [
        (["pinctrl-rp1", "other"], None),
        (["other"], "pinctrl-rp1: there is no such chip; see `gpiodetect`"),
        (["pinctrl-rp1"] * 2, "pinctrl-rp1: 2 chips bear that label"),
    ],
)
def test_a_chip_is_found_by_its_label(requests, monkeypatch, labels, told):
    class Chip:
        def __init__(self, path):
            self.label = labels[int(path[-1])]

        def __enter__(self):
            return self

        def __exit__(self, *error):
            pass

        def get_info(self):
            return self

    paths = [f"/dev/gpiochip{number}" for number in range(len(labels))]
    monkeypatch.setattr(gpiod, "Chip", Chip)
    monkeypatch.setattr(driver.glob, "glob", lambda pattern: paths[::-1])
    lines = [{"name": "led", "offset": 1}]
    if told is None:
        with opened("gpio", chip="pinctrl-rp1", lines=lines) as device:
            assert device.identity == "pinctrl-rp1"
            assert len(requests[0]) == 1
    else:
        with (
            pytest.raises(MachineError, match=told),
            opened("gpio", chip="pinctrl-rp1", lines=lines),
        ):
            pass


@pytest.mark.parametrize(
    ("chip", "offset", "told"),
    [
        ("/dev/gpiochip9", 1, "/dev/gpiochip9: there is no such chip"),
        ("/dev/gpiochip0", 99, "it has not all of these lines"),
        ("/dev/gpiochip0", 5, "another program has one of the lines"),
    ],
)
def test_lines_that_cannot_be_had_are_told_with_their_cure(requests, chip, offset, told):
    requests[1].add(5)
    with (
        pytest.raises(MachineError, match=told),
        opened("gpio", chip=chip, lines=[{"name": "a", "offset": offset}]),
    ):
        pass


def test_lines_that_do_not_go_together_are_refused():
    level, edges = {"name": "a", "offset": 1}, {"name": "b", "offset": 2, "mode": "edges"}
    with pytest.raises(PluginError, match="give those with mode edges a device of their own"):
        prepare("gpio", {"lines": [level, edges]}, None)
    with pytest.raises(PluginError, match="expected each offset once"):
        prepare("gpio", {"lines": [level, {"name": "b", "offset": 1}]}, None)
    output = {"name": "led", "offset": 3, "mode": "output", "debounce_s": 0.01}
    with pytest.raises(PluginError, match="lines: led: debounce_s is of inputs"):
        prepare("gpio", {"lines": [level, output]}, None)


def test_opening_moves_no_output_where_none_may_move(requests):
    made, _ = requests
    lines = [{"name": "heater", "offset": 3, "mode": "output", "safe": 1}]
    with opened("gpio", may_move=False, lines=lines):
        assert made[0].config[3].direction == gpiod.line.Direction.AS_IS
