"""Sensors that are hardware, in lockstep: what `cosmos validate` finds, what a run records, and its errors against truth."""

import pytest
from harness.cosmos_command import LOOSE, CosmosCommand

from cosmos_cli import app
from cosmos_cli.errors import InputError
from cosmos_cli.models.loading import load_scenario
from madns_runtime.recording.reader import read_stream

SCENARIO = """
name: mixed
simulation: constellation
agents: {count: 2, tick_hz: 10}
time: {mode: lockstep, duration_s: 6}
parameters:
  satellites: {walker: "86.4:2/1/0", altitude_km: 780}
  epoch_utc: 2026-03-20T12:00:00Z
  vehicles:
    - agents: [agent-01]
      attitude: {inertia_kg_m2: [12, 14, 9], initial: inertial}
      sensors:
        gyro: {device: imu.gyro, bias: [0.1, 0.0, 0.0], model: {noise: 1e-4}}
        magnetometer: {device: imu.field}
        clock: {noise: 1e-3}
    - attitude: {inertia_kg_m2: [12, 14, 9]}
      sensors: {gyro: {noise: 1e-4}}
hardware:
  devices:
    - name: imu
      kind: synthetic
      agents: [agent-01]
      rate_hz: 7
      parameters:
        channels:
          - name: gyro
            unit: deg/s
            components: [x, y, z]
            elements: [{offset: 0.1}, {offset: 0.0}, {offset: 0.0, noise: 0.01}]
          - {name: field, unit: uT, components: [x, y, z], elements: [{offset: 10}, {}, {}]}
          - {name: voltage, unit: V}
"""
GYRO = "parameters.vehicles[0].sensors.gyro"


@pytest.fixture
def scenario(tmp_path):
    path = tmp_path / "mixed.yaml"
    path.write_text(SCENARIO)
    return path


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (f"{GYRO}.device=imu.gyr", "imu has no input 'gyr', did you mean gyro?"),
        (f"{GYRO}.device=hat.gyro", "expected a device that the agent uses (imu), got 'hat'"),
        (f"{GYRO}.device=imu", "a device and its channel such as imu.gyro"),
        (f"{GYRO}.device=imu.voltage", "expected values of 3 numbers, got 1"),
        (f"{GYRO}.device=imu.field", "converts to rad/s"),
        (f"{GYRO}.alignment=[[1,2,3],[2,4,6],[0,0,1]]", "loses no direction"),
        (f"{GYRO}.alignment=[1,2]", "missing; expected a number"),
        (f"{GYRO}.scale=[1,0,1]", "expected factors other than 0"),
        (f"{GYRO}.model.rate_hz=3", "at the times of the device's samples"),
        (f"{GYRO}.noise=1", "unknown key; known here: device, alignment, scale, bias, model"),
        ("parameters.vehicles[0].attitude=null", "needs a vehicle with attitude"),
        ("parameters.vehicles[0].agents=['agent-0*']", "(none), got 'imu'"),
    ],
)
def test_what_does_not_fit_is_found_before_a_run(scenario, change, words):
    with pytest.raises(InputError) as refused:
        load_scenario(scenario, (change,))

    texts = [fault.text for fault in refused.value.faults]
    assert any(words in text for text in texts), texts


def test_a_device_of_the_inventory_is_looked_for_when_a_run_is_planned(scenario, capsys):
    text = SCENARIO.replace("lockstep", "realtime").replace(
        "hardware:\n", "hardware:\n  use: [{devices: [hat], agents: [agent-01]}]\n"
    )
    scenario.write_text(text)

    given = (str(scenario), "--set", f"{GYRO}.device=hat.anything")
    assert app.run(["validate", *given]) == 0
    assert app.run(["plan", *given]) == 2
    assert "no machine with agents has a device 'hat'" in capsys.readouterr().err


@pytest.mark.process
def test_two_runs_record_the_same_and_the_error_of_hardware_is_a_figure(scenario, tmp_path):
    cosmos = CosmosCommand(tmp_path)

    (code, first), (_, second) = (cosmos.run(scenario, *LOOSE) for _ in range(2))

    assert code == 0, first["verdict"]
    assert first["records_sha256"] == second["records_sha256"]
    folder = cosmos.directory(first) / "agents" / "agent-01"
    rows = {
        name: list(read_stream(folder / f"{name}.jsonl").records())
        for name in ("gyro", "gyro_truth", "gyro_model", "magnetometer", "magnetometer_truth")
    }
    # 7 Hz for 5.9 s, the first at 0, none seen twice.
    assert {name: len(each) for name, each in rows.items()} == dict.fromkeys(rows, 42)
    for measured, truth in zip(rows["gyro"], rows["gyro_truth"], strict=True):
        assert measured[:2] == truth[:2]
        assert measured[2:4] == pytest.approx([0.0, 0.0], abs=1e-12)
        # Gravity turns it by that much.
        assert truth[2:] == pytest.approx([0.0, 0.0, 0.0], abs=1e-5)
    compared = cosmos("diff", first["run"], second["run"], "--expect-same")
    assert compared.returncode == 0, compared.stderr
    errors = [line for line in compared.stdout.splitlines() if line.startswith(("gyro", "magnet"))]
    for figure in (
        "gyro          body rates of the device ",
        "gyro          body rates of the device against its model",
        "gyro          body rates ",
        "gyro_model    body rates ",
        "magnetometer  field of the device ",
    ):
        assert any(line.startswith(figure) for line in errors), compared.stdout


HALF = """
from madns_runtime.hardware.contract import Channel, DeviceKind, Sample, SimulatedDevice


class Half(SimulatedDevice):
    kind = DeviceKind(
        name="half",
        summary="gives one of its two inputs alone",
        channels=(
            Channel(name="gyro", unit="rad/s", shape=(3,)),
            Channel(name="field", unit="uT", shape=(3,)),
        ),
        needs_hardware=False,
        follows_simulated_time=True,
    )

    def sample_at(self, t_s):
        return Sample(values={"gyro": (0.0, 0.0, t_s)}, taken_s=t_s)
"""


@pytest.mark.process
def test_a_sensor_whose_channel_gives_nothing_breaks_a_check_by_its_name(scenario, tmp_path):
    (tmp_path / "half.py").write_text(HALF)
    head, _, _ = SCENARIO.partition("hardware:\n")
    scenario.write_text(
        f"{head}hardware:\n  devices: [{{name: imu, kind: ./half.py:Half, agents: [agent-01]}}]\n"
    )
    code, document = CosmosCommand(tmp_path).run(scenario, *LOOSE, "time.duration_s=1")

    broken = [check for check in document["checks"] if not check["passed"]]
    assert (code, document["devices"]["agent-01/imu"]["status"]) == (4, "ok")
    assert [(each["name"], each["got"], each["worst"]) for each in broken] == [
        ("constellation.sensors_silent", 1, "agent-01: magnetometer")
    ]
