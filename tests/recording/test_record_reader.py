import json
import math
import os
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from madns_runtime.config import Recording
from madns_runtime.errors import MachineError
from madns_runtime.lockstep.recorder import DirectWriter
from madns_runtime.recording import reader
from madns_runtime.recording.reader import read_columns, read_stream
from madns_runtime.recording.record_files import RecordFiles
from madns_runtime.recording.recorder import Recorder
from madns_runtime.recording.records import EVENTS, TICKS, Field, StreamSchema

MIXED = StreamSchema(
    "mixed",
    (
        Field("n", "", "int"),
        Field("x_m", "m"),
        Field("name", "", "str"),
        Field("ok", "", "bool"),
        Field("r_m", "m", "json"),
    ),
)


def record(directory, schema, rows, *, t0_utc=None):
    settings = Recording(buffer_bytes=1 << 24)
    recorder = Recorder(RecordFiles(directory, run="0001-test", source="a"), settings)
    recorder.open_stream(schema)
    if t0_utc:
        recorder.set_t0(t0_utc)
    for row in rows:
        recorder.record(schema.name, row)
    recorder.close(30)
    return directory / f"{schema.name}.jsonl"


def make_ticks(count):
    return [[index, 50 + index % 7, 9000 - index % 11, index % 2] for index in range(count)]


def assert_columns_are(columns, rows):
    for position, name in enumerate(("tick", "lateness_us", "margin_us", "missed")):
        assert columns[name].tolist() == [row[position] for row in rows]


@pytest.fixture
def small_blocks(monkeypatch):
    monkeypatch.setattr(reader, "BLOCK_BYTES", 97)


def test_whole_stream_is_read_back(tmp_path):
    rows = make_ticks(10)
    reading = read_stream(record(tmp_path, TICKS, rows, t0_utc="2026-01-02T03:04:05Z"))

    assert list(reading.records()) == rows
    assert reading.schema["stream"] == "ticks"
    assert reading.field_names == ("tick", "lateness_us", "margin_us", "missed")
    assert reading.state == reader.StreamState(
        records=10, is_cut=False, recorded=10, t0_utc="2026-01-02T03:04:05Z"
    )


def test_lines_that_are_no_records_are_those_of_which_the_guide_tells(tmp_path):
    files = RecordFiles(tmp_path, run="0001-test", source="a")
    recorder = Recorder(files, Recording(), DirectWriter(files))
    recorder.open_stream(TICKS)
    for row in make_ticks(2):
        recorder.record("ticks", row)
        recorder.flush()
        recorder.set_t0("2026-01-02T03:04:05Z")
    recorder.close(30)
    guide = (Path(__file__).parents[2] / "docs/plugins.md").read_text()

    lines = [json.loads(line) for line in (tmp_path / "ticks.jsonl").read_text().splitlines()]

    assert [type(line) for line in lines] == [dict, list, dict, list, dict]
    assert [[*line] for line in (lines[2], lines[4])] == [["t0_utc"], ["end"]]
    assert '`{"t0_utc": ...}`' in guide
    assert '`{"end": {"records": ...}}`' in guide


def test_state_is_known_without_asking_for_the_records(tmp_path):
    assert read_stream(record(tmp_path, TICKS, make_ticks(7))).state.records == 7


def test_object_stream_is_read_back(tmp_path):
    events = [
        {"t_s": 1.0, "utc": "u", "event": "lost", "agent": "a"},
        {"t_s": 2.0, "utc": "u", "event": "end"},
    ]
    reading = read_stream(record(tmp_path, EVENTS, events))

    assert list(reading.records()) == events
    assert not reading.state.is_cut


def test_stream_of_many_blocks_is_the_same(tmp_path, small_blocks):
    rows = make_ticks(200)
    path = record(tmp_path, TICKS, rows)

    assert list(read_stream(path).records()) == rows
    assert_columns_are(read_columns(path), rows)
    assert read_stream(path).state.records == 200
    assert len(list(read_stream(path).chunks())) > 10


def test_counts_of_the_end_line_are_told(tmp_path):
    recorder = Recorder(RecordFiles(tmp_path, run="r", source="a"), Recording(buffer_bytes=65_536))
    recorder.open_stream(TICKS)
    for row in make_ticks(2000):
        recorder.record("ticks", row)
    dropped = recorder.close(30).dropped

    state = read_stream(tmp_path / "ticks.jsonl").state
    assert dropped > 0
    assert (state.dropped, state.records, state.recorded) == (
        dropped,
        2000 - dropped,
        2000 - dropped,
    )


@pytest.mark.parametrize("schema", [TICKS, EVENTS], ids=["array", "object"])
def test_file_cut_anywhere_in_its_end_gives_every_whole_record(tmp_path, schema):
    rows = [(index, 1.5, "e", 4)[: len(schema.fields)] for index in range(6)]
    if schema is EVENTS:
        rows = [(float(index), "u", "e") for index in range(6)]
    path = record(tmp_path, schema, rows)
    text = path.read_bytes()
    line_ends = [index + 1 for index, octet in enumerate(text) if octet == ord("\n")]
    whole = list(read_stream(path).records())
    cut_path = tmp_path / "cut.jsonl"
    for size in range(line_ends[4], len(text)):  # from within the last two records to the end line
        cut_path.write_bytes(text[:size])
        # A record is whole without its newline: its closing bracket says so.
        lines = sum(end - 1 <= size for end in line_ends)
        is_whole = size in line_ends or size + 1 in line_ends
        expected = whole[: lines - 1]
        state = read_stream(cut_path).state

        assert list(read_stream(cut_path).records()) == expected
        assert state.records == len(expected)
        assert state.truncated_lines == (0 if is_whole else 1)
        assert state.damaged == 0
        assert state.is_cut == (lines < len(line_ends))
        assert [len(column) for column in read_columns(cut_path).values()] == [len(expected)] * len(
            schema.fields
        )


def test_file_cut_in_its_first_line_is_told(tmp_path):
    path = record(tmp_path, TICKS, make_ticks(3))
    first = path.read_bytes().index(b"\n")
    for size in (1, first // 2, first - 1):
        path.write_bytes(path.read_bytes()[:size])
        reading = read_stream(path)

        assert (dict(reading.schema), list(reading.records())) == ({}, [])
        assert (reading.state.is_cut, reading.state.truncated_lines) == (True, 1)
        assert read_columns(path) == {}


def test_empty_file_is_a_cut_one(tmp_path):
    (tmp_path / "ticks.jsonl").write_bytes(b"")
    reading = read_stream(tmp_path / "ticks.jsonl")

    assert reading.state == reader.StreamState()
    assert list(reading.records()) == []


@pytest.mark.parametrize(
    "broken",
    [
        b"[1,2,3",
        b"[1,2,3]",
        b"[1,2,3,4,5]",
        b"",
        b"\0\0\0\0",
        b"[1,2,3,4],[5,6,7,8]",
        b'{"tick":1}',
        b"[1,2,3,4]]",
        b"7",
        b"\xff\xfe",
        b'{"end":3}',
    ],
)
def test_broken_line_in_the_middle_is_skipped_and_counted(tmp_path, broken):
    rows = make_ticks(4)
    path = record(tmp_path, TICKS, rows)
    lines = path.read_bytes().split(b"\n")
    path.write_bytes(b"\n".join([*lines[:3], broken, *lines[3:]]))

    assert list(read_stream(path).records()) == rows
    assert_columns_are(read_columns(path), rows)
    state = read_stream(path).state
    assert (state.damaged, state.truncated_lines, state.is_cut) == (1, 0, False)


def test_line_torn_in_two_is_not_mistaken_for_a_record(tmp_path):
    path = record(tmp_path, TICKS, make_ticks(4))
    path.write_bytes(path.read_bytes().replace(b"[1,51,8999,1]", b"[1,51\n8999,1]"))

    assert list(read_stream(path).records()) == [make_ticks(4)[i] for i in (0, 2, 3)]
    assert read_stream(path).state.damaged == 2


def test_two_damaged_widths_that_make_up_for_each_other_are_seen(tmp_path):
    path = record(tmp_path, TICKS, make_ticks(4))
    text = path.read_bytes()
    text = text.replace(b"[1,51,8999,1]", b"[1,51,89991]").replace(
        b"[2,52,8998,0]", b"[2,52,8,99,0]"
    )
    path.write_bytes(text)

    assert_columns_are(read_columns(path), [make_ticks(4)[i] for i in (0, 3)])
    assert read_stream(path).state.damaged == 2


def test_line_without_end_is_not_held_in_memory(tmp_path, monkeypatch, small_blocks):
    monkeypatch.setattr(reader, "LINE_BYTES_MAX", 1000)
    rows = make_ticks(4)
    path = record(tmp_path, TICKS, rows)
    lines = path.read_bytes().split(b"\n")
    path.write_bytes(b"\n".join([*lines[:3], b"\0" * 50_000, *lines[3:]]))

    assert list(read_stream(path).records()) == rows
    assert read_stream(path).state.damaged == 1


def test_stream_without_a_first_line_gives_no_records(tmp_path):
    path = record(tmp_path, TICKS, make_ticks(3))
    path.write_bytes(path.read_bytes().split(b"\n", 1)[1])
    reading = read_stream(path)

    assert list(reading.records()) == []
    assert reading.state.damaged == 3


def test_missing_file_is_named(tmp_path):
    with pytest.raises(MachineError, match=r"none\.jsonl: cannot be read"):
        read_stream(tmp_path / "none.jsonl")


def test_columns_have_the_kinds_of_their_fields(tmp_path):
    rows = [(1, 1.5, "a", True, [1, 2]), (2, float("nan"), "b", False, None)]
    columns = read_columns(record(tmp_path, MIXED, rows))

    kinds = {name: column.dtype for name, column in columns.items()}
    assert kinds == {
        "n": np.int64,
        "x_m": np.float64,
        "name": object,
        "ok": np.bool_,
        "r_m": object,
    }
    assert columns["n"].tolist() == [1, 2]
    assert columns["x_m"][0] == 1.5
    assert math.isnan(columns["x_m"][1])
    assert columns["r_m"].tolist() == [[1, 2], None]


def test_columns_of_an_empty_stream_are_empty_and_of_their_kind(tmp_path):
    columns = read_columns(record(tmp_path, MIXED, []))

    assert {name: (len(c), c.dtype) for name, c in columns.items()} == {
        "n": (0, np.int64),
        "x_m": (0, np.float64),
        "name": (0, np.dtype(object)),
        "ok": (0, np.bool_),
        "r_m": (0, np.dtype(object)),
    }


def test_whole_numbers_with_gaps_or_fractions_become_floats(tmp_path):
    rows = [(1, 2, 3, 4), (None, 2.5, 3, 4)]
    columns = read_columns(record(tmp_path, TICKS, rows))

    assert math.isnan(columns["tick"][1])
    assert columns["lateness_us"].tolist() == [2.0, 2.5]
    assert columns["margin_us"].dtype == np.int64


def test_large_whole_numbers_are_exact(tmp_path):
    rows = [((1 << 62) + 1, 2, 3, 4), ((1 << 62) + 2, 2, 3, 4)]

    assert read_columns(record(tmp_path, TICKS, rows))["tick"].tolist() == [row[0] for row in rows]


def test_columns_of_events_hold_none_where_a_field_is_absent(tmp_path):
    path = record(tmp_path, EVENTS, [(1.0, "u", "a"), (2.0, "u", "b")])
    path.write_bytes(path.read_bytes().replace(b'"event":"b"', b'"other":"b"'))
    columns = read_columns(path)

    assert columns["t_s"].tolist() == [1.0, 2.0]
    assert columns["event"].tolist() == ["a", None]


def read_line_by_line(path):
    """What a plain reader makes of a ticks file: the measure for the quick one."""
    rows = []
    for line in path.read_bytes().split(b"\n")[1:]:
        try:
            value = json.loads(line.decode("utf-8"), parse_constant=_refuse)
        except ValueError:
            continue
        if isinstance(value, list) and len(value) == 4:
            rows.append(value)
    return rows


def _refuse(text):
    raise ValueError(text)


@pytest.mark.slow
@settings(
    max_examples=300, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(
    count=st.integers(0, 30),
    hits=st.lists(
        st.tuples(st.integers(0, 10_000), st.sampled_from(list(b'0,.[]{}"\n-e \x00'))), max_size=4
    ),
    cut=st.integers(0, 60),
)
def test_damaged_columns_are_what_a_plain_reader_reads(tmp_path_factory, count, hits, cut):
    path = tmp_path_factory.mktemp("damage")
    path = record(path, TICKS, make_ticks(count))
    text = bytearray(path.read_bytes())
    first = text.index(b"\n") + 1
    for place, octet in hits:
        text[first + place % (len(text) - first)] = octet
    path.write_bytes(text[: max(first, len(text) - cut)])
    expected = read_line_by_line(path)

    assert list(read_stream(path).records()) == expected
    columns = read_columns(path)
    got = [list(row) for row in zip(*(column.tolist() for column in columns.values()), strict=True)]
    assert got == expected or any(not isinstance(v, int) for row in expected for v in row)
    assert len(got) == len(expected)


HEADER = '{"schema":1,"stream":"own","shape":"array","fields":%s}'
GOOD = HEADER % '[{"name":"a","kind":"float"}]'


@pytest.mark.parametrize(
    "line",
    [
        HEADER % "3",
        HEADER % '["a"]',
        HEADER % '[{"name":"a"}]',
        HEADER % '[{"name":[],"kind":"float"}]',
        HEADER % '[{"name":"a","kind":"float"},{"name":"a","kind":"int"}]',
        HEADER % "null",
        "7",
        "[]",
    ],
)
def test_a_damaged_header_makes_a_file_without_schema_not_an_error(tmp_path, line):
    path = tmp_path / "own.jsonl"
    path.write_text(line + "\n[1.5]\n")
    reading = read_stream(path)

    assert (dict(reading.schema), list(reading.records())) == ({}, [])
    assert read_columns(path) == {}


@pytest.mark.parametrize(
    "end",
    [
        "3",
        "{}",
        '{"records":1,"dropped":"x","not_finite":0}',
        '{"records":1,"dropped":-3,"not_finite":0}',
        '{"records":1}',
        "null",
    ],
)
def test_a_damaged_end_line_ends_nothing(tmp_path, end):
    path = tmp_path / "own.jsonl"
    path.write_text(f'{GOOD}\n[1.5]\n{{"end":{end}}}\n')
    reading = read_stream(path)

    assert list(reading.records()) == [[1.5]]
    assert (reading.state.is_cut, reading.state.truncated_lines) == (True, 1)


@pytest.mark.timeout(60)
def test_pipe_in_the_place_of_a_stream_is_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "ticks.jsonl")

    with pytest.raises(MachineError, match="expected a file, got a pipe"):
        read_stream(tmp_path / "ticks.jsonl")
