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
from madns_runtime.recording.records import Field, StreamSchema

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
PULSE = StreamSchema(
    "pulse", (Field("t_s", "s"), Field("lateness_us", "us", "int"), Field("pulse", "s"))
)


@pytest.mark.process
def test_a_queue_of_values_of_one_tick_is_the_same_again(tmp_path):
    (tmp_path / "pulser.py").write_text(DRIVER)
    (tmp_path / "pulses.py").write_text(SIMULATION)
    (tmp_path / "pulses.yaml").write_text(SCENARIO)
    cosmos = CosmosCommand(tmp_path)
    code, document = cosmos.run(tmp_path / "pulses.yaml")
    assert code == 0, document["verdict"]

    done = cosmos("rerun", document["run"], "--json", "--quiet")
    told = {each["name"]: each for each in json.loads(done.stdout)["devices"]}

    pulse = told["agent-01/pulser.pulse"]
    assert (pulse["records"], pulse["compared"], pulse["different"]) == (18, 18, 0)
    assert done.returncode == 0


def compared(tmp_path, recorded, rerun):
    """Return what the comparison of an output's values finds, (time in s, value) each."""
    for folder, rows in (("devices", recorded), ("rerun/devices", rerun)):
        files = RecordFiles(tmp_path / folder / "a/dev", run="r", source="a/dev")
        recorder = Recorder(files, Recording())
        recorder.open_stream(PULSE)
        for t_s, value in rows:
            recorder.record("pulse", (t_s, 0, value))
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
