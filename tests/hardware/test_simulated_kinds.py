"""`synthetic`, `playback` and `null`: the same values each time, by simulated time alone."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
import pytest

from madns_runtime.config import Agents, DeviceLaunch, RunConfig
from madns_runtime.errors import PluginError
from madns_runtime.hardware import simulated
from madns_runtime.hardware.contract import Sample
from madns_runtime.hardware.inline import InlineDevice
from madns_runtime.hardware.kind_registry import prepare
from madns_runtime.hardware.records import DeviceRecords
from madns_runtime.hardware.stream_schemas import schema_of
from madns_runtime.recording.reader import read_stream
from madns_runtime.recording.record_files import RecordFiles
from madns_runtime.recording.recorder import Recorder
from madns_runtime.recording.run_journal import RunJournal
from madns_runtime.recording.stream_file import path_of
from tests.hardware.driving import opened

CHANNELS = [
    {"name": "gyro", "unit": "rad/s", "components": ["x", "y", "z"], "elements": [{"noise": 0.1}] * 3},
    {"name": "level", "elements": [{"shape": "sine", "amplitude": 2.0, "offset": 1.0}]},
]  # fmt: skip
TICKS_HEAD = (
    '{"schema":1,"stream":"ticks","shape":"array","fields":['
    '{"name":"tick","unit":"","kind":"int"},{"name":"lateness_us","unit":"us","kind":"int"}]}'
)
CONFIG = RunConfig(
    run="0001-r", scenario="s", simulation="counter", base_directory="", agents=Agents(count=1)
)


def test_waveforms():
    shapes = ("constant", "sine", "square", "triangle", "sawtooth", "ramp")
    channels = [
        {"name": s, "elements": [{"shape": s, "amplitude": 2.0, "offset": 1.0, "frequency_hz": 0.5}]}
        for s in shapes
    ]  # fmt: skip
    with opened("synthetic", channels=channels) as device:
        quarter = device.sample_at(0.5).values
        three = device.sample_at(1.5).values
    assert [quarter[s] for s in shapes] == pytest.approx([1.0, 3.0, 3.0, 1.0, 0.0, 2.0])
    assert [three[s] for s in shapes] == pytest.approx([1.0, -1.0, -1.0, 1.0, 2.0, 4.0])


def test_noise_is_the_seeds():
    def values(seed: int) -> np.ndarray:
        with opened("synthetic", channels=CHANNELS, seed=seed) as device:
            return np.array([device.sample_at(i / 100).values["gyro"] for i in range(2000)])

    first = values(1)
    assert np.array_equal(first, values(1))
    assert not np.array_equal(first, values(2))
    assert first.std(axis=0) == pytest.approx([0.1] * 3, rel=0.1)


def test_each_agents_own_device_has_noise_of_its_own():
    def first(place: str) -> list[float]:
        device = prepare("synthetic", {"channels": CHANNELS, "seed": 1}, None).make()
        device.place = place
        device.open()
        return device.sample_at(0.0).values["gyro"]

    assert first("agent-01") == first("agent-01")
    assert first("agent-01") != first("agent-02")


def test_null_takes_anything_and_tells_the_time():
    with opened("null", outputs=["valve"], low=-1.0, high=1.0) as device:
        device.write({"valve": 1.0}, 0.0)
        assert device.sample_at(2.5) == Sample(values={"time": 2.5}, taken_s=2.5)
    program = prepare("null", {"outputs": ["valve"], "low": -1.0, "high": 1.0}, None)
    assert [channel.limits for channel in program.channels] == [None, (-1.0, 1.0)]


@pytest.mark.parametrize(("low", "high", "safe"), [(1.0, 5.0, 1.0), (-5.0, -2.0, -2.0)])
def test_null_stands_in_for_an_output_that_is_never_zero(low, high, safe):
    program = prepare("null", {"low": low, "high": high}, None)

    assert [each.safe for each in program.channels if each.direction == "out"] == [safe]


def record(folder, ages_s: Mapping[str, float]) -> list:
    """Record what a synthetic device gives, as its process does, and return (channel, t, age in us, values)."""
    program = prepare("synthetic", {"channels": CHANNELS, "seed": 3}, None)
    config = CONFIG
    recorder = Recorder(RecordFiles(folder, run="0001-r", source="pi22/imu"), config.recording)
    journal = RunJournal(recorder, config.recording.verbosity, t_s=lambda: None)
    records = DeviceRecords(journal, program.channels)
    recorder.start()
    records.set_time(1000.0, 0.0, 1.0)
    device = program.make()
    device.open()
    told = []
    for number in range(200):
        t_s = number / 50
        sample = device.sample_at(t_s)
        for channel in program.channels:
            value = sample.values[channel.name]
            numbers = tuple(value) if channel.shape else (value,)
            age_s = ages_s[channel.name] + number * 1e-6
            records.sample(
                channel.name, number + 1, 1000.0 + t_s, numbers, told_s=1000.0 + t_s + age_s
            )
            told.append((channel.name, round(t_s, 6), round(age_s * 1e6), numbers))
    records.close(5.0)
    return told


def test_playback_gives_the_recorded_values_at_their_own_times_and_ages(tmp_path):
    told = record(tmp_path, {"gyro": 0.0015, "level": 0.03})
    with opened("playback", tmp_path, directory=".") as device:
        found = []
        while (next_s := device.next_s()) != math.inf:
            assert device.sample_at(next_s - 1e-7) is None  # not before it was handed on
            sample = device.sample_at(next_s)
            [(name, value)] = sample.values.items()
            numbers = tuple(value) if isinstance(value, list) else (value,)
            age_us = round((next_s - sample.taken_s) * 1e6)
            found.append((name, round(sample.taken_s, 6), age_us, numbers))
    assert sorted(found) == sorted(told)
    handed_on = [t_s + age_us * 1e-6 for _, t_s, age_us, _ in found]
    assert handed_on == sorted(handed_on)


def test_playback_goes_through_the_files_of_all_processes_that_the_device_had(tmp_path):
    told = record(tmp_path, {"gyro": 0.0015, "level": 0.03})
    for name in ("gyro", "level"):
        head, *lines = (tmp_path / f"{name}.jsonl").read_text().splitlines(keepends=True)
        for number, part in ((1, lines[:9]), (2, lines[9:60]), (10, lines[60:])):
            path_of(tmp_path, name, number).write_text("".join([head, *part]))
        path_of(tmp_path, name, 3).touch()  # of a process that was killed before it wrote
    with opened("playback", tmp_path, directory=".") as device:
        found = []
        while (next_s := device.next_s()) != math.inf:
            [(name, value)] = device.sample_at(next_s).values.items()
            found.append((name, tuple(value) if isinstance(value, list) else (value,)))

    for name in ("gyro", "level"):
        values = [numbers for channel, _, _, numbers in told if channel == name]
        assert [numbers for channel, numbers in found if channel == name] == values
    schema = (tmp_path / "gyro.jsonl").read_text().splitlines()[0]
    path_of(tmp_path, "level", 11).write_text(schema)
    with pytest.raises(PluginError, match=r"level.11.jsonl: expected the fields of level.jsonl"):
        prepare("playback", {"directory": "."}, tmp_path)


def test_a_playback_recorded_anew_is_the_same_to_the_microsecond(tmp_path):
    record(tmp_path, {"gyro": 0.0015, "level": 0.03})
    program = prepare("playback", {"directory": "."}, tmp_path)
    assert [(c.name, c.unit, c.shape, c.components) for c in program.channels] == [
        ("gyro", "rad/s", (3,), ("x", "y", "z")),
        ("level", "", (), ()),
    ]
    again = tmp_path / "again"
    config = CONFIG
    recorder = Recorder(RecordFiles(again, run="0002-r", source="pi22/imu"), config.recording)
    records = DeviceRecords(
        RunJournal(recorder, config.recording.verbosity, t_s=lambda: None), program.channels
    )
    recorder.start()
    records.set_time(500.0, 0.0, 1.0)
    device = program.make()
    device.open()
    numbers: dict[str, int] = {}
    while (next_s := device.next_s()) != math.inf:
        sample = device.sample_at(next_s)
        [(name, value)] = sample.values.items()
        numbers[name] = numbers.get(name, 0) + 1
        values = value if isinstance(value, list) else (value,)
        records.sample(name, numbers[name], 500.0 + sample.taken_s, values, told_s=500.0 + next_s)
    records.close(5.0)
    for name in ("gyro", "level"):
        first = list(read_stream(tmp_path / f"{name}.jsonl").records())
        second = list(read_stream(again / f"{name}.jsonl").records())
        assert len(first) == 200
        assert second == first
    assert schema_of(program.channels[0]).name == "gyro"


def inline(folder, program):
    """Return a device in lockstep at 50 Hz that records into a folder, and its clock: a list of one time, s."""
    recording, clock = CONFIG.recording, [0.0]
    recorder = Recorder(RecordFiles(folder, run="0002-r", source="agent-01/imu"), recording)
    journal = RunJournal(recorder, recording.verbosity, t_s=lambda: None)
    records = DeviceRecords(journal, program.channels)
    launch = DeviceLaunch(
        name="imu", place="agent-01", kind=program.kind.name, base_directory="", rate_hz=50.0
    )
    device = InlineDevice(launch, program, records, now_s=lambda: clock[0])
    recorder.start()
    return device, clock


@pytest.mark.parametrize(
    ("kind", "passed"), [("playback", {"passed_while_closed": 100}), ("synthetic", {})]
)
def test_a_device_that_is_opened_in_mid_run_in_lockstep_goes_on_and_does_not_begin_anew(
    tmp_path, kind, passed
):
    record(tmp_path, {"gyro": 0.0, "level": 0.0})
    given = {"directory": "."} if kind == "playback" else {"channels": CHANNELS, "seed": 3}
    device, clock = inline(tmp_path / "again", prepare(kind, given, tmp_path))
    clock[0] = 1.0
    device.open()
    for clock[0] in (1.0, 1.11):
        device.advance(clock[0])
    told = device.close()

    for name in ("gyro", "level"):
        rows = [row[:2] for row in read_stream(tmp_path / "again" / f"{name}.jsonl").records()]
        assert rows == [[t_s, n] for n, t_s in enumerate((1.0, 1.02, 1.04, 1.06, 1.08, 1.1), 1)]
    assert {key: told[key] for key in told if key.startswith("passed")} == passed
    opened = next(iter(read_stream(tmp_path / "again" / "events.jsonl").records()))
    assert (opened["event"], opened["t_s"]) == ("opened", 1.0)


def test_a_sample_that_was_handed_on_before_its_own_time_is_played_back_in_lockstep(tmp_path):
    record(tmp_path, {"gyro": -0.0015, "level": 0.0})
    program = prepare("playback", {"directory": "."}, tmp_path)
    device, clock = inline(tmp_path / "again", program)
    device.open()
    clock[0] = 4.0
    device.advance(4.0)

    assert device.close()["samples"] == 400
    first, second = (
        [record[2:] for record in read_stream(folder / "gyro.jsonl").records()]
        for folder in (tmp_path, tmp_path / "again")
    )
    assert second[1:] == first[1:]  # the first was handed on before simulated time


def test_lines_of_a_recording_that_are_none_are_counted_and_records_of_another_kind_are_named(
    tmp_path,
):
    record(tmp_path, {"gyro": 0.0015, "level": 0.03})
    path, counts = tmp_path / "level.jsonl", {}
    head, *lines = path.read_text().splitlines()
    path.write_text("\n".join([head, *lines[:5], "[0.1,6", *lines[6:9], "[]", *lines[10:]]))
    with opened("playback", tmp_path, directory=".") as device:
        device.count = lambda name, number: counts.update({name: counts.get(name, 0) + number})
        found = 0
        while (next_s := device.next_s()) != math.inf:
            found += device.sample_at(next_s) is not None

    assert (found, counts) == (398, {"damaged_lines": 2})
    path.write_text("\n".join([head, '["soon",1,30,1.0]']))
    with (
        pytest.raises(
            PluginError, match=r"level.jsonl: expected records \[t_s, number, age_us, .*'soon'"
        ),
        opened("playback", tmp_path, directory="."),
    ):
        pass


def test_lines_that_are_none_are_counted_of_a_recording_that_is_not_played_to_its_end(tmp_path):
    record(tmp_path, {"gyro": 0.0015, "level": 0.03})
    path, counts = tmp_path / "level.jsonl", {}
    head, *lines = path.read_text().splitlines()
    path.write_text("\n".join([head, *lines[:5], "[0.1,6", *lines[6:]]))
    with opened("playback", tmp_path, directory=".") as device:
        device.count = lambda name, number: counts.update({name: counts.get(name, 0) + number})
        while device.sample_at(1.0) is not None:
            pass

    assert counts == {"damaged_lines": 1}


def test_a_playback_begins_where_it_is_told_and_refuses_an_empty_folder(tmp_path):
    record(tmp_path, {"gyro": 0.0, "level": 0.0})
    with opened("playback", tmp_path, directory=".", start_s=2.0) as device:
        assert device.sample_at(10.0).taken_s == 0.0
    (tmp_path / "empty").mkdir()
    with pytest.raises(PluginError, match="expected records of a device's channels, found none"):
        prepare("playback", {"directory": "empty"}, tmp_path)


def test_a_playback_with_ticks_gives_each_sample_in_the_tick_that_could_find_it(tmp_path):
    told = record(tmp_path, {"gyro": 0.0015, "level": 0.03})
    (tmp_path / "ticks.jsonl").write_text(f"{TICKS_HEAD}\n[0,100]\n[1,30000]\n[3,0]\n")
    settings = {"directory": ".", "ticks": "ticks.jsonl", "tick_hz": 10.0, "phase_s": 0.05}
    with opened("playback", tmp_path, **settings) as device:
        found = []
        while (next_s := device.next_s()) != math.inf:
            sample = device.sample_at(next_s)
            found.append((next_s, sample.handed_s))

    woke_s = {0.0: 0.0501, 0.1: 0.18, 0.3: 0.35}
    assert {next_s for next_s, _ in found} == set(woke_s)
    assert all(handed_s <= woke_s[next_s] + 2e-6 for next_s, handed_s in found)
    handed_s = sorted(t_s + age_us * 1e-6 for _, t_s, age_us, _ in told)
    assert len(found) == sum(each <= 0.35 + 1e-6 for each in handed_s)  # later ones nobody found


def test_however_many_samples_a_tick_found_they_are_played_in_it(tmp_path, monkeypatch):
    monkeypatch.setattr(simulated, "AT_ONCE_MAX", 50)
    record(tmp_path, {"gyro": 0.0015, "level": 0.03})
    (tmp_path / "ticks.jsonl").write_text(f"{TICKS_HEAD}\n[0,0]\n[4,0]\n")
    settings = {"directory": ".", "ticks": "ticks.jsonl", "tick_hz": 1.0}
    device, clock = inline(tmp_path / "again", prepare("playback", settings, tmp_path))
    device.open()
    clock[0] = 4.0
    device.advance(4.0)

    assert device.close()["samples"] == 399  # but for one that was handed on later


def test_a_playback_of_lockstep_gives_a_sample_between_two_ticks_when_it_was_handed_on(tmp_path):
    """And not with the next tick: a device that is unplugged in between has given it before."""
    record(tmp_path, {"gyro": 0.0, "level": 0.0})
    with opened("playback", tmp_path, directory=".", tick_hz=3.0) as device:
        found_s = []
        while (next_s := device.next_s()) < 0.4:
            found_s.append(next_s)
            device.sample_at(next_s)

    assert found_s[2 * 16] == pytest.approx(0.320016, abs=1e-9)
    (tmp_path / "third").mkdir()
    (tmp_path / "third" / "level.jsonl").write_text(
        (tmp_path / "level.jsonl").read_text().splitlines()[0]
        + "\n[0.333333,1,0,1.5]\n[0.666667,2,0,1.5]\n"
    )
    with opened("playback", tmp_path, directory="third", tick_hz=3.0) as device:
        assert device.next_s() == 1 / 3  # that tick's, on record in whole microseconds
        device.sample_at(1 / 3)
        assert device.next_s() == 2 / 3


def test_a_sample_of_a_tick_of_lockstep_does_not_lie_behind_that_tick_as_its_time_was_rounded(
    tmp_path,
):
    record(tmp_path, {"gyro": 0.0, "level": 0.0})
    (tmp_path / "thirds").mkdir()
    schema = (tmp_path / "level.jsonl").read_text().splitlines()[0]
    samples = f"{schema}\n[0.333333,1,0,1.5]\n[0.666667,2,0,1.5]\n[0.8,3,0,1.5]\n"
    (tmp_path / "thirds" / "level.jsonl").write_text(samples)

    with opened("playback", tmp_path, directory="thirds", tick_hz=3.0) as device:
        taken_s = [device.sample_at(1.0).taken_s for _ in range(3)]

    assert taken_s == [1 / 3, 2 / 3, 0.8]


def test_recorded_outputs_take_what_they_are_given_and_limits_are_told(tmp_path):
    fields = [("t_s", "s"), ("lateness_us", "us"), ("duty", "1")]
    told = ",".join(f'{{"name":"{name}","unit":"{unit}","kind":"float"}}' for name, unit in fields)
    (tmp_path / "duty.jsonl").write_text(
        f'{{"schema":1,"stream":"duty","shape":"array","fields":[{told}]}}\n[0.5,10,0.25]\n'
    )

    program = prepare("playback", {"directory": ".", "limits": {"duty": [0.0, 1.0]}}, tmp_path)

    [duty] = program.channels
    assert (duty.name, duty.direction, duty.unit, duty.limits) == ("duty", "out", "1", (0.0, 1.0))
    device = program.make()
    device.open()
    device.write({"duty": 0.5}, 0.0)


def test_a_recording_of_as_many_channels_as_a_device_has_is_played_back_whole(tmp_path):
    channels = [{"name": f"value{number:02d}"} for number in range(64)]
    program = prepare("synthetic", {"channels": channels}, None)
    recorder = Recorder(RecordFiles(tmp_path, run="0001-r", source="pi22/imu"), CONFIG.recording)
    journal = RunJournal(recorder, CONFIG.recording.verbosity, t_s=lambda: None)
    records = DeviceRecords(journal, program.channels)
    recorder.start()
    records.set_time(1000.0, 0.0, 1.0)
    records.event("opened", 1000.0)
    records.state(1000.0, (1, 0), 0, {})
    records.clock(1000.0, 0.0, 0.0)
    for channel in program.channels:
        records.sample(channel.name, 1, 1000.0, (0.5,), told_s=1000.0)
    records.close(5.0)
    assert len(list(tmp_path.glob("*.jsonl"))) > 64  # what is recorded beside channels

    again = prepare("playback", {"directory": "."}, tmp_path)

    assert [channel.name for channel in again.channels] == [each["name"] for each in channels]


def test_a_recording_of_outputs_alone_is_a_device_that_is_there(tmp_path):
    """A device of outputs alone says so by samples without a value; of these there are no records."""
    fields = [("t_s", "s"), ("lateness_us", "us"), ("duty", "1")]
    told = ",".join(f'{{"name":"{name}","unit":"{unit}","kind":"float"}}' for name, unit in fields)
    (tmp_path / "duty.jsonl").write_text(
        f'{{"schema":1,"stream":"duty","shape":"array","fields":[{told}]}}\n[0.5,10,0.25]\n'
    )
    with opened("playback", tmp_path, directory=".") as device:
        assert device.next_s() is None  # at its rate
        assert device.sample_at(1.5) == Sample(values={}, taken_s=1.5)
