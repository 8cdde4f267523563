"""`cosmos rerun`: recorded runs flown again in lockstep with their devices played back, and runs that cannot be."""

import json
import shutil

import pytest
from harness.cosmos_command import LOOSE, SCENARIOS, CosmosCommand
from harness.firmware import build_firmware, needs_emulator

pytestmark = pytest.mark.process

DRIVER = """
import random
import time

from madns_runtime.hardware.contract import Channel, Device, DeviceKind, Sample


class Imu(Device):
    kind = DeviceKind(
        name="noisy",
        summary="a gyroscope with noise of its own",
        needs_hardware=False,
        rate_hz=25.0,
        channels=(
            Channel(name="gyro", unit="rad/s", shape=(3,), components=("x", "y", "z")),
            Channel(name="coil", unit="A", shape=(3,), direction="out", safe=(0.0, 0.0, 0.0)),
        ),
    )

    def read(self):
        rates = [random.gauss(0.01, 1e-3) for _ in range(3)]
        return Sample(values={"gyro": rates}, taken_s=time.monotonic())

    def write(self, values, due_s):
        pass
"""
FLIGHT = """
from madns_runtime.simulations.constellation.flight.api import FlightSoftware


class Brake(FlightSoftware):
    def setup(self, context):
        self.context = context

    def step(self, t_s, readings):
        if "gyro" in readings:
            torque = [-1e-3 * rate for rate in readings["gyro"].values]
            self.context.torque(torque, at_s=t_s + 0.5, duration_s=0.1)
"""
REAL = """
name: braked
simulation: constellation
agents: {count: 2, tick_hz: 10}
time: {mode: realtime, duration_s: 2}
hardware:
  armed: true
  on_device_loss: continue
  devices: [{name: imu, kind: "./noisy.py:Imu"}]
parameters:
  satellites: {walker: "86.4:2/2/0", altitude_km: 780}
  epoch_utc: 2026-03-20T12:00:00Z
  vehicles:
    - attitude:
        inertia_kg_m2: [0.2, 0.3, 0.25]
        initial: inertial
        wheels: {torque_n_m_max: 0.1, momentum_n_m_s_max: 1}
      sensors: {gyro: {device: imu.gyro}, magnetometer: {noise: 1e-8}}
      stimuli: [{source: magnetic_field, channel: imu.coil, scale: 1.0e+4, rate_hz: 20}]
  flight: brake.py:Brake
"""
EVEN = """
name: even
simulation: counter
agents: {count: 2, tick_hz: 30}
time: {duration_s: 2, mode: lockstep}
hardware:
  devices:
    - name: gps
      kind: synthetic
      rate_hz: 30
      parameters: {channels: [{name: value, elements: [{shape: sine, amplitude: 1.0, noise: 0.1}]}]}
"""


def rerun(cosmos, *arguments):
    done = cosmos("rerun", *arguments, "--json", "--quiet")
    return done.returncode, json.loads(done.stdout) if done.stdout else {}, done.stderr


@pytest.fixture(scope="module")
def braked(tmp_path_factory):
    """A run in real time whose flight software brakes by the rates of a device; none of its tests changes it."""
    folder = tmp_path_factory.mktemp("braked")
    (folder / "noisy.py").write_text(DRIVER)
    (folder / "brake.py").write_text(FLIGHT)
    (folder / "braked.yaml").write_text(REAL)
    cosmos = CosmosCommand(folder)
    code, document = cosmos.run(
        folder / "braked.yaml", *LOOSE, "hardware.stale_ratio=1", "hardware.stimulus_late=1"
    )
    # A busy machine may break deadlines of commands; what came of them is recorded, and so the same again.
    assert document["status"] == "complete" and code in (0, 4), document["verdict"]
    return cosmos, document


def channels(told):
    return {each["name"]: each for each in told["devices"]}


def test_a_lockstep_run_with_devices_is_the_same_again(tmp_path):
    (tmp_path / "even.yaml").write_text(EVEN)
    cosmos = CosmosCommand(tmp_path)
    cosmos.run(tmp_path / "even.yaml", *LOOSE)

    code, told, err = rerun(cosmos, "last")

    assert code == 0, err
    assert told["same"]
    value = channels(told)["agent-02/gps.value"]
    assert (value["compared"], value["different"], value["left_out"]) == (60, 0, 0)


def test_a_run_in_real_time_has_the_same_samples_commands_and_truth_in_lockstep(braked):
    cosmos, document = braked

    code, told, err = rerun(cosmos, document["run"])

    found = channels(told)
    gyro, coil = found["agent-01/imu.gyro"], found["agent-01/imu.coil"]
    assert gyro["different"] == 0 and gyro["compared"] >= 20, gyro
    assert coil["different"] == 0 and coil["compared"] >= 20, coil
    tables = {each["table"]: each for each in told["diff"]["streams"]}
    unsure = sum(each["in_ticks"] for each in found.values()) + document["timing"]["missed"]
    if (
        not unsure
    ):  # what came within a tick it may have found; lockstep flies ticks that were skipped
        assert code == 0, (told["devices"], err)
        assert tables["commands"]["matched"] >= 20
        assert tables["commands"]["identical"]
    assert told["rerun"] != told["run"]


def test_a_change_of_the_flight_software_is_found_and_its_copy_is_not(braked, tmp_path):
    cosmos, document = braked
    for name in ("noisy.py", "brake.py"):
        shutil.copy(cosmos.folder / name, tmp_path)
    changed = FLIGHT.replace("-1e-3 * rate", "-2e-3 * rate")
    (tmp_path / "brake.py").write_text(changed)

    code, told, _ = rerun(cosmos, document["run"], "--as-recorded", tmp_path)

    assert code == 1
    tables = {each["table"]: each for each in told["diff"]["streams"]}
    assert tables["commands"]["fields"]["x"]["different"] >= 20
    assert channels(told)["agent-01/imu.gyro"]["different"] == 0


@pytest.mark.parametrize(
    ("gone", "words"),
    [
        ("run.json", "is not collected yet; do that with: cosmos collect"),
        ("plan.json", "expected the run's settings under config"),
        ("devices/agent-01/imu", "agent-01/imu: no records of it in"),
        ("agents/agent-02/ticks.jsonl", "agent-02: its ticks cannot be read"),
    ],
)
def test_a_run_that_cannot_be_flown_again_is_refused_in_words(braked, tmp_path, gone, words):
    cosmos, document = braked
    copy = tmp_path / "runs" / document["run"]
    shutil.copytree(cosmos.directory(document), copy)
    path = copy / gone
    shutil.rmtree(path) if path.is_dir() else path.unlink()

    done = cosmos("rerun", str(copy), "--runs", tmp_path / "runs")

    assert done.returncode == 2
    assert words in done.stderr
    assert "Traceback" not in done.stderr
    assert len(list((tmp_path / "runs").iterdir())) == 1


def test_a_plan_that_names_devices_elsewhere_is_refused(braked, tmp_path):
    cosmos, document = braked
    copy = tmp_path / "runs" / document["run"]
    shutil.copytree(cosmos.directory(document), copy)
    plan = json.loads((copy / "plan.json").read_text())
    plan["devices"] = {"loopback": ["../../etc", "a\x1b[31m/imu"]}
    (copy / "plan.json").write_text(json.dumps(plan))

    done = cosmos("rerun", str(copy), "--runs", tmp_path / "runs")

    assert done.returncode == 2
    assert done.stderr.count("plan.json names no device so") == 2
    assert "\x1b" not in done.stderr


def test_a_folder_that_is_not_there_any_more_is_named(braked, tmp_path):
    cosmos, document = braked

    done = cosmos("rerun", document["run"], "--as-recorded", tmp_path / "gone")

    assert done.returncode == 2
    assert "is not there; put it back, or name a copy with --as-recorded DIR" in done.stderr


@needs_emulator
def test_a_flight_computer_is_played_back_without_its_emulator(tmp_path):
    text = (SCENARIOS / "hwil_detumble.yaml").read_text()
    for old, new in (
        ("count: 10", "count: 1"),
        ("duration_s: 120", "duration_s: 3"),
        ("[agent-01, agent-02, agent-03]", "[agent-01]"),
        ("86.4:10/5/1", "86.4:1/1/0"),
        ("    - software: flight/detumble.py:Detumble\n", ""),
    ):
        assert old in text
        text = text.replace(old, new)
    (tmp_path / "one.yaml").write_text(text)
    image = build_firmware(tmp_path)
    (tmp_path / "firmware" / "detumble").mkdir(parents=True)
    image.rename(tmp_path / "firmware" / "detumble" / "detumble.elf")
    cosmos = CosmosCommand(tmp_path)
    _, document = cosmos.run(tmp_path / "one.yaml", *LOOSE, "hardware.stimulus_late=1")

    without = CosmosCommand(tmp_path, PATH="/nonexistent")
    code, told, err = rerun(without, document["run"])

    found = channels(told)
    received = found["agent-01/mcu.received"]
    assert received["different"] == 0 and received["compared"] >= 20, (received, err)
    assert found["agent-01/mcu.magnetometer"]["records"] >= 40
    assert found["agent-01/mcu.sent"]["judged"] is True
    assert any("its recorded bytes are played back" in remark for remark in told["remarks"])
    tables = {each["table"]: each for each in told["diff"]["streams"]}
    assert tables["commands"]["matched"] >= 1
    if not (document["timing"]["missed"] or received["in_ticks"]):
        assert code == 0, (told["devices"], err)
        assert tables["commands"]["identical"]
        # Results among it: to the bit, in their ticks.
        assert found["agent-01/mcu.sent"]["different"] == 0
        assert tables["command_results"]["identical"]
