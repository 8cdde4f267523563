import dataclasses
import datetime
import errno
import hashlib
import math
import os
import subprocess
import sys

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from harness.synthetic_run import MACHINE, T0_UTC, SyntheticRun, make_config

from cosmos_cli.collect.finish import finish_run
from cosmos_cli.errors import InputError
from cosmos_cli.evidence.run_directory import write_json
from cosmos_cli.evidence.streams import find_streams, open_stream_file, scan_stream
from cosmos_cli.evidence.table_labels import NEVER_US, TableLabels
from cosmos_cli.evidence.table_layout import plan_table
from cosmos_cli.evidence.tables import TableReader, TableWriter, no_tables, open_tables
from cosmos_cli.evidence.tabulate import gather
from cosmos_cli.models.agent_labels import AgentLabels
from madns_runtime.errors import MachineError
from madns_runtime.recording import reader
from madns_runtime.recording.records import Field, StreamSchema

MIXED = StreamSchema(
    "mixed",
    (
        Field("t_s", "s"),
        Field("count", "", "int"),
        Field("level", "m"),
        Field("name", "", "str"),
        Field("is_on", "", "bool"),
        Field("extra", "", "json"),
    ),
)


def quiet(_what, _share):
    pass


def record(made, agent, schema, rows):
    recorder = made.recorder(f"agents/{agent}", agent, schema)
    for row in rows:
        recorder.record(schema.name, row)
    recorder.close()


def gathered_table(made, name, tick_hz=10.0):
    gather(made.run, tick_hz, quiet)
    return TableReader(made.run.tables / f"{name}.parquet")


@pytest.mark.parametrize("name", [".mixed.parquet.part", "mixed.parquet"])
def test_table_is_not_written_through_a_link(tmp_path, name):
    made = SyntheticRun(tmp_path)
    record(made, "agent-01", MIXED, [(0.0, 1, 1, "a", True, {})])
    victim = tmp_path / "victim"
    victim.write_bytes(b"precious")
    made.run.tables.mkdir()
    (made.run.tables / name).symlink_to(victim)

    gathered = gather(made.run, 10.0, quiet)

    assert gathered.faults == ()
    assert victim.read_bytes() == b"precious"
    assert open_tables(made.run.tables)["mixed"].sources == ("agent-01",)


def test_tables_are_not_written_into_a_folder_that_is_a_link(tmp_path):
    made = SyntheticRun(tmp_path)
    record(made, "agent-01", MIXED, [(0.0, 1, 1, "a", True, {})])
    (tmp_path / "victim").mkdir()
    made.run.tables.symlink_to(tmp_path / "victim")

    gathered = gather(made.run, 10.0, quiet)

    assert gathered.faults == (
        "tables/mixed.parquet: not written: the folder tables is a link; delete it",
    )
    assert list((tmp_path / "victim").iterdir()) == []


def test_what_is_no_file_is_no_table_and_is_not_waited_for(tmp_path):
    made = SyntheticRun(tmp_path)
    record(made, "agent-01", MIXED, [(0.0, 1, 1, "a", True, {})])
    gather(made.run, 10.0, quiet)
    os.mkfifo(made.run.tables / "pipe.parquet")
    (made.run.tables / "link.parquet").symlink_to(made.run.tables / "mixed.parquet")

    assert list(open_tables(made.run.tables)) == ["mixed"]
    assert no_tables(made.run.tables) == ("link.parquet", "pipe.parquet")


def test_values_keep_their_kinds_and_nulls(tmp_path):
    made = SyntheticRun(tmp_path)
    rows = [
        (0.0, 1, 1, "a", True, {"k": [1, 2]}),
        (1, None, None, None, None, None),
        (2.5, 2**53 + 1, 2.5, "ü", False, "text"),
    ]
    record(made, "agent-01", MIXED, rows)

    gather(made.run, 10.0, quiet)

    table = pq.read_table(made.run.tables / "mixed.parquet").to_pydict()
    assert table["t_s"] == [0.0, 1.0, 2.5]
    assert table["level"] == [1.0, None, 2.5]
    assert table["count"] == [1, None, 2**53 + 1]
    assert table["name"] == ["a", None, "ü"]
    assert table["is_on"] == [True, None, False]
    assert table["extra"] == ['{"k": [1, 2]}', None, "text"]
    assert table["agent"] == ["agent-01"] * 3


def test_large_integers_without_null_are_exact(tmp_path):
    made = SyntheticRun(tmp_path)
    schema = StreamSchema("big", (Field("n", "", "int"),))
    values = [2**53 + 1, -(2**62) - 1, 0]
    record(made, "agent-01", schema, [(v,) for v in values])

    assert gathered_table(made, "big").read("agent-01", ("n",))["n"].tolist() == values


def test_large_integers_are_exact_where_others_of_the_field_are_null(tmp_path, monkeypatch):
    # So that some blocks have no null, some nothing else.
    monkeypatch.setattr(reader, "BLOCK_BYTES", 512)
    made = SyntheticRun(tmp_path)
    schema = StreamSchema("big", (Field("n", "", "int"), Field("name", "", "str")))
    values = [2**60 + n for n in range(60)] + [None] * 60 + [None, -(2**53) - 1, 3, 2**53 + 1] * 9
    record(made, "agent-01", schema, [(value, "x") for value in values])

    found = gather(made.run, 10.0, quiet)

    assert pq.read_table(made.run.tables / "big.parquet")["n"].to_pylist() == values
    assert found.faults == ()


@pytest.mark.parametrize("kind", ["packed", "str"])
def test_a_tick_that_is_no_number_tells_no_time(tmp_path, kind):
    made = SyntheticRun(tmp_path)
    schema = StreamSchema("odd", (Field("tick", "", kind), Field("n", "", "int")))
    record(made, "agent-01", schema, [("dawn", 1), ("dusk", 2)])

    gather(made.run, 10.0, quiet)

    table = pq.read_table(made.run.tables / "odd.parquet").to_pydict()
    assert table["n"] == [1, 2]
    assert "t_s" not in table


def test_a_value_that_is_nested_too_deep_is_null_and_reported(tmp_path):
    made = SyntheticRun(tmp_path)
    schema = StreamSchema("odd", (Field("extra", "", "json"),))
    record(made, "agent-01", schema, [([1],), ([2],)])
    path = made.stream("agent-01", "odd")
    path.write_bytes(path.read_bytes().replace(b"[[2]]", b"[" * 1000 + b"2" + b"]" * 1000))

    found = gather(made.run, 10.0, quiet)

    assert pq.read_table(made.run.tables / "odd.parquet")["extra"].to_pylist() == ["[1]", None]
    assert found.faults == (
        "tables/odd.parquet: 1 values of extra (json) are null: not of their kind, first a list that cannot be shown"
        " of agent-01",
    )


def test_value_that_is_not_of_its_kind_is_null_and_reported(tmp_path):
    made = SyntheticRun(tmp_path)
    schema = StreamSchema("odd", (Field("n", "", "int"), Field("x", "m")))
    record(made, "agent-01", schema, [(1, 1.0), (None, None)])
    record(made, "agent-02", schema, [(1, 1.0), (2.5, "wi\x1bde"), (3, True), (None, None)])

    found = gather(made.run, 10.0, quiet)

    table = pq.read_table(made.run.tables / "odd.parquet").to_pydict()
    assert table["n"] == [1, None, 1, None, 3, None]
    assert table["x"] == [1.0, None, 1.0, None, None, None]
    assert found.faults == (
        "tables/odd.parquet: 1 values of n (int) are null: not of their kind, first 2.5 of agent-02;"
        r" 2 values of x (float) are null: not of their kind, first 'wi\x1bde' of agent-02",
    )


@pytest.mark.parametrize("value", [3, 2.5, True, [1, 2], {"a": 1}])
def test_what_is_no_text_is_null_where_text_belongs_and_reported(tmp_path, value):
    made = SyntheticRun(tmp_path)
    schema = StreamSchema("odd", (Field("state", "", "str"),))
    record(made, "agent-01", schema, [("on",), (value,), (None,)])

    found = gather(made.run, 10.0, quiet)

    assert pq.read_table(made.run.tables / "odd.parquet")["state"].to_pylist() == ["on", None, None]
    assert found.faults == (
        "tables/odd.parquet: 1 values of state (str) are null: not of their kind,"
        f" first {value!r} of agent-01",
    )


def test_of_many_fields_with_values_of_another_kind_the_first_are_told(tmp_path):
    made = SyntheticRun(tmp_path)
    schema = StreamSchema("odd", tuple(Field(name) for name in "abcde"))
    record(made, "agent-01", schema, [("1.5",) * 5] * 7)

    (fault,) = gather(made.run, 10.0, quiet).faults

    assert fault.count("7 values of ") == 3
    assert fault.endswith(
        "of c (float) are null: not of their kind, first '1.5' of agent-01; so are those of 2 more"
    )


@pytest.mark.parametrize("value", [np.array([1.0]), [[1.0, 2.0]], "1.5", {"a": 1}])
def test_a_value_of_another_shape_costs_no_other_field_its_table(tmp_path, value):
    made = SyntheticRun(tmp_path)
    schema = StreamSchema("odd", (Field("n", "", "int"), Field("x", "m"), Field("m", "", "int")))
    record(made, "agent-01", schema, [(number, value, value) for number in range(4)])

    found = gather(made.run, 10.0, quiet)

    table = pq.read_table(made.run.tables / "odd.parquet").to_pydict()
    assert table["n"] == [0, 1, 2, 3]
    assert table["x"] == table["m"] == [None] * 4
    assert found.faults[0].startswith("tables/odd.parquet: 4 values of x (float) are null: ")


def test_ticks_get_their_simulated_time(tmp_path):
    made = SyntheticRun(tmp_path, make_config(2, ticks=30, tick_hz=10.0)).write()

    table = gathered_table(made, "ticks")

    times = table.read("agent-02", ("tick", "t_s"))
    np.testing.assert_allclose(times["t_s"], times["tick"] / 10.0)
    assert [f.unit for f in table.fields if f.name in ("t_s", "lateness_us")] == ["s", "us"]


def test_columns_are_encoded_small(tmp_path):
    made = SyntheticRun(tmp_path).write(with_states=True)
    gather(made.run, 10.0, quiet)

    group = pq.ParquetFile(made.run.tables / "state.parquet").metadata.row_group(0)
    by_name = {group.column(i).path_in_schema: group.column(i) for i in range(group.num_columns)}

    assert "DELTA_BINARY_PACKED" in by_name["tick"].encodings
    assert "BYTE_STREAM_SPLIT" in by_name["x_m"].encodings
    assert "RLE_DICTIONARY" in by_name["agent"].encodings
    assert by_name["x_m"].compression == "ZSTD"


def test_host_agents_and_machines_have_tables_of_their_own(tmp_path):
    made = SyntheticRun(tmp_path).write()

    gather(made.run, 10.0, quiet)

    tables = open_tables(made.run.tables)
    assert {"events", "host_events", "machine_health", "ticks"} <= set(tables)
    assert tables["machine_health"].sources == (MACHINE,)
    assert tables["ticks"].sources == ("agent-01", "agent-02")
    assert tables["host_events"].sources == ("host",)


def test_details_of_events_are_kept(tmp_path):
    made = SyntheticRun(tmp_path).write()

    table = gathered_table(made, "host_events")

    details = table.read("host", ("event", "details"))
    assert details["event"].tolist() == ["SIMULATION_START"]
    assert details["details"].tolist() == ['{"why":"all"}']


def test_a_field_of_an_earlier_run_that_is_called_details_keeps_its_values(tmp_path):
    made = SyntheticRun(tmp_path)
    schema = StreamSchema("contacts", (Field("t_s", "s"), Field("notes")), shape="object")
    record(made, "agent-01", schema, [{"t_s": 1.0, "notes": 2.5}, {"t_s": 2.0, "notes": 3.5}])
    path = made.stream("agent-01", "contacts")
    path.write_bytes(path.read_bytes().replace(b"notes", b"details"))

    gather(made.run, 10.0, quiet)

    table = pq.read_table(made.run.tables / "contacts.parquet").to_pydict()
    assert table["details"] == ["2.5", "3.5"]


def test_stream_without_records_becomes_an_empty_table(tmp_path):
    made = SyntheticRun(tmp_path)
    record(made, "agent-01", MIXED, [])

    table = gathered_table(made, "mixed")

    assert table.rows == 0
    assert table.sources == ()
    assert len(table.read("agent-01", ("t_s",))["t_s"]) == 0


def test_incarnations_with_other_fields_share_a_table(tmp_path):
    made = SyntheticRun(tmp_path)
    record(made, "agent-01", StreamSchema("s", (Field("n", "", "int"), Field("a"))), [(1, 2.0)])
    record(made, "agent-01", StreamSchema("s", (Field("n"), Field("b", "", "str"))), [(1.5, "x")])

    gather(made.run, 10.0, quiet)

    table = pq.read_table(made.run.tables / "s.parquet").to_pydict()
    assert table["n"] == [1.0, 1.5]
    assert table["a"] == [2.0, None]
    assert table["b"] == [None, "x"]
    assert table["incarnation"] == [1, 2]


def with_range(unit, kind="float"):
    return StreamSchema("radar", (Field("t_s", "s"), Field("range_", unit, kind)))


@pytest.mark.parametrize(
    ("kind", "unit", "recorded", "expected"),
    [
        ("float", "km", [1.005, None, -2.0], [1005.0, None, -2000.0]),
        ("float", "km", [1e307], [None]),  # more than a float of m can be
        ("int", "km", [3, 4], [3000.0, 4000.0]),
        ("int", "mm", [3, None], [0.003, None]),
    ],
)
def test_numbers_in_another_unit_are_converted_to_that_of_their_column(
    tmp_path, kind, unit, recorded, expected
):
    made = SyntheticRun(tmp_path)
    record(made, "agent-01", with_range("m", kind), [(0.0, 7)])
    record(made, "agent-02", with_range(unit, kind), list(enumerate(recorded)))

    gathered = gather(made.run, 10.0, quiet)

    table = TableReader(made.run.tables / "radar.parquet")
    assert table.fields[1] == Field("range_", "m")
    assert table.read("agent-01", ("range_",))["range_"].tolist() == [7.0]
    values = table.read("agent-02", ("range_",))["range_"]
    assert [None if np.isnan(value) else value for value in values] == expected
    assert bool(gathered.faults) == (recorded == [1e307])


def test_numbers_that_measure_something_else_are_null_and_a_fault_of_the_table(tmp_path):
    made = SyntheticRun(tmp_path)
    record(made, "agent-01", with_range("m"), [(0.0, 7.0)])
    record(made, "agent-02", with_range("kg"), [(0.0, 1.0), (1.0, None), (2.0, 3.0)])

    gathered = gather(made.run, 10.0, quiet)

    assert gathered.faults == (
        "tables/radar.parquet: range_ of agent-02 is in kg, the table's in m: 2 values are null",
    )
    table = TableReader(made.run.tables / "radar.parquet")
    assert table.read("agent-01", ("range_",))["range_"].tolist() == [7.0]
    assert np.isnan(table.read("agent-02", ("range_",))["range_"]).all()


@pytest.mark.parametrize(
    ("unit", "told", "expected"),
    [("deg/s", "rad/s", [0.0, math.pi]), ("V", "", [0.0, 180.0]), ("", "", [0.0, 180.0])],
)
def test_devices_of_one_name_that_measure_different_things_have_a_column_without_a_unit(
    tmp_path, unit, told, expected
):
    """They are no copies of each other, as agents are: nothing is wrong, and no value is lost."""
    made = SyntheticRun(tmp_path)
    for place, own, values in (
        ("a", "rad/s", [1.0]),
        ("b", unit, [0.0, 180.0]),
        ("c", "rad/s", [2.0]),
    ):
        schema = StreamSchema("gyro", (Field("t_s", "s"), Field("rate", own)))
        recorder = made.recorder(f"devices/{place}/imu", f"{place}/imu", schema)
        for row in enumerate(values):
            recorder.record("gyro", row)
        recorder.close()

    gathered = gather(made.run, 10.0, quiet)

    table = TableReader(made.run.tables / "device_imu.gyro.parquet")
    assert gathered.faults == ()
    assert table.fields[1] == Field("rate", told)
    assert table.read("b/imu", ("rate",))["rate"].tolist() == pytest.approx(expected)
    assert table.read("c/imu", ("rate",))["rate"].tolist() == [2.0]


def test_a_column_of_text_from_different_units_has_none(tmp_path):
    made = SyntheticRun(tmp_path)
    record(made, "agent-01", with_range("m", "json"), [(0.0, [7.0])])
    record(made, "agent-02", with_range("km", "json"), [(0.0, [8.0])])

    table = gathered_table(made, "radar")

    assert table.fields[1] == Field("range_", "", "json")
    assert table.read("agent-02", ("range_",))["range_"].tolist() == ["[8.0]"]


def test_field_named_as_our_own_column_is_kept_beside_it(tmp_path):
    made = SyntheticRun(tmp_path)
    schema = StreamSchema("links", (Field("agent", "", "str"), Field("range_m", "m")))
    record(made, "agent-01", schema, [("agent-02", 1.0)])

    table = gathered_table(made, "links")

    assert table.sources == ("agent-01",)
    assert table.read("agent-01", ("agent",))["agent"].tolist() == ["agent-02"]


def test_every_column_has_a_name_of_its_own_whatever_fields_are_called(tmp_path):
    made = SyntheticRun(tmp_path)
    taken = StreamSchema("told", (Field("agent", "", "str"), Field("agent_name", "", "str")))
    record(made, "agent-01", taken, [("car", "driver")])
    labels = AgentLabels(column="agent_name_name", names={"agent-01": "one"})

    gather(made.run, 10.0, quiet, labels=TableLabels(agents=labels))

    told = pq.read_table(made.run.tables / "told.parquet")
    assert told.column_names == ["agent_name_name", "incarnation", "agent", "agent_name"]
    assert [column[0].as_py() for column in told.columns] == ["agent-01", 1, "car", "driver"]


def test_stream_whose_schema_line_is_damaged_is_counted_and_not_guessed(tmp_path):
    made = SyntheticRun(tmp_path).write()
    path = made.stream("agent-01", "ticks")
    path.write_bytes(b"X" + path.read_bytes())

    (file,) = [f for f in find_streams(made.run.path) if f.path == path]
    scan = scan_stream(file)

    assert scan.fault == "the schema line is missing or damaged"
    assert scan.truncated
    assert gathered_table(made, "ticks").sources == ("agent-02",)


HEADER = (
    b'{"schema":1,"stream":"s","shape":"array","fields":[{"name":"n","unit":"","kind":"int"},'
    b'{"name":"x_m","unit":"m","kind":"float"}]}\n'
)
END = b'{"end":{"records":2,"dropped":0,"not_finite":0}}\n'


@pytest.mark.parametrize(
    "content",
    [
        b"",
        HEADER,
        HEADER + b"[1,2.5]\n[2,3.5]\n" + END,
        HEADER + b"[1,2.5]\n[2,3.",
        HEADER + b"[1,2.5]\nnonsense\n[2,3.5]\n" + END,
        HEADER + b"".join(b"[%d,0.5]\n" % n for n in range(100_000)),
        HEADER + b"[1," + b" " * 2_000 + b"2.5]\n" + END,
        b"no header\n[1,2.5]\n",
    ],
)
def test_stream_is_read_once_and_its_hash_is_that_of_all_its_bytes(tmp_path, monkeypatch, content):
    path = tmp_path / "agents" / "a" / "s.jsonl"
    path.parent.mkdir(parents=True)
    path.write_bytes(content)
    file = open_stream_file(path, "agent")
    monkeypatch.setattr(reader, "LINE_BYTES_MAX", 1_000)
    monkeypatch.setattr(reader, "BLOCK_BYTES", 512)
    blocks = []
    whole_lines = reader._whole_lines
    monkeypatch.setattr(
        reader, "_whole_lines", lambda *given: blocks.append(1) or whole_lines(*given)
    )

    scan = scan_stream(file)

    assert (scan.sha256, scan.size_bytes) == (hashlib.sha256(content).hexdigest(), len(content))
    assert len(blocks) == 1


def test_stream_that_breaks_off_while_it_is_read_is_told_with_its_name(tmp_path, monkeypatch):
    made = SyntheticRun(tmp_path).write()
    file = open_stream_file(made.stream("agent-01", "ticks"), "agent")

    def broken(*given):
        raise OSError(errno.EIO, os.strerror(errno.EIO))
        yield

    monkeypatch.setattr(reader, "_whole_lines", broken)

    with pytest.raises(MachineError, match=r"ticks\.jsonl: cannot be read: Input/output error"):
        scan_stream(file)


def test_empty_file_is_a_fault(tmp_path):
    path = tmp_path / "agents" / "a" / "ticks.jsonl"
    path.parent.mkdir(parents=True)
    path.touch()

    assert scan_stream(open_stream_file(path, "agent")).fault.startswith("empty file")


def test_names_of_later_incarnations_are_read(tmp_path):
    path = tmp_path / "agents" / "a" / "my_stream.12.jsonl"
    path.parent.mkdir(parents=True)
    path.touch()

    file = open_stream_file(path, "agent")

    assert (file.source, file.stream, file.incarnation) == ("a", "my_stream", 12)


def test_table_that_fails_leaves_nothing_behind(tmp_path):
    made = SyntheticRun(tmp_path).write()
    files = [f for f in find_streams(made.run.path) if f.table == "ticks"]
    writer = TableWriter(made.run.tables / "ticks.parquet", plan_table(files, 10.0))

    writer.abandon()

    assert list(made.run.tables.iterdir()) == []


ROWS = 1_000_000
MEMORY_BYTES_MAX = 250 * 1024 * 1024
"""Imports alone take about 120 MB; all rows as Python objects would take more than 300 MB on top."""


@pytest.mark.process
def test_table_of_a_million_rows_is_written_in_little_memory(tmp_path):
    path = tmp_path / "agents" / "agent-01" / "ticks.jsonl"
    path.parent.mkdir(parents=True)
    header = (
        b'{"schema":1,"stream":"ticks","shape":"array","fields":[{"name":"tick","unit":"","kind":"int"},'
        b'{"name":"lateness_us","unit":"us","kind":"int"},{"name":"margin_us","unit":"us","kind":"float"}]}\n'
    )
    with path.open("wb") as file:
        file.write(header)
        for start in range(0, ROWS, 10_000):
            lines = (
                b"[%d,%d,%d.25]" % (i, i % 977, i % 9973) for i in range(start, start + 10_000)
            )
            file.write(b"\n".join(lines) + b"\n")
        file.write(b'{"end":{"records":%d,"dropped":0,"not_finite":0}}\n' % ROWS)
    code = (
        "import sys; from pathlib import Path; from cosmos_cli.evidence.tabulate import gather\n"
        "from cosmos_cli.evidence.run_directory import RunDirectory\n"
        "found = gather(RunDirectory(Path(sys.argv[1])), 100.0, lambda what, share: None)\n"
        "assert found.scans[0].records == 1_000_000 and found.scans[0].fault is None\n"
        # Not ru_maxrss, which a child inherits from the process that started it.
        "status = Path('/proc/self/status').read_text()\n"
        "print(status.split('VmHWM:')[1].split()[0])\n"
    )

    done = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path)], capture_output=True, text=True, timeout=120
    )

    assert done.returncode == 0, done.stderr
    assert int(done.stdout) * 1024 < MEMORY_BYTES_MAX
    table = TableReader(tmp_path / "tables" / "ticks.parquet")
    assert table.rows == ROWS
    values = table.read("agent-01", ("tick", "margin_us"))
    assert values["tick"].tolist() == list(range(ROWS))
    assert values["margin_us"][-1] == (ROWS - 1) % 9973 + 0.25


def test_records_of_large_texts_make_row_groups_of_few_and_small_ones_of_many(
    tmp_path, monkeypatch
):
    monkeypatch.setattr("cosmos_cli.evidence.tables.BYTES_PER_GROUP", 1 << 20)
    made = SyntheticRun(tmp_path)
    letters = [chr(ord("a") + index % 26) * 32_768 for index in range(128)]
    record(
        made, "agent-01", MIXED, [(0.0, i, 0.0, text, True, None) for i, text in enumerate(letters)]
    )
    record(made, "agent-02", MIXED, [(0.0, i, 0.0, "x", True, None) for i in range(10_000)])

    table = gathered_table(made, "mixed")

    file = pq.ParquetFile(table.path)
    rows = [file.metadata.row_group(index).num_rows for index in range(file.num_row_groups)]
    assert rows[-1] == 10_000
    assert max(rows[:-1]) <= 40  # of 32 KiB each
    assert table.read("agent-01", ("name",))["name"].tolist() == letters
    assert table.read("agent-01", ("count",))["count"].tolist() == list(range(128))


NAMES = {"agent-01": "IRIDIUM 8", "agent-02": "IRIDIUM 7"}
EPOCH = "2017-03-07T13:32:57Z"


def labelled(tmp_path, **host):
    """Return the tables of a constellation of two, as any reader of Parquet sees them."""
    made = SyntheticRun(tmp_path).write(with_states=True)
    truth = StreamSchema("truth", (Field("t_s", "s"), Field("agent", "", "str"), Field("x_m", "m")))
    recorder = made.recorder("host", "host", truth)
    for row in ((0.25, "agent-02", 1.0), (None, "agent-01", 2.0), (1.5, "nobody", 3.0)):
        recorder.record("truth", row)
    recorder.close()
    finish_run(made.run, made.result(simulation=host), made.expected, has_report=False)
    return {path.stem: pq.read_table(path) for path in made.run.tables.glob("*.parquet")}


def test_tables_of_a_constellation_bear_utc_since_its_epoch_and_names_of_satellites(tmp_path):
    tables = labelled(tmp_path, satellites=NAMES, epoch_utc=EPOCH)

    state = tables["state"].to_pylist()
    zero = datetime.datetime(2017, 3, 7, 13, 32, 57, tzinfo=datetime.UTC)
    assert str(tables["state"].schema.field("simulated_utc").type) == "timestamp[us, tz=UTC]"
    for row in state:
        assert row["simulated_utc"] == zero + datetime.timedelta(seconds=row["t_s"])
        assert row["satellite"] == NAMES[row["agent"]]
    truth = tables["host_truth"].to_pylist()
    assert [row["satellite"] for row in truth] == ["IRIDIUM 7", "IRIDIUM 8", None]
    assert [row["simulated_utc"] for row in truth] == [
        zero + datetime.timedelta(seconds=0.25),
        None,
        zero + datetime.timedelta(seconds=1.5),
    ]
    assert {"simulated_utc", "satellite"}.isdisjoint(tables["machine_health"].column_names)


def test_tables_bear_the_second_names_that_the_plan_keeps(tmp_path):
    made = SyntheticRun(tmp_path).write()
    plan = made.run.read_json(made.run.plan_json)
    labels = {"column": "car", "names": {"agent-01": "KITT"}}
    write_json(made.run.plan_json, {**plan, "labels": labels})
    finish_run(made.run, made.result(), made.expected, has_report=False)

    rows = pq.read_table(made.run.tables / "ticks.parquet").to_pylist()

    assert {(row["agent"], row["car"]) for row in rows} == {
        ("agent-01", "KITT"),
        ("agent-02", None),
    }


def test_tables_of_another_simulation_bear_utc_since_the_run_began(tmp_path):
    made = SyntheticRun(tmp_path).write()
    finish_run(made.run, made.result(), made.expected, has_report=False)

    ticks = pq.read_table(made.run.tables / "ticks.parquet")

    zero = datetime.datetime(2024, 5, 6, 7, 8, 9, tzinfo=datetime.UTC)
    assert ticks["simulated_utc"][0].as_py() == zero
    assert ticks["simulated_utc"][10].as_py() == zero + datetime.timedelta(seconds=1)
    assert "satellite" not in ticks.column_names


@pytest.mark.parametrize(
    ("parameter", "host", "zero"),
    [(EPOCH, {}, "2017-03-07"), (EPOCH, {"epoch_utc": "2020-02-02"}, "2020-02-02")],
)
def test_time_zero_is_the_epoch_of_summary_or_parameters_whatever_the_simulation(
    tmp_path, parameter, host, zero
):
    config = dataclasses.replace(
        SyntheticRun(tmp_path).config, simulation="rovers", parameters={"epoch_utc": parameter}
    )
    result = {"t0_utc": "2024-05-06T07:08:09Z", "simulation": host}

    found = TableLabels.of(config, result).zero_utc

    assert found.date().isoformat() == zero
    beyond = dataclasses.replace(config, parameters={"epoch_utc": "0001-01-01T00:00:00+14:00"})
    assert TableLabels.of(beyond, {}).zero_utc is None
    nothing = dataclasses.replace(config, parameters={"epoch_utc": None})
    assert TableLabels.of(nothing, {**result, "simulation": {}}).zero_utc is None


@pytest.mark.parametrize("is_told_by_the_host", [True, False])
def test_time_zero_that_is_no_time_is_remarked_on_as_tables_have_no_utc(
    tmp_path, is_told_by_the_host
):
    given = {"epoch_utc": "noon\x1b"}
    config = make_config(parameters={} if is_told_by_the_host else given)
    made = SyntheticRun(tmp_path, config).write()
    result = made.result(simulation=given if is_told_by_the_host else {})

    finish_run(made.run, result, made.expected, has_report=False)

    assert (
        "tables have no simulated_utc: expected an epoch_utc such as 2017-03-07T12:00:00Z, got 'noon\\x1b'"
        in made.run.read_json(made.run.run_json)["remarks"]
    )


@pytest.mark.parametrize(
    ("t0_utc", "words"),
    [
        ("2006-12-02T12:00:00Z", "the run began 175320 h before it was started here"),
        ("2026-12-03T12:00:00Z", "the run began 24 h after it was started here"),
        ("2026-12-02T12:20:00Z", ""),
        (None, ""),
    ],
)
def test_time_zero_by_a_clock_of_the_hosts_machine_that_is_wrong_is_remarked_on(
    tmp_path, t0_utc, words
):
    made = SyntheticRun(tmp_path, make_config()).write()
    write_json(made.run.run_json, {"started_utc": "2026-12-02T12:00:00.000Z"})

    finish_run(made.run, {**made.result(), "t0_utc": t0_utc}, made.expected, has_report=False)

    remarks = made.run.read_json(made.run.run_json)["remarks"]
    found = [remark for remark in remarks if "simulated_utc" in remark]
    assert len(found) == bool(words)
    assert not words or words in found[0]


def test_epoch_of_a_simulation_is_no_clock_of_a_machine(tmp_path):
    made = SyntheticRun(tmp_path, make_config(parameters={"epoch_utc": T0_UTC})).write()
    write_json(made.run.run_json, {"started_utc": "2026-12-02T12:00:00.000Z"})

    finish_run(made.run, made.result(), made.expected, has_report=False)

    remarks = made.run.read_json(made.run.run_json)["remarks"]
    assert not [remark for remark in remarks if "simulated_utc" in remark]


def test_nothing_is_labelled_where_time_zero_is_not_known(tmp_path):
    made = SyntheticRun(tmp_path).write(with_states=True)
    finish_run(made.run, None, made.expected, has_report=False)

    state = pq.read_table(made.run.tables / "state.parquet")

    assert {"simulated_utc", "satellite"}.isdisjoint(state.column_names)


def test_readers_of_tables_take_labels_for_no_recorded_field(tmp_path):
    made = SyntheticRun(tmp_path).write(with_states=True)
    host = {"satellites": NAMES, "epoch_utc": EPOCH}
    finish_run(made.run, made.result(simulation=host), made.expected, has_report=False)

    table = open_tables(made.run.tables)["state"]

    assert [field.name for field in table.fields][:3] == ["t_s", "tick", "x_m"]
    assert table.has("satellite", "simulated_utc")


@pytest.mark.parametrize("about", [None, {b"cosmos": b"[1]"}, {b"cosmos": b"{}"}])
def test_parquet_file_of_somebody_else_is_no_table(tmp_path, about):
    pq.write_table(pa.table({"a": [1.0]}).replace_schema_metadata(about), tmp_path / "mine.parquet")

    assert open_tables(tmp_path) == {}


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_times_without_a_utc_are_null(tmp_path):
    labels = TableLabels.of(None, {"t0_utc": "2024-05-06T07:08:09Z"})

    times = labels.utc_us(np.array([np.nan, np.inf, 1e300, 1e308, 0.0000004, 0.0000006]))

    zero_us = 1714979289 * 10**6
    assert times.tolist() == [*[NEVER_US] * 4, zero_us, zero_us + 1]


@pytest.mark.parametrize("said", [None, 3, "yesterday", "2024-05-06"])
def test_zero_that_is_no_time_is_none(said):
    found = TableLabels.of(None, {"t0_utc": said}).zero_utc

    assert found is None or found.tzinfo is not None


def test_lockstep_tells_no_wall_time(tmp_path):
    config = make_config(2)
    config = dataclasses.replace(config, time=dataclasses.replace(config.time, mode="lockstep"))

    assert TableLabels.of(config, {"t0_utc": "2024-05-06T07:08:09Z"}).zero_utc == (
        datetime.datetime(1970, 1, 1, tzinfo=datetime.UTC)
    )


def test_value_that_was_damaged_in_a_table_is_told_and_not_taken(tmp_path):
    """Parquet's own decoders take what is stored: another number, as good as any."""
    made = SyntheticRun(tmp_path)
    record(made, "agent-01", MIXED, [(i / 7, i, i / 3, "a", True, {}) for i in range(500)])
    table = gathered_table(made, "mixed")
    place = pq.ParquetFile(table.path).metadata.row_group(0).column(4)
    assert place.path_in_schema == "level"
    whole = bytearray(table.path.read_bytes())
    whole[place.data_page_offset + place.total_compressed_size - 20] ^= 1
    table.path.write_bytes(whole)

    (damaged,) = open_tables(made.run.tables).values()
    with pytest.raises(InputError, match=r"mixed\.parquet: damaged .*cosmos collect"):
        damaged.read("agent-01", ["level"])
    with pytest.raises(InputError, match=r"mixed\.parquet: damaged .*cosmos collect"):
        list(damaged.batches("agent-01", ["level"], 100))


@pytest.mark.parametrize(
    ("stream", "was", "wrong"),
    [
        ("ticks", b'"lateness_us","unit":"us","kind":"int"', b'"lateness_us","unit":"us","kind":"str"'),
        ("clock", b'"offset_us","unit":"us","kind":"float"', b'"offset_us","unit":"us","kind":"flobt"'),
        ("ticks", b'"name":"missed"', b'"name":"tick"'),
        ("round_trips", b'"name":"round_trip_us"', b'"name":[]'),
    ],
)  # fmt: skip
def test_schema_line_that_was_damaged_makes_its_stream_one_that_cannot_be_read(
    tmp_path, stream, was, wrong
):
    made = SyntheticRun(tmp_path).write()
    path = made.stream("agent-01", stream)
    assert was in path.read_bytes()
    path.write_bytes(path.read_bytes().replace(was, wrong))

    summary = finish_run(made.run, made.result(), made.expected)

    assert summary.exit_code == 5
    assert summary.missing == (f"agent-01: {stream} the schema line is missing or damaged",)


def test_group_without_a_record_is_of_nobody(tmp_path):
    """As one is that another program wrote, which took all records of a table out."""
    made = SyntheticRun(tmp_path).write()
    gather(made.run, 10.0, lambda *told: None)
    path = made.run.tables / "round_trips.parquet"
    nothing = pq.read_table(path).slice(0, 0)
    with pq.ParquetWriter(path, nothing.schema) as writer:
        writer.write_table(nothing)

    table = open_tables(made.run.tables)["round_trips"]

    assert (table.rows, table.sources) == (0, ())
