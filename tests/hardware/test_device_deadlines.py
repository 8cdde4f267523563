"""
How soon outputs are safe and devices are back, by the times that the driver itself notes.

A limit bears what this machine lets a ready thread wait meanwhile (`MachineWaits`), and nothing else.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import asdict
from pathlib import Path

import pytest
import yaml
from harness.cosmos_command import LOOSE, CosmosCommand
from harness.machine_waits import MachineWaits
from harness.waiting import wait_until

from madns_runtime.config import AgentLaunch, Agents, DeviceLaunch, RunConfig
from madns_runtime.hardware import guardian, manager, status
from madns_runtime.processes import list_processes
from tests.hardware.bench import AGENT, DeviceBench, still_running

pytestmark = pytest.mark.process

SAFE_S_MAX = 1.0
RETURN_S_MAX = 2.0
DRIVER = '''
import os, time
from dataclasses import dataclass

from madns_runtime.hardware.contract import Channel, Device, DeviceKind, Sample
from madns_runtime.plugin.api import AgentSimulation, Simulation


@dataclass(frozen=True, kw_only=True)
class Parameters:
    log: str
    file: str = "/dev/null"
    hang_file: str = "none"
    safe_s: float = 0.0
    make_s: float = 0.0


class Valve(Device):
    """Notes when it is opened, moved and made safe, and by whom."""

    kind = DeviceKind(
        name="valve",
        summary="a valve",
        parameters=Parameters,
        needs_hardware=False,
        channels=(Channel(name="level"), Channel(name="valve", direction="out", safe=0.0)),
    )

    def __init__(self, parameters):
        super().__init__(parameters)
        time.sleep(parameters.make_s)  # as the import of a library does on a small board
        self.note("MADE")

    def open(self):
        with open(self.parameters.file) as file:
            file.read()
        self.note("OPEN")
        self.has_read = False
        return ""

    def read(self):
        if not os.path.exists(self.parameters.file):
            raise OSError("the valve is unplugged")
        while os.path.exists(self.parameters.hang_file):
            time.sleep(0.02)
        if not self.has_read:
            self.note("READ")
            self.has_read = True
        return Sample(values={"level": 1.0}, taken_s=time.monotonic())

    def write(self, values, due_s):
        self.note("MOVED")

    def make_safe(self):
        time.sleep(self.parameters.safe_s)
        self.note("SAFE")

    def note(self, word):
        fd = os.open(self.parameters.log, os.O_WRONLY | os.O_APPEND | os.O_CREAT)
        os.write(fd, f"{word} {time.monotonic()!r} {os.getpid()}\\n".encode())
        os.close(fd)


@dataclass(frozen=True, kw_only=True)
class Nothing:
    pass


class Mover(AgentSimulation):
    def setup(self, context, initial):
        self.valve = context.hardware.get("valve")

    def step(self, tick):
        if self.valve is not None:
            self.valve.write("valve", 1.0)


simulation = Simulation(name="mover", parameters=Nothing, agent=":Mover")
'''


class Log:
    """What the driver noted: words with their times."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def notes(self, word: str, after_s: float = 0.0) -> list[tuple[float, int]]:
        """Return when and by which processes something was noted."""
        if not self.path.exists():
            return []
        lines = [line.split() for line in self.path.read_text().splitlines()]
        return [(float(t), int(pid)) for w, t, pid in lines if w == word and float(t) > after_s]

    def first(self, word: str, after_s: float = 0.0) -> float:
        """Return when something was first noted after a moment; it must come."""
        return wait_until(lambda: self.notes(word, after_s), f"{word} in {self.path}")[0][0]


@pytest.fixture
def waits():
    with MachineWaits() as found:
        yield found


@pytest.fixture
def log(tmp_path):
    (tmp_path / "valve.py").write_text(DRIVER, encoding="utf-8")
    return Log(tmp_path / "log")


def launch_of(folder: Path, rate_hz: float = 20.0, **parameters) -> DeviceLaunch:
    return DeviceLaunch(
        name="valve",
        place="pi22",
        kind="./valve.py:Valve",
        base_directory=str(folder),
        rate_hz=rate_hz,
        parameters={"log": str(folder / "log"), **parameters},
        users=(AGENT,),
        owner=AGENT,
        may_move=True,
    )


def moved_bench(folder: Path, **parameters) -> DeviceBench:
    """Return a bench whose device has moved its output."""
    bench = DeviceBench(folder, (launch_of(folder, **parameters),))
    bench.until(lambda: bench.hardware["valve"]["level"].number > 0, timeout_s=60.0)
    bench.hardware["valve"].write("valve", 1.0)
    log = Log(folder / "log")
    bench.until(lambda: bool(log.notes("MOVED")), timeout_s=60.0)
    return bench


def assert_within(limit_s: float, begin_s: float, end_s: float, waits: MachineWaits) -> None:
    waited_s = waits.between(begin_s, end_s)
    assert end_s - begin_s <= limit_s + waited_s, f"the machine let threads wait {waited_s:.3f} s"


def test_the_promised_times_hold_by_their_parts():
    """Where nothing else waits: the guardian's grace, the look at the pages, the back-off of an opening."""
    assert guardian.GRACE_S + guardian.RETRY_S <= SAFE_S_MAX / 2
    assert manager.LOOK_PERIOD_S + status.back_off_s(100) <= RETURN_S_MAX - 0.5


def test_outputs_are_safe_after_the_devices_process_was_killed(tmp_path, log, waits):
    bench = moved_bench(tmp_path)
    began_s = time.monotonic()
    os.kill(bench.pid_of(), signal.SIGKILL)
    bench.until(lambda: bool(log.notes("SAFE", began_s)), timeout_s=60.0)
    bench.close()

    assert_within(SAFE_S_MAX, began_s, log.first("SAFE", began_s), waits)


def test_outputs_are_safe_in_time_though_the_drivers_libraries_take_longer(tmp_path, log, waits):
    bench = moved_bench(tmp_path, make_s=2.5)
    pid = bench.pid_of()
    bench.until(lambda: any(by != pid for _, by in log.notes("MADE")))  # one stands by
    began_s = time.monotonic()
    os.kill(pid, signal.SIGKILL)
    bench.until(lambda: bool(log.notes("SAFE", began_s)))
    bench.close()

    assert_within(SAFE_S_MAX, began_s, log.first("SAFE", began_s), waits)


def test_a_device_that_is_back_before_the_guardian_is_done_does_not_stay_lost(
    tmp_path, log, monkeypatch
):
    # For the guardian's last attempt, however long it waits.
    monkeypatch.setattr(manager, "END_S", 60.0)
    bench = moved_bench(tmp_path, safe_s=1.0)
    pid = bench.pid_of()
    os.kill(pid, signal.SIGKILL)
    bench.until(lambda: bench.pid_of() not in (0, pid))
    bench.until(lambda: any(by not in (pid, bench.pid_of()) for _, by in log.notes("SAFE")))
    bench.run(0.3)  # the guardian hears of the end of its attempt

    bench.until(lambda: bench.hardware["valve"].status == "ok")
    bench.hardware["valve"].write("valve", 1.0)
    bench.until(lambda: len(log.notes("MOVED")) >= 2)
    assert bench.close()["pi22/valve"]["unsafe"] == 0


@pytest.mark.parametrize("does_hang", [False, True])
def test_outputs_are_safe_after_the_owners_end(tmp_path, log, waits, does_hang):
    bench = moved_bench(tmp_path, hang_file=str(tmp_path / "hang"))
    owner = os.fork()
    if owner == 0:
        signal.pause()
    bench.manager.agents_started((AGENT,), owner)
    if does_hang:
        (tmp_path / "hang").touch()
        bench.run(0.2)  # it is in its read by then
    began_s = time.monotonic()
    os.kill(owner, signal.SIGKILL)
    os.waitpid(owner, 0)
    if not does_hang:
        bench.manager.agents_ended((AGENT,))  # what the supervisor says of an agent that has ended
    bench.until(lambda: bool(log.notes("SAFE", began_s)), timeout_s=60.0)
    (tmp_path / "hang").unlink(missing_ok=True)
    bench.close()

    assert_within(SAFE_S_MAX, began_s, log.first("SAFE", began_s), waits)


@pytest.mark.parametrize("does_hang", [False, True])
def test_outputs_are_safe_after_the_end_of_an_owner_whose_process_goes_on(
    tmp_path, log, waits, does_hang
):
    bench = moved_bench(tmp_path, hang_file=str(tmp_path / "hang"))
    bench.manager.agents_started((AGENT,), os.getpid())
    if does_hang:
        (tmp_path / "hang").touch()
        bench.run(0.2)  # it is in its read by then
    began_s = time.monotonic()
    bench.manager.agent_left(AGENT)
    bench.until(lambda: bool(log.notes("SAFE", began_s)), timeout_s=60.0)
    (tmp_path / "hang").unlink(missing_ok=True)
    bench.close()

    assert_within(SAFE_S_MAX, began_s, log.first("SAFE", began_s), waits)


@pytest.mark.parametrize("does_hang", [False, True])
def test_outputs_are_safe_after_the_end_of_the_run(tmp_path, log, waits, does_hang):
    bench = moved_bench(tmp_path, hang_file=str(tmp_path / "hang"))
    if does_hang:
        (tmp_path / "hang").touch()
        bench.run(0.2)
    began_s = time.monotonic()
    bench.close()

    assert_within(SAFE_S_MAX, began_s, log.first("SAFE", began_s), waits)


def test_outputs_are_safe_after_the_supervisors_end_though_the_driver_hangs(tmp_path, log, waits):
    hang = tmp_path / "hang"
    supervisor = os.fork()
    if supervisor == 0:
        try:
            bench = moved_bench(tmp_path, hang_file=str(hang))
            hang.touch()
            bench.run(600.0)
        finally:
            os._exit(1)
    try:
        wait_until(hang.exists, "the valve has moved")
        time.sleep(0.2)  # it is in its read by then
        began_s = time.monotonic()
    finally:
        os.kill(supervisor, signal.SIGKILL)
        os.waitpid(supervisor, 0)
    safe_s = log.first("SAFE", began_s)

    assert_within(SAFE_S_MAX, began_s, safe_s, waits)


@pytest.mark.parametrize("what", ["unplugged", "killed"])
def test_a_device_is_back_soon_after_its_return(tmp_path, log, waits, what):
    port = tmp_path / "port"
    port.touch()
    bench = moved_bench(tmp_path, file=str(port))
    port.unlink()
    if what == "killed":
        os.kill(bench.pid_of(), signal.SIGKILL)
    bench.until(lambda: bench.hardware["valve"].status == "lost", timeout_s=60.0)
    bench.run(1.5)  # by now it waits longest between two attempts
    began_s = time.monotonic()
    port.touch()
    bench.until(lambda: bench.hardware["valve"].status == "ok", timeout_s=60.0)
    bench.close()

    assert_within(RETURN_S_MAX, began_s, log.first("READ", began_s), waits)


def test_outputs_are_safe_once_an_operator_has_been_away_for_its_time(tmp_path, log, waits):
    """An operator on another computer may come back for `silence_s`; outputs stay as long, and not much longer."""
    config = RunConfig(
        run="0001-away",
        scenario="away",
        simulation="./valve.py:simulation",
        base_directory=str(tmp_path),
        agents=Agents(count=1),
    )
    away_s = 1.0
    launch = AgentLaunch(
        config=config,
        run_key_hex="0" * 64,
        session_hex="0" * 16,
        machine="pi22",
        agents=(AGENT,),
        host_address="127.0.0.1",
        host_port=9,  # nobody is there: its agents say hello until the end
        directory=str(tmp_path),
        reattach_s=away_s,
        devices=(launch_of(tmp_path),),
    )
    with subprocess.Popen(
        [sys.executable, "-m", "madns_runtime.agent"],
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        env={**os.environ, "COSMOS_STATE_DIR": str(tmp_path / "state")},
    ) as supervisor:
        try:
            supervisor.stdin.write(json.dumps(asdict(launch)).encode() + b"\n")
            supervisor.stdin.flush()
            log.first("READ")
            began_s = time.monotonic()
            supervisor.stdin.close()
            safe_s = log.first("SAFE", began_s)
            supervisor.wait(timeout=120)
        finally:
            supervisor.kill()

    assert safe_s >= began_s + away_s
    assert_within(away_s + SAFE_S_MAX, began_s, safe_s, waits)


def test_outputs_of_a_run_are_safe_whoever_is_killed(tmp_path, log, waits, monkeypatch):
    """One run in which the agent, then the device's process, then the supervisor gets SIGKILL; each moves it again."""
    scenario = tmp_path / "mover.yaml"
    device = {
        "name": "valve",
        "kind": "./valve.py:Valve",
        "agents": [AGENT],
        "rate_hz": 20,
        "parameters": {"log": str(log.path)},
    }
    document = {
        "name": "mover",
        "simulation": "./valve.py:simulation",
        "agents": {"count": 2, "tick_hz": 20, "restarts_max": 9},
        "on_agent_loss": "continue",
        "time": {"duration_s": 120},
        "hardware": {"armed": True, "on_device_loss": "continue", "devices": [device]},
    }
    scenario.write_text(yaml.safe_dump(document), encoding="utf-8")
    killed: list[tuple[str, float, float]] = []
    monkeypatch.setenv("COSMOS_STATE_DIR", str(tmp_path / "state"))
    with CosmosCommand(tmp_path).start_run(scenario, *LOOSE) as run:
        try:
            pid_of = {
                "agent": lambda: the_process(run, "agent"),
                "device": lambda: log.notes("MOVED")[-1][1],
                "supervisor": lambda: the_process(run, "supervisor"),
            }
            for who, find in pid_of.items():
                moved_after_s = time.monotonic()
                log.first("MOVED", moved_after_s)
                pid, began_s = find(), time.monotonic()
                os.kill(pid, signal.SIGKILL)
                killed.append((who, began_s, log.first("SAFE", began_s)))
            out, err = run.communicate(timeout=240)
            wait_until(lambda: not still_running(tmp_path), "nothing of it runs")
        finally:
            run.kill()

    assert [who for who, *_ in killed] == ["agent", "device", "supervisor"]
    for _, began_s, safe_s in killed:
        assert_within(SAFE_S_MAX, began_s, safe_s, waits)
    document = json.loads(out)
    assert document["exit_code"] == run.returncode != 0
    assert document["devices"][f"{AGENT}/valve"]["status"] == "unknown"  # who knew it is dead
    checks = [each for each in document["checks"] if each["name"].startswith("hardware.")]
    assert checks
    assert not any(each["passed"] for each in checks)
    assert "agent-01 is lost: its supervisor" in err
    assert not log.notes("MOVED", killed[-1][2])  # nobody moves it any more


def the_process(run, role: str) -> int:
    [pid] = wait_until(
        lambda: [
            each.pid
            for each in list_processes()
            if each.role == role and (role != "agent" or each.name == AGENT)
        ],
        role,
        process=run,
    )
    return pid
