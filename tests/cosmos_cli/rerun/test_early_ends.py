"""What a rerun has of agents after their last ticks on record is not compared, and told."""

import dataclasses
import shutil

import pytest
from harness.synthetic_run import SyntheticRun, make_config

from cosmos_cli.collect.finish import finish_run
from cosmos_cli.diff.compare import Comparison
from cosmos_cli.diff.fields import RecordPlace
from cosmos_cli.diff.stream import Alone, StreamDifference
from cosmos_cli.errors import InputError
from cosmos_cli.evidence.run_directory import RunDirectory
from cosmos_cli.rerun.device_comparison import compare_devices
from cosmos_cli.rerun.early_ends import (
    early_ends,
    leave_out_after_ends,
    leave_out_after_simulated_time,
    leave_out_unwritten,
)
from cosmos_cli.rerun.outcome import RerunOutcome, verdict_of
from cosmos_cli.rerun.recorded_run import FlownRun, RecordedAgent, UsedDevice, read_recorded_run
from cosmos_cli.rerun.scenario import make_rerun
from madns_runtime.config import Agents, Recording, RunConfig, TimeSettings
from madns_runtime.recording.record_files import RecordFiles
from madns_runtime.recording.recorder import Recorder
from madns_runtime.recording.records import Field, StreamSchema

HZ = 10.0


def stream(source, *, by="tick", first, count=1):
    place = RecordPlace(first)
    return StreamDifference(
        table="state",
        source=source,
        by=by,
        rows_a=34,
        rows_b=34 + count,
        only_b=Alone(count=count, first=place, last=place),
    )


def test_a_rerun_with_nothing_to_judge_is_not_the_same():
    counted = StreamDifference(table="round_trips", source="a", rows_a=20, rows_b=20, matched=20)
    compared = Comparison(a=None, b=None, streams=[counted])
    outcomes = [
        RerunOutcome(devices=(), streams=compared, remarks=(), unlike=unlike)
        for unlike in ((), ("round_trips",))
    ]

    assert [found.is_same for found in outcomes] == [True, False]
    assert verdict_of(outcomes[0]).startswith("SAME: 0 records of 0 channels of devices, 20")
    assert verdict_of(outcomes[1]).startswith("NOTHING COMPARED")


def test_a_field_that_one_run_alone_records_or_in_another_unit_is_a_difference():
    counted = StreamDifference(
        table="drive",
        source="a",
        rows_a=20,
        rows_b=20,
        matched=20,
        fields_only_a=("odometer_m (m)", "speed_m_s"),
        fields_only_b=("odometer_m (km)",),
    )
    compared = Comparison(a=None, b=None, streams=[counted])
    found, without = (
        RerunOutcome(devices=(), streams=compared, remarks=(), unlike=unlike)
        for unlike in ((), ("drive.speed_m_s", "drive.odometer_m"))
    )

    assert found.differences_of(counted) == [
        "odometer_m (m), speed_m_s only on record",
        "odometer_m (km) only in the rerun",
    ]
    assert (found.is_same, without.is_same) == (False, True)


def test_agents_that_ended_before_the_last_one_are_known_with_their_times():
    agents = {name: RecordedAgent(ticks=None, last_s=s) for name, s in (("a", 3.4), ("b", 3.3))}

    assert early_ends(agents) == {"b": 3.3}


def test_what_comes_after_an_agents_end_is_left_out_and_told_and_nothing_else():
    after, earlier = stream("b", first=34), stream("b", first=33)
    timed, other = stream("b", by="time", first=3.4, count=2), stream("a", first=34)

    remarks = leave_out_after_ends([after, earlier, timed, other], {"b": 3.3}, HZ)

    assert (after.only_b.count, after.rows_b, after.has_same_values) == (0, 34, True)
    assert timed.only_b.count == 0
    assert (earlier.only_b.count, other.only_b.count) == (1, 1)
    assert remarks == (
        "b ended with the tick of 3.3 s: 3 records of the rerun after that are not compared",
    )


def test_what_the_host_recorded_after_simulated_time_is_left_out_and_told_and_nothing_else():
    def of_host(first_s, *, by="time", source="host"):
        place = RecordPlace(first_s)
        alone = Alone(count=3, first=place, last=place)
        return StreamDifference(
            table="host_truth", source=source, by=by, rows_a=37, rows_b=34, only_a=alone
        )

    after, within = of_host(3.4 - 1e-15), of_host(3.39)
    others = of_host(3.45, by="order"), of_host(3.45, source="a")

    remarks = leave_out_after_simulated_time([after, within, *others], 3.4)

    assert (after.only_a.count, after.rows_a, after.has_same_values) == (0, 34, True)
    assert [one.only_a.count for one in (within, *others)] == [3, 3, 3]
    assert remarks == (
        "host_truth: 3 records of the host from the end of simulated time on, 3.4 s, are not compared",
    )


def test_remarks_name_few_of_many_agents():
    names = [f"agent-{number:02d}" for number in range(1, 41)]

    remarks = leave_out_after_ends(
        [stream(name, first=34) for name in names], dict.fromkeys(names, 3.3), HZ
    )

    assert len(remarks) == 6
    assert remarks[-1] == "35 more agents ended before the last one did, likewise"


VALVE = StreamSchema(
    "valve", (Field("t_s", "s"), Field("lateness_us", "us", "int"), Field("valve", "1"))
)
IMU = StreamSchema(
    "rate",
    (
        Field("t_s", "s"),
        Field("number", "", "int"),
        Field("age_us", "us", "int"),
        Field("rate", "1"),
    ),
)


def write(folder, source, ticks):
    """Record a sample before each tick, and an output with it."""
    files = RecordFiles(folder, run="r", source=source)
    recorder = Recorder(files, Recording())
    for schema in (VALVE, IMU):
        recorder.open_stream(schema)
    for tick in range(ticks):
        recorder.record("valve", (tick / HZ, 0, 1.0))
        recorder.record("rate", (tick / HZ - 0.01, tick + 1, 0, 2.0))
    recorder.start()
    recorder.close()


@pytest.mark.parametrize(("ends", "differ"), [({"a": 3.3}, [0, 0]), ({}, [1, 1])])
def test_what_devices_are_given_after_their_agents_end_is_left_out_too(tmp_path, ends, differ):
    write(tmp_path / "devices/a/imu", "a/imu", 34)
    write(tmp_path / "rerun/devices/a/imu", "a/imu", 35)
    used = UsedDevice(
        agent="a",
        name="imu",
        full_name="a/imu",
        folder=tmp_path / "devices/a/imu",
        may_write=True,
    )
    agent = RecordedAgent(ticks=tmp_path / "ticks.jsonl", last_s=3.3, last_wake_s=3.3)
    config = RunConfig(
        run="r",
        scenario="r",
        simulation="counter",
        base_directory=".",
        agents=Agents(count=1, tick_hz=HZ),
        time=TimeSettings(duration_s=60.0),
    )
    recorded = FlownRun(
        run=RunDirectory(tmp_path), config=config, agents={"a": agent}, devices=(used,)
    )

    found = compare_devices(recorded, tmp_path / "rerun", ends)

    assert [(each.direction, each.different) for each in found] == list(
        zip(("in", "out"), differ, strict=True)
    )


def test_of_an_agent_that_was_killed_its_last_tick_need_not_be_written_whole():
    at_last, before = stream("b", first=33), stream("b", first=32)

    remarks = leave_out_after_ends([at_last, before], {"b": 3.3}, HZ, {"b"})

    assert (at_last.only_b.count, before.only_b.count) == (0, 1)
    assert remarks == (
        "b ended with the tick of 3.3 s: 1 record of the rerun from then on are not compared",
    )


def test_all_that_the_rerun_has_of_an_agent_that_wrote_no_tick_is_left_out_and_told():
    first, other = stream("b", first=0, count=2), stream("a", first=0)
    alone = [("state", "a"), ("state", "b"), ("orbit", "b")]

    told = leave_out_after_ends([first, other], {"b": -0.1}, HZ, {"b"})
    told += leave_out_unwritten(alone, {"b": -0.1})

    assert (first.only_b.count, other.only_b.count, alone) == (0, 1, [("state", "a")])
    assert told == (
        "b was killed before any of its ticks was written: 2 records of the rerun are not compared",
        "b was killed before any of its ticks was written: state, orbit of the rerun are not compared",
    )


def recorded_by(tmp_path, ticks, **told):
    """Return a run in real time of two agents, of which the second wrote so many ticks, as a rerun reads it."""
    made = SyntheticRun(tmp_path).write()
    shutil.rmtree(made.run.path / "agents/agent-02")
    made.write_agent("agent-02", last=ticks)
    result = made.result()
    result["agents"]["agent-02"] |= told
    finish_run(made.run, result, made.expected, has_report=False)
    return read_recorded_run(made.run, "last", None)


@pytest.mark.parametrize(("ticks", "last_s"), [(150, 14.9), (0, -0.1)])
def test_an_agent_that_a_fault_killed_is_flown_again_however_little_it_wrote(
    tmp_path, ticks, last_s
):
    recorded = recorded_by(tmp_path, ticks, ended_on_purpose=[1])

    assert recorded.killed == {"agent-02"}
    assert recorded.agents["agent-02"].last_s == pytest.approx(last_s)
    assert make_rerun(recorded).ends == {"agent-02": pytest.approx(last_s)}


def test_an_agent_without_ticks_that_nobody_killed_on_purpose_is_refused(tmp_path):
    with pytest.raises(InputError, match="agent-02: .*expected its ticks, found none"):
        recorded_by(tmp_path, 0)


def test_an_agent_that_lives_to_the_end_of_a_complete_run_ends_with_it(tmp_path):
    assert make_rerun(recorded_by(tmp_path, 199)).ends == {}


@pytest.mark.parametrize(
    "told", [{"status": "interrupted"}, {"status": "aborted", "who": "operator"}, None]
)
def test_a_run_in_lockstep_that_was_cut_off_is_cut_off_again_and_compared_up_to_there(
    tmp_path, told
):
    config = make_config(2)
    config = dataclasses.replace(
        config, time=dataclasses.replace(config.time, mode="lockstep"), on_agent_loss="abort"
    )
    made = SyntheticRun(tmp_path, config)
    (made.run.path / "scenario.yaml").write_text("name: synthetic\nsimulation: counter\n")
    for name in made.names:
        made.write_agent(name, last=121)
    result = None if told is None else made.result(**told)
    finish_run(made.run, result, made.expected, has_report=False)

    recorded = read_recorded_run(made.run, "last", None)
    flown = make_rerun(recorded)

    assert recorded.cut_s == pytest.approx(12.0)
    (end,) = flown.scenario.scenario.timeline
    assert end == {"action": "stop", "at_s": pytest.approx(12.05)}
    assert flown.ends == dict.fromkeys(("agent-01", "agent-02", "host"), pytest.approx(11.8))
    assert any("it was cut off at 12 s" in remark for remark in flown.remarks)


def test_a_run_in_lockstep_that_failed_by_itself_fails_again(tmp_path):
    config = make_config(1)
    config = dataclasses.replace(config, time=dataclasses.replace(config.time, mode="lockstep"))
    made = SyntheticRun(tmp_path, config)
    made.write_agent("agent-01", last=121)
    result = made.result(status="failed", who="agent-01", reason="step raised")
    finish_run(made.run, result, made.expected, has_report=False)

    assert read_recorded_run(made.run, "last", None).cut_s is None


def test_the_last_tick_of_a_run_in_lockstep_that_was_stopped_is_the_one_before_the_stop(tmp_path):
    config = make_config(1)
    config = dataclasses.replace(config, time=dataclasses.replace(config.time, mode="lockstep"))
    made = SyntheticRun(tmp_path, config)
    made.write_agent("agent-01", last=120)
    finish_run(made.run, made.result(duration_s=12.0), made.expected, has_report=False)

    recorded = read_recorded_run(made.run, "last", None)

    assert (recorded.cut_s, recorded.agents["agent-01"].last_s) == (None, pytest.approx(11.9))
