"""What whoever watches a run is told of the fields that its simulation names."""

import pytest

from madns_runtime.config import Recording
from madns_runtime.plugin.columns import COLUMNS_MAX
from madns_runtime.protocol.codec import encode_message
from madns_runtime.protocol.messages import Ping
from madns_runtime.reactor.udp import DATAGRAM_BYTES_MAX
from madns_runtime.recording.newest_values import (
    AGENTS_TOLD_MAX,
    NewestValues,
    clean_values,
    told_columns,
)
from madns_runtime.recording.record_files import RecordFiles
from madns_runtime.recording.recorder import Recorder
from madns_runtime.recording.records import Field, StreamSchema

DRIVE = StreamSchema("drive", (Field("tick", "", "int"), Field("speed_m_s", "m/s")))
GEAR = StreamSchema("gear", (Field("gear", "", "str"),), shape="object")


@pytest.fixture
def files(tmp_path):
    return RecordFiles(tmp_path, run="0001-test", source="a")


@pytest.fixture
def recorder(files):
    recorder = Recorder(files, Recording())
    recorder.open_stream(DRIVE)
    recorder.open_stream(GEAR)
    return recorder


def test_newest_record_is_told_whether_it_waits_or_is_on_the_disk(recorder, files):
    values = NewestValues(recorder, ("drive.speed_m_s", "gear.gear"))
    assert values.read() == [None, None]

    recorder.record("drive", (0, 1.5))
    recorder.record("drive", (1, 2.5))
    recorder.record("gear", {"gear": "first"})
    assert values.read() == [2.5, "first"]

    files.write_waiting()
    assert values.read() == [2.5, "first"]
    recorder.record("drive", (2, float("nan")))
    assert values.read() == [None, "first"]


def test_a_stream_or_field_that_the_run_lacks_has_no_value(recorder):
    recorder.record("drive", (0, 1.5))

    assert NewestValues(recorder, ("radar.range_m", "drive.range_m")).read() == [None, None]


@pytest.mark.parametrize(
    ("told", "kept"),
    [
        ([1, 2.5, "x" * 99], [1, 2.5, "x" * 16]),
        ([float("inf"), 2**60, {"a": 1}], [None, None, None]),
        ([1], [1, None, None]),
        ([1, 2, 3, 4], [1, 2, 3]),
        ("abc", [None, None, None]),
        (None, [None, None, None]),
    ],
)
def test_values_from_elsewhere_are_bounded_numbers_and_texts(told, kept):
    assert clean_values(told, 3) == kept


def test_as_many_columns_as_are_allowed_fit_a_datagram_whatever_their_values():
    values = clean_values(["\N{GRINNING FACE}" * 99] * COLUMNS_MAX)
    counts = dict.fromkeys(("ticks", "missed", "dropped", "lost"), 2**60)
    floats = dict.fromkeys(("late_p50_us", "late_p99_us", "rtf"), 1.5)
    problem = "\N{GRINNING FACE}" * 200

    ping = Ping(1.0, {**counts, **floats, "problem": problem, "columns": values})

    assert len(encode_message(ping)) < DATAGRAM_BYTES_MAX - 200


def test_progress_tells_of_a_bounded_number_of_agents_and_counts_the_others():
    agents = [(f"agent-{number}", [number]) for number in range(AGENTS_TOLD_MAX + 5)]

    told = told_columns(("drive.tick",), agents)

    assert len(told["values"]) == AGENTS_TOLD_MAX
    assert told["values"]["agent-7"] == [7]
    assert told["values_left_out"] == 5
    assert told_columns((), agents) == {}
