"""Whole runs whose devices raise, hang and are killed: who ends the run, with which word, and what is kept of it."""

import json

import pyarrow.parquet as pq
import pytest
from harness.cosmos_command import LOOSE, CosmosCommand
from harness.waiting import wait_until

pytestmark = pytest.mark.process

DRIVER = """
import os, signal, time
from dataclasses import dataclass

from madns_runtime.hardware.contract import Channel, Device, DeviceKind, Sample


@dataclass(frozen=True, kw_only=True)
class Parameters:
    what: str = ""
    after_s: float = 1.0


class Moody(Device):
    kind = DeviceKind(
        name="moody",
        summary="a device that comes to harm",
        parameters=Parameters,
        needs_hardware=False,
        channels=(Channel(name="level", unit="m"),),
    )

    def open(self):
        if self.parameters.what == "never":
            raise OSError("no \\x1b[31mcable")
        self.opened_s = time.monotonic()
        return "moody-1"

    def read(self):
        now_s = time.monotonic()
        if now_s - self.opened_s > self.parameters.after_s:
            if self.parameters.what == "kill":
                os.kill(os.getpid(), signal.SIGKILL)
            if self.parameters.what == "hang":
                time.sleep(60)
            if self.parameters.what == "raise":
                raise OSError("the cable is loose")
        return Sample(values={"level": now_s}, taken_s=now_s)
"""
SCENARIO = """
name: harmed
simulation: counter
agents: {count: 2, tick_hz: 20}
time: {duration_s: 4}
hardware:
  on_device_loss: %s
  devices:
    - name: tank
      kind: ./driver.py:Moody
      agents: [agent-02]
      rate_hz: %g
      hang_s: 1
      parameters: {what: "%s", after_s: %g}
    - {name: gps, kind: synthetic, rate_hz: 1}
"""


SOUND_HZ = 2
"""Lost after 5 s without a sample: a busy machine does not hold a process for that long."""


def write_scenario(tmp_path, what, on_loss="abort", *, rate_hz=SOUND_HZ):
    (tmp_path / "driver.py").write_text(DRIVER)
    scenario = tmp_path / "harmed.yaml"
    scenario.write_text(SCENARIO % (on_loss, rate_hz, what, 1.5))
    return scenario


def run(tmp_path, what, on_loss="abort", *settings, rate_hz=SOUND_HZ, options=("--no-report",)):
    scenario = write_scenario(tmp_path, what, on_loss, rate_hz=rate_hz)
    cosmos = CosmosCommand(tmp_path)
    code, document = cosmos.run(scenario, *LOOSE, *settings, options=options)
    return code, document, cosmos.directory(document)


def checks(document):
    return {c["name"]: c for c in document["checks"] if c["name"].startswith("hardware.")}


def test_sound_devices_are_judged_recorded_and_tabulated(tmp_path):
    code, document, folder = run(
        tmp_path, "nothing", "abort", "hardware.stale_ratio=0.9", options=()
    )

    assert code == 0, document["verdict"]
    assert set(document["devices"]) == {"agent-01/gps", "agent-02/gps", "agent-02/tank"}
    tank = document["devices"]["agent-02/tank"]
    assert tank["status"] in ("ok", "stale")
    assert (tank["lost"], tank["restarts"], tank["frozen"]) == (0, 0, 0)
    assert tank["samples"] >= 3
    assert all(check["passed"] for check in checks(document).values())
    assert set(checks(document)) == {"hardware.stale_ratio", "hardware.lost", "hardware.frozen"}
    table = pq.read_table(folder / "tables" / "device_tank.level.parquet")
    assert set(table["device"].to_pylist()) == {"agent-02/tank"}
    assert len(table["level"]) >= 3
    report = (folder / "report.html").read_text()
    assert "What devices came to" in report
    assert "device_tank.level" in report
    assert "device_tank.events" not in report
    gps = pq.read_table(folder / "tables" / "device_gps.value.parquet")
    assert set(gps["device"].to_pylist()) == {"agent-01/gps", "agent-02/gps"}


@pytest.mark.parametrize(
    ("what", "why"),
    [("kill", "killed by SIGKILL"), ("hang", "no sample for 1 s"), ("raise", "the cable is loose")],
)
def test_a_lost_device_ends_the_run_by_its_name(tmp_path, what, why):
    # Who does not hang is lost at once; before that, no busy machine is to make it silent.
    code, document, folder = run(tmp_path, what, rate_hz=20 if what == "hang" else SOUND_HZ)

    assert code == 3, document["verdict"]
    assert document["who"] == "agent-02/tank"
    assert document["verdict"].startswith("FAILED: agent-02/tank: lost: ")
    assert why in document["verdict"]
    assert document["devices"]["agent-02/tank"]["lost"] >= 1
    assert checks(document)["hardware.lost"]["worst"] == "agent-02/tank"
    log = (folder / "host" / "events.jsonl").read_text()
    assert '"device":"agent-02/tank","status":"lost"' in log


def test_a_device_that_never_comes_up_ends_the_run_by_its_name(tmp_path):
    code, document, _ = run(tmp_path, "never")

    assert code == 3, document["verdict"]
    assert document["verdict"].startswith("FAILED: agent-02/tank: lost: ")
    assert "cable" in document["verdict"]
    assert "\x1b" not in json.dumps(document, ensure_ascii=False)


def test_a_fault_is_inserted_in_a_living_run_and_recorded(tmp_path):
    scenario = write_scenario(tmp_path, "nothing", "continue")
    cosmos = CosmosCommand(tmp_path)
    settings = ("time.duration_s=200", "hardware.stale_ratio=0.9")
    with cosmos.start_run(scenario, *LOOSE, *settings) as process:
        wait_until(
            lambda: list(cosmos.runs.glob("*/devices/agent-02/tank/level.jsonl")), "a device"
        )
        (folder,) = cosmos.runs.iterdir()
        wait_until(lambda: levels_of(folder), "a sample without a fault, of simulated time")
        assert (folder / ".orders.sock").stat().st_mode & 0o777 == 0o600

        put = cosmos("inject", "last", "agent-02/tank", "bias", "1000000")
        unknown = cosmos("inject", "last", "agent-07/tank", "freeze", "--json")
        wrong = cosmos("inject", "last", "agent-02/tank", "bias")
        wait_until(lambda: largest(folder) > 900_000, "a biased sample")
        # Not before simulated time runs: devices are there sooner.
        wait_until(lambda: cosmos("inject", "last", "run", "stop").returncode == 0, "a stop")
        out, err = process.communicate(timeout=240)
    over = cosmos("inject", "last", "agent-02/tank", "clear")

    assert wrong.returncode == 2
    assert "bias needs a value" in wrong.stderr
    assert unknown.returncode == 1
    assert "there are agent-02/tank" in json.loads(unknown.stdout)["refusal"]
    assert put.returncode == 0, put.stderr
    assert "in force" in put.stdout
    assert over.returncode == 2
    assert "nobody of this run listens" in over.stderr
    document = json.loads(out)
    assert document["exit_code"] == 0, err
    levels = pq.read_table(folder / "tables" / "device_tank.level.parquet")["level"].to_pylist()
    assert max(levels) - min(levels) > 900_000
    told = (folder / "host" / "events.jsonl").read_text()
    assert '"target":"agent-02/tank","action":"bias","value":1000000.0,"refusal":""' in told
    assert not (folder / ".orders.sock").exists()


def largest(folder):
    """Return the largest level on record so far."""
    return max(levels_of(folder), default=0.0)


def levels_of(folder):
    """Return the levels on record so far."""
    lines = (folder / "devices/agent-02/tank/level.jsonl").read_bytes().splitlines(keepends=True)
    whole = [line for line in lines if line.startswith(b"[") and line.endswith(b"\n")]
    return [json.loads(line)[-1] for line in whole]


@pytest.mark.nightly
def test_a_detached_run_takes_faults_and_ends_by_the_name_of_a_lost_device(tmp_path):
    scenario = write_scenario(tmp_path, "nothing", rate_hz=1)
    cosmos = CosmosCommand(tmp_path)
    settings = [f"--set={each}" for each in (*LOOSE, "time.duration_s=200")]
    started = cosmos("run", scenario, "--detach", *settings)
    assert started.returncode == 0, started.stderr
    (folder,) = cosmos.runs.iterdir()
    try:
        wait_until(lambda: list(folder.glob("devices/agent-02/tank/level.jsonl")), "a sample")
        unknown = cosmos("inject", "last", "agent-07/tank", "freeze", "--json")
        wait_until(
            lambda: cosmos("inject", "last", "agent-02/tank", "bias", "1000000").returncode == 0
        )
        wait_until(lambda: largest(folder) > 900_000, "a biased sample")
        pulled = cosmos("inject", "last", "agent-02/tank", "disconnect")
        wait_until(
            lambda: not json.loads(cosmos("ps", "--json").stdout)["runs"], "the run has ended"
        )
    finally:
        cosmos("down", "last")
    collected = cosmos("collect", "last", "--json")

    assert unknown.returncode == 1
    assert "agent-02/tank" in json.loads(unknown.stdout)["refusal"]
    assert pulled.returncode == 0, pulled.stdout + pulled.stderr
    document = json.loads((folder / "run.json").read_text())
    assert collected.returncode == 0, collected.stderr  # it was brought and judged
    assert document["exit_code"] == 3, collected.stderr
    assert document["who"] == "agent-02/tank"
    lost = "FAILED: agent-02/tank: lost: an inserted fault disconnects it"
    assert document["verdict"].startswith(lost)
    told = (folder / "host" / "events.jsonl").read_text()
    assert '"target":"agent-02/tank","action":"bias","value":1000000.0,"refusal":""' in told
    assert '"device":"agent-02/tank","status":"lost"' in told
    assert not (folder / ".orders.sock").exists()


FLOOD = """
import os, time

from madns_runtime.hardware.contract import Channel, Device, DeviceKind, Sample


class Flood(Device):
    kind = DeviceKind(
        name="flood",
        summary="a device that has more frames than anybody keeps",
        needs_hardware=False,
        channels=(Channel(name="received", is_frame=True, passing="queue"),),
    )

    def open(self):
        self.left, self.signal = 12_000, os.eventfd(1)
        return "flood-1"

    def fileno(self):
        return self.signal

    def read(self):
        if not self.left:
            return None
        self.left -= 1
        if not self.left:
            os.eventfd_read(self.signal)
        return Sample(values={"received": b"frame"}, taken_s=time.monotonic())

    def close(self):
        os.close(self.signal)
"""
UNHEARD = """
name: unheard
simulation: counter
agents: {count: 1, tick_hz: 10}
time: {duration_s: 3}
hardware:
  on_device_loss: continue
  lost: 9
  stale_ratio: 1
  devices: [{name: line, kind: "./flood.py:Flood", rate_hz: 10}]
"""


def test_frames_that_an_agent_does_not_take_are_told_by_it_and_in_the_verdict(tmp_path):
    (tmp_path / "flood.py").write_text(FLOOD)
    (tmp_path / "unheard.yaml").write_text(UNHEARD)
    cosmos = CosmosCommand(tmp_path)

    code, document = cosmos.run(tmp_path / "unheard.yaml", *LOOSE, options=("--no-report",))

    assert code == 0, document["verdict"]
    missed = document["devices"]["agent-01/line"]["counts"]["frames_missed"]
    assert 0 < missed <= 2_000
    told = f"agent-01: device agent-01/line: there was no room for all: frames_missed {missed}"
    assert told in document["remarks"]
    agent = cosmos.directory(document) / "agents" / "agent-01"
    assert f'"device_losses","device":"agent-01/line","frames_missed":{missed}' in (
        agent / "events.jsonl"
    ).read_text("utf-8")
    assert f"frames_missed {missed}" in (agent / "log.jsonl").read_text("utf-8")


SHARING = """
name: sharing
simulation: counter
agents: {count: 2, tick_hz: 10}
time: {duration_s: 6}
on_agent_loss: continue
hardware:
  use: [{devices: [gyro], agents: ["*"]}]
timeline:
  - {at_s: 0.5, action: device_fault, agents: [agent-01], device: gyro, fault: freeze, for_s: 0.3}
  - {at_s: 1.2, action: device_fault, agents: [agent-02], device: gyro, fault: bias, value: 1000, for_s: 3.5}
  - {at_s: 1.5, action: restart, agents: [agent-01]}
"""
SHARED = """
all:
  hosts:
    here:
      ansible_connection: local
      cosmos_devices: [{name: gyro, kind: synthetic, rate_hz: 20}]
"""


def test_an_agent_that_returns_ends_no_newer_fault_of_a_device_that_others_share(tmp_path):
    (tmp_path / "sharing.yaml").write_text(SHARING)
    (tmp_path / "here.yaml").write_text(SHARED)
    cosmos = CosmosCommand(tmp_path)

    _, document = cosmos.run(
        tmp_path / "sharing.yaml",
        *LOOSE,
        options=("--no-report", "-i", str(tmp_path / "here.yaml")),
    )

    lines = (cosmos.directory(document) / "devices/here/gyro/events.jsonl").read_text().splitlines()
    faults = [event for event in map(json.loads, lines) if event.get("event") == "fault"]
    assert [event["action"] for event in faults] == ["freeze", "clear", "bias", "clear"]
    assert document["agents"]["lost_on_purpose"] == ["agent-01"]
    assert faults[-1]["t_s"] > 4.0
