"""Several values of one output at one time, as of a queue of pulses, are put out again by a rerun, and compared one by one."""

import json

import pytest
from harness.cosmos_command import CosmosCommand

from cosmos_cli.evidence.run_directory import RunDirectory
from cosmos_cli.rerun.device_comparison import compare_devices
from cosmos_cli.rerun.recorded_run import FlownRun, RecordedAgent, UsedDevice
from madns_runtime.config import Agents, Recording, RunConfig, TimeSettings
from madns_runtime.recording.record_files import RecordFiles
from madns_runtime.recording.recorder import Recorder
from madns_runtime.recording.records import EVENTS, Field, StreamSchema

DRIVER = """
from madns_runtime.hardware.contract import Channel, DeviceKind, Sample, SimulatedDevice


class Pulser(SimulatedDevice):
    kind = DeviceKind(
        name="pulser",
        summary="gives pulses, one after the other",
        needs_hardware=False,
        can_block=False,
        follows_simulated_time=True,
        rate_hz=10.0,
        channels=(
            Channel(name="level", unit="V"),
            Channel(name="pulse", unit="s", direction="out", passing="queue", safe=0.0),
        ),
    )

    def sample_at(self, t_s):
        return Sample(values={"level": t_s}, taken_s=t_s)

    def write(self, values, due_s):
        pass
"""
SIMULATION = """
from dataclasses import dataclass

from madns_runtime.plugin.api import AgentSimulation, HostSimulation, Simulation


@dataclass(frozen=True)
class Parameters:
    pass


class Host(HostSimulation):
    def setup(self, context):
        pass

    def initial_data(self, agent):
        return {}

    def start(self, t_s):
        pass

    def receive(self, agent, message):
        pass

    def timer(self, t_s):
        return None

    def result(self, job, value):
        pass

    def finish(self):
        return {}


class Agent(AgentSimulation):
    def setup(self, context, initial):
        self.context = context

    def start(self, t_s):
        pass

    def receive(self, message):
        pass

    def step(self, tick):
        self.context.hardware["pulser"].write("pulse", 0.1)
        self.context.hardware["pulser"].write("pulse", 0.2)

    def finish(self):
        return {}


simulation = Simulation(name="pulses", parameters=Parameters, host=":Host", agent=":Agent")
"""
SCENARIO = """
name: pulses
simulation: ./pulses.py:simulation
agents: {count: 1, tick_hz: 10}
time: {mode: lockstep, duration_s: 1}
hardware: {armed: true, devices: [{name: pulser, kind: "./pulser.py:Pulser"}]}
"""
SAMPLE = StreamSchema(
    "pulse",
    (
        *(Field("t_s", "s"), Field("number", "", "int")),
        *(Field("age_us", "us", "int"), Field("pulse", "s")),
    ),
)
FRAME = StreamSchema(
    "pulse",
    (
        *(Field("t_s", "s"), Field("lateness_us", "us", "int")),
        *(Field("bytes", "B", "int"), Field("data", "", "str")),
    ),
)
PULSE = StreamSchema(
    "pulse", (Field("t_s", "s"), Field("lateness_us", "us", "int"), Field("pulse", "s"))
)


def flown_again(folder, driver, simulation):
    """Fly a device with a simulation, and again; return the rerun's exit code and its channels by name."""
    (folder / "pulser.py").write_text(driver)
    (folder / "pulses.py").write_text(simulation)
    (folder / "pulses.yaml").write_text(SCENARIO)
    cosmos = CosmosCommand(folder)
    code, document = cosmos.run(folder / "pulses.yaml")
    assert code == 0, document["verdict"]
    done = cosmos("rerun", document["run"], "--json", "--quiet")
    return done.returncode, {each["name"]: each for each in json.loads(done.stdout)["devices"]}


@pytest.mark.process
def test_a_queue_of_values_of_one_tick_is_the_same_again(tmp_path):
    code, told = flown_again(tmp_path, DRIVER, SIMULATION)

    pulse = told["agent-01/pulser.pulse"]
    assert (pulse["records"], pulse["compared"], pulse["different"]) == (18, 18, 0)
    assert code == 0


@pytest.mark.process
def test_frames_of_which_the_newest_of_a_tick_alone_goes_out_are_the_same_again(tmp_path):
    of_bus = 'Channel(name="bus", direction="out", is_frame=True),'
    twice = SIMULATION.replace('"pulse", 0.1', '"bus", b"a"').replace(
        '"pulse", 0.2', '"bus", b"bc"'
    )

    _, told = flown_again(tmp_path, DRIVER.replace("channels=(", f"channels=({of_bus}"), twice)

    bus = told["agent-01/pulser.bus"]
    assert (bus["records"], bus["compared"], bus["different"]) == (9, 9, 0)


def compared(tmp_path, recorded, rerun, *, events=(), schema=PULSE):
    """Return what the comparison of an output's values finds, (time in s, value) each, and *events* of the device on record."""
    for folder, rows in (("devices", recorded), ("rerun/devices", rerun)):
        files = RecordFiles(tmp_path / folder / "a/dev", run="r", source="a/dev")
        recorder = Recorder(files, Recording())
        recorder.open_stream(schema)
        recorder.open_stream(EVENTS)
        for t_s, *values in rows:
            recorder.record("pulse", (t_s, 100, *values))
        for t_s, event, values in events if folder == "devices" else ():
            recorder.record("events", {"t_s": t_s, "utc": "", "event": event, **values})
        recorder.start()
        recorder.close()
    used = UsedDevice(
        agent="a",
        name="dev",
        full_name="a/dev",
        folder=tmp_path / "devices/a/dev",
        may_write=True,
    )
    config = RunConfig(
        run="r",
        scenario="r",
        simulation="counter",
        base_directory=".",
        agents=Agents(count=1, tick_hz=10.0),
        time=TimeSettings(duration_s=1.0),
    )
    flown = FlownRun(
        run=RunDirectory(tmp_path),
        config=config,
        agents={"a": RecordedAgent(ticks=None, last_s=0.9, last_wake_s=0.9)},
        devices=(used,),
    )
    (found,) = compare_devices(flown, tmp_path / "rerun", ())
    return found


def test_values_of_one_time_are_compared_in_their_order(tmp_path):
    rows = [(0.1, 1.0), (0.1, 2.0), (0.1, 3.0), (0.2, 1.0)]

    assert compared(tmp_path / "same", rows, rows).different == 0
    fewer = compared(tmp_path / "fewer", rows, [rows[0], *rows[2:]])
    # The second has another value, the third none.
    assert (fewer.compared, fewer.different) == (4, 2)


def test_values_of_real_time_that_differ_by_microseconds_find_those_of_their_tick(tmp_path):
    recorded = [(0.100001, 1.0), (0.100008, 2.0), (0.200002, 1.0), (0.200003, 2.0)]
    rerun = [(0.1, 1.0), (0.1, 2.0), (0.2, 1.0), (0.2, 2.0)]

    assert compared(tmp_path, recorded, rerun).different == 0


def test_what_another_clock_put_out_a_moment_off_its_time_finds_that_of_its_time(tmp_path):
    times_s = [0.05 * number for number in range(1, 18)]
    recorded = [(t_s + 41e-6 * (-1) ** k, float(k)) for k, t_s in enumerate(times_s)]
    rerun = [(t_s, float(k)) for k, t_s in enumerate(times_s)]

    assert compared(tmp_path / "whole", recorded, rerun).different == 0
    missing = compared(tmp_path / "missing", [*recorded[:8], *recorded[9:]], rerun)
    assert (missing.compared, missing.different) == (17, 1)
    assert missing.first.text == "only in the rerun"


def refused(t_s, why="pulse: the bus is full"):
    return (t_s, "refused", {"why": why})


def frames(*told):
    return [(t_s, len(data) // 2, data) for t_s, data in told]


FRAMES = frames((0.1, "aa"), (0.2, "bb"), (0.2, "cc"), (0.2, "dd"), (0.3, "ee"))


@pytest.mark.parametrize("gone", [0, 1, 2, 3, 4])
def test_a_frame_that_the_driver_refused_is_no_difference(tmp_path, gone):
    at_s = FRAMES[gone][0] + 0.0003
    recorded = FRAMES[:gone] + FRAMES[gone + 1 :]

    found = compared(tmp_path, recorded, FRAMES, events=[refused(at_s)], schema=FRAME)
    others = [refused(at_s, "other: the bus is full"), refused(0.09), refused(None)]
    told = compared(tmp_path / "told", recorded, FRAMES, events=others, schema=FRAME)

    assert (found.compared, found.different, found.left_out) == (4, 0, 1)
    assert told.different > 0


def test_a_frame_that_was_refused_is_no_difference_where_others_came_after_the_last_tick(tmp_path):
    found = compared(
        tmp_path,
        [*FRAMES[1:], *frames((0.9001, "ff"), (0.9002, "00"))],
        FRAMES,
        events=[refused(0.1003)],
        schema=FRAME,
    )

    assert (found.compared, found.different, found.left_out) == (4, 0, 3)


def test_a_frame_of_todays_software_is_a_difference_beside_one_that_was_refused(tmp_path):
    recorded = frames((0.1, "aa"), (0.3, "ee"))
    rerun = frames((0.1, "ab"), (0.2, "bb"), (0.3, "ee"))

    found = compared(tmp_path, recorded, rerun, events=[refused(0.2003)], schema=FRAME)

    assert (found.compared, found.different, found.left_out) == (2, 1, 1)


def test_a_value_that_the_driver_refused_is_no_difference(tmp_path):
    rerun = [(0.1 * k, float(k)) for k in range(1, 8)]
    recorded = [*rerun[:3], *rerun[4:]]

    found = compared(tmp_path, recorded, rerun, events=[refused(0.4003, "a: pulse: too long")])

    assert (found.compared, found.different, found.left_out) == (6, 0, 1)


def test_the_safe_value_of_a_profile_that_had_run_out_is_no_difference(tmp_path):
    rerun = [(0.1, 1.0), (0.2, 2.0), (0.5, 5.0)]
    recorded = [*rerun[:2], (0.3, 0.0), rerun[2]]
    ran_out = (0.30009, "underrun", {"channel": "pulse"})

    found = compared(tmp_path, recorded, rerun, events=[ran_out])
    told = compared(tmp_path / "told", recorded, rerun, events=[(0.2, *ran_out[1:])])

    assert (found.compared, found.different, found.left_out) == (3, 0, 1)
    assert (told.compared, told.different) == (4, 1)


@pytest.mark.parametrize(("fault_s", "different"), [(0.97, 0), (0.5, 2)])
def test_what_the_last_step_wrote_is_no_difference_where_a_fault_came_behind_it(
    tmp_path, fault_s, different
):
    rerun = [(0.7, 1.0), (0.8, 1.0)]
    fault = (fault_s, "fault", {"action": "bias", "value": 1.0})

    found = compared(tmp_path, [*rerun, (0.9, 1.0), (0.9, 2.0)], rerun, events=[fault])

    assert (found.different, found.left_out) == (different, 2 - different)


def test_a_sample_that_came_behind_the_last_tick_is_not_seen_though_it_was_taken_before(tmp_path):
    rerun = [(0.75, 50_000, 1.0), (0.8, 50_000, 2.0)]
    fault = (0.97, "fault", {"action": "bias", "value": 1.0})
    recorded = [*rerun, (0.9, 50_000, 3.0)]

    found = compared(tmp_path, recorded, rerun, events=[fault], schema=SAMPLE)

    assert (found.compared, found.different, found.left_out) == (2, 0, 1)
