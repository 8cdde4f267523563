"""`cosmos rerun`: recorded runs flown again in lockstep with their devices played back, and runs that cannot be."""

import json
import shutil
from pathlib import Path

import pytest
from harness.cosmos_command import LOOSE, SCENARIOS, CosmosCommand
from harness.firmware import build_firmware, needs_emulator

from cosmos_cli.evidence.manifest import file_entry

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
time: {mode: realtime, duration_s: 4}
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
timeline:
  - {at_s: 0.5, action: device_fault, agents: [agent-01], device: imu, fault: bias, value: 1.0e-3, for_s: 0.3}
  - {at_s: 1.0, action: annotate, text: halfway}
  - {when: {stream: ticks, field: tick, above: 5}, action: annotate, text: of real time alone}
checks:
  # Its samples after the last tick, at 3.9 s, are in no rerun.
  - {name: turns, stream: imu.gyro, field: gyro_x, within: [-1, 1], to_s: 3.8}
  - {name: prompt, stream: ticks, field: lateness_us, below: 60, unit: s}
  - {name: halfway, event: action_began, agents: [host]}
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
on_agent_loss: continue
timeline:
  - {at_s: 0.2, action: device_fault, agents: ["*"], device: gps, fault: bias, value: 3, for_s: 0.5}
  - {when: {stream: round_trips, field: packet, above: 20}, action: hang, agents: [agent-01], for_s: 0.2}
  - {at_s: 1.2, action: kill, agents: [agent-02], for_s: 0.2}
checks:
  - {name: shifted, stream: gps.value, field: value, statistic: max, below: 3}
  - {name: hung, event: hang_begins, agents: [agent-01]}
  # Of the device itself, which a recording stands in for: told, and not judged.
  - {name: biased, stream: gps.events, event: fault}
"""


PLUGIN = """
from dataclasses import dataclass
from madns_runtime.plugin.api import AgentSimulation, HostSimulation, Simulation

@dataclass(frozen=True)
class Parameters:
    pass

class H(HostSimulation):
    def initial_data(self, agent):
        return {}

class A(AgentSimulation):
    def step(self, tick):
        self.index = tick.index

simulation = Simulation(name="calm", parameters=Parameters, host=":H", agent=":A")
"""
OF_PLUGIN = """
name: calm
simulation: ./calm.py:simulation
agents: {count: 1, tick_hz: 10}
time: {duration_s: 0.5, mode: lockstep}
"""


def rerun(cosmos, *arguments):
    done = cosmos("rerun", *arguments, "--json", "--quiet")
    return done.returncode, json.loads(done.stdout) if done.stdout else {}, done.stderr


def test_a_run_that_fails_where_it_was_to_be_compared_is_told_with_its_verdict_and_folder(tmp_path):
    plugin, scenario = tmp_path / "calm.py", tmp_path / "calm.yaml"
    plugin.write_text(PLUGIN)
    scenario.write_text(OF_PLUGIN)
    cosmos = CosmosCommand(tmp_path)
    code, document = cosmos.run(scenario)
    assert code == 0, document["verdict"]
    plugin.write_text(PLUGIN.replace("self.index = tick.index", "raise RuntimeError('boom')"))

    compared = cosmos("diff", "--run", scenario, scenario, "--json", "--quiet")
    again = cosmos("rerun", document["run"], "--json", "--quiet")

    for done in (compared, again):
        told = json.loads(done.stdout)
        assert (done.returncode, told["exit_code"], told["error"]["kind"]) == (1, 1, "run_failed")
        assert "boom" in told["error"]["message"] and "boom" in done.stderr
        assert (Path(told["error"]["run"]) / "run.json").is_file()


@pytest.fixture(scope="module")
def braked(tmp_path_factory):
    """A run in real time whose flight software brakes by the rates of a device; none of its tests changes it."""
    top = tmp_path_factory.mktemp("braked")
    folder = top / "scenario"
    folder.mkdir()
    (folder / "noisy.py").write_text(DRIVER)
    (folder / "brake.py").write_text(FLIGHT)
    (folder / "braked.yaml").write_text(REAL)
    cosmos = CosmosCommand(top)
    code, document = cosmos.run(
        folder / "braked.yaml", *LOOSE, "hardware.stale_ratio=1", "hardware.stimulus_late=1"
    )
    # A busy machine may break deadlines of commands; what came of them is recorded, and so the same again.
    assert document["status"] == "complete" and code in (0, 4), document["verdict"]
    return cosmos, document


def records(path):
    lines = map(json.loads, path.read_text().splitlines())
    return [line for line in lines if isinstance(line, list)]


def channels(told):
    return {each["name"]: each for each in told["devices"]}


def test_a_lockstep_run_with_devices_is_the_same_again(tmp_path):
    (tmp_path / "even.yaml").write_text(EVEN)
    cosmos = CosmosCommand(tmp_path)
    _, document = cosmos.run(tmp_path / "even.yaml", *LOOSE)

    code, told, err = rerun(cosmos, "last", "--as-recorded")

    assert code == 0, err
    assert "even.yaml" in document["flown"]["files"]
    assert told["same"], told["diff"]
    passed = [e["passed"] for e in told["checks"]]
    assert document["exit_code"] == 4 and passed == [False, True, True]
    assert [e["same"] for e in told["checks"]] == [True, True, False]
    assert told["checks"][0]["got"] == told["checks"][0]["rerun_got"] > 3
    assert told["remarks"] == [
        "timeline[0] (device_fault): device_fault is in the samples on record, and not inserted again"
    ]
    value = channels(told)["agent-01/gps.value"]
    assert (value["compared"], value["different"], value["left_out"]) == (60, 0, 0)


def test_a_run_in_real_time_has_the_same_samples_commands_and_truth_in_lockstep(braked):
    cosmos, document = braked

    code, told, err = rerun(cosmos, document["run"])

    found = channels(told)
    gyro, coil = found["agent-01/imu.gyro"], found["agent-01/imu.coil"]
    assert gyro["different"] == 0 and gyro["compared"] >= 20, gyro
    assert coil["compared"] >= 20, coil
    tables = {each["table"]: each for each in told["diff"]["streams"]}
    checks = {each["name"]: each for each in told["checks"]}
    assert list(checks) == ["turns", "halfway"]
    # What came within a tick it may have found; lockstep flies ticks that were skipped, and is never late.
    if not unsure(document, told):
        assert code == 0, (told["devices"], err)
        assert checks["turns"]["got"] == pytest.approx(checks["turns"]["rerun_got"], abs=1e-3)
        assert coil["different"] == 0
        assert tables["commands"]["matched"] >= 20
        assert tables["commands"]["identical"]
    assert told["rerun"] != told["run"]
    assert all(each["same"] and each["rerun_passed"] for each in checks.values())
    assert [text for text in told["remarks"] if text.startswith("timeline")] == [
        "timeline[0] (device_fault): device_fault is in the samples on record, and not inserted again",
        "timeline[2] (annotate): left out: stream ticks is not recorded in time.mode lockstep",
    ]


def test_a_rerun_flown_again_has_its_samples_in_the_same_ticks(braked, tmp_path):
    cosmos, document = braked
    _, first, _ = rerun(cosmos, document["run"])

    code, told, err = rerun(cosmos, first["rerun"])

    assert code == 0, (told["devices"], told["diff"], err)
    assert told["same"]
    copy = tmp_path / first["rerun"]
    shutil.copytree(first["directory"], copy)
    plan = (copy / "plan.json").read_text()
    assert plan.count("ticks.jsonl") >= 2
    (copy / "plan.json").write_text(plan.replace("ticks.jsonl", "gone.jsonl"))
    _, told, _ = rerun(cosmos, copy)
    gone = [text for text in told["remarks"] if "gone.jsonl is not there any more" in text]
    assert [text.partition(":")[0] for text in gone] == ["agent-01/imu", "agent-02/imu"]


def test_a_change_of_the_flight_software_is_found_and_its_copy_is_not(braked, tmp_path):
    cosmos, document = braked
    for name in ("noisy.py", "brake.py"):
        shutil.copy(cosmos.folder / "scenario" / name, tmp_path)
    changed = FLIGHT.replace("-1e-3 * rate", "-2e-3 * rate")
    (tmp_path / "brake.py").write_text(changed)

    code, told, _ = rerun(cosmos, document["run"], "--as-recorded-from", tmp_path)

    assert code == 1
    assert (
        f"{tmp_path}: the flight software differs: brake.py, braked.yaml (gone)" in told["remarks"]
    )
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


@pytest.mark.parametrize("value", ["null", '"late"', "1.5"])
def test_ticks_that_are_no_whole_numbers_are_refused_in_words(braked, tmp_path, value):
    cosmos, document = braked
    copy = tmp_path / "runs" / document["run"]
    shutil.copytree(cosmos.directory(document), copy)
    path = copy / "agents/agent-02/ticks.jsonl"
    *lines, last, end = path.read_text().splitlines()
    path.write_text("\n".join([*lines, f"[{value}{last[last.index(',') :]}", end, ""]))

    done = cosmos("rerun", str(copy), "--runs", tmp_path / "runs")

    assert done.returncode == 2
    assert "ticks.jsonl: expected whole numbers in every record" in done.stderr
    assert "Traceback" not in done.stderr


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


@pytest.mark.parametrize("name", ["gone", "x" * 300])
def test_a_folder_that_is_not_there_any_more_or_cannot_be_looked_at_is_named(
    braked, tmp_path, name
):
    cosmos, document = braked

    done = cosmos("rerun", document["run"], "--as-recorded-from", tmp_path / name)

    assert done.returncode == 2
    assert "is not there; put it back, fly the run's own copy with --as-recorded" in done.stderr


def test_two_sources_of_software_are_refused(braked, tmp_path):
    cosmos, document = braked

    done = cosmos("rerun", document["run"], "--as-recorded", "--as-recorded-from", tmp_path)

    assert done.returncode == 2
    assert "give one of them" in done.stderr


@pytest.fixture
def changed(braked, tmp_path):
    """The same run in a place of its own, with what it flew changed since where it was flown."""
    cosmos, document = braked
    copy = tmp_path / "runs" / document["run"]
    shutil.copytree(cosmos.directory(document), copy)
    today = tmp_path / "today"
    today.mkdir()
    (today / "noisy.py").write_text(DRIVER)
    (today / "brake.py").write_text(FLIGHT.replace("-1e-3 * rate", "-2e-3 * rate"))
    (today / "braked.yaml").write_text(REAL)
    (today / "gains.json").write_text("{}")
    plan = json.loads((copy / "plan.json").read_text())
    plan["config"]["base_directory"] = str(today)
    (copy / "plan.json").write_text(json.dumps(plan))
    # As if it had been collected so.
    manifest = json.loads((copy / "manifest.json").read_text())
    manifest["files"]["plan.json"] = file_entry(copy / "plan.json")
    (copy / "manifest.json").write_text(json.dumps(manifest))
    return CosmosCommand(tmp_path, COSMOS_CACHE=str(tmp_path / "cache")), copy


def test_a_run_keeps_a_copy_of_what_it_flew_and_packages_it(braked):
    cosmos, document = braked
    run = cosmos.directory(document)

    listed = json.loads((run / "run.json").read_text())["flown"]
    manifest = json.loads((run / "manifest.json").read_text())["files"]

    assert listed["whole"] and not listed["left_out"]
    assert set(listed["files"]) == {"brake.py", "braked.yaml", "noisy.py"}
    for name, entry in listed["files"].items():
        assert manifest[f"flown/{name}"] == {"bytes": entry["bytes"], "sha256": entry["sha256"]}
        assert (run / "flown" / name).read_bytes() == (
            cosmos.folder / "scenario" / name
        ).read_bytes()


@pytest.mark.nightly
def test_the_copy_flies_whatever_todays_files_are_and_without_it_they_are_named(changed):
    cosmos, copy = changed

    code, told, _ = rerun(cosmos, str(copy))

    assert code == 1
    assert "today's flight software differs: brake.py" in told["remarks"]
    assert "today's flight software has new files beside it: gains.json" in told["remarks"]
    tables = {each["table"]: each for each in told["diff"]["streams"]}
    assert tables["commands"]["fields"]["x"]["different"] >= 20

    shutil.rmtree(copy.parents[1] / "today")
    code, told, err = rerun(cosmos, str(copy), "--as-recorded")

    tables = {each["table"]: each for each in told["diff"]["streams"]}
    assert tables["commands"]["matched"] >= 20, err
    if not unsure(json.loads((copy / "run.json").read_text()), told):
        assert code == 0, (told, err)
        assert tables["commands"]["identical"]
    assert not any("differs" in remark for remark in told["remarks"])
    assert not list((cosmos.folder / "cache" / "flown").glob("*"))


def unsure(document, told):
    """Count what lockstep cannot know of a run in real time: samples within ticks, what was missed, skipped or late."""
    in_ticks = sum(each["in_ticks"] for each in told["devices"])
    stimuli = [one for each in document["devices"].values() for one in each["stimulus"].values()]
    skipped = sum(one["skipped"] + one["underruns"] for one in stimuli)
    return in_ticks + skipped + document["timing"]["missed"] + late_commands(document)


def late_commands(document):
    """Return how many commands came too late for truth to be there in time, as of a host that waited for a processor."""
    return document["simulation"]["host"]["maneuvers"]["inequality_broken"]


def test_a_copy_that_was_changed_or_escapes_is_refused(changed):
    cosmos, copy = changed
    whole = json.loads((copy / "run.json").read_text())
    entry = whole["flown"]["files"]["brake.py"]
    (copy.parent / "evil.py").write_text("raise SystemExit")
    for files, words in (
        ({"../evil.py": entry}, "expected no part that starts with a dot"),
        ({"/etc/passwd": entry}, "expected a path within the folder"),
        ({"brake.py": {**entry, "bytes": 1 << 40}}, "expected at most 8388608 bytes"),
        ({"brake.py": {**entry, "sha256": "0" * 64}}, "what lies in flown/ is not what was flown"),
        ({"gone.py": entry}, "gone.py: No such file"),
        ({"brake.py": entry, "brake.py/x.py": entry}, "brake.py/x.py: "),
    ):
        (copy / "run.json").write_text(json.dumps({**whole, "flown": {"files": files}}))

        done = cosmos("rerun", str(copy), "--as-recorded")

        assert done.returncode == 2, files
        assert words in done.stderr, (files, done.stderr)
        assert "--as-recorded-from DIR" in done.stderr
        assert "Traceback" not in done.stderr
    (copy / "run.json").write_text(json.dumps(whole))
    (copy / "flown" / "brake.py").unlink()
    (copy / "flown" / "brake.py").symlink_to(copy.parents[1] / "today" / "brake.py")

    done = cosmos("rerun", str(copy), "--as-recorded")

    assert done.returncode == 2
    assert "brake.py: a link that leads elsewhere" in done.stderr


def test_what_a_copy_lacks_is_named_where_it_cannot_be_flown(tmp_path):
    folder = tmp_path / "scenario"
    folder.mkdir()
    (tmp_path / "linked.py").write_text(FLIGHT)
    (folder / "linked.py").symlink_to(tmp_path / "linked.py")
    (folder / "s.yaml").write_text(
        "name: s\nsimulation: constellation\nagents: {count: 1, tick_hz: 10}\n"
        "time: {mode: lockstep, duration_s: 1}\n"
        "parameters:\n  satellites: {walker: '56:1/1/0', altitude_km: 780}\n"
        "  epoch_utc: '2026-01-01T00:00:00Z'\n  flight: linked.py:Brake\n"
    )
    cosmos = CosmosCommand(tmp_path, COSMOS_CACHE=str(tmp_path / "cache"))
    flown = cosmos("run", folder / "s.yaml", "--no-report", "--quiet")

    done = cosmos("rerun", "last", "--as-recorded")
    elsewhere = cosmos("rerun", "last", "--as-recorded-from", folder)

    assert flown.returncode == 0, flown.stderr
    assert done.returncode == 2
    assert "its copy is not whole, and cannot be flown: " in done.stderr
    assert "linked.py: a link that leads out of the folder" in done.stderr
    assert "flight: no such file: linked.py" in done.stderr
    assert "--as-recorded-from DIR" in done.stderr
    assert "cache" not in done.stderr
    assert elsewhere.returncode == 0, elsewhere.stderr


def test_a_run_of_before_there_were_copies_says_what_to_do(changed):
    cosmos, copy = changed
    document = json.loads((copy / "run.json").read_text())
    del document["flown"]
    (copy / "run.json").write_text(json.dumps(document))

    done = cosmos("rerun", str(copy), "--as-recorded")

    assert done.returncode == 2
    assert "keeps no copy of what it flew" in done.stderr
    assert "--as-recorded-from DIR" in done.stderr


def test_played_samples_have_the_recorded_values_times_and_ages(braked):
    cosmos, document = braked
    _, told, _ = rerun(cosmos, document["run"])

    for agent in ("agent-01", "agent-02"):
        first, second = (
            [row for row in records(root / "devices" / agent / "imu" / "gyro.jsonl")]
            for root in (cosmos.directory(document), Path(told["directory"]))
        )
        compared = channels(told)[f"{agent}/imu.gyro"]["compared"]
        assert compared == len(second) >= 20
        whole = [row for row in first if None not in row]
        for recorded, played in zip(whole, second, strict=False):
            assert played[3:] == recorded[3:]
            assert played[0] == pytest.approx(recorded[0], abs=1.5e-6)
            assert abs(played[2] - recorded[2]) <= 1


@pytest.mark.nightly
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
    assert received["different"] == 0 and received["compared"] >= 10, (received, err)
    assert found["agent-01/mcu.magnetometer"]["records"] >= 20
    assert found["agent-01/mcu.sent"]["judged"] is True
    assert any("its recorded bytes are played back" in remark for remark in told["remarks"])
    tables = {each["table"]: each for each in told["diff"]["streams"]}
    assert tables["commands"]["matched"] >= 1
    timing = document["timing"]
    late = timing["missed"] or timing["late"] or late_commands(document)
    if not (late or received["in_ticks"]):
        assert code == 0, (told["devices"], err)
        assert tables["commands"]["identical"]
        # Results among it: to the bit, in their ticks.
        assert found["agent-01/mcu.sent"]["different"] == 0
        assert tables["command_results"]["identical"]
