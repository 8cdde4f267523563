"""`cosmos doctor` as a person meets it; machines are this computer under other names."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from cosmos_cli.app import run as cosmos
from cosmos_cli.commands import doctor as command
from cosmos_cli.commands.doctor import with_machines
from cosmos_cli.doctor.finding import HERE, CheckRemark, Finding
from cosmos_cli.fleet.connection import Connection, ConnectOptions
from cosmos_cli.fleet.failure import FailureKind, MachineFailure
from cosmos_cli.fleet.local import LocalConnection
from cosmos_cli.fleet.target import Target
from cosmos_cli.ui import invocation
from cosmos_cli.ui.invocation import Invocation

pytestmark = pytest.mark.process


@pytest.mark.parametrize(
    ("words", "said", "cure"),
    [
        (("-i", "my box.yaml"), "`cosmos up -i INVENTORY`", "`cosmos up -i 'my box.yaml'`"),
        ((), "`cosmos up -i INVENTORY`", "`cosmos up -i INVENTORY`"),
        (("-i", "a.yaml"), "`cosmos up` removes it", "`cosmos up -i a.yaml` removes it"),
        (("-i", "a.yaml"), "`cosmos wipe --uncollected`", "`cosmos wipe -i a.yaml --uncollected`"),
        (("-i", "a.yaml"), "`x: 1` there, then `cosmos up`", "`x: 1` there, then `cosmos up`"),
        (("-i", "a.yaml"), "`cosmos down 7 -i INVENTORY`", "`cosmos down 7 -i a.yaml`"),
    ],
)
def test_cure_names_the_inventory_that_was_given(monkeypatch, words, said, cure):
    monkeypatch.delenv("COSMOS_INVENTORY", raising=False)
    given = Invocation(verb="doctor", words=words, valued=frozenset({"-i"}))
    monkeypatch.setattr(invocation, "current", lambda: given)
    remark = CheckRemark(found="no package x", cure=said)

    (finding,) = with_machines([Finding(machine="pi01", check="devices", remark=remark)])

    assert finding.remark.cure == cure


SCENARIO = """\
name: two
simulation: counter
agents: {count: 2, tick_hz: 20}
network: {receive_buffer_bytes: 2000000000}
"""
INVENTORY = """\
all:
  vars: {cosmos_root: ROOT}
  hosts:
    "pi[01:03]": {}
    here: {ansible_connection: local}
"""


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr("cosmos_cli.doctor.probe.WAKE_UP_COUNT", 3)
    monkeypatch.setattr("cosmos_cli.doctor.probe.ROUND_TRIP_COUNT", 5)
    monkeypatch.setenv("COSMOS_RUNS", str(tmp_path / "runs"))


@pytest.fixture
def inventory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    def connect(target: Target, options: ConnectOptions) -> Connection:
        if target.name == "pi03":
            raise MachineFailure(FailureKind.UNREACHABLE, "no route to pi03", "switch it on")
        return LocalConnection(target)

    monkeypatch.setattr("cosmos_cli.fleet.fleet.connect", connect)
    path = tmp_path / "inventory.yaml"
    path.write_text(INVENTORY.replace("ROOT", str(tmp_path / "cosmos")))
    return path


@pytest.fixture
def told(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Let machines tell something else, so that nothing depends on this computer's state."""
    ask, ask_here = command.ask, command.ask_here
    other: dict[str, dict[str, Any]] = {}

    def change(machine: str, **facts: Any) -> None:
        other[machine] = facts

    def changed(machine: str, values: dict[str, Any]) -> dict[str, Any]:
        # Nothing of this computer that would be found wanting elsewhere.
        values["wake_ups"] |= {"p50_ms": 0.1, "p99_ms": 0.1, "max_ms": 0.1, "policy": "fifo"}
        values["busy"] |= {"processors": 0.0, "steal_share": 0.0, "swapped_pages": 0}
        values["limits"] |= {"cpu_quota": None}
        values["interfaces"] = []
        values["receive_drops"] = {"total": 0, "before": 0}
        values["swap"] = {"total_bytes": 0, "used_bytes": 0}
        values["disk_write"] |= {"duration_s": 0.05, "sync_s": 0.01}
        if trips := values["round_trips"]:  # a busy computer's answer may come after its time
            trips |= {"sent": trips["answered"], "p50_ms": 0.1, "clock_offset_s": 0.0}
        values["facts"]["network"]["receive_buffer_bytes_max"] = 2_000_000_000
        values["facts"]["disk"] |= {"free_bytes": 10**12, "free_files": 10**6}
        values["facts"]["memory"]["available_bytes"] = 10**10
        values["facts"] |= {"throttled": 0, "temperature_c": 40.0, "governors": {}}
        values["facts"] |= other.get(machine, {})
        return values

    monkeypatch.setattr(command, "ask", lambda c, *a, **k: changed(c.target.name, ask(c, *a, **k)))
    monkeypatch.setattr(command, "ask_here", lambda *a, **k: changed(HERE, ask_here(*a, **k)))
    return change


def test_this_computer_alone(told: Callable[..., None], capsys: pytest.CaptureFixture[str]) -> None:
    code = cosmos(["doctor", "--all"])

    out = capsys.readouterr().out
    assert code == 0
    assert out.splitlines()[0].split() == ["level", "check", "machines", "found", "cure"]
    assert "SCHED_FIFO with priority 11 is permitted" in out
    assert out.splitlines()[-1].startswith(f"{HERE}: ")


def test_machines_are_grouped_by_what_was_found(
    told: Callable[..., None], inventory: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for machine in ("pi01", "pi02"):
        told(machine, governors={"cpu0": "ondemand"})

    code = cosmos(["doctor", "-i", str(inventory), "--limit", "!pi03"])

    lines = capsys.readouterr().out.splitlines()
    (line,) = [line for line in lines if " governor " in line]
    assert code == 0
    assert "pi01, pi02" in line
    assert "`cosmos_cpu_governor: performance` in the inventory, then `cosmos up`" in line
    assert lines[-1].startswith("2 machines and this computer: 1 warning, ")


def test_strict_fails_on_warnings(told: Callable[..., None], inventory: Path) -> None:
    told("pi01", governors={"cpu0": "ondemand"})

    assert cosmos(["doctor", "-i", str(inventory), "--limit", "pi01", "--strict"]) == 1


def test_error_fails(
    told: Callable[..., None], inventory: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    told("pi02", throttled=1)

    code = cosmos(["doctor", "-i", str(inventory), "--limit", "pi01:pi02", "--json"])

    answer = json.loads(capsys.readouterr().out)
    machines = {machine["machine"]: machine for machine in answer["machines"]}
    assert code == answer["exit_code"] == 1
    assert answer["levels"]["error"] == 1
    assert list(machines) == [HERE, "pi01", "pi02"]
    assert {
        "check": "throttled",
        "level": "error",
        "found": "now: under-voltage",
    }.items() <= next(f for f in machines["pi02"]["findings"] if f["level"] == "error").items()
    assert 1 <= machines["pi01"]["probed"]["round_trips"]["answered"] <= 5


def test_unreachable_machine_hides_nobody_and_ends_with_3(
    told: Callable[..., None], inventory: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    told("pi01", throttled=1)

    code = cosmos(["doctor", "-i", str(inventory)])

    lines = capsys.readouterr().out.splitlines()
    assert code == 3
    assert lines[1].split()[:3] == ["failed", "unreachable", "pi03"]
    assert "switch it on" in lines[1]
    assert any(line.startswith("error") and "pi01" in line for line in lines)
    assert lines[-1].startswith("3 machines and this computer: 1 error")
    assert "1 failed" in lines[-1]


def test_wants_are_the_scenarios(
    told: Callable[..., None],
    inventory: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    (tmp_path / "two.yaml").write_text(SCENARIO)
    told("pi01", network={"receive_buffer_bytes_max": 8_388_608})

    cosmos(
        ["doctor", str(tmp_path / "two.yaml"), "-i", str(inventory), "--limit", "pi01", "--json"]
    )

    answer = json.loads(capsys.readouterr().out)
    here, machine = answer["machines"]
    assert answer["scenario"] == "two"
    assert any(f["check"] == "feasibility" and f["level"] == "ok" for f in here["findings"])
    assert any("2 agents at 20 Hz" in f["found"] for f in machine["findings"])


@pytest.fixture
def quick_scenario(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """A counter on this computer that keeps 2000 Hz by a datagram's time on loopback, and would not by a switch's."""
    monkeypatch.setattr("cosmos_cli.launch.plan_view.measure_loopback_s", lambda: 1e-5)
    path = tmp_path / "quick.yaml"
    path.write_text("name: quick\nsimulation: counter\nagents: {count: 3, tick_hz: 2000}\n")
    return str(path)


def findings_of(check: str, answer: dict[str, Any]) -> list[dict[str, Any]]:
    return [each for each in answer["machines"][0]["findings"] if each["check"] == check]


def test_inequalities_of_a_run_on_this_computer_are_those_of_its_plan(
    told: Callable[..., None], quick_scenario: str, capsys: pytest.CaptureFixture[str]
) -> None:
    plan_code = cosmos(["plan", quick_scenario, "--json"])
    planned = json.loads(capsys.readouterr().out)
    code = cosmos(["doctor", quick_scenario, "--json"])
    answer = json.loads(capsys.readouterr().out)

    assert (plan_code, code) == (0, 0)
    here = answer["machines"][0]["probed"]["here"]
    assert here["feasibility"] == planned["feasibility"]
    assert here["capacity"] == planned["capacity"]
    assert [each["level"] for each in findings_of("feasibility", answer)] == ["ok"]


def test_lockstep_is_not_held_against_real_time(
    told: Callable[..., None], quick_scenario: str, capsys: pytest.CaptureFixture[str]
) -> None:
    broken = ["--set", "plan.latency_ms=5", "--json"]

    real_time = cosmos(["doctor", quick_scenario, *broken])
    capsys.readouterr()
    lockstep = cosmos(["doctor", quick_scenario, *broken, "--set", "time.mode=lockstep"])
    answer = json.loads(capsys.readouterr().out)

    assert (real_time, lockstep) == (1, 0)
    assert findings_of("feasibility", answer) == []


@pytest.mark.usefixtures("told")
@pytest.mark.parametrize(
    ("agents", "level"),
    [
        ("{count: 62, tick_hz: 100}", "ok"),
        ("{count: 80, tick_hz: 100}", "warning"),  # up to 62 by the plan; 54 and 66 were found
        ("{count: 93, tick_hz: 100, per_process: 47}", "ok"),  # as measured, with none missed
        ("{count: 93, tick_hz: 100, per_process: 93}", "ok"),
        ("{count: 93, tick_hz: 200, per_process: 93}", "warning"),  # one thread
    ],
)
def test_agents_are_held_against_the_processors_as_a_plan_does(
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    agents: str,
    level: str,
) -> None:
    ask_here = command.ask_here

    def on_two(*arguments: Any, **options: Any) -> dict[str, Any]:
        values = ask_here(*arguments, **options)
        values["limits"]["usable_processors"] = 2
        return values

    monkeypatch.setattr(command, "ask_here", on_two)
    monkeypatch.setattr("cosmos_cli.launch.capacity_view.processors_here", lambda: 2)
    path = tmp_path / "many.yaml"
    path.write_text(f"name: many\nsimulation: counter\nagents: {agents}\n")

    cosmos(["plan", str(path), "--latency-ms", "0.01", "--json"])
    capacity = json.loads(capsys.readouterr().out)["capacity"]
    cosmos(["doctor", str(path), "--json"])
    (finding,) = findings_of("processors", json.loads(capsys.readouterr().out))

    most = {each["name"]: each["agents"] for each in capacity["limits"]}
    count = int(agents.partition(",")[0].removeprefix("{count: "))
    names = ("process of agents", "processors of this computer")
    is_planned = all(most[name] is None or count <= most[name] for name in names)
    assert (finding["level"], is_planned) == (level, level == "ok")


def test_processors_that_a_machine_has_not_are_told_whoever_asks_for_them(
    told: Callable[..., None],
    inventory: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    inventory.write_text(inventory.read_text().replace("{}", "{cosmos_cpu_affinity: [0, 4001]}"))
    (tmp_path / "two.yaml").write_text(SCENARIO + "scheduling: {cpu_affinity: [4002]}\n")

    cosmos(["doctor", "-i", str(inventory), "--limit", "pi01,here"])
    without = capsys.readouterr().out
    cosmos(["doctor", str(tmp_path / "two.yaml"), "-i", str(inventory), "--limit", "pi01,here"])
    with_scenario = capsys.readouterr().out

    def found(out: str) -> list[tuple[str, str]]:
        lines = [re.split(r"  +", line) for line in out.splitlines()]
        return [(line[2], line[3].split(",")[0]) for line in lines if line[1:2] == ["cpu_affinity"]]

    of_inventory = ("pi01", "agents are to use its processor 4001")
    of_scenario = (HERE, "agents are to use its processor 4002")
    assert found(without) == [of_inventory]
    assert sorted(found(with_scenario)) == sorted([of_inventory, of_scenario])


def test_nothing_is_left_in_the_runs_folder(told: Callable[..., None], tmp_path: Path) -> None:
    cosmos(["doctor"])

    assert not (tmp_path / "runs").exists()
