"""Devices that fail for real in real runs: nobody loses a tick, all is on record, and outputs are left safe."""

from __future__ import annotations

import contextlib
import math
import os
import signal
import time
from pathlib import Path

import orjson
import pytest
import yaml
from harness.cosmos_command import LOOSE, CosmosCommand
from harness.machine_waits import MachineWaits
from harness.waiting import wait_until

from madns_runtime.config import DeviceLaunch
from tests.hardware.bench import DRIVER, Terminal, line_bench, still_running

pytestmark = pytest.mark.process

DURATION_S = 8.0
TICK_HZ = 5
MISSED_MAX = 2
"""Ticks that an agent may miss more than the one without a device, beside those for which the machine let threads wait
that were ready: in line with the step, each of these faults costs five or more."""
RAISING = ("open", "read", "write", "health", "make_safe", "close")
WHYS = {
    "pulled": "port is gone",
    "slow": None,
    "slowest": "no sample for 1 s",
    "hanging": "did not return within 1 s",
    "garbage": "no sample for 1 s",
    "fast": None,
    "leaking": "Leaking leaks descriptors",
    "hoarding": "Hoarding leaks memory",
    **{
        f"raises_{method}": f"Line.{method} raised ValueError: {method} does not work (user.py:"
        for method in RAISING
    },
}
"""Agents with a device each, and what must be told of it; None: nothing but its records, since it works."""
LINES = ("pulled", "slow", "slowest", "hanging", "garbage", "fast")
PLAIN = "plain"
"""An agent that has no device."""
PLUGIN = (
    DRIVER
    + '''
import resource
from dataclasses import replace

from madns_runtime.hardware.kinds import serial
from madns_runtime.plugin.api import AgentSimulation, Simulation
from madns_runtime.recording.records import Field

serial_line = replace(serial.kind, name="serial_line", needs_hardware=False)
Line.kind = replace(Line.kind, needs_hardware=False)


class Leaking(Device):
    """Opens descriptors and closes none."""

    kind = DeviceKind(name="leaking", summary="leaks", needs_hardware=False, channels=(Channel(name="time"),))

    def open(self):
        resource.setrlimit(resource.RLIMIT_NOFILE, (128, 128))
        for _ in range(60):
            os.open("/dev/null", os.O_RDONLY)
        return ""

    def read(self):
        raise ValueError("no answer")


class Hoarding(Device):
    """Keeps all that it has read."""

    kind = DeviceKind(name="hoarding", summary="keeps", needs_hardware=False, channels=(Channel(name="time"),))
    kept = []

    def read(self):
        self.kept.append(b"x" * 6_000_000)
        return Sample(values={"time": 0.0}, taken_s=time.monotonic())


@dataclass(frozen=True, kw_only=True)
class Nothing:
    pass


class User(AgentSimulation):
    """Takes all that comes from its device, and moves what can be moved."""

    def setup(self, context, initial):
        self.context = context
        self.frames = []
        context.open_stream("statuses", (Field("status", "", "str"),))

    def step(self, tick):
        device = self.context.hardware.get("device")
        if device is None:
            return
        self.context.record("statuses", (device.status,))
        if "received" in device.channels:
            self.frames += [frame.number for frame in device.frames("received")]
            device.write("sent", b"tick %d" % tick.index)
        elif "valve" in device.channels:
            device.write("valve", 1.0)

    def finish(self):
        in_order = self.frames == sorted(set(self.frames))
        return {"frames": len(self.frames), "in_order": in_order, "whole": self.frames == list(
            range(self.frames[0], self.frames[0] + len(self.frames))) if self.frames else True}


simulation = Simulation(name="user", parameters=Nothing, agent=":User")
'''
)


def device(agent: str, kind: str, **parameters) -> dict:
    # One that works is lost after 5 s without a sample: its process, or the test that feeds it, may have to wait.
    is_well = WHYS[agent] is None
    return {
        "name": "device",
        "kind": f"./user.py:{kind}",
        "agents": [agent],
        "rate_hz": 2 if is_well else 20,
        "hang_s": {"hanging": 1.0, "garbage": 60.0}.get(agent, 15.0),
        "parameters": parameters,
    }


def write_scenario(folder: Path, devices: list[dict]) -> Path:
    (folder / "user.py").write_text(PLUGIN, encoding="utf-8")
    names = [each["agents"][0] for each in devices]
    scenario = {
        "name": "user",
        "simulation": "./user.py:simulation",
        "agents": {
            "count": len(names) + 1,
            "names": [*names, PLAIN],
            "tick_hz": TICK_HZ,
            "per_process": 3,
        },
        "time": {"duration_s": DURATION_S},
        "hardware": {"armed": True, "on_device_loss": "continue", "devices": devices},
    }
    path = folder / "user.yaml"
    path.write_text(yaml.safe_dump(scenario), encoding="utf-8")
    return path


class Board:
    """What hangs on the machine: terminals that the test feeds, pulls out and plugs in again."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        raising = [f"raises_{method}" for method in RAISING]
        self.lines = {name: Terminal() for name in (*LINES, *raising)}
        self.pulled_s: float | None = None
        self.is_back = False
        self.heard_again = False
        self.written = 0
        self.began_s = math.inf
        """When an agent was first heard, s."""
        self.link()

    def link(self) -> None:
        port = self.folder / "port"
        port.symlink_to(self.lines["pulled"].port)

    def devices(self) -> list[dict]:
        port = {name: line.port for name, line in self.lines.items()}
        return [
            device("pulled", "serial_line", port=str(self.folder / "port")),
            device("slow", "Line", port=port["slow"], read_s=0.5),
            device("slowest", "Line", port=port["slowest"], read_s=10.0),
            device("hanging", "Line", port=port["hanging"], hang_file=str(self.folder / "hang")),
            device("garbage", "serial_line", port=port["garbage"], framing="nmea"),
            device("fast", "serial_line", port=port["fast"]),
            device("leaking", "Leaking"),
            device("hoarding", "Hoarding"),
            *(
                device(f"raises_{method}", "Line", port=port[f"raises_{method}"], raises=method)
                for method in RAISING
            ),
        ]

    def work(self) -> None:
        """Do what is due; called 20 times per second."""
        now_s = time.monotonic()
        if self.pulled_s is None:
            self.feed("pulled", b"steady\n")
            if max(self.ticks_heard("pulled"), default=-1) >= 8:
                (self.folder / "port").unlink()  # before its number is another terminal's
                self.lines["pulled"].close()
                self.pulled_s = now_s
        elif not self.is_back:
            if now_s > self.pulled_s + 1.5:
                self.lines["pulled"] = Terminal()
                self.link()
                self.is_back = True
        else:
            self.heard_again = self.heard_again or bool(self.lines["pulled"].heard())
            self.feed("pulled", b"steady\n")
        if "VALVE 1" in self.lines["hanging"].heard():
            (self.folder / "hang").touch()
        self.feed("garbage", os.urandom(4000))
        if self.ticks_heard("fast"):
            self.began_s = min(self.began_s, now_s)
        for _ in range(100):
            self.written += self.feed("fast", b"%07d\n" % self.written)

    def ticks_heard(self, name: str) -> list[int]:
        """Return the ticks in which an agent has written, but one whose line may not be whole."""
        words = (line.split() for line in self.lines[name].heard()[:-1])
        return [int(word[1]) for word in words if len(word) == 2 and word[0] == "tick"]

    def feed(self, name: str, data: bytes) -> bool:
        with contextlib.suppress(BlockingIOError):
            os.write(self.lines[name].fd, data)
            return True
        return False

    def close(self) -> None:
        for line in self.lines.values():
            line.close()


@pytest.fixture(scope="module")
def faulty(tmp_path_factory):
    """One run in which fourteen agents have a device each, and each device its own fault."""
    folder = tmp_path_factory.mktemp("faulty")
    board = Board(folder)
    cosmos = CosmosCommand(folder)
    scenario = write_scenario(folder, board.devices())
    settings = [f"--set={each}" for each in (*LOOSE, "hardware.stale_ratio=1")]
    run = cosmos.start("run", scenario, "--json", "--no-report", *settings)
    deadline_s = time.monotonic() + 240
    try:
        with MachineWaits() as waits:
            while run.poll() is None and time.monotonic() < deadline_s:
                board.work()
                time.sleep(0.05)
    finally:
        run.kill()
    board.waited_s = waits.between(board.began_s, board.began_s + DURATION_S)
    out, err = run.communicate(timeout=30)
    board.said, board.code = out + err, run.returncode
    assert (folder / "runs").is_dir(), board.said
    board.run = folder / "runs" / "0001-user"
    board.document = orjson.loads((board.run / "run.json").read_bytes())
    yield board
    board.close()


def events(run: Path, agent: str) -> list[dict]:
    """What befell a device, told by all processes that drove it."""
    paths = sorted((run / "devices" / agent / "device").glob("events*.jsonl"))
    found = [orjson.loads(line) for path in paths for line in path.read_bytes().splitlines()]
    return [each for each in found if "event" in each]


def host_events(run: Path) -> list[dict]:
    """What the host has recorded of devices' statuses."""
    lines = (run / "host" / "events.jsonl").read_bytes().splitlines()
    found = [orjson.loads(line) for line in lines]
    return [each for each in found if isinstance(each, dict) and each.get("event") == "device"]


def whys(run: Path, agent: str) -> list[str]:
    return [each["why"] for each in events(run, agent) if each["event"] == "error"]


def statuses(run: Path, agent: str) -> list[str]:
    """The statuses that the agent saw in its ticks, each once in a row."""
    found: list[str] = []
    for line in (run / "agents" / agent / "statuses.jsonl").read_bytes().splitlines():
        value = orjson.loads(line)
        if isinstance(value, list) and value[-1] not in found[-1:]:
            found.append(value[-1])
    return found


def summary(run: Path, agent: str) -> dict:
    return orjson.loads((run / "run.json").read_bytes())["simulation"]["agents"][agent]


def ticks(run: Path, agent: str) -> int:
    """Return how many ticks an agent has recorded."""
    lines = (run / "agents" / agent / "ticks.jsonl").read_bytes().splitlines()
    return sum(line.startswith(b"[") for line in lines)


@pytest.mark.parametrize("agent", WHYS)
def test_no_fault_of_a_device_costs_its_agent_a_tick(faulty, agent):
    missed_max = MISSED_MAX + faulty.waited_s * TICK_HZ
    plain = ticks(faulty.run, PLAIN)
    assert plain > 0, faulty.said
    assert ticks(faulty.run, agent) >= plain - missed_max, (faulty.waited_s, faulty.said)


@pytest.mark.parametrize("agent", WHYS)
def test_each_fault_is_named_with_its_device_and_its_reason(faulty, agent):
    name, wanted = f"{agent}/device", WHYS[agent]
    account = faulty.document["devices"][name]
    told = [each for each in host_events(faulty.run) if each.get("device") == name]
    reasons = [*whys(faulty.run, agent), account["why"], *(each["why"] or "" for each in told)]
    if wanted is None:
        assert (account["errors"], account["lost"], account["restarts"]) == (0, 0, 0), reasons
    else:
        assert any(wanted in reason for reason in reasons), reasons
    if agent not in ("raises_close", "raises_make_safe") and wanted is not None:
        assert account["lost"] >= 1  # those raise at the end alone
        assert f"device {name}: lost" in faulty.said
    assert (faulty.run / "devices" / agent / "device" / "events.jsonl").stat().st_size


def test_such_a_run_ends_with_the_code_of_its_checks_and_names_the_worst_device(faulty):
    checks = {each["name"]: each for each in faulty.document["checks"]}

    assert faulty.code == faulty.document["exit_code"] == 4, faulty.said
    assert faulty.document["status"] == "complete"
    assert "hardware.lost" in faulty.document["verdict"]
    assert not checks["hardware.lost"]["passed"]
    assert faulty.document["devices"]["hanging/device"]["restarts"] >= 1
    assert checks["hardware.lost"]["worst"].endswith("/device")
    assert not checks["hardware.unsafe"]["passed"]
    assert checks["hardware.unsafe"]["worst"] == "raises_make_safe/device"


@pytest.mark.parametrize("agent", ["slow", "slowest", "hanging", *(f"raises_{m}" for m in RAISING)])
def test_outputs_are_left_safe_whatever_the_driver_does(faulty, agent):
    heard = faulty.lines[agent].heard()
    moves = [word for word in heard if word.startswith("VALVE") or word == "SAFE"]
    assert moves[-1:] in ([], ["SAFE"]), heard
    if agent == "raises_make_safe":  # which says so, and then raises: each attempt at it is here
        assert heard.count("SAFE") >= 2
        assert "raises_make_safe/device: could not be made safe" in faulty.said


def test_a_read_of_ten_seconds_costs_the_device_no_new_process(faulty):
    account = faulty.document["devices"]["slowest/device"]
    assert account["restarts"] == account["errors"] == 0


def test_a_line_that_is_pulled_out_is_lost_and_comes_back_with_its_plug(faulty):
    assert faulty.is_back
    seen = statuses(faulty.run, "pulled")
    assert seen.index("lost") < len(seen) - 1 - seen[::-1].index("ok")  # ok after it was lost
    assert any("port is gone" in why for why in whys(faulty.run, "pulled"))
    assert faulty.heard_again
    opened = [each for each in events(faulty.run, "pulled") if each["event"] == "opened"]
    assert len(opened) >= 2, events(faulty.run, "pulled")


def test_a_read_of_half_a_second_is_recorded_with_its_age(faulty):
    lines = (faulty.run / "devices" / "slow" / "device" / "time.jsonl").read_bytes().splitlines()
    ages_us = [orjson.loads(line)[2] for line in lines if line.startswith(b"[")]
    assert ages_us
    assert min(ages_us) >= 500_000
    assert whys(faulty.run, "slow") == []


def test_a_driver_that_hangs_is_lost_for_its_agent_and_its_outputs_are_made_safe(faulty):
    assert statuses(faulty.run, "hanging")[-1] == "lost"
    heard = faulty.lines["hanging"].heard()
    assert "SAFE" in heard[heard.index("VALVE 1") :]
    assert heard[-1] != "VALVE 1"


def test_garbage_is_counted_and_passed_to_nobody(faulty):
    path = faulty.run / "devices" / "garbage" / "device"
    states = [
        orjson.loads(line)
        for line in (path / "device_state.jsonl").read_bytes().splitlines()
        if line.startswith(b"[")
    ]
    assert states[-1][-1]["garbage_bytes"] > 100_000
    frames = [x for x in (path / "received.jsonl").read_bytes().splitlines() if x.startswith(b"[")]
    assert len(frames) <= 3  # what passes eight bits of checksum by chance
    assert whys(faulty.run, "garbage") == []


def test_what_comes_faster_than_asked_comes_whole_and_in_order(faulty):
    told = summary(faulty.run, "fast")
    assert told["in_order"]
    assert told["whole"]
    assert told["frames"] > 1000


def test_a_driver_that_leaks_descriptors_gets_a_process_anew_and_is_named(faulty):
    assert statuses(faulty.run, "leaking")[-1] == "lost"
    found = whys(faulty.run, "leaking")
    assert any("descriptors" in why for why in found), found
    pids = [each for each in events(faulty.run, "leaking") if each["event"] == "end"]
    assert pids or len(found) > 2


def test_nothing_of_such_a_run_is_left(faulty):
    wait_until(lambda: not still_running(faulty.folder), "nothing of it runs")


def test_a_killed_guardian_is_replaced_and_the_next_one_guards_as_well(tmp_path):
    with line_bench(tmp_path) as (bench, terminal):
        bench.start_time()
        line = bench.hardware["line"]
        owner = os.fork()
        if owner == 0:
            time.sleep(60)
            os._exit(0)
        bench.manager.agents_started(("agent-01",), owner)
        bench.until(lambda: line.status == "ok")
        before = bench.manager._guardian_pid

        os.kill(before, signal.SIGKILL)
        bench.until(lambda: bench.manager._guardian_pid not in (0, before))
        line.write("valve", 1.0)
        bench.until(lambda: "VALVE 1" in terminal.heard())
        os.kill(bench.pid_of(), signal.SIGSTOP)  # it cannot make anything safe itself
        os.kill(owner, signal.SIGKILL)
        os.waitpid(owner, 0)

        bench.until(lambda: "SAFE" in terminal.heard())
        bench.close()


def test_a_read_that_takes_long_but_not_for_ever_survives(tmp_path):
    """As 10 s do with the hang_s of 15 s that a device has by itself."""
    assert DeviceLaunch.__dataclass_fields__["hang_s"].default == 15.0
    with line_bench(tmp_path, launch={"hang_s": 10.0}, read_s=2.0) as (bench, _):
        bench.start_time()
        pid = bench.pid_of()
        bench.until(lambda: bench.hardware["line"]["time"].number >= 1, timeout_s=60.0)
        assert bench.pid_of() == pid
        result = bench.close()["pi22/line"]
    assert result["restarts"] == result["errors"] == 0


def test_two_agents_that_claim_one_output_are_refused_by_name(tmp_path):
    (tmp_path / "user.py").write_text(PLUGIN, encoding="utf-8")
    uses = [{"devices": ["valve"], "agents": [agent], "owner": agent} for agent in ("one", "two")]
    scenario = {
        "name": "user",
        "simulation": "./user.py:simulation",
        "agents": {"count": 2, "names": ["one", "two"], "tick_hz": 5},
        "time": {"duration_s": 5},
        "hardware": {"armed": True, "use": uses},
    }
    parameters = {"port": "/dev/null"}
    listed = {"name": "valve", "kind": "./user.py:Line", "outputs": True, "parameters": parameters}
    here = {"ansible_connection": "local", "ansible_host": "127.0.0.1", "cosmos_devices": [listed]}
    (tmp_path / "user.yaml").write_text(yaml.safe_dump(scenario), encoding="utf-8")
    inventory = tmp_path / "inventory.yaml"
    inventory.write_text(yaml.safe_dump({"all": {"hosts": {"here": here}}}), encoding="utf-8")

    with CosmosCommand(tmp_path).start("run", "user.yaml", "-i", inventory) as run:
        out, err = run.communicate(timeout=120)

    assert run.returncode == 2, out + err
    told = " ".join((out + err).split())
    assert "valve of here" in told
    assert "one" in told
    assert "two" in told
