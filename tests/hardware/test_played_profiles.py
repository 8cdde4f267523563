"""Profiles that devices play: by their own processes in real time, by simulated time alone in lockstep."""

from __future__ import annotations

import itertools
import math
import os
import signal
from functools import partial

import pytest

from madns_runtime.config import Agents, DeviceLaunch, RunConfig
from madns_runtime.errors import BlamedError, PluginError
from madns_runtime.hardware.contract import Device
from madns_runtime.hardware.driven import DrivenDevice
from madns_runtime.hardware.inline import InlineDevice
from madns_runtime.hardware.kind_registry import prepare
from madns_runtime.hardware.port import DevicePort
from madns_runtime.hardware.records import DeviceRecords
from madns_runtime.hardware.runner import DeviceRunner
from madns_runtime.reactor.reactor import Reactor
from madns_runtime.recording.reader import read_stream
from madns_runtime.recording.record_files import RecordFiles
from madns_runtime.recording.recorder import Recorder
from madns_runtime.recording.run_journal import RunJournal
from tests.hardware.bench import line_bench

CONFIG = RunConfig(
    run="0001-r", scenario="s", simulation="counter", base_directory="", agents=Agents(count=1)
)


class InlineBench:
    """A `null` device in lockstep, and the agent that uses it."""

    def __init__(self, folder, *, is_open=True, **launch):
        program = prepare("null", {"outputs": ["coil"], "low": -1.0, "high": 1.0}, folder)
        recorder = Recorder(RecordFiles(folder, run="0001-r", source="a/null"), CONFIG.recording)
        records = DeviceRecords(
            RunJournal(recorder, CONFIG.recording.verbosity, t_s=lambda: None), program.channels
        )
        recorder.start()
        self.folder = folder
        self.t_s = 0.0
        settings = {"owner": "a", "may_move": True, **launch}
        told = DeviceLaunch(
            name="null", place="a", kind="null", base_directory="", rate_hz=10, **settings
        )
        self.device = InlineDevice(told, program, records, now_s=lambda: self.t_s)
        if is_open:
            self.device.open()
        self.port = self.device.port

    def advance(self, t_s):
        self.t_s = t_s
        self.device.advance(t_s)

    def played(self):
        records = read_stream(self.folder / "coil.jsonl").records()
        return [(t_s, late_us, value) for t_s, late_us, value in records]


def test_in_lockstep_each_point_is_put_out_at_its_due_time(tmp_path):
    bench = InlineBench(tmp_path)
    bench.port.play("coil", [(k / 20, math.sin(k)) for k in range(1, 11)])
    bench.advance(0.3)
    bench.port.play("coil", [(0.4, 0.0), (0.5, 9.0)], from_s=0.35)
    bench.advance(0.7)
    report = bench.device.close()

    values = [*((k / 20, math.sin(k)) for k in range(1, 7)), (0.4, 0.0), (0.5, 1.0)]
    assert bench.played() == [(t_s, 0, pytest.approx(value)) for t_s, value in values]
    told = report["stimulus"]["coil"]
    assert (told["points"], told["played"], told["replaced"]) == (12, 8, 4)
    assert (told["underruns"], told["late"], report["coil_limited"]) == (1, 0, 1)
    assert told["lateness_us"] == {"p50": 0, "p99": 0, "max": 0}


@pytest.mark.parametrize("step_s", [0.0, 1e-9])
def test_in_lockstep_a_driver_that_lets_time_stand_still_is_told_so(tmp_path, monkeypatch, step_s):
    monkeypatch.setattr("madns_runtime.hardware.simulated.AT_ONCE_MAX", 20)
    bench = InlineBench(tmp_path)
    bench.advance(4.8)  # 49 samples, one per 0.1 s
    told_s = (4.8 + step_s * number for number in itertools.count())
    monkeypatch.setattr(
        "madns_runtime.hardware.drivers.null.NullDevice.next_s", lambda self: next(told_s)
    )
    with pytest.raises(
        PluginError, match=r"device null: NullDevice.next_s.* more than 20 samples at 4.8 s: next_s"
    ):
        bench.advance(4.9)


def test_in_lockstep_a_device_opened_late_passes_over_any_number_of_samples(tmp_path, monkeypatch):
    monkeypatch.setattr("madns_runtime.hardware.simulated.AT_ONCE_MAX", 20)
    bench = InlineBench(tmp_path, is_open=False)
    told_s = itertools.count(0.0, 0.1)
    monkeypatch.setattr(
        "madns_runtime.hardware.drivers.null.NullDevice.next_s", lambda self: next(told_s)
    )
    bench.t_s = 100.0
    bench.device.open()

    assert bench.device.close()["passed_while_closed"] >= 999


def test_in_lockstep_what_came_too_late_is_put_out_once_and_counted(tmp_path):
    bench = InlineBench(tmp_path)
    bench.advance(1.0)
    bench.port.play("coil", [(0.7, 0.1), (0.8, 0.2), (1.1, 0.3), (5.0, 0.4)])
    bench.advance(1.5)
    report = bench.device.close()

    assert bench.played() == [(0.8, pytest.approx(200_000, abs=1), 0.2), (1.1, 0, 0.3)]
    told = report["stimulus"]["coil"]
    assert (told["came_late"], told["skipped"], told["late"], told["unplayed"]) == (2, 1, 1, 1)


def test_in_lockstep_writes_are_put_out_too_and_end_a_profile(tmp_path):
    bench = InlineBench(tmp_path)
    bench.port.play("coil", [(k / 10, 0.5) for k in range(1, 10)])
    bench.port.write("coil", -0.5, due_s=0.25)
    bench.advance(1.0)
    report = bench.device.close()

    assert bench.played() == [(0.1, 0, 0.5), (0.2, 0, 0.5), (0.25, 0, -0.5)]
    assert report["stimulus"]["coil"]["underruns"] == 0


def test_outputs_that_may_not_move_play_nothing_and_every_point_is_counted(tmp_path):
    bench = InlineBench(tmp_path, may_move=False, why_not="not armed")
    bench.port.play("coil", [(0.1, 0.5), (0.2, 0.5)])
    bench.advance(1.0)
    report = bench.device.close()

    assert bench.played() == []
    assert report["stimulus"]["coil"]["refused"] == 2
    assert report["refused"] == 1


def test_in_lockstep_points_that_the_driver_does_not_take_are_counted_as_refused(tmp_path):
    bench = InlineBench(tmp_path)

    def write(values, due_s):
        if values["coil"] == 0.5:
            raise PluginError("stuck")

    bench.device._device.write = write
    bench.port.play("coil", [(0.1, 0.25), (0.2, 0.5), (0.3, 0.5), (0.4, 0.75)])
    bench.advance(0.45)
    report = bench.device.close()

    assert bench.played() == [(0.1, 0, 0.25), (0.4, 0, 0.75)]
    told = report["stimulus"]["coil"]
    assert (told["points"], told["played"], told["refused"], told["lost"]) == (4, 2, 2, 0)
    assert not report.get("refused")


def test_in_lockstep_a_driver_with_outputs_and_no_write_is_to_blame(tmp_path):
    bench = InlineBench(tmp_path)
    bench.device._device.write = partial(Device.write, bench.device._device)
    bench.port.write("coil", 0.5, due_s=0.1)

    with pytest.raises(BlamedError, match=r"has outputs and no write\(values, due_s\)"):
        bench.advance(0.2)


def test_what_no_output_can_play_is_refused_at_once(tmp_path):
    port = InlineBench(tmp_path).port

    for arguments, what in (
        (("coyl", [(0.0, 1.0)]), "no output 'coyl'"),
        (("time", [(0.0, 1.0)]), "no output 'time'"),
        (("coil", []), "got neither"),
    ):
        with pytest.raises(PluginError, match=what):
            port.play(*arguments)
    with pytest.raises(PluginError, match="none before from_s"):
        port.play("coil", [(0.0, 1.0)], from_s=0.5)
    assert port.size_of("coil") == 1


def test_what_an_agent_said_last_is_counted_though_the_end_was_heard_before_it(tmp_path):
    told = DeviceLaunch(
        name="null", place="a", kind="null", base_directory="", rate_hz=10, users=("a",),
        owner="a", may_move=True,
    )  # fmt: skip
    program = prepare("null", {"outputs": ["coil"], "low": -1.0, "high": 1.0}, tmp_path)
    driven = DrivenDevice.share(told, program)
    recorder = Recorder(RecordFiles(tmp_path, run="0001-r", source="a/null"), CONFIG.recording)
    journal = RunJournal(recorder, CONFIG.recording.verbosity, t_s=lambda: None)
    reactor = Reactor()
    runner = DeviceRunner(driven.seat, DeviceRecords(journal, program.channels), reactor)
    recorder.start()
    runner.open()
    port = DevicePort(
        "a/null", program.channels, shared=(driven.seat.page, driven.ends["a"]),
        limits=driven.limits, agent="a",
    )  # fmt: skip

    port.write("coil", 0.5, due_s=1e9)
    port.play("coil", [(600.0, 0.5), (601.0, 0.5)])
    report = runner.end("the run is over", 60.0)
    reactor.close()

    assert report["writes_left"] == 1
    assert report["stimulus"]["coil"]["unplayed"] == 2


@pytest.mark.process
def test_a_process_plays_a_profile_of_one_message_and_tells_how_late_it_was(tmp_path):
    with line_bench(tmp_path, launch={"late_s": 30.0}) as (bench, terminal):
        bench.until(lambda: "ok" in bench.statuses("line"))
        port = bench.hardware["line"]
        port.play("valve", [(0.2 + k / 50, k / 100) for k in range(50)])  # before time runs
        bench.start_time()
        bench.until(lambda: "VALVE 0.1" in terminal.heard())
        port.play("valve", [(1.2 + k / 50, 0.5 + k / 1000) for k in range(10)], from_s=1.2)
        bench.until(lambda: "VALVE 0.509" in terminal.heard())
        port.play("valve", (), from_s=1.5)
        port.play("valve", [(900.0, 1.0)])
        bench.run(0.1)
        report = bench.close()["pi22/line"]["report"]

    told = report["stimulus"]["valve"]
    records = list(read_stream(tmp_path / "devices" / "pi22" / "line" / "valve.jsonl").records())
    assert told["points"] == told["played"] + told["skipped"] + told["unplayed"]
    assert (told["points"], told["unplayed"], told["refused"]) == (61, 1, 0)
    assert len(records) == told["played"] >= 20
    assert [record[0] for record in records] == sorted(record[0] for record in records)
    assert all(record[1] >= 0 for record in records)
    assert 0 <= told["lateness_us"]["p50"] <= told["lateness_us"]["max"]


@pytest.mark.process
def test_a_process_puts_out_nothing_that_is_due_behind_the_runs_end(tmp_path):
    with line_bench(tmp_path) as (bench, terminal):
        bench.until(lambda: "ok" in bench.statuses("line"))
        port, zero_s = bench.hardware["line"], bench.start_time()
        bench.hardware.use_clock(lambda t_s: zero_s + t_s)
        port.play("valve", [(0.1 + k / 10, 0.1 + k / 100) for k in range(20)])
        bench.until(lambda: "VALVE 0.1" in terminal.heard())
        bench.hardware.tell_time(zero_s, 0.0, 1.0, 1.0)  # as a stop makes the end sooner
        bench.until(lambda: bench.reactor.now_s() > zero_s + 1.5)
        port.write("valve", 0.75)  # as an agent does that sums up
        bench.until(lambda: "VALVE 0.75" in terminal.heard())
        port.play("valve", [(1.5, 0.8), (60.0, 0.9)])
        bench.run(0.2)
        report = bench.close()["pi22/line"]["report"]

    told = report["stimulus"]["valve"]
    rows = list(read_stream(tmp_path / "devices" / "pi22" / "line" / "valve.jsonl").records())
    assert [value for t_s, _, value in rows if t_s >= 1.0] == [0.75]
    assert (told["points"], told["underruns"]) == (22, 0)
    assert (
        told["unplayed"] >= 13
    )  # of 1.0 s and later, and more where the machine was busy at the end
    assert told["points"] == told["played"] + told["skipped"] + told["unplayed"]


@pytest.mark.process
def test_writes_that_are_due_behind_the_runs_end_are_left(tmp_path):
    with line_bench(tmp_path) as (bench, terminal):
        bench.until(lambda: "ok" in bench.statuses("line"))
        zero_s = bench.start_time()
        bench.hardware.tell_time(zero_s, 0.0, 1.0, 1.0)
        bench.hardware.use_clock(lambda t_s: zero_s + t_s)
        bench.hardware["line"].write("valve", 0.5, due_s=1.2)
        bench.until(lambda: bench.reactor.now_s() > zero_s + 1.5)
        report = bench.close()["pi22/line"]["report"]
        heard = terminal.heard()

    assert report["writes_left"] == 1
    assert not [word for word in heard if word.startswith("VALVE")]


@pytest.mark.process
def test_points_of_a_device_that_is_gone_are_lost_and_counted_over_its_processes(tmp_path):
    with line_bench(tmp_path) as (bench, terminal):
        bench.until(lambda: "ok" in bench.statuses("line"))
        bench.start_time()
        port = bench.hardware["line"]
        port.play("valve", [*((k / 50, 0.25) for k in range(1, 400)), (500.0, 0.5)])
        bench.until(lambda: "VALVE 0.25" in terminal.heard())
        os.kill(bench.pid_of(), signal.SIGKILL)
        bench.until(lambda: bench.statuses("line")[-2:] == ["lost", "ok"])
        port.play("valve", [(600.0, 0.75)])
        bench.run(0.1)
        report = bench.close()["pi22/line"]["report"]

    told = report["stimulus"]["valve"]
    assert (told["points"], told["unplayed"]) == (401, 1)
    assert 1 <= told["played"] <= 399
    # At least the point that was to come waited in the process that was killed.
    assert told["lost"] == 401 - 1 - told["played"] - told["skipped"] >= 1


@pytest.mark.process
def test_a_profile_that_runs_out_is_told_and_that_of_an_agent_that_is_gone_is_made_safe(tmp_path):
    with line_bench(tmp_path) as (bench, terminal):
        bench.until(lambda: "ok" in bench.statuses("line"))
        bench.start_time()
        port = bench.hardware["line"]
        port.play("valve", [(0.01, 0.1), (0.02, 0.2), (0.03, 0.3)])
        events = tmp_path / "devices" / "pi22" / "line" / "events.jsonl"
        bench.until(lambda: events.exists() and b'"underrun"' in events.read_bytes())
        assert terminal.heard()[-1] == "VALVE 0.3"  # held
        port.play("valve", [(600.0 + k, 0.5) for k in range(7)])
        bench.manager.agents_ended(["agent-01"])
        bench.until(lambda: terminal.heard()[-1] == "SAFE")
        report = bench.close()["pi22/line"]["report"]

    told = report["stimulus"]["valve"]
    assert (told["points"], told["unplayed"], told["underruns"]) == (10, 7, 1)
