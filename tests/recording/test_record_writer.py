import errno
import json
import os
import random
import threading
import time
from array import array
from collections import ChainMap, UserDict, UserList, deque
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from types import MappingProxyType, SimpleNamespace
from typing import NamedTuple

import numpy as np
import pytest
from harness.waiting import wait_until
from hypothesis import given, settings
from hypothesis import strategies as st

from cosmos_cli.onboard import log_tail
from madns_runtime.config import Recording
from madns_runtime.errors import MachineError, PluginError
from madns_runtime.lockstep.recorder import DirectWriter
from madns_runtime.recording import run_journal, stream_file
from madns_runtime.recording.reader import read_stream
from madns_runtime.recording.record_files import RecordFiles
from madns_runtime.recording.recorder import Recorder
from madns_runtime.recording.records import EVENTS, TICKS, Field, StreamSchema
from madns_runtime.recording.run_journal import RunJournal

PAIR = StreamSchema("pair", (Field("number", "", "int"), Field("value_m", "m")))


def make_recorder(directory, *, incarnation=1, **values):
    chosen = Recording(**{"flush_interval_s": 0.05, **values})
    files = RecordFiles(directory, run="0001-test", source="a", incarnation=incarnation)
    return Recorder(files, chosen)


def make_journal(directory, *, verbosity=3):
    return RunJournal(make_recorder(directory), verbosity, t_s=lambda: None)


def read_lines(path):
    return [json.loads(line) for line in path.read_text().splitlines()]


def test_file_has_schema_first_then_records_then_end(tmp_path):
    recorder = make_recorder(tmp_path)
    recorder.open_stream(TICKS)
    recorder.start()
    recorder.record("ticks", (0, 12, 900, 0))
    recorder.record("ticks", [1, 13, 901, 0])
    counts = recorder.close(30)

    header, *records, end = read_lines(tmp_path / "ticks.jsonl")
    assert header == TICKS.header(run="0001-test", source="a", t0_utc=None)
    assert records == [[0, 12, 900, 0], [1, 13, 901, 0]]
    assert end == {"end": {"records": 2, "dropped": 0, "not_finite": 0}}
    assert (counts.written, counts.dropped, counts.errors) == (2, 0, ())
    assert counts.bytes == (tmp_path / "ticks.jsonl").stat().st_size


def test_stream_without_records_has_schema_and_end(tmp_path):
    recorder = make_recorder(tmp_path)
    recorder.open_stream(TICKS)
    recorder.close(30)

    assert [next(iter(line)) for line in read_lines(tmp_path / "ticks.jsonl")] == ["schema", "end"]


def test_first_line_carries_t0_where_it_is_known_in_time(tmp_path):
    recorder = make_recorder(tmp_path)
    recorder.open_stream(TICKS)
    recorder.set_t0("2026-01-02T03:04:05Z")
    recorder.close(30)

    header, _ = read_lines(tmp_path / "ticks.jsonl")
    assert header["t0_utc"] == "2026-01-02T03:04:05Z"


def test_later_t0_is_a_line_of_its_own_in_every_stream_once(tmp_path):
    recorder = make_recorder(tmp_path)
    recorder.open_stream(TICKS)
    recorder.open_stream(EVENTS)
    recorder.start()
    wait_until(lambda: all(s.bytes for s in recorder.counts().streams.values()))
    recorder.set_t0("2026-01-02T03:04:05Z")
    recorder.record("ticks", (0, 0, 0, 0))
    recorder.close(30)

    for name in ("ticks", "events"):
        lines = read_lines(tmp_path / f"{name}.jsonl")
        assert lines[0]["t0_utc"] is None
        assert lines.count({"t0_utc": "2026-01-02T03:04:05Z"}) == 1
        assert read_stream(tmp_path / f"{name}.jsonl").state.t0_utc == "2026-01-02T03:04:05Z"


def test_t0_line_is_no_record_in_the_counts(tmp_path):
    recorder = make_recorder(tmp_path)
    recorder.open_stream(TICKS)
    recorder.start()
    wait_until(lambda: recorder.counts().bytes)
    recorder.set_t0("2026-01-02T03:04:05Z")

    assert recorder.close(30).written == 0


@pytest.mark.parametrize(
    ("existing", "incarnation", "expected"),
    [
        ([], 1, "ticks.jsonl"),
        (["ticks.jsonl"], 1, "ticks.2.jsonl"),
        (["ticks.jsonl", "ticks.2.jsonl"], 1, "ticks.3.jsonl"),
        (["ticks.jsonl"], 2, "ticks.2.jsonl"),
        (["ticks.2.jsonl"], 2, "ticks.3.jsonl"),
    ],
)
def test_existing_file_is_left_alone(tmp_path, existing, incarnation, expected):
    for name in existing:
        (tmp_path / name).write_text("precious")
    recorder = make_recorder(tmp_path, incarnation=incarnation)
    recorder.open_stream(TICKS)
    counts = recorder.close(30)

    assert counts.streams["ticks"].file == expected
    assert read_lines(tmp_path / expected)[0]["stream"] == "ticks"
    assert all((tmp_path / name).read_text() == "precious" for name in existing)


def test_all_streams_of_one_recorder_begin_at_the_number_of_its_first(tmp_path):
    other = StreamSchema("own", (Field("x"),))
    for streams in ((TICKS,), (TICKS, other), (TICKS, other)):
        recorder = make_recorder(tmp_path)
        for schema in streams:
            recorder.open_stream(schema)
        recorder.close(30)

    assert {path.name for path in tmp_path.glob("own*")} == {"own.2.jsonl", "own.3.jsonl"}


@pytest.mark.parametrize("name", ["../ticks", "a/b", "", ".hidden", "a.b", "x" * 65])
def test_stream_name_that_is_no_file_name_is_refused(tmp_path, name):
    recorder = make_recorder(tmp_path)

    with pytest.raises(PluginError, match="expected a name"):
        recorder.open_stream(StreamSchema(name, (Field("x"),)))
    assert list(tmp_path.iterdir()) == []


def test_stream_declared_twice_is_refused(tmp_path):
    recorder = make_recorder(tmp_path)
    recorder.open_stream(PAIR)

    with pytest.raises(PluginError, match="stream pair: declared twice"):
        recorder.open_stream(PAIR)


@pytest.mark.parametrize(
    "fields", [(), (Field("x"), Field("x"))], ids=["no fields", "two of one name"]
)
def test_unfit_fields_are_refused(tmp_path, fields):
    with pytest.raises(PluginError, match="distinct names"):
        make_recorder(tmp_path).open_stream(StreamSchema("s", fields))


@pytest.mark.parametrize("field", ["x", Field("x", "", "double")])
def test_fields_of_no_kind_are_refused(tmp_path, field):
    with pytest.raises(PluginError, match=r"stream s: expected fields of kind float, int, .* got "):
        make_recorder(tmp_path).open_stream(StreamSchema("s", (field,)))


@pytest.mark.parametrize(
    "field",
    [Field("t_s", "ms"), Field("t_s", "", "int"), Field("tick", "s"), Field("tick", "ms", "int")],
)
def test_a_time_or_a_tick_in_another_unit_is_refused(tmp_path, field):
    told = rf"stream s: {field.name} is .*, got unit '{field.unit}'; call .* otherwise"
    with pytest.raises(PluginError, match=told):
        make_recorder(tmp_path).open_stream(StreamSchema("s", (field,)))


@pytest.mark.parametrize(
    "field", [Field("t_s", "", "str"), Field("tick", "1"), Field("t_ms", "ms")]
)
def test_what_is_no_simulated_time_has_any_unit(tmp_path, field):
    make_recorder(tmp_path).open_stream(StreamSchema("s", (field,)))


def test_single_field_that_reads_as_another_kind_of_line_is_refused(tmp_path):
    schema = StreamSchema("s", (Field("end", "", "int"),), shape="object")

    with pytest.raises(PluginError, match="may not be named end"):
        make_recorder(tmp_path).open_stream(schema)


def test_an_object_has_no_field_of_the_name_under_which_tables_keep_what_stands_beside(tmp_path):
    fields = (Field("t_s", "s"), Field("details", "", "json"))
    RecordFiles(tmp_path, run="r", source="a").create_stream(StreamSchema("rows", fields))

    with pytest.raises(PluginError, match="have no field details.*choose another name"):
        RecordFiles(tmp_path, run="r", source="a").create_stream(
            StreamSchema("contacts", fields, shape="object")
        )
    assert not (tmp_path / "contacts.jsonl").exists()


def test_directory_that_cannot_be_made_is_the_machines_fault(tmp_path):
    (tmp_path / "file").write_text("")

    with pytest.raises(MachineError, match="cannot record there"):
        make_recorder(tmp_path / "file" / "below")


def test_stream_that_cannot_be_created_is_the_machines_fault(tmp_path):
    recorder = make_recorder(tmp_path / "gone")
    (tmp_path / "gone").rmdir()

    with pytest.raises(MachineError, match=r"ticks\.jsonl: cannot record there"):
        recorder.open_stream(TICKS)


def test_unknown_stream_is_named_with_the_known_ones(tmp_path):
    recorder = make_recorder(tmp_path)
    recorder.open_stream(PAIR)

    with pytest.raises(PluginError, match=r"unknown stream 'pear'; declared are: pair"):
        recorder.record("pear", (1, 2.0))


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ((1,), r"stream pair: expected 2 values \(number, value_m\), got 1"),
        ((1, 2.0, 3.0), "got 3"),
        (np.zeros(3), "got 3"),
        ({"number": 1}, "missing value_m"),
        ({"number": 1, "value_m": 2.0, "extra": 3, "more": 4}, "unknown extra, more"),
        ("ab", "expected one value per field, got str"),
        ((1, object()), "stream pair: value 1: object has no JSON form"),
        ((1 << 70, 1.0), "stream pair: value 0"),
        ({"number": 1, "value_m": b"x"}, "value 1: bytes has no JSON form"),
    ],
)
def test_unfit_values_are_refused_by_name(tmp_path, values, message):
    recorder = make_recorder(tmp_path)
    recorder.open_stream(PAIR)

    with pytest.raises(PluginError, match=message):
        recorder.record("pair", values)
    assert recorder.close(30).written == 0


@pytest.mark.parametrize(
    "values",
    [
        (1, 2.5),
        [1, 2.5],
        {"value_m": 2.5, "number": 1},
        (np.int32(1), np.float64(2.5)),
        np.array([1, 2.5]),
        np.array([1, 0, 2.5, 0])[::2],
    ],
    ids=repr,
)
def test_numbers_of_any_make_are_the_same_record(tmp_path, values):
    recorder = make_recorder(tmp_path)
    recorder.open_stream(PAIR)
    recorder.record("pair", values)
    recorder.close(30)

    assert read_lines(tmp_path / "pair.jsonl")[1] == [1, 2.5]


def test_array_within_a_record_is_a_list(tmp_path):
    recorder = make_recorder(tmp_path)
    recorder.open_stream(StreamSchema("state", (Field("t_s", "s"), Field("r_m", "m", "json"))))
    recorder.record("state", (0.5, np.arange(6.0).reshape(2, 3)[:, ::2]))
    recorder.close(30)

    assert read_lines(tmp_path / "state.jsonl")[1] == [0.5, [[0.0, 2.0], [3.0, 5.0]]]


def test_event_carries_details_beside_its_fields(tmp_path):
    recorder = make_recorder(tmp_path)
    recorder.open_stream(EVENTS)
    event = {"t_s": 1.0, "utc": "u", "event": "lost", "agent": "a-7"}
    recorder.record("events", event)
    recorder.record("events", (2.0, "u", "end"))
    recorder.close(30)

    expected = [event, {"t_s": 2.0, "utc": "u", "event": "end"}]
    assert read_lines(tmp_path / "events.jsonl")[1:-1] == expected


def test_event_without_a_field_is_refused(tmp_path):
    recorder = make_recorder(tmp_path)
    recorder.open_stream(EVENTS)

    with pytest.raises(PluginError, match="stream events: missing utc, event"):
        recorder.record("events", {"t_s": 1.0})


def test_values_that_are_not_finite_are_null_and_counted(tmp_path):
    recorder = make_recorder(tmp_path)
    recorder.open_stream(StreamSchema("s", (Field("a"), Field("b", "", "json"))))
    recorder.record("s", (float("nan"), [1.0, float("inf"), np.float32("-inf")]))
    recorder.record("s", (None, "null"))
    recorder.record("s", (1.0, {"x": np.array([np.nan, 2.0, np.inf]), "i": np.array([1])}))
    counts = recorder.close(30)

    assert counts.not_finite == 5
    assert read_lines(tmp_path / "s.jsonl")[-1]["end"]["not_finite"] == 5
    assert read_lines(tmp_path / "s.jsonl")[1] == [None, [1.0, None, None]]


NAN = float("nan")


@dataclass
class Attitude:
    rate_rad_s: float
    _kept: float = NAN
    named: float = 1.0


@dataclass(slots=True)
class Slotted:
    rate_rad_s: float
    _kept: float = NAN


@dataclass
class Heir(Slotted):
    more: float = NAN


class Level(Enum):
    NONE = NAN


class Row(NamedTuple):
    value_m: float


class Lines(list):
    """A list with a name."""


ROWS = np.array([(NAN, 1), (2.0, 3)], dtype="f8,i4")
MASKED = np.ma.masked_array([NAN, 1.0, NAN], [False, False, True])
NOT_FINITE = {
    "float": (NAN, 1),
    "infinity": (float("-inf"), 1),
    "half": (np.float16("nan"), 1),
    "single": (np.float32("inf"), 1),
    "double": (np.float64("nan"), 1),
    "list": ([NAN, 1.0, [float("inf")]], 2),
    "list with a name": (Lines([NAN]), 1),
    "tuple": ((NAN, None), 1),
    "named tuple": (Row(NAN), 1),
    "mapping": ({"a": NAN, "b": "null"}, 1),
    "mapping proxy": (MappingProxyType({"a": [NAN]}), 1),
    "chained mappings": (ChainMap({"a": NAN}, {"b": NAN}), 2),
    "user mapping": (UserDict(a=NAN), 1),
    "user list": (UserList([NAN]), 1),
    "deque": (deque([NAN, NAN]), 2),
    "machine array": (array("d", [NAN, 1.0]), 1),
    "dataclass": (Attitude(NAN), 1),
    "dataclass with slots": (Slotted(NAN), 1),
    "dataclass that inherits slots": (Heir(NAN), 1),
    "dataclasses in a list": ([Attitude(NAN), {"a": Slotted(NAN)}], 2),
    "enumeration": (Level.NONE, 1),
    "array": (np.array([[NAN, 1.0], [np.inf, NAN]]), 3),
    "array of one number": (np.array(NAN), 1),
    "array of halves": (np.array([NAN], np.float16), 1),
    "array with strides": (np.full(4, NAN)[::2], 2),
    "array of objects": (np.array([NAN, None, [np.inf], "a"], object), 2),
    "array of rows": (ROWS, 1),
    "row": (ROWS[0], 1),
    "array with a mask": (MASKED, 1),
    "finite": ([1.0, None, "null", range(2), np.float32(1), True, Slotted(1.0)], 0),
}


@pytest.mark.parametrize("kind", list(NOT_FINITE))
def test_every_kind_of_value_that_is_written_is_looked_into_for_nan(tmp_path, kind):
    value, count = NOT_FINITE[kind]
    recorder = make_recorder(tmp_path)
    recorder.open_stream(StreamSchema("s", (Field("a"), Field("b", "", "json"))))
    recorder.record("s", (None, value))
    counts = recorder.close(30)

    assert counts.written == 1
    assert counts.not_finite == count


def test_what_has_no_json_form_is_refused_and_not_counted(tmp_path):
    recorder = make_recorder(tmp_path)
    recorder.open_stream(StreamSchema("s", (Field("a", "", "json"),)))
    for value in ({NAN}, np.longdouble("nan"), np.complex128(NAN), b"null", iter([NAN])):
        with pytest.raises(PluginError, match="stream s: value"):
            recorder.record("s", ([None, value],))

    assert recorder.close(30).not_finite == 0


def test_what_does_not_fit_the_buffer_is_counted(tmp_path):
    recorder = make_recorder(tmp_path, buffer_bytes=65_536)
    recorder.open_stream(PAIR)
    recorder.open_stream(EVENTS)
    for number in range(2000):
        recorder.record("pair", (number, 0.5))
    recorder.record("events", (0.0, "u", "e"))
    counts = recorder.close(30)

    pair = counts.streams["pair"]
    assert pair.written + pair.dropped == 2000
    assert 0 < pair.dropped < 2000
    assert (counts.streams["events"].written, counts.streams["events"].dropped) == (0, 1)
    lines = read_lines(tmp_path / "pair.jsonl")
    assert lines[1:-1] == [[number, 0.5] for number in range(pair.written)]
    assert lines[-1]["end"] == {"records": pair.written, "dropped": pair.dropped, "not_finite": 0}


def test_written_records_make_room_in_the_buffer(tmp_path):
    recorder = make_recorder(tmp_path, buffer_bytes=65_536)
    recorder.open_stream(PAIR)
    recorder.start()
    for number in range(5000):
        recorder.record("pair", (number, 0.5))
        if number % 250 == 0:
            wait_until(lambda n=number: recorder.counts().written > n)

    assert recorder.close(30).to_mapping()["written"] == 5000


def test_writer_is_woken_before_the_smallest_buffer_is_full(tmp_path):
    woken = []
    writer = SimpleNamespace(start=lambda: None, flush=lambda: woken.append(1))
    files = RecordFiles(tmp_path, run="0001-test", source="a")
    recorder = Recorder(files, Recording(buffer_bytes=65_536), writer)
    recorder.open_stream(PAIR)
    while not woken:
        recorder.record("pair", (1, 0.5))
        assert recorder.counts().dropped == 0


@pytest.mark.parametrize("text", ["short", "t" * 40_000, "t" * 65_000])
def test_who_may_wait_for_the_disk_loses_nothing_that_the_buffer_holds(tmp_path, text):
    said = StreamSchema("said", (Field("number", "", "int"), Field("text", "", "str")))
    files = RecordFiles(tmp_path, run="0001-test", source="a")
    recorder = Recorder(files, Recording(buffer_bytes=65_536), DirectWriter(files))
    recorder.open_stream(said)
    for number in range(2000 if text == "short" else 20):
        recorder.record("said", (number, text))
    counts = recorder.close(30)

    numbers = [number for number, _ in read_lines(tmp_path / "said.jsonl")[1:-1]]
    assert counts.dropped == 0
    assert numbers == list(range(counts.written))


def test_record_after_close_is_dropped(tmp_path):
    recorder = make_recorder(tmp_path)
    recorder.open_stream(PAIR)
    recorder.close(30)
    recorder.record("pair", (1, 2.0))

    assert recorder.counts().dropped == 1


def test_closing_twice_gives_the_same_counts(tmp_path):
    recorder = make_recorder(tmp_path)
    recorder.open_stream(PAIR)
    recorder.record("pair", (1, 2.0))

    assert recorder.close(30) == recorder.close(30)


def test_counts_are_a_plain_mapping(tmp_path):
    recorder = make_recorder(tmp_path)
    recorder.open_stream(PAIR)
    recorder.record("pair", (1, 2.0))
    mapping = recorder.close(30).to_mapping()

    size = (tmp_path / "pair.jsonl").stat().st_size
    stream = {"file": "pair.jsonl", "written": 1, "dropped": 0, "not_finite": 0, "bytes": size}
    totals = {"written": 1, "dropped": 0, "not_finite": 0, "bytes": size, "errors": []}
    assert mapping == {**totals, "streams": {"pair": stream}}


@pytest.mark.parametrize(
    ("verbosity", "expected"),
    [
        (0, []),
        (1, ["critical"]),
        (2, ["critical", "error"]),
        (3, ["critical", "error", "warning"]),
        (4, ["critical", "error", "warning", "info"]),
        (5, ["critical", "error", "warning", "info", "debug"]),
    ],
)
def test_verbosity_decides_what_is_logged(tmp_path, verbosity, expected):
    journal = make_journal(tmp_path, verbosity=verbosity)
    for level in ("critical", "error", "warning", "info", "debug"):
        journal.log(level, f"a {level}", 1.5)
    journal.close(30)

    records = read_lines(tmp_path / "log.jsonl")[1:-1]
    assert [record["level"] for record in records] == expected
    assert all(record["t_s"] == 1.5 and record["utc"].endswith("Z") for record in records)


@pytest.mark.parametrize(
    ("level", "told"),
    [("warn", "'warn'"), (["info"], r"\['info'\]"), ({}, "{}"), ("w" * 1000, "'w{79}")],
)
def test_unknown_level_is_refused(tmp_path, level, told):
    with pytest.raises(PluginError, match=f"unknown log level {told}; expected one of critical"):
        make_journal(tmp_path).log(level, "x", None)


def test_log_takes_text_that_is_no_unicode(tmp_path):
    journal = make_journal(tmp_path)
    journal.log("error", "no such file: \udcff", None)
    journal.close(30)

    assert read_lines(tmp_path / "log.jsonl")[1]["text"] == "no such file: \\udcff"


def test_close_returns_in_time_though_the_disk_hangs(tmp_path, monkeypatch):
    is_released = threading.Event()
    monkeypatch.setattr(stream_file.os, "write", lambda fd, data: is_released.wait(60) and 0)
    recorder = make_recorder(tmp_path)
    recorder.open_stream(PAIR)
    try:
        counts = recorder.close(0.1)
    finally:
        monkeypatch.undo()
        is_released.set()

    assert "records not on disk after 0.1 s" in counts.errors[0]
    recorder.close(30)


def test_failing_disk_is_told_first_and_latest_and_not_tried_without_pause(tmp_path, monkeypatch):
    calls = []

    def refuse(fd, data):
        calls.append(len(data))
        raise OSError(errno.EIO if len(calls) == 1 else errno.EDQUOT, f"refusal {len(calls)}")

    recorder = make_recorder(tmp_path, buffer_bytes=65_536)
    recorder.open_stream(PAIR)
    monkeypatch.setattr(stream_file.os, "write", refuse)
    recorder.record("pair", (1, 0.5))
    # Before its thread, which may have tried for long when this one goes on.
    started_s = time.monotonic()
    recorder.start()
    while len(calls) < 4:
        recorder.record("pair", (1, 0.5))
        assert time.monotonic() < started_s + 60
    tries, elapsed_s = len(calls), time.monotonic() - started_s
    problem = recorder.problem
    counts = recorder.close(30)

    assert tries <= elapsed_s / 0.05 + 3
    assert "refusal 1" in problem
    assert "pair.jsonl" in problem
    assert f"latest of {len(calls)}: " in counts.errors[1]
    assert counts.written == 0
    assert counts.dropped > 0


class _Disk:
    """Stands in for os.write: takes seeded amounts, refuses now and then."""

    def __init__(self, seed, refusal):
        self._random = random.Random(seed)
        self._refusal = refusal
        self._write = os.write

    def __call__(self, fd, data):
        if self._random.random() < self._refusal:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return self._write(fd, bytes(data[: self._random.randint(1, len(data))]))


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 2**32),
    refusal=st.sampled_from([0.0, 0.2, 0.6]),
    batches=st.lists(st.integers(0, 30), min_size=1, max_size=8),
)
def test_partial_writes_neither_cut_nor_repeat_a_line(tmp_path_factory, seed, refusal, batches):
    path = Path(tmp_path_factory.mktemp("disk")) / "pair.jsonl"
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    file = stream_file.StreamFile(PAIR, path, descriptor)
    header, t0 = b'{"schema":1,"stream":"pair"}\n', b'{"t0_utc":"u"}\n'
    recorded = 0
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(stream_file.os, "write", _Disk(seed, refusal))
        for index, count in enumerate(batches):
            file.lines.extend(b"[%d,0.5]\n" % n for n in range(recorded, recorded + count))
            recorded += count
            head = header if not file.has_header else t0 if index and not file.has_t0 else b""
            try:
                file.write_waiting(head, has_t0=head == t0 or file.has_t0)
            except OSError:
                continue
    file.finish()

    text = path.read_bytes()
    assert text.endswith(b"\n") or not text
    lines = [json.loads(line) for line in text.splitlines()]
    records = [line for line in lines if isinstance(line, list)]
    assert records == [[number, 0.5] for number in range(file.written)]
    assert file.written + file.dropped == recorded
    assert lines[:1] == ([json.loads(header)] if text else [])
    assert lines.count({"t0_utc": "u"}) <= 1
    if lines:
        end = {"records": file.written, "dropped": file.dropped, "not_finite": 0}
        assert lines[-1] == {"end": end}
    assert file.bytes_written == len(text)


def test_records_are_brought_to_the_disk_at_the_interval_and_only_when_there_are_new_ones(
    tmp_path, monkeypatch
):
    synced = []
    has_synced = threading.Event()

    def sync(descriptor):
        synced.append(os.readlink(f"/proc/self/fd/{descriptor}"))
        has_synced.set()

    monkeypatch.setattr(stream_file.os, "fdatasync", sync)
    recorder = make_recorder(tmp_path, sync_interval_s=0.001)
    recorder.open_stream(TICKS)
    recorder.open_stream(PAIR)
    recorder.record("ticks", (0, 12, 900, 0))
    recorder.start()

    assert has_synced.wait(30)
    recorder.close(30)
    assert sorted(set(map(os.path.basename, synced))) == ["pair.jsonl", "ticks.jsonl"]
    assert len(synced) == 2


@pytest.mark.parametrize("interval_s", [None, 0])
def test_records_are_left_to_the_kernel_where_no_interval_is_given(
    tmp_path, monkeypatch, interval_s
):
    synced = []
    monkeypatch.setattr(stream_file.os, "fdatasync", synced.append)
    recorder = make_recorder(tmp_path, sync_interval_s=interval_s, flush_interval_s=0.001)
    recorder.open_stream(TICKS)
    recorder.start()
    recorder.record("ticks", (0, 12, 900, 0))
    recorder.close(30)

    assert synced == []


def test_text_of_any_length_is_cut_to_what_readers_take_and_says_so(tmp_path):
    journal = make_journal(tmp_path)
    journal.log("error", "x" * (run_journal.LOG_CHARACTERS_MAX + 7))
    journal.log("error", "\x01" * run_journal.LOG_CHARACTERS_MAX)
    journal.close(30)

    _, first, second, _ = (tmp_path / "log.jsonl").read_bytes().splitlines()
    text = json.loads(first)["text"]
    assert text == "x" * run_journal.LOG_CHARACTERS_MAX + "... (7 more characters)"
    assert len(second) < log_tail.RECORD_BYTES_MAX
