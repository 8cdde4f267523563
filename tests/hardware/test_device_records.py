"""Records of a device: which values of an input are on record."""

import math

import pytest

from madns_runtime.config import Agents, RunConfig
from madns_runtime.hardware.contract import Channel
from madns_runtime.hardware.records import DeviceRecords
from madns_runtime.recording.reader import read_stream
from madns_runtime.recording.record_files import RecordFiles
from madns_runtime.recording.recorder import Recorder
from madns_runtime.recording.run_journal import RunJournal

CONFIG = RunConfig(
    run="0001-r", scenario="s", simulation="counter", base_directory="", agents=Agents(count=1)
)
CHANNELS = (
    Channel(name="level"),
    Channel(name="silent"),
    Channel(name="line", is_frame=True, frame_bytes_max=8, passing="queue"),
)


@pytest.fixture
def records(tmp_path):
    recorder = Recorder(RecordFiles(tmp_path, run="0001-r", source="a/x"), CONFIG.recording)
    found = DeviceRecords(
        RunJournal(recorder, CONFIG.recording.verbosity, t_s=lambda: None), CHANNELS
    )
    recorder.start()
    return found


def test_the_value_that_first_ticks_act_by_is_on_record_though_time_was_not_known_yet(
    records, tmp_path
):
    for number, told_s in ((1, 90.0), (2, 95.0)):
        records.sample("level", number, told_s - 1e-3, [float(number)], told_s=told_s)
        records.sample("line", number, told_s, (1, "00"), told_s=told_s)
    records.sample("level", 2, 96.0, [math.nan], told_s=96.0)

    records.set_time(100.0, -0.5, 1.0)
    records.set_time(101.0, 0.5, 1.0)
    records.sample("level", 3, 102.0, [3.0], told_s=102.0)
    records.close(5.0)

    rows = {
        channel.name: list(read_stream(tmp_path / f"{channel.name}.jsonl").records())
        for channel in CHANNELS
    }
    assert rows["level"] == [[-5.501, 2, 1000, 2.0], [1.5, 3, 0, 3.0]]
    assert rows["silent"] == rows["line"] == []


@pytest.mark.parametrize("goes_on", [True, False])
def test_of_the_values_handed_on_before_simulated_time_zero_the_newest_alone_is_on_record(
    records, tmp_path, goes_on
):
    records.set_time(100.0, -0.5, 1.0)
    for number in range(1, 5):
        taken_s = 100.0 + number / 10
        records.sample("level", number, taken_s, [float(number)], told_s=taken_s)
        records.sample("line", number, taken_s, (1, "00"), told_s=taken_s)
    records.sample("level", 5, 100.45, [math.nan], told_s=100.45)
    records.set_time(100.46, -0.04, 1.0)
    if goes_on:
        records.sample(
            "level", 5, 100.45, [5.0], told_s=100.52
        )  # which a first tick may not have found yet
    records.close(5.0)

    level, line = (
        list(read_stream(tmp_path / f"{name}.jsonl").records()) for name in ("level", "line")
    )
    assert level == [[-0.1, 4, 0, 4.0], [-0.05, 5, 70000, 5.0]][: 1 + goes_on]
    assert [number for _, number, *_ in line] == [1, 2, 3, 4]  # each arrives, in the first tick
