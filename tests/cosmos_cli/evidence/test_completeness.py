"""What of a run's records is missing, judged from scans alone."""

import json
from pathlib import Path

import pytest
from harness.synthetic_run import MACHINE, SyntheticRun

from cosmos_cli.collect.finish import finish_run
from cosmos_cli.evidence.completeness import ExpectedRecords, find_missing
from cosmos_cli.evidence.run_directory import write_json
from cosmos_cli.evidence.streams import find_streams, scan_stream
from cosmos_cli.evidence.tabulate import gather
from madns_runtime.recording.records import EVENTS, Field, StreamSchema


def missing(made: SyntheticRun, **of_first_agent) -> list[str]:
    scans = [scan_stream(file) for file in find_streams(made.run.path)]
    result = made.result()
    result["agents"]["agent-01"].update(of_first_agent)
    return find_missing(made.expected, scans, result)


def renumber(folder: Path, incarnation: int) -> None:
    for path in folder.glob("*.jsonl"):
        path.rename(path.with_name(f"{path.stem}.{incarnation}.jsonl"))


@pytest.mark.parametrize(
    ("folder", "name"), [("agents/agent-01", "agent-01"), ("machines/loopback", "loopback")]
)
def test_incarnation_that_left_nothing_is_missing_when_a_later_one_recorded(tmp_path, folder, name):
    made = SyntheticRun(tmp_path).write()
    # The machine lost power before its disk had the first incarnation's files, and returned.
    renumber(made.run.path / folder, 2)

    (line,) = missing(made)
    assert line.startswith(f"{name}: no records of incarnation 1")


@pytest.mark.parametrize("is_in_lockstep", [True, False])
def test_a_stream_of_which_a_devices_account_tells_and_that_is_gone_is_missing(
    tmp_path, is_in_lockstep
):
    made = SyntheticRun(tmp_path).write()
    plan = made.run.read_json(made.run.plan_json) or {}
    write_json(made.run.plan_json, {**plan, "devices": {MACHINE: ["agent-01/imu"]}})
    gyro = StreamSchema("gyro", (Field("t_s", "s"), Field("gyro", "rad/s")))
    recorder = made.recorder("devices/agent-01/imu", "agent-01/imu", gyro, EVENTS)
    recorder.start()
    account = {"status": "ok", "frozen": {}, "records": recorder.close().to_mapping()}
    account |= {"samples": 0, "errors": 0, "stale_ratio": 0.0, "lost": 0, "restarts": 0}
    result = made.result()
    if is_in_lockstep:
        result["agents"]["agent-01"]["records"]["devices"] = {"imu": account}
    else:
        report = json.dumps({"agent-01/imu": {**account, "records": None, "report": account}})
        (made.run.path / "machines" / MACHINE / "devices.json").write_text(report)
    whole = finish_run(made.run, result, made.expected, has_report=False).missing
    (made.run.path / "devices/agent-01/imu/gyro.jsonl").unlink()
    made.run.manifest_json.unlink()

    cut = finish_run(made.run, result, made.expected, has_report=False).missing

    assert (whole, cut) == ((), ("agent-01/imu: gyro is missing",))


def test_machine_that_runs_no_agent_owes_no_records(tmp_path):
    made = SyntheticRun(tmp_path)
    plan = made.run.read_json(made.run.plan_json) or {}
    machines = {"pi01": {"agents": []}, "pi02": {"agents": ["agent-01"]}, "pi03": ["agent-02"]}
    made.run.plan_json.write_text(json.dumps({**plan, "machines": machines}))

    assert ExpectedRecords.read(made.run).machines == ("pi02", "pi03")


@pytest.mark.parametrize(
    ("ended", "incarnations", "lines"),
    [([1], 1, 0), ([1], 2, 1), ([1, 2], 2, 0), ([1, 2], 3, 1), ([10**15], 1, 0), (["x", -3], 1, 0)],
)
def test_an_agent_that_returned_owes_the_records_of_its_last_incarnation(
    tmp_path, ended, incarnations, lines
):
    made = SyntheticRun(tmp_path).write()

    found = missing(made, ended_on_purpose=ended, incarnations=incarnations)

    assert found == ["agent-01: no records"] * lines


@pytest.mark.parametrize("number", ["20000000", "3000000000", "0", "01"])
def test_a_number_to_which_no_recorder_counts_is_no_incarnation(tmp_path, number):
    made = SyntheticRun(tmp_path).write()
    file = made.run.path / "agents/agent-01/ticks.jsonl"
    file.rename(file.with_name(f"ticks.{number}.jsonl"))

    stray = f"ticks.{number} holds records of agent-01/ticks, which do not belong here"
    assert missing(made) == [f"agent-01: ticks is missing, {stray}"]
    assert gather(made.run, 10.0, lambda *_: None).faults == ()
