import dataclasses
import errno
import os
import shutil
import tarfile
import tempfile
from pathlib import Path

import orjson
import pyarrow.parquet as pq
import pytest
import zstandard
from harness import full_disk
from harness.synthetic_run import SyntheticRun, make_config

from cosmos_cli.collect import finish as finish_module
from cosmos_cli.collect import previous_manifest
from cosmos_cli.collect.finish import collect_run, finish_run
from cosmos_cli.diff.recorded import recorded_streams
from cosmos_cli.errors import InputError, RunFailedError
from cosmos_cli.evidence.run_directory import RunDirectory
from cosmos_cli.evidence.run_documents import Problem
from madns_runtime.config import Deadline
from madns_runtime.recording.reader import StreamReading
from madns_runtime.recording.records import EVENTS, TICKS


def finish(made, *, has_report=False, **changes):
    """End a run; its page is half the work, and written where a test is about it."""
    return finish_run(made.run, made.result(**changes), made.expected, has_report=has_report)


def read(path):
    return orjson.loads(path.read_bytes())


def failed_checks(summary):
    return [check["name"] for check in summary.document["checks"] if not check["passed"]]


def test_whole_run_is_green_and_leaves_all_its_evidence(tmp_path):
    made = SyntheticRun(tmp_path).write()

    summary = finish(made, has_report=True)

    assert summary.exit_code == 0, summary.verdict.text
    document = read(made.run.run_json)
    assert document == summary.document
    assert document["status"] == "complete"
    assert document["timing"]["ticks"] == 400
    assert document["timing"]["missed"] == 0
    assert document["records"]["truncated"] == 0
    assert document["data"] == {"complete": True, "missing": []}
    assert document["round_trip_ms"]["count"] == 400
    assert made.run.report_html.exists()
    assert made.run.bundle.exists()
    assert not made.run.reserve.exists()


@pytest.fixture
def ordinary():
    """A run of a user who is not root, whom modes of folders bind; the test acts for that user."""
    folder = Path(tempfile.mkdtemp(prefix="cosmos-ordinary-"))
    made = SyntheticRun(folder / "runs").write()
    finish(made)
    is_root = os.geteuid() == 0
    if is_root:
        for path in (folder, *folder.rglob("*")):
            os.chown(path, 65534, 65534)
        os.setegid(65534)
        os.seteuid(65534)
    yield made
    if is_root:
        os.seteuid(0)
        os.setegid(0)
    for path in made.run.path.rglob("*"):
        path.chmod(0o700)
    shutil.rmtree(folder)


@pytest.mark.parametrize("name", ["agents/agent-01", "tables"])
def test_a_folder_of_which_the_names_alone_may_be_read_is_told(ordinary, name):
    (ordinary.run.path / name).chmod(0o444)

    summary = collect_run(ordinary.run, processes=lambda: [])

    assert summary.exit_code == 5
    assert f"{name}: not read: Permission denied" in summary.missing
    assert recorded_streams(ordinary.run)


@pytest.mark.parametrize("name", ["agents/agent-01/ticks.jsonl", "scenario.yaml"])
def test_a_file_that_may_not_be_read_is_told_and_the_rest_is_judged(ordinary, name):
    (ordinary.run.path / name).touch()
    (ordinary.run.path / name).chmod(0)

    summary = collect_run(ordinary.run, processes=lambda: [])

    assert summary.exit_code == 5
    assert f"{name}: not read: Permission denied" in summary.missing
    is_in_package = name != "scenario.yaml"
    assert summary.is_packed is not is_in_package  # what it alone can give is kept


def test_a_stream_on_a_bad_disk_is_told_and_the_rest_is_judged_and_packaged(tmp_path, monkeypatch):
    made = SyntheticRun(tmp_path).write()
    finish(made)
    bad = made.stream("agent-01", "ticks")
    chunks = StreamReading.column_chunks

    def breaking(self):
        if self.path == bad:
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        return chunks(self)

    monkeypatch.setattr(StreamReading, "column_chunks", breaking)

    summary = collect_run(made.run, processes=lambda: [])

    assert summary.exit_code == 5
    assert "agents/agent-01/ticks.jsonl: cannot be read: Input/output error" in summary.missing
    assert any(line.startswith("agent-01: ticks is missing") for line in summary.missing)
    assert summary.document["records"]["written"] > 0
    assert summary.kept_member == f"{made.run.name}/agents/agent-01/ticks.jsonl"
    made.run.bundle.unlink()
    assert collect_run(made.run, processes=lambda: []).is_packed


@pytest.mark.parametrize(
    ("number", "told"),
    [
        (errno.EIO, "cannot be read: Input/output error"),
        (errno.ENOENT, "missing; it was there when the run was collected"),
    ],
)
def test_a_file_that_cannot_be_read_when_a_run_is_collected_again_is_told(
    tmp_path, monkeypatch, number, told
):
    made = SyntheticRun(tmp_path).write()
    (made.run.path / "notes.txt").write_text("seen")
    finish(made)

    def broken(path):
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(previous_manifest, "file_entry", broken)

    summary = collect_run(made.run, processes=lambda: [])

    assert f"notes.txt: {told}" in summary.missing


def test_run_json_holds_every_promised_key(tmp_path):
    made = SyntheticRun(tmp_path).write()

    document = finish(made).document

    promised = (
        "schema run scenario status exit_code agents started_utc duration_s rtf seed versions timing "
        "messages round_trip_ms clock records checks simulation"
    )
    assert set(promised.split()) <= set(document)
    assert {"count", "lost"} <= set(document["agents"])
    assert {"ticks", "missed", "miss_ratio", "lateness_ms", "margin_ms"} <= set(document["timing"])
    assert {"p50", "p99", "p999", "max"} <= set(document["timing"]["lateness_ms"])
    assert {"sent", "received", "lost"} <= set(document["messages"]["reliable"])
    assert {"offset_us_max", "uncertainty_us_max"} <= set(document["clock"])
    assert {"written", "dropped", "truncated"} <= set(document["records"])


def test_killed_agent_under_continue_makes_data_incomplete_and_is_named(tmp_path):
    made = SyntheticRun(tmp_path, make_config(3)).write()
    made.kill("agent-02")
    result = made.result(lost=["agent-02"])
    result["agents"]["agent-02"] = {"state": "lost", "reason": "no sign of life for 2.5 s"}

    summary = finish_run(made.run, result, made.expected)

    assert summary.exit_code == 5
    assert len(summary.missing) == 1
    assert summary.missing[0].startswith("agent-02: no sign of life for 2.5 s: ")
    assert "cut after" in summary.missing[0]
    assert summary.document["agents"]["lost"] == ["agent-02"]
    assert {"agents.lost", "records.truncated", "deadline.miss_ratio"} <= set(
        failed_checks(summary)
    )


def test_agent_without_records_is_named(tmp_path):
    made = SyntheticRun(tmp_path).write()
    for path in (made.run.path / "agents/agent-01").iterdir():
        path.unlink()

    summary = finish(made)

    assert summary.exit_code == 5
    assert summary.missing == ("agent-01: no records",)


def test_stream_that_an_agent_reported_and_that_is_not_there_is_named(tmp_path):
    made = SyntheticRun(tmp_path).write()
    made.stream("agent-02", "round_trips").unlink()

    summary = finish(made)

    assert summary.exit_code == 5
    assert summary.missing == ("agent-02: round_trips is missing",)


def test_hosts_own_state_of_health_is_expected(tmp_path):
    made = SyntheticRun(tmp_path).write()
    (made.run.path / "host/health.jsonl").unlink()

    summary = finish(made)

    assert summary.exit_code == 5
    assert summary.missing == ("host: health is missing",)


def test_trouble_that_the_hosts_sampler_reports_is_a_gap(tmp_path):
    made = SyntheticRun(tmp_path).write()
    trouble = "process 77 had to be killed: no end in 6 s"
    made.records["host"]["health"] = {"errors": [trouble]}

    summary = finish(made)

    assert summary.exit_code == 5
    assert summary.missing == (f"host: health: {trouble}",)


def test_damaged_line_is_counted_and_the_rest_is_kept(tmp_path):
    made = SyntheticRun(tmp_path).write()
    path = made.stream("agent-01", "ticks")
    lines = path.read_bytes().split(b"\n")
    lines[50] = lines[50][:7]
    path.write_bytes(b"\n".join(lines))

    summary = finish(made)

    assert summary.exit_code == 5
    assert summary.missing == ("agent-01: ticks 1 damaged line(s)",)
    entry = read(made.run.manifest_json)["files"]["agents/agent-01/ticks.jsonl"]
    assert entry["records"] == made.ticks - 1
    assert entry["lost"] == 1
    assert entry["truncated"] is True
    assert pq.read_metadata(made.run.tables / "ticks.parquet").num_rows == 2 * made.ticks - 1


def test_records_that_the_recorder_dropped_make_data_incomplete_and_say_why(tmp_path):
    made = SyntheticRun(tmp_path).write()
    path = made.stream("agent-01", "ticks")
    end = orjson.dumps({"end": {"records": made.ticks, "dropped": 17, "not_finite": 0}})
    path.write_bytes(b"\n".join([*path.read_bytes().split(b"\n")[:-2], end, b""]))
    made.records["agent-01"]["errors"] = ["ticks.jsonl: No space left on device"]

    summary = finish(made)

    assert summary.exit_code == 5
    assert "17 records were dropped" in summary.missing[0]
    assert "No space left on device" in summary.missing[0]
    assert summary.document["records"]["dropped"] == 17


@pytest.mark.parametrize(("told_of", "dropped"), [("ticks.jsonl", 17), ("ticks.2.jsonl", 0)])
def test_records_whose_end_line_found_no_room_are_counted_as_the_host_was_told(
    tmp_path, told_of, dropped
):
    made = SyntheticRun(tmp_path).write()
    path = made.stream("agent-01", "ticks")
    path.write_bytes(b"\n".join([*path.read_bytes().split(b"\n")[:-2], b""]))
    told = made.records["agent-01"]["streams"]["ticks"]
    made.records["agent-01"]["streams"]["ticks"] = told | {"file": told_of, "dropped": 17}

    summary = finish(made)

    assert summary.exit_code == 5
    assert summary.document["records"]["dropped"] == dropped
    entry = read(made.run.manifest_json)["files"]["agents/agent-01/ticks.jsonl"]
    assert (entry["dropped"], entry["truncated"]) == (dropped, True)


def test_result_that_found_no_room_before_the_reserve_was_freed_is_there_to_collect_again(
    tmp_path, monkeypatch
):
    made = SyntheticRun(tmp_path).write()
    write_json = finish_module.write_json

    def write(path, *value, **more):
        if path == made.run.result_json and made.run.reserve.exists():
            raise OSError(errno.ENOSPC, "No space left on device")
        write_json(path, *value, **more)

    monkeypatch.setattr(finish_module, "write_json", write)

    assert finish(made).exit_code == collect_run(made.run).exit_code == 0


def test_host_that_ended_without_a_result_fails_the_run_and_collect_says_data_incomplete(tmp_path):
    made = SyntheticRun(tmp_path).write()
    for path in (made.run.path / "host").iterdir():
        made.cut(path, path.stat().st_size - 3)

    summary = finish_run(made.run, None, made.expected)

    assert summary.exit_code == 1
    assert summary.verdict.text.startswith("FAILED: host: ")
    assert summary.missing[0].startswith("host: no result")
    again = collect_run(made.run, processes=lambda: [])
    assert again.missing == summary.missing
    assert made.run.bundle.exists()


def test_run_directory_that_was_cut_off_at_once_is_still_collected(tmp_path):
    made = SyntheticRun(tmp_path)

    summary = collect_run(made.run, processes=lambda: [])

    assert summary.exit_code == 1
    assert {line.split(":")[0] for line in summary.missing} == {
        "host",
        "agent-01",
        "agent-02",
        "loopback",
    }


def test_later_incarnation_is_in_the_table_and_its_predecessor_is_named_as_cut(tmp_path):
    made = SyntheticRun(tmp_path).write()
    made.kill("agent-01")
    made.write_agent("agent-01", first=150)

    summary = finish(made)

    assert summary.exit_code == 5
    table = pq.read_table(made.run.tables / "ticks.parquet", columns=["agent", "incarnation"])
    rows = table.filter(pq.filters_to_expression([("agent", "==", "agent-01")])).to_pydict()
    assert set(rows["incarnation"]) == {1, 2}
    assert rows["incarnation"].count(2) == 50
    assert "agents/agent-01/ticks.2.jsonl" in read(made.run.manifest_json)["files"]


def test_incarnation_that_ended_before_set_up_does_not_shift_the_numbers_of_the_next(tmp_path):
    made = SyntheticRun(tmp_path).write()
    for path in (made.run.path / "agents/agent-01").iterdir():
        path.unlink()
    first = made.recorder("agents/agent-01", "agent-01", TICKS, EVENTS)
    first.close()
    made.write_agent("agent-01")

    finish(made)

    for table in ("ticks", "round_trips"):
        columns = pq.read_table(
            made.run.tables / f"{table}.parquet", columns=["agent", "incarnation"]
        )
        rows = columns.filter(pq.filters_to_expression([("agent", "==", "agent-01")])).to_pydict()
        assert set(rows["incarnation"]) == {2}, table


def test_interrupted_run_ends_with_130_also_when_it_is_collected_again(tmp_path):
    made = SyntheticRun(tmp_path).write()

    first = finish_run(made.run, made.result(status="aborted"), made.expected, interrupted=True)
    second = collect_run(made.run, processes=lambda: [])

    assert (first.exit_code, second.exit_code) == (130, 130)
    assert second.document["status"] == "interrupted"


def test_collecting_twice_gives_the_same_summary_and_the_same_package(tmp_path):
    made = SyntheticRun(tmp_path).write()
    first = finish(made, has_report=True)
    package = made.run.bundle.read_bytes()

    second = collect_run(made.run, processes=lambda: [])

    assert second.document == first.document
    assert made.run.bundle.read_bytes() == package


def test_collect_refuses_while_a_process_of_the_run_lives(tmp_path):
    made = SyntheticRun(tmp_path).write()
    living = made.living_agent()

    with pytest.raises(InputError, match=r"agent agent-02 \(pid 4242\)"):
        collect_run(made.run, processes=lambda: [living])


def test_problem_of_a_machine_ends_with_3_and_names_it(tmp_path):
    made = SyntheticRun(tmp_path).write()
    text = "agents@loopback (pid 7) was killed by SIGKILL"

    summary = finish_run(
        made.run,
        made.result(),
        made.expected,
        problems=[Problem(machine="loopback", text=text)],
    )

    assert summary.exit_code == 3
    assert f"MACHINES FAILED: loopback: {text}" in summary.verdict.text
    assert summary.document["problems"] == [{"machine": "loopback", "text": text, "step": "run"}]
    assert f"<li>{text}</li>" in made.run.report_html.read_text()


def test_problem_of_a_machine_is_kept_when_the_run_is_collected_again(tmp_path):
    made = SyntheticRun(tmp_path).write()
    found = [Problem(machine="loopback", text="it was cut off")]
    first = finish_run(made.run, made.result(), made.expected, problems=found)

    second = collect_run(made.run, processes=lambda: [])

    assert (first.exit_code, second.exit_code) == (3, 3)
    assert second.document == first.document


def test_trouble_with_the_report_is_forgotten_once_it_is_mended(tmp_path, monkeypatch):
    made = SyntheticRun(tmp_path).write()

    def break_down(*_arguments):
        raise ZeroDivisionError("no ticks")

    with monkeypatch.context() as patch:
        patch.setattr("cosmos_cli.collect.finish.write_report", break_down)
        finish(made, has_report=True)
        broken = collect_run(made.run, processes=lambda: [])
    mended = collect_run(made.run, processes=lambda: [])

    assert broken.exit_code == 3
    assert len(broken.document["problems"]) == 1
    assert "report.html: not written: ZeroDivisionError" in broken.verdict.text
    assert mended.exit_code == 0
    assert mended.document["problems"] == []


def test_result_that_the_host_left_is_collected_and_in_the_manifest(tmp_path):
    made = SyntheticRun(tmp_path).write()
    left = made.run.left_result_json
    left.write_bytes(orjson.dumps(made.result()))

    summary = collect_run(made.run, processes=lambda: [])

    assert summary.exit_code == 0, summary.verdict.text
    assert "host/result.json" in read(made.run.manifest_json)["files"]


@pytest.mark.parametrize("content", [b"", b'{"status": "comp', b"[]", b'{"agents": {}}'])
def test_result_that_was_cut_off_is_none(tmp_path, content):
    made = SyntheticRun(tmp_path).write()
    made.run.left_result_json.write_bytes(content)

    summary = collect_run(made.run, processes=lambda: [])

    assert summary.exit_code == 1
    first, *named = summary.missing
    assert first == "host: no result"
    assert len(named) == (content != b'{"agents": {}}')
    assert all(line.startswith("host/result.json: cannot be used: ") for line in named)


def test_ticks_of_an_agent_that_left_nothing_are_missed_to_the_last(tmp_path):
    made = SyntheticRun(tmp_path, make_config(ticks=29, tick_hz=100.0)).write()
    assert made.config.time.duration_s * 100.0 < 29.0  # 28.999999999999996
    result = made.result()
    del result["agents"]["agent-01"]
    made.stream("agent-01", "ticks").unlink()

    summary = finish_run(made.run, result, made.expected)

    assert (summary.document["timing"]["ticks"], summary.document["timing"]["missed"]) == (58, 29)


def test_missed_ticks_break_the_deadline_check(tmp_path):
    made = SyntheticRun(tmp_path).write()
    result = made.result()
    for agent in result["agents"].values():
        agent["ticks"] |= {"due": made.ticks + 2, "missed": 2}

    summary = finish_run(made.run, result, made.expected)

    assert summary.exit_code == 4
    assert failed_checks(summary) == ["deadline.miss_ratio"]
    assert summary.document["timing"]["missed"] == 4


def test_broken_check_of_a_plug_in_is_judged_by_its_worst_agent(tmp_path):
    made = SyntheticRun(tmp_path).write()
    result = made.result()
    check = {"name": "counter.lost", "limit": 0, "got": 3, "passed": False}
    result["agents"]["agent-02"]["simulation"]["checks"] = [check]

    summary = finish_run(made.run, result, made.expected)

    assert summary.exit_code == 4
    assert check | {"worst": "agent-02"} in summary.document["checks"]


def test_manifest_lists_every_file_with_its_hash_but_not_the_reserve(tmp_path):
    made = SyntheticRun(tmp_path).write()

    finish(made, has_report=True)

    files = read(made.run.manifest_json)["files"]
    assert {"run.json", "plan.json", "result.json", "report.html", "tables/ticks.parquet"} <= set(
        files
    )
    assert not any("reserve" in name for name in files)
    assert all(len(entry["sha256"]) == 64 for entry in files.values())
    ticks = files["agents/agent-01/ticks.jsonl"]
    assert (ticks["records"], ticks["lost"], ticks["closed"]) == (made.ticks, 0, True)


def test_package_holds_the_run_under_its_name(tmp_path):
    made = SyntheticRun(tmp_path).write()

    finish(made)

    with made.run.bundle.open("rb") as raw:
        stream = zstandard.ZstdDecompressor().stream_reader(raw)
        with tarfile.open(fileobj=stream, mode="r|") as archive:
            members = [(m.name, m.mode, m.uid) for m in archive]
    names = [name for name, _, _ in members]
    assert names == sorted(names)
    assert {f"{made.run.name}/run.json", f"{made.run.name}/manifest.json"} <= set(names)
    assert all((mode, uid) == (0o600, 0) for _, mode, uid in members)


@pytest.mark.slow
@pytest.mark.timeout(60)
@pytest.mark.parametrize("name", ["core", "ticks.jsonl"])
def test_file_with_holes_that_claims_terabytes_is_named_and_not_read(tmp_path, name):
    made = SyntheticRun(tmp_path).write()
    finish(made)
    path = made.run.path / "agents/agent-01" / name
    path.touch()
    os.truncate(path, 9 * 10**12)

    for _ in range(2):
        summary = again(made)

        assert summary.exit_code == 5
        (line,) = [line for line in summary.missing if line.startswith(f"agents/agent-01/{name}: ")]
        assert "not read: it is 9.0 TB, with holes" in line
        assert f"cosmos collect --size-max SIZE {made.run.path}" in line
        entry = read(made.run.manifest_json)["files"].get(f"agents/agent-01/{name}", {})
        assert set(entry) <= {"missing", "was"}
        assert made.run.bundle.stat().st_size < 10_000_000
    path.unlink()
    assert again(made).exit_code == (0 if name == "core" else 5)


def test_file_with_holes_that_is_allowed_is_read_and_stays_so(tmp_path):
    made = SyntheticRun(tmp_path).write()
    (made.run.path / "host/holes").touch()
    os.truncate(made.run.path / "host/holes", 3_000_000)
    bounded = {"bytes_max": 2_000_000}
    assert finish_run(made.run, made.result(), made.expected, **bounded).exit_code == 5

    finish(made)

    assert read(made.run.manifest_json)["files"]["host/holes"]["bytes"] == 3_000_000
    assert finish_run(made.run, made.result(), made.expected, **bounded).exit_code == 0


def test_file_without_holes_is_read_however_large(tmp_path):
    made = SyntheticRun(tmp_path).write()
    (made.run.path / "host/noise").write_bytes(b"x" * 3_000_000)

    summary = finish_run(made.run, made.result(), made.expected, bytes_max=2_000_000)

    assert summary.exit_code == 0, summary.verdict.text


def test_full_disk_still_gets_a_summary_that_names_what_is_not_written(tmp_path, monkeypatch):
    made = SyntheticRun(tmp_path).write()
    for what in (
        "evidence.tabulate.TableWriter",
        "collect.finish.write_report",
        "collect.finish.pack_run",
    ):
        monkeypatch.setattr(f"cosmos_cli.{what}", full_disk.refuse)

    summary = finish(made, has_report=True)

    assert (summary.exit_code, summary.is_packed) == (5, False)
    text = "\n".join(read(made.run.run_json)["data"]["missing"])
    assert "tables/ticks.parquet: not written" in text
    assert "report.html: not written" in text
    assert f"{made.run.bundle.name}: not written" in text
    assert made.run.manifest_json.exists()


def test_progress_tells_of_every_long_step(tmp_path):
    made = SyntheticRun(tmp_path).write()
    told = []

    finish_run(
        made.run,
        made.result(),
        made.expected,
        progress=lambda what, share: told.append((what.split()[0], share)),
    )

    assert {"reading", "writing", "packing"} <= {what for what, _ in told}
    assert all(0 <= share <= 1 for _, share in told)


def test_values_that_were_not_finite_are_counted_in_run_json(tmp_path):
    made = SyntheticRun(tmp_path).write()
    path = made.stream("agent-01", "ticks")
    end = orjson.dumps({"end": {"records": made.ticks, "dropped": 0, "not_finite": 3}})
    path.write_bytes(b"\n".join([*path.read_bytes().split(b"\n")[:-2], end, b""]))

    summary = finish(made)

    assert summary.document["records"]["not_finite"] == 3
    check = {c["name"]: c for c in summary.document["checks"]}["records.not_finite"]
    assert (check["got"], check["passed"], check["worst"]) == (3, False, "agent-01/ticks")
    assert summary.verdict.exit_code == 4


def test_round_trips_of_the_clock_are_labelled_as_minima_and_have_no_tail(tmp_path):
    made = SyntheticRun(tmp_path).write()
    for name in made.names:
        made.stream(name, "round_trips").unlink()
        del made.records[name]["streams"]["round_trips"]

    summary = finish(made)

    assert summary.exit_code == 0, summary.verdict.text
    assert summary.document["round_trip_ms"] == {
        "stream": "clock (minimum a window)",
        "count": 40,
        "min": 0.18,
        "p50": 0.18,
        "max": 0.18,
    }


def again(made):
    return collect_run(made.run, processes=lambda: [])


def test_agent_and_plan_that_were_deleted_are_both_named(tmp_path):
    made = SyntheticRun(tmp_path).write()
    finish(made)
    shutil.rmtree(made.run.path / "agents/agent-02")
    made.run.plan_json.unlink()

    summary = again(made)

    assert summary.exit_code == 5
    named = {line.split(":")[0] for line in summary.missing}
    assert {"agent-02", "plan.json", "agents/agent-02/ticks.jsonl"} <= named


def test_run_in_lockstep_whose_plan_is_lost_misses_no_records_of_real_time(tmp_path):
    config = make_config()
    in_lockstep = dataclasses.replace(config.time, mode="lockstep")
    made = SyntheticRun(tmp_path, dataclasses.replace(config, time=in_lockstep)).write()
    for name in ("ticks", "clock", "process"):
        for agent in made.names:
            made.stream(agent, name).unlink()
            del made.records[agent]["streams"][name]
    shutil.rmtree(made.run.path / "machines")
    (made.run.path / "host/health.jsonl").unlink()
    before = finish(made)
    assert before.missing == ()
    made.run.plan_json.unlink()

    after = again(made)

    told = ("missing; it was there when the run was collected",)
    assert tuple(line for line in after.missing if not line.startswith("tables/")) == tuple(
        f"plan.json: {text}" for text in told
    )
    names = [check["name"] for check in after.document["checks"]]
    assert names == [check["name"] for check in before.document["checks"]]
    assert after.document["records_sha256"] == before.document["records_sha256"]


def test_agent_and_plan_are_named_even_without_the_manifest(tmp_path):
    made = SyntheticRun(tmp_path).write()
    finish(made)
    shutil.rmtree(made.run.path / "agents/agent-02")
    made.run.plan_json.unlink()
    made.run.manifest_json.unlink()

    assert {line.split(":")[0] for line in again(made).missing} == {"agent-02", "plan.json"}


@pytest.mark.parametrize(
    ("text", "told"), [("{", "cannot be used: "), ('{"files": 3}', "expected the run's files")]
)
def test_manifest_that_cannot_be_read_is_named(tmp_path, text, told):
    made = SyntheticRun(tmp_path).write()
    finish(made)
    made.run.manifest_json.write_text(text)

    summary = again(made)

    assert summary.exit_code == 5
    (line,) = summary.missing
    assert line.startswith("manifest.json: ") and told in line
    assert line.endswith("; what has changed since it was written is not known")


@pytest.mark.parametrize(
    ("listed", "told"),
    [
        ({"a": 1}, "expected a list of checks under expectations"),
        ([3], "expectations[0]: expected"),
        ([{"name": "a", "words": "a", "stream": "b", "agents": [], "newer": 1}], "newer"),
    ],
)
def test_a_check_of_the_plan_that_cannot_be_read_is_missing_and_not_left_out(
    tmp_path, listed, told
):
    made = SyntheticRun(tmp_path).write()
    plan = read(made.run.plan_json) | {"expectations": listed}
    made.run.plan_json.write_bytes(orjson.dumps(plan))

    summary = finish(made)

    assert summary.exit_code == 5
    (line,) = summary.missing
    assert line.startswith("plan.json: cannot be used: ") and told in line


@pytest.mark.slow
@pytest.mark.parametrize("name", ["plan.json", "scenario.yaml"])
def test_input_that_was_deleted_is_named_and_limits_stay(tmp_path, name):
    made = SyntheticRun(tmp_path, make_config(deadline=Deadline(max_miss_ratio=0.25))).write()
    (made.run.path / "scenario.yaml").write_text("name: synthetic\n")
    limits = {c["name"]: c["limit"] for c in finish(made).document["checks"]}
    (made.run.path / name).unlink()

    for _ in range(2):
        summary = again(made)

        assert summary.exit_code == 5
        assert [line.split(":")[0] for line in summary.missing] == [name]
        assert {c["name"]: c["limit"] for c in summary.document["checks"]} == limits


@pytest.mark.slow
def test_the_hosts_table_is_no_evidence_that_changes_when_it_is_made_anew_or_deleted(tmp_path):
    made = SyntheticRun(tmp_path, make_config(1, ticks=20)).write()
    finish(made)
    made.run.host_table.write_bytes(b"at 1 Hz")
    assert again(made).exit_code == 0
    assert made.run.host_table.name in read(made.run.manifest_json)["files"]

    made.run.host_table.write_bytes(b"at 10 Hz")
    assert again(made).missing == ()
    made.run.host_table.unlink()
    assert again(made).missing == ()


@pytest.mark.slow
def test_stream_that_was_shortened_and_closed_again_is_named_every_time(tmp_path):
    made = SyntheticRun(tmp_path).write()
    finish(made)
    first = read(made.run.manifest_json)["files"]["agents/agent-01/round_trips.jsonl"]
    path = made.stream("agent-01", "round_trips")
    whole = path.read_bytes()
    lines = whole.split(b"\n")
    end = orjson.dumps({"end": {"records": made.ticks - 1, "dropped": 0, "not_finite": 0}})
    path.write_bytes(b"\n".join([*lines[:-3], end, b""]))

    for _ in range(2):
        summary = again(made)

        assert summary.exit_code == 5
        assert summary.missing == (
            "agents/agent-01/round_trips.jsonl: changed since the run was collected"
            " (199 records, were 200)",
        )
        entry = read(made.run.manifest_json)["files"]["agents/agent-01/round_trips.jsonl"]
        assert (entry["records"], entry["was"]) == (199, first)

    path.write_bytes(whole)
    assert again(made).exit_code == 0


@pytest.mark.parametrize("is_there", [True, False])
def test_package_that_alone_holds_records_as_they_were_is_kept_until_they_are_back(
    tmp_path, is_there
):
    made = SyntheticRun(tmp_path).write()
    finish(made)
    path, package = made.stream("agent-01", "round_trips"), made.run.bundle.read_bytes()
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    if not is_there:
        path.unlink()

    for _ in range(2):
        summary = again(made)

        assert (summary.exit_code, summary.is_packed) == (5, False)
        assert summary.kept_member == "0001-synthetic/agents/agent-01/round_trips.jsonl"
        assert made.run.bundle.read_bytes() == package
    path.write_bytes(whole)
    assert again(made).is_packed


@pytest.mark.timeout(60)
@pytest.mark.parametrize("what", ["cut", "gone", "a pipe"])
def test_package_without_the_records_as_they_were_is_written_anew(tmp_path, what):
    made = SyntheticRun(tmp_path).write()
    finish(made)
    made.stream("agent-01", "round_trips").write_bytes(b"")
    start = made.run.bundle.read_bytes()[:100]
    made.run.bundle.unlink()
    if what == "cut":
        made.run.bundle.write_bytes(start)
    elif what == "a pipe":  # which nobody writes into
        os.mkfifo(made.run.bundle)

    assert again(made).is_packed
    assert again(made).is_packed


@pytest.mark.parametrize("name", ["agents/agent-01/ticks.jsonl", "note.txt", "flown"])
def test_link_in_the_place_of_what_was_collected_is_named_and_not_followed(tmp_path, name):
    """What a link leads to is not packaged: it may be the same file today and gone tomorrow, or not of the run at all."""
    made = SyntheticRun(tmp_path / "runs").write()
    (made.run.path / "note.txt").write_text("as it was")
    (made.run.path / "flown").mkdir()
    (made.run.path / "flown/code.py").write_text("as it was")
    assert finish(made).exit_code == 0
    path = made.run.path / name
    path.rename(tmp_path / "elsewhere")
    path.symlink_to(tmp_path / "elsewhere")

    for _ in range(2):
        summary = again(made)

        assert summary.exit_code == 5
        assert any(
            line.startswith(name) and "a link, which is not followed" in line
            for line in summary.missing
        )


def test_link_to_another_file_in_the_place_of_a_stream_is_named(tmp_path):
    made = SyntheticRun(tmp_path / "runs").write()
    finish(made)
    (tmp_path / "foreign").write_text("nobody's records\n")
    made.stream("agent-01", "ticks").unlink()
    made.stream("agent-01", "ticks").symlink_to(tmp_path / "foreign")

    summary = again(made)

    assert summary.exit_code == 5
    assert "agent-01: ticks is missing" in summary.missing


@pytest.mark.parametrize(("number", "has_cure"), [(errno.ENOSPC, True), (errno.EROFS, False)])
def test_summary_that_cannot_be_written_asks_for_room_where_that_helps(
    tmp_path, monkeypatch, number, has_cure
):
    made = SyntheticRun(tmp_path).write()

    def refuse(*_):
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(finish_module, "write_json", refuse)

    with pytest.raises(RunFailedError, match="the verdict was: PASSED") as caught:
        finish(made)
    assert ("make room" in str(caught.value)) == has_cure


@pytest.mark.parametrize(
    ("origin", "place", "told"),
    [
        ("agents/agent-02/ticks.jsonl", "agents/agent-01/ticks.jsonl", "agent-02/ticks"),
        ("agents/agent-01/clock.jsonl", "agents/agent-01/ticks.jsonl", "agent-01/clock"),
        ("agents/agent-01/ticks.jsonl", "agents/agent-09/ticks.jsonl", "agent-01/ticks"),
        ("../else", "agents/agent-01/ticks.jsonl", "agent-01/ticks of run 0007-else"),
    ],
)
def test_records_of_others_are_named_and_not_taken_for_ones_own(tmp_path, origin, place, told):
    """Nothing in them is cut: by their end line alone they are whole."""
    made = SyntheticRun(tmp_path / "runs").write()
    ticks = made.stream("agent-01", "ticks").read_bytes()
    (made.run.path.parent / "else").write_bytes(ticks.replace(b"0001-synthetic", b"0007-else"))
    (made.run.path / place).parent.mkdir(exist_ok=True)
    shutil.copy(made.run.path / origin, made.run.path / place)

    summary = finish(made)

    assert summary.exit_code == 5
    (line,) = summary.missing
    who = place.split("/")[1]
    assert line == f"{who}: ticks holds records of {told}, which do not belong here"


def test_run_that_was_renamed_holds_its_own_records(tmp_path):
    made = SyntheticRun(tmp_path / "runs").write()
    made.run.path.rename(tmp_path / "runs/0042-moved")
    made.run = RunDirectory(tmp_path / "runs/0042-moved")

    assert finish(made).exit_code == 0
