import json
import os
import shutil

import pyarrow.parquet as pq
import pytest
from harness.synthetic_run import SyntheticRun, make_config

from cosmos_cli import app
from cosmos_cli.collect.finish import finish_run
from cosmos_cli.diff import recorded
from madns_runtime.recording.records import Field, StreamSchema

pytestmark = pytest.mark.usefixtures("own_places")

AGENTS, TICKS = 3, 300


@pytest.fixture
def make(tmp_path):
    def make_run(change=None, *, agents=AGENTS, ticks=TICKS, **more):
        config = make_config(agents, ticks=ticks, **more)
        made = SyntheticRun(tmp_path / "runs", config).write(with_states=True)
        if change is not None:
            change(made)
        finish_run(made.run, made.result(), made.expected, has_report=False)
        return made

    return make_run


def change_record(made, *, agent="agent-02", stream="state", tick=123, field=2, by=5.0):
    """Change one value of one record; line 1 is the schema, line 2 may tell time zero."""
    path = made.stream(agent, stream)
    lines = path.read_text().split("\n")
    index = next(i for i, line in enumerate(lines) if line.startswith(f"[{tick},"))
    values = json.loads(lines[index])
    values[field] += by
    lines[index] = json.dumps(values)
    path.write_text("\n".join(lines))


def diff(capsys, *arguments):
    code = app.run(["diff", *arguments, "--json", "--quiet"])
    return code, json.loads(capsys.readouterr().out)


def streams_of(document):
    return {stream["table"]: stream for stream in document["streams"]}


def test_same_run_twice_is_identical(make, capsys):
    make(), make()

    code, document = diff(capsys, "1", "2", "--expect-same")

    assert code == 0
    assert (document["schema"], document["same"], document["identical"]) == (1, True, True)
    assert document["runs"] == {"a": "0001-synthetic", "b": "0002-synthetic"}
    state = streams_of(document)["state"]
    assert state["matched"] == AGENTS * TICKS
    assert set(state["sources"]) == {"agent-01", "agent-02", "agent-03"}


def test_one_value_changed_in_one_record_is_found_and_located(make, capsys):
    make(), make(change_record)

    code, document = diff(capsys, "1", "2")

    streams = streams_of(document)
    y_m = streams["state"]["fields"]["y_m"]
    assert code == 0
    assert not document["same"]
    assert (y_m["different"], y_m["at"]) == (1, {"key": 123.0, "who": "agent-02"})
    assert y_m["max"] == pytest.approx(5.0)
    assert y_m["rms"] == pytest.approx(5.0 / TICKS**0.5)  # of the one agent that is not identical
    assert streams["state"]["fields"]["x_m"]["different"] == 0
    assert streams["state"]["sources"]["agent-01"]["identical"]
    assert streams["round_trips"]["identical"]


@pytest.mark.slow
def test_differences_end_with_1_only_where_none_are_expected(make, capsys):
    make(), make(change_record)

    assert diff(capsys, "1", "2")[0] == 0
    assert diff(capsys, "1", "2", "--expect-same")[0] == 1
    assert diff(capsys, "1", "2", "--expect-same", "--agents", "agent-01")[0] == 0
    assert diff(capsys, "1", "2", "--expect-same", "--streams", "round_*")[0] == 0


def test_lines_tell_the_same_as_tables(make, capsys):
    first, second = make(), make(change_record)
    _, of_tables = diff(capsys, "1", "2")
    for made in (first, second):
        shutil.rmtree(made.run.tables)

    _, of_lines = diff(capsys, "1", "2")

    assert of_lines == of_tables


def record_epochs(made, *, later_ns=0):
    """Record nanoseconds of an epoch, some null: as floats, some hundred of them would be one."""
    schema = StreamSchema("epochs", (Field("tick", "", "int"), Field("utc_ns", "ns", "int")))
    recorder = made.recorder("agents/agent-01", "agent-01", schema)
    for tick in range(100):
        utc_ns = None if tick % 3 == 0 and tick > 50 else 1_700_000_000_000_000_000 + tick
        recorder.record("epochs", (tick, utc_ns + later_ns if tick == 77 else utc_ns))
    recorder.close()


@pytest.mark.parametrize("is_of_lines", [False, True])
def test_whole_numbers_that_no_float_tells_apart_differ_where_others_are_null(
    make, capsys, is_of_lines
):
    a, b = make(record_epochs), make(lambda made: record_epochs(made, later_ns=3))
    for made in (a, b) if is_of_lines else ():
        shutil.rmtree(made.run.tables)

    code, document = diff(capsys, "1", "2", "--streams", "epochs", "--expect-same")

    utc_ns = streams_of(document)["epochs"]["fields"]["utc_ns"]
    assert (code, document["same"]) == (1, False)
    assert (utc_ns["different"], utc_ns["max"], utc_ns["first"]["key"]) == (1, 3.0, 77.0)
    assert utc_ns["values"] == [1_700_000_000_000_000_077, 1_700_000_000_000_000_080]


def test_a_table_older_than_its_lines_is_not_believed(make, capsys):
    make(), change_record(make())

    _, document = diff(capsys, "1", "2")

    assert streams_of(document)["state"]["fields"]["y_m"]["different"] == 1


def test_missing_agent_is_named(make, capsys):
    make(), make(agents=AGENTS - 1)

    code, document = diff(capsys, "1", "2", "--expect-same")

    assert code == 1
    assert ["state", "agent-03"] in document["streams_only_a"]
    assert document["streams_only_b"] == []
    assert {"key": "agents.count", "a": 3, "b": 2} in document["settings"]


def test_run_that_was_cut_short_is_not_said_to_have_had_the_time_that_was_planned(
    make, tmp_path, capsys
):
    config = make_config(AGENTS, ticks=3 * TICKS)
    cut = SyntheticRun(tmp_path / "runs", config).write(with_states=True)
    finish_run(cut.run, cut.result(status="interrupted"), cut.expected, has_report=False)
    make()

    _, document = diff(capsys, "1", "2")

    assert document["remarks"][0] == (
        f"{cut.run.name}: interrupted before the end of the 90 s that were planned; what the other run has"
        " beyond that is alone"
    )
    assert not any("simulated times differ" in remark for remark in document["remarks"])


def test_different_tick_rates_are_matched_by_time_and_said(make, capsys):
    make(), make(ticks=TICKS // 2, tick_hz=5.0)

    _, document = diff(capsys, "1", "2")

    state = streams_of(document)["state"]
    assert any("matched by time" in remark for remark in document["remarks"])
    assert (state["by"], state["rows"]) == ("time", [AGENTS * TICKS, AGENTS * TICKS // 2])
    assert state["matched"] == AGENTS * TICKS // 2
    assert state["only_a"]["count"] == AGENTS * TICKS // 2
    assert state["only_a"]["first"] == {"key": 0.1, "who": "agent-01"}
    assert state["fields"]["x_m"]["max"] < 1e-6  # the same orbit at the same instants


def record_path(made):
    """Record a path by ticks alone, of which only the rate tells the times."""
    fields = (Field("tick", "", "int"), Field("x_m", "m"))
    recorder = made.recorder("agents/agent-01", "agent-01", StreamSchema("path", fields))
    for tick in range(20):
        recorder.record("path", (tick, 7.0 * tick))
    recorder.close()


def test_the_same_ticks_at_another_rate_are_other_instants(make, capsys):
    make(record_path), make(record_path, ticks=TICKS // 2, tick_hz=5.0)

    code, document = diff(capsys, "1", "2", "--streams", "path", "--expect-same")

    path = streams_of(document)["path"]
    assert (code, document["identical"]) == (1, False)
    assert (path["by"], path["matched"], path["identical"]) == ("time", 10, False)
    assert (path["only_a"]["count"], path["only_b"]["count"]) == (10, 10)
    assert path["fields"]["x_m"]["different"] == 9


@pytest.mark.parametrize("table", ["as it is", "gone"])
@pytest.mark.parametrize(
    ("fields", "told"),
    [
        ((Field("x_m", "m"), Field("x_km", "km")), ("x_m", "x_km")),
        ((Field("x", "m"), Field("x", "km")), ("x (m)", "x (km)")),
    ],
)
def test_the_same_numbers_under_another_name_or_in_another_unit_are_different(
    make, capsys, table, fields, told
):
    def recorded_as(field):
        def change(made):
            recorder = made.recorder("agents/agent-01", "agent-01", StreamSchema("way", (field,)))
            for tick in range(TICKS):
                recorder.record("way", (float(tick),))
            recorder.close()

        return change

    made = [make(recorded_as(field)) for field in fields]
    if table == "gone":
        for one in made:
            (one.run.tables / "way.parquet").unlink()

    code, document = diff(capsys, "1", "2", "--expect-same")
    app.run(["diff", "1", "2", "--quiet"])

    way = streams_of(document)["way"]
    assert code == 1
    assert (way["fields_only_a"], way["fields_only_b"]) == ([told[0]], [told[1]])
    assert (way["rows"], way["matched"]) == ([TICKS, TICKS], TICKS)
    assert f"way: {told[0]} only recorded in A" in capsys.readouterr().out


def test_different_simulations_are_refused(make, capsys):
    def rename(made):
        plan = json.loads(made.run.plan_json.read_text())
        plan["config"]["simulation"] = "counter"
        made.run.plan_json.write_text(json.dumps(plan))

    make(), make(rename)

    code = app.run(["diff", "1", "2"])

    assert code == 2
    err = capsys.readouterr().err
    assert "0001-synthetic of constellation" in err
    assert "0002-synthetic of counter" in err


def test_cut_data_are_named_and_never_the_same(make, capsys):
    make(), make(lambda made: made.kill("agent-03"))

    code, document = diff(capsys, "1", "2", "--expect-same")

    assert code == 1
    assert any("0002-synthetic: agent-03" in line for line in document["missing"])
    alone = streams_of(document)["state"]["only_a"]
    assert alone["count"] > 0
    assert alone["last"] == {"key": TICKS - 1.0, "who": "agent-03"}


@pytest.mark.slow
@pytest.mark.parametrize("has_tables", [True, False])
@pytest.mark.parametrize(
    ("harm", "words"),
    [
        (lambda path: path.unlink(), "missing; it was there"),
        (lambda path: path.write_bytes(path.read_bytes()[:-200]), "changed since"),
        (lambda path: path.write_bytes(b""), "changed since"),
    ],
)
def test_data_that_went_after_the_collection_are_named_and_never_the_same(
    make, capsys, harm, words, has_tables
):
    make()
    harmed = make()
    harm(harmed.stream("agent-03", "state"))
    if not has_tables:
        shutil.rmtree(harmed.run.tables)

    code, document = diff(capsys, "1", "2", "--expect-same")

    assert (code, document["same"]) == (1, False)
    (line,) = document["missing"]
    assert line.startswith("0002-synthetic: agents/agent-03/state.jsonl: ")
    assert words in line


def flip_digit(path):
    """Change a digit of the last record as a disk does: neither length nor time tell."""
    before = path.stat()
    data = path.read_bytes()
    at = data.rindex(b"]\n") - 1
    path.write_bytes(data[:at] + (b"1" if data[at : at + 1] != b"1" else b"2") + data[at + 1 :])
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))


def test_a_digit_that_changed_on_the_disk_is_named_and_never_the_same(make, capsys):
    make()
    flip_digit(make().stream("agent-03", "state"))

    code, document = diff(capsys, "1", "2", "--expect-same")

    assert (code, document["same"]) == (1, False)
    assert document["missing"] == [
        "0002-synthetic: agents/agent-03/state.jsonl: changed since the run was collected"
    ]


@pytest.mark.parametrize("name", ["agents/agent-03/events.jsonl", "plan.json"])
def test_what_changed_beside_the_compared_streams_is_named_and_never_the_same(make, capsys, name):
    make()
    harmed = make()
    path = harmed.run.path / name
    data = path.read_bytes()
    at = max(data.rindex(digit) for digit in (b"0", b"1", b"2") if digit in data)
    path.write_bytes(data[:at] + b"7" + data[at + 1 :])

    code, document = diff(capsys, "1", "2", "--expect-same")

    assert (code, document["same"]) == (1, False)
    assert document["missing"] == [f"0002-synthetic: {name}: changed since the run was collected"]


def test_of_changed_tables_nothing_is_told_by_the_simulation(make, capsys, monkeypatch):
    asked = []
    monkeypatch.setattr(
        "cosmos_cli.diff.compare._compare_by_simulation", lambda *_: asked.append(1)
    )
    make()
    assert diff(capsys, "1", "1")[0] == 0
    assert asked == [1]
    table = make().run.tables / "state.parquet"
    before = table.stat()
    table.write_bytes(table.read_bytes()[:-9] + b"7" + table.read_bytes()[-8:])
    os.utime(table, ns=(before.st_atime_ns, before.st_mtime_ns))

    code, document = diff(capsys, "1", "2", "--expect-same")

    assert (code, document["same"], asked) == (1, False, [1])
    (line,) = document["missing"]
    assert line.startswith("0002-synthetic: tables/state.parquet is not as it was collected")
    assert any("compared nothing itself" in line for line in document["remarks"])


def test_tables_of_another_run_are_not_read_for_its_own(make, capsys):
    first, second = make(), make(change_record)
    shutil.rmtree(second.run.tables)
    shutil.copytree(first.run.tables, second.run.tables, copy_function=shutil.copyfile)

    code, document = diff(capsys, "1", "2", "--expect-same")

    assert code == 1
    assert streams_of(document)["state"]["fields"]["y_m"]["different"] == 1

    for path in second.run.path.glob("agents/*/state.jsonl"):
        path.unlink()
    assert app.run(["diff", "1", "2"]) == 2
    assert "state.parquet: not as it was collected, and the lines" in capsys.readouterr().err


def test_what_the_framework_recorded_is_compared_when_it_is_named(make, capsys):
    make(), make(lambda made: change_record(made, stream="ticks", field=1))

    assert diff(capsys, "1", "2", "--expect-same")[0] == 0
    code, document = diff(capsys, "1", "2", "--expect-same", "--streams", "ticks")

    assert code == 1
    assert streams_of(document)["ticks"]["fields"]["lateness_us"]["at"]["key"] == 123


def test_nothing_chosen_is_never_the_same(make, capsys):
    nothing = StreamSchema("silent", (Field("tick", "", "int"),))
    for _ in range(2):
        make(lambda made: made.recorder("agents/agent-01", "agent-01", nothing).close())

    code, document = diff(capsys, "1", "2", "--expect-same", "--streams", "silent")

    assert code == 1
    assert [one["rows"] for one in document["streams"]] == [[0, 0]]


@pytest.mark.parametrize(
    ("option", "word", "expected"),
    [
        (
            "--agents",
            "agent-99",
            "--agents agent-99: no agent of these runs is called so; there are agent-[",
        ),
        ("--streams", "stat", "--streams stat: these runs recorded no such stream, did you mean"),
    ],
)
def test_a_word_that_chooses_nothing_is_refused(make, capsys, option, word, expected):
    make(), make()

    assert app.run(["diff", "1", "2", "--expect-same", option, "*", option, word]) == 2

    assert expected in capsys.readouterr().err


def test_streams_are_read_a_bounded_number_of_rows_at_a_time(make, capsys, monkeypatch):
    make(), make(change_record)
    read = []
    original = recorded.Recorded.batches

    def watched(self, names):
        for columns in original(self, names):
            read.append(len(columns["tick"]))
            yield columns

    monkeypatch.setattr(recorded, "ROWS_READ_MAX", 50)
    monkeypatch.setattr(recorded.Recorded, "batches", watched)

    diff(capsys, "1", "2", "--streams", "state", "--agents", "agent-02")

    assert max(read) <= 50
    # Once for the records, once for what the simulation itself makes of them.
    assert sum(read) == 2 * 2 * TICKS


def test_terminal_tells_where_and_how_much(make, capsys):
    make(), make(change_record)

    app.run(["diff", "1", "2"])

    out, err = capsys.readouterr()
    assert "agent-02 tick 123 (12.3 s)" in out
    assert out.endswith("DIFFERENT: records differ in state\n")
    assert "comparing agent-02/state" in err


def test_a_late_tick_is_told_in_all_its_digits(make, capsys):
    def record(made, *, by=0.0):
        fields = (Field("tick", "", "int"), Field("x_m", "m"))
        recorder = made.recorder("agents/agent-01", "agent-01", StreamSchema("late", fields))
        for tick in range(8_639_000, 8_639_010):
            recorder.record("late", (tick, 1.0 + by * (tick == 8_639_007)))
        recorder.close()

    make(record), make(lambda made: record(made, by=0.5))

    assert app.run(["diff", "1", "2", "--streams", "late"]) == 0
    assert "agent-01 tick 8639007 (863900.7 s)" in capsys.readouterr().out


def record_ranks(made, *, others=0):
    """Record of the host without a time; *others* are of another agent, before those of each."""
    fields = (Field("agent", "", "str"), Field("rank", "", "int"))
    recorder = made.recorder("host", "host", StreamSchema("ranks", fields))
    for number in range(20):
        for _ in range(others):
            recorder.record("ranks", ("agent-03", number))
        recorder.record("ranks", ("agent-01", number))
    recorder.close()


def test_records_without_a_time_are_matched_among_those_of_the_agents_that_are_chosen(make, capsys):
    make(record_ranks), make(lambda made: record_ranks(made, others=2))

    code, document = diff(
        capsys, "1", "2", "--streams", "ranks", "--agents", "agent-01", "--expect-same"
    )

    assert code == 0
    ranks = streams_of(document)["host_ranks"]
    assert (ranks["matched"], ranks["only_b"]["count"]) == (20, 0)
    assert diff(capsys, "1", "2", "--streams", "ranks", "--expect-same")[0] == 1


@pytest.mark.parametrize("table", ["as it is", "gone"])
def test_of_a_hosts_identical_records_those_of_chosen_agents_alone_are_counted(make, capsys, table):
    for _ in range(2):
        made = make(lambda made: record_ranks(made, others=2))
        if table == "gone":
            (made.run.tables / "host_ranks.parquet").unlink()

    code, document = diff(
        capsys, "1", "2", "--streams", "ranks", "--agents", "agent-01", "--expect-same"
    )

    ranks = streams_of(document)["host_ranks"]
    assert (code, document["identical"], ranks["identical"]) == (0, True, True)
    assert (ranks["rows"], ranks["matched"]) == ([20, 20], 20)
    assert diff(capsys, "1", "2", "--streams", "ranks")[1]["streams"][0]["matched"] == 60


def record_device(made, value):
    """Record a device of agent-02, and one of the inventory."""
    gyro = StreamSchema("gyro", (Field("t_s", "s"), Field("gyro", "rad/s")))
    for folder, own in (("agent-02/imu", value), ("pi02/clock", 1.0)):
        recorder = made.recorder(f"devices/{folder}", folder, gyro)
        recorder.record("gyro", (0.0, own))
        recorder.close()


def test_devices_of_agents_that_are_not_chosen_are_not_compared(make, capsys):
    make(lambda made: record_device(made, 1.0)), make(lambda made: record_device(made, 2.0))

    code, document = diff(capsys, "1", "2", "--agents", "agent-01", "--expect-same")

    assert code == 0
    assert {name for name in streams_of(document) if name.startswith("device")} == {
        "device_clock.gyro"
    }
    assert diff(capsys, "1", "2", "--agents", "agent-0[12]", "--expect-same")[0] == 1


def test_run_that_is_not_collected_is_bad_input_with_advice(make, tmp_path, capsys):
    make()
    SyntheticRun(tmp_path / "runs")

    assert app.run(["diff", "1", "2"]) == 2

    assert "cosmos collect 2" in capsys.readouterr().err


def test_settings_of_scenarios_need_scenarios(make, capsys):
    make()

    assert app.run(["diff", "1", "1", "--set", "seed=3"]) == 2

    assert "--run" in capsys.readouterr().err


def record_incarnations(made, *fields_of_incarnations):
    """Record a stream in several incarnations of an agent, each with fields of its own."""
    for before, names in enumerate(fields_of_incarnations):
        fields = (Field("t_s", "s"), *(Field(name, "m") for name in names))
        recorder = made.recorder("agents/agent-01", "agent-01", StreamSchema("restarted", fields))
        for second in range(3):
            recorder.record("restarted", (10.0 * before + second, *[1.0] * len(names)))
        recorder.close()


def test_a_field_that_one_incarnation_alone_has_is_null_in_the_lines_of_the_other(make, capsys):
    """The table, in which it is null as well, was changed since: the lines are read."""
    make(lambda made: record_incarnations(made, ("a_m",), ("a_m", "b_m")))
    made = make(lambda made: record_incarnations(made, ("a_m",), ("a_m", "b_m")))
    lines = made.run.path / "agents/agent-01/restarted.jsonl"
    lines.write_text(lines.read_text().replace("[2.0,1.0]", "[2.0,4.0]"))
    path = made.run.tables / "restarted.parquet"
    pq.write_table(pq.read_table(path), path)

    code, document = diff(capsys, "1", "2", "--streams", "restarted")

    fields = streams_of(document)["restarted"]["fields"]
    assert code == 0
    assert (fields["a_m"]["max"], fields["a_m"]["compared"]) == (3.0, 6)
    assert (fields["b_m"]["different"], fields["b_m"]["compared"]) == (0, 3)


def record_contacts(made, *, end_s=9.0):
    """Record objects whose first value bears the name of what else a line may be."""
    fields = (Field("end", "s"), Field("t0_utc", "", "str"), Field("t_s", "s"))
    recorder = made.recorder(
        "agents/agent-01", "agent-01", StreamSchema("contacts", fields, shape="object")
    )
    recorder.record("contacts", {"end": end_s, "t0_utc": "", "t_s": 1.0})
    recorder.record("contacts", {"t0_utc": "", "end": 2.0 * end_s, "t_s": 2.0})
    recorder.close()


def test_objects_that_begin_like_another_kind_of_line_are_compared(make, capsys):
    make(record_contacts), make(lambda made: record_contacts(made, end_s=8.0))

    code, document = diff(capsys, "1", "2", "--expect-same")

    contacts = streams_of(document)["contacts"]
    assert code == 1
    assert contacts["rows"] == [2, 2]
    assert contacts["fields"]["end"]["different"] == 2
    assert not contacts["identical"]


def record_calls(made, *rows):
    fields = (Field("t_s", "s"), *(Field(n, "", "str") for n in ("sender", "receiver")))
    schema = StreamSchema("calls", (*fields, Field("kind", "", "str")))
    recorder = made.recorder("agents/agent-01", "agent-01", schema)
    for row in rows:
        recorder.record("calls", row)
    recorder.close()


@pytest.mark.parametrize(
    ("a", "b"),
    [(("x", None, "call"), (None, "x", "call")), (("x", "a b", "c"), ("x", "a", "b c"))],
)
def test_records_about_others_are_no_pairs_though_their_words_are_the_same_in_a_row(
    make, capsys, a, b
):
    (
        make(lambda made: record_calls(made, (1.0, *a))),
        make(lambda made: record_calls(made, (1.0, *b))),
    )

    code, document = diff(capsys, "1", "2", "--expect-same")

    calls = streams_of(document)["calls"]
    assert code == 1
    assert (calls["matched"], calls["only_a"]["count"], calls["only_b"]["count"]) == (0, 1, 1)
    assert calls["only_a"]["first"]["who"] == "agent-01 " + " ".join(filter(None, a))


def test_a_stream_whose_table_is_in_another_unit_is_compared_in_its_own(make, capsys):
    def in_units(made, by=0.0):
        for agent, unit in (("agent-01", "m"), ("agent-02", "km")):
            schema = StreamSchema("radar", (Field("t_s", "s"), Field("range_", unit)))
            recorder = made.recorder(f"agents/{agent}", agent, schema)
            recorder.record("radar", (0.0, 1.0 + by))
            recorder.close()

    make(in_units), make(lambda made: in_units(made, by=2.0))

    _, document = diff(capsys, "1", "2")

    sources = streams_of(document)["radar"]["sources"]
    found = {name: source["fields"]["range_"] for name, source in sources.items()}
    assert {name: (each["unit"], each["max"]) for name, each in found.items()} == {
        "agent-01": ("m", 2.0),
        "agent-02": ("km", 2.0),
    }


def add_rovers(made, mood, *rovers):
    """Have the host record each of some rovers at each of ten times, under names of the plug-in's own."""
    fields = (
        Field("t_s", "s"),
        Field("rover", "", "str"),
        Field("mood", "", "str"),
        Field("x_m", "m"),
    )
    recorder = made.recorder("host", "host", StreamSchema("rovers", fields))
    for t in range(10):
        for rover in rovers:
            recorder.record("rovers", (float(t), rover, mood, 100.0 * ord(rover) + t))
    recorder.close()


def test_records_of_one_time_are_told_apart_by_a_text_of_any_name(make, capsys):
    make(lambda made: add_rovers(made, "bored", "a", "b"))
    make(lambda made: add_rovers(made, "keen", "b"))
    make(lambda made: add_rovers(made, "keen", "c"))

    _, document = diff(capsys, "1", "2")
    found = streams_of(document)["host_rovers"]
    assert (found["matched"], found["only_a"]["count"], found["only_b"]["count"]) == (10, 10, 0)
    assert {n: f["different"] for n, f in found["fields"].items()} == {"mood": 10, "x_m": 0}
    # Of one record at a time any text is a value.
    _, document = diff(capsys, "2", "3")
    found = streams_of(document)["host_rovers"]
    assert (found["matched"], found["only_a"]["count"]) == (10, 0)
