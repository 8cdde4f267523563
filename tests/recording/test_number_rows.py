"""Rounding and encoding of many records at once: to the bit what each by itself gives."""

import random
from dataclasses import replace

import numpy as np
import orjson
import pytest

from madns_runtime.config import Recording
from madns_runtime.errors import PluginError
from madns_runtime.lockstep.recorder import DirectWriter
from madns_runtime.recording.number_rows import NumberRows
from madns_runtime.recording.record_files import RecordFiles
from madns_runtime.recording.recorder import Recorder
from madns_runtime.recording.records import Field, StreamSchema

FIELDS = (Field("tick", "", "int"), Field("x_m", "m", digits=6), Field("v_m_s", "m/s", digits=9))
SCHEMA = StreamSchema("state", FIELDS)
DIGITS = (None, 6, 9)
ROWS_TOGETHER = 8


def line_of(row):
    tick, x, v = row
    return orjson.dumps([tick, round(x, 6), round(v, 9)]) + b"\n"


def edges():
    """Return numbers in the middle between two decimals, beside it, huge, tiny, and of either sign."""
    halves = [(n + 0.5) / 1e6 for n in (0, 1, 7_158_000_000_000, 42_164_000_000_001)]
    powers = [
        s * 2.0**e for s in (1.0, -1.0) for e in (-1074, -40, -21, -7, 20, 43, 49, 52, 60, 1000)
    ]
    return [*halves, *(-n for n in halves), *powers, 0.0, -0.0, 1e-6, 2.5e-6, 0.1, 1e22]


def test_many_rows_are_the_lines_that_each_row_is_by_itself():
    draw = random.Random(7)
    pool = edges() + [draw.uniform(-1, 1) * 10 ** draw.randint(-10, 9) for _ in range(20_000)]
    pool += [round(draw.uniform(-9e6, 9e6), 6) + 5e-7 for _ in range(20_000)]
    table = [(n, x, draw.choice(pool)) for n, x in enumerate(pool)]
    rows = NumberRows(DIGITS)
    rows.waiting = list(table)

    lines, not_finite = rows.encode()

    assert [*map(line_of, table)] == lines
    assert (not_finite, rows.waiting) == (0, [])


def test_a_broken_number_of_an_int_is_recorded_as_it_came_and_not_rounded():
    assert NumberRows(DIGITS).rounded((1.5, 0.12345678, 2)) == [1.5, 0.123457, 2]


def test_what_is_not_finite_is_null_and_counted():
    rows = NumberRows(DIGITS)
    rows.waiting = [(0, float("nan"), 1.0), (1, float("inf"), -float("inf")), (2, 0.5, 0.25)]

    assert rows.encode() == ([b"[0,null,1.0]\n", b"[1,null,null]\n", b"[2,0.5,0.25]\n"], 3)


@pytest.mark.parametrize("odd", [(1, 2, 0.5), (1, True, 0.5), (1, "0.5", 0.5), (1.0, 0.5, 0.5)])
def test_a_row_of_other_kinds_is_not_encoded_with_others(odd):
    rows = NumberRows(DIGITS)
    rows.waiting = [(0, 0.5, 0.5), odd]

    with pytest.raises(TypeError, match="expected (int|float) alone"):
        rows.encode()

    assert len(rows.waiting) == 2


def recorded(folder, rows, *, together):
    """Return what a recorder of direct writes leaves of some rows, and its counts."""
    files = RecordFiles(folder, run="r", source="a")
    recorder = Recorder(files, Recording(), DirectWriter(files), rows_together=together)
    recorder.open_stream(SCHEMA)
    for row in rows:
        recorder.record("state", row)
    newest = recorder.newest("state")
    return (recorder.close().to_mapping(), newest, (folder / "state.jsonl").read_bytes())


def test_files_counts_and_newest_values_are_the_same_however_many_rows_are_encoded_together(
    tmp_path,
):
    rows = [(n, n / 3.0, n / 7.0) for n in range(3 * ROWS_TOGETHER + 2)]
    # A list, an int for a float and what is not finite go their own way, in order.
    rows[9], rows[14], rows[17] = [9, 0.1, 0.2], (14, 3, 0.2), (17, float("nan"), 0.1)

    alone = recorded(tmp_path / "alone", rows, together=1)
    together = recorded(tmp_path / "together", rows, together=ROWS_TOGETHER)

    assert alone == together
    assert alone[0]["written"] == len(rows)
    assert alone[0]["not_finite"] == 1


def test_a_value_without_a_json_form_is_told_with_its_place(tmp_path):
    rows = [(0, 0.5, 0.5), (1, object(), 0.5)]

    with pytest.raises(PluginError, match=r"stream state: value 1: .*object"):
        recorded(tmp_path, rows, together=ROWS_TOGETHER)


@pytest.mark.parametrize(
    ("field", "told"),
    [
        (Field("x_m", "m", words=("a",)), "x_m has words, and is of kind float, not str"),
        (Field("state", "", "str", words="ab"), "expected words of state to be a tuple of texts"),
        (Field("state", "", "str", words=(1,)), "expected words of state to be a tuple of texts"),
    ],
)
def test_words_are_texts_of_a_field_of_texts(tmp_path, field, told):
    files = RecordFiles(tmp_path, run="r", source="a")

    with pytest.raises(PluginError, match=told):
        Recorder(files, Recording()).open_stream(StreamSchema("state", (field,)))


@pytest.mark.parametrize(
    "fields",
    [
        (*FIELDS, Field("reason", "", "str")),
        (*FIELDS, Field("y_m", "m")),
        (FIELDS[0], replace(FIELDS[1], digits=16)),
        (replace(FIELDS[0], digits=3), FIELDS[1]),
    ],
)
def test_a_stream_is_rounded_in_all_its_floats_or_in_none(tmp_path, fields):
    files = RecordFiles(tmp_path, run="r", source="a")

    with pytest.raises(PluginError, match="stream state: expected digits, 0 to 15"):
        Recorder(files, Recording()).open_stream(StreamSchema("state", fields))


def make_rows_recorder(tmp_path):
    files = RecordFiles(tmp_path, run="r", source="a")
    recorder = Recorder(files, Recording(), DirectWriter(files), rows_together=128)
    recorder.open_stream(StreamSchema("state", (FIELDS[0], FIELDS[1])))
    return recorder


def test_a_value_without_a_form_is_told_in_the_call_that_records_it(tmp_path):
    recorder = make_rows_recorder(tmp_path)
    recorder.record("state", (1, 1.0))

    with pytest.raises(PluginError, match="stream state: value 1: object has no JSON form"):
        recorder.record("state", (2, object()))


def test_a_number_that_no_file_holds_is_counted_at_the_end_and_costs_no_other_record(tmp_path):
    recorder = make_rows_recorder(tmp_path)
    for number in (1, 2**70, 3):
        recorder.record("state", (number, 1.0))
    counts = recorder.close()

    assert (counts.written, counts.dropped) == (2, 1)
    assert "Integer exceeds 64-bit range" in counts.errors[0]


def test_rounding_does_not_raise_whatever_a_plugin_has_numpy_do():
    rows = NumberRows((None, 6))
    rows.waiting = [(1, 5e-320)]
    before = np.seterr(all="raise")
    try:
        lines, _ = rows.encode()
    finally:
        np.seterr(**before)

    assert lines == [b"[1,0.0]\n"]
