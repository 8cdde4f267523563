"""Records of a device: which values of an input are on record."""

import math

import pytest

from madns_runtime.config import Agents, RunConfig
from madns_runtime.hardware.contract import Channel
from madns_runtime.hardware.records import EARLY_BYTES_MAX, EARLY_QUEUED_MAX, DeviceRecords
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
    Channel(name="queued", passing="queue"),
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
    records.sample("queued", 0, 96.0, [math.nan], told_s=96.0)

    records.set_time(100.0, -0.5, 1.0)
    records.set_time(101.0, 0.5, 1.0)
    records.sample("level", 3, 102.0, [3.0], told_s=102.0)
    records.close(5.0)

    rows = {
        channel.name: list(read_stream(tmp_path / f"{channel.name}.jsonl").records())
        for channel in CHANNELS
    }
    assert rows["level"] == [[-5.501, 2, 1000, 2.0], [1.5, 3, 0, 3.0]]
    assert rows["line"] == [[-10.5, 1, 0, 1, "00"], [-5.5, 2, 0, 1, "00"]]
    assert rows["silent"] == rows["queued"] == []


@pytest.mark.parametrize(
    ("size", "kept"), [(1, EARLY_QUEUED_MAX), (8192, EARLY_BYTES_MAX // 16384)]
)
def test_of_what_queues_were_given_early_a_bounded_number_is_on_record_and_the_rest_is_counted(
    records, tmp_path, size, kept
):
    line = (size, "00" * size)
    given_up = [records.sample("line", n + 1, 90.0, line, told_s=90.0) for n in range(kept + 7)]
    records.set_time(100.0, -0.5, 1.0)
    records.sample("line", kept + 8, 101.0, line, told_s=101.0)
    closed = records.close(5.0)

    numbers = [row[1] for row in read_stream(tmp_path / "line.jsonl").records()]
    assert sum(given_up) == 7
    assert numbers == list(range(8, kept + 9))
    assert closed["dropped"] == 0
