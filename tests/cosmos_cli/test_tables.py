import subprocess
import sys

import numpy as np
import pyarrow.parquet as pq
import pytest
from synthetic_run import MACHINE, SyntheticRun, make_config

from cosmos_cli.gather import gather
from cosmos_cli.streams import find_streams, open_stream_file, scan_stream
from cosmos_cli.tables import TableReader, TableWriter, open_tables, plan_table
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
    assert table["count"][:2] == [1, None]
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


def test_value_that_is_not_of_its_kind_is_null_and_reported(tmp_path):
    made = SyntheticRun(tmp_path)
    schema = StreamSchema("odd", (Field("n", "", "int"), Field("x", "m")))
    record(made, "agent-01", schema, [(1, 1.0), (2.5, "wide"), (3, True)])

    found = gather(made.run, 10.0, quiet)

    table = pq.read_table(made.run.tables / "odd.parquet").to_pydict()
    assert table["n"] == [1, None, 3]
    assert table["x"][:2] == [1.0, None]
    assert found.faults[0].startswith("tables/odd.parquet: 3 recorded values")


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


def test_field_named_as_our_own_column_is_kept_beside_it(tmp_path):
    made = SyntheticRun(tmp_path)
    schema = StreamSchema("links", (Field("agent", "", "str"), Field("range_m", "m")))
    record(made, "agent-01", schema, [("agent-02", 1.0)])

    table = gathered_table(made, "links")

    assert table.sources == ("agent-01",)
    assert table.read("agent-01", ("agent",))["agent"].tolist() == ["agent-02"]


def test_stream_whose_schema_line_is_damaged_is_counted_and_not_guessed(tmp_path):
    made = SyntheticRun(tmp_path).write()
    path = made.stream("agent-01", "ticks")
    path.write_bytes(b"X" + path.read_bytes())

    (file,) = [f for f in find_streams(made.run.path) if f.path == path]
    scan = scan_stream(file)

    assert scan.fault == "the schema line is missing or damaged"
    assert scan.truncated
    assert gathered_table(made, "ticks").sources == ("agent-02",)


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
        "import sys; from pathlib import Path; from cosmos_cli.gather import gather\n"
        "from cosmos_cli.rundir import RunDirectory\n"
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
