"""Vehicles that are flown by firmware in an emulator, as changes of a scenario, and what became of one whose board was lost."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import yaml

from harness.cosmos_command import SCENARIOS
from harness.firmware import build_firmware

HZ = 10
COMMAND_LEAD_S = 0.5
"""From a command of the firmware to its begin, and from there to its end: `lead_s` and `command_s` of detumble.c."""
RUN_MIN = 0.2
"""Share of the ticks that a machine which others use as well must come to; who waited for a lost one comes to none."""


def emulated_flight(folder: Path, *computers: str, count: int, duration_s: float) -> dict[str, Any]:
    """Build the firmware into a scenario's folder, and return what makes a scenario that flies some vehicles by it."""
    (folder / "firmware").mkdir(exist_ok=True)
    build_firmware(folder / "firmware")
    told: dict[str, Any] = yaml.safe_load((SCENARIOS / "hwil_detumble.yaml").read_text())
    parameters, hardware = told["parameters"], told["hardware"]
    hardware["devices"][0] |= {
        "agents": list(computers),
        "parameters": {"firmware": "firmware/detumble.elf"},
    }
    hardware["stimulus_late"] = 1
    parameters["satellites"]["walker"] = f"86.4:{count}/1/0"
    parameters["maneuvers"] = {"late": "refuse"}
    with_computer, others = parameters["vehicles"]
    parameters["vehicles"] = [{**with_computer, "agents": list(computers)}, others]
    rule = {**parameters["flight"][0], "agents": list(computers), "answer_s": 60}
    parameters["flight"] = [rule]
    return {
        "simulation": "constellation",
        "parameters": parameters,
        "hardware": hardware,
        "agents": {"count": count, "tick_hz": HZ, "restarts_max": 5},
        "on_agent_loss": "continue",
        "time": {"duration_s": duration_s, "rtf_tolerance": 0.9},
    }


def records(path: Path) -> list[Any]:
    """Return the lines of a stream that are records."""
    lines = map(json.loads, path.read_text().splitlines()[1:])
    return [line for line in lines if isinstance(line, list)]


def has_commanded(run: Path, agent: str, *, before: int = 0) -> bool:
    """Tell whether truth holds some commands of an agent's, behind those *before*; its own records then hold them, too."""
    return count_commands(run, agent) >= before + 3


def count_commands(run: Path, agent: str) -> int:
    """Return how many commands of an agent's truth holds by now."""
    path = run / "host" / "maneuvers.jsonl"
    return path.read_text().count(f'"{agent}",') if path.exists() else 0


def assert_returned(run: Path, agent: str) -> None:
    """Check that a lost agent's computer was started anew and goes on, and that nothing was commanded while it was away."""
    folder = run / "agents" / agent
    lost_s, back_s = lost_and_back_s(run, agent)
    document = json.loads((run / "run.json").read_text())
    flight = document["simulation"]["agents"][agent]["flight"]
    assert flight["answers"] > HZ, flight
    taken = [row for row in records(run / "host" / "maneuvers.jsonl") if row[1] == agent]
    numbers = [row[2] for row in taken]
    assert len(set(numbers)) == len(numbers)
    assert [row for row in taken if lost_s < row[0] < back_s] == []
    # What was heard of it before ends by itself, 1 s later at most; it commands again when it is back.
    acting = [row for row in taken if row[7] is not None]
    assert any(row[0] < lost_s for row in acting)
    assert any(row[0] >= back_s for row in acting)
    assert all(row[7] - row[0] <= COMMAND_LEAD_S + 1e-6 for row in acting)
    assert {row[-1] for row in commanded(folder)} == {COMMAND_LEAD_S}


def lost_and_back_s(run: Path, agent: str) -> tuple[float, float]:
    """Return when the host missed an agent, and when it was back, s."""
    lines = (run / "host" / "events.jsonl").read_text().splitlines()[1:]
    events = [line for line in map(json.loads, lines) if line.get("agent") == agent]
    lost_s = next(each["t_s"] for each in events if each.get("state") == "lost")
    back_s = next(each["t_s"] for each in events if each["event"] == "agent_rejoined")
    return lost_s, back_s


def commanded(folder: Path) -> list[Any]:
    """Return an agent's commands, over all its incarnations."""
    return [row for path in sorted(folder.glob("commands*.jsonl")) for row in records(path)]


def assert_untouched(run: Path, agent: str, lost: str, *, has_computer: bool) -> None:
    """Check that an agent ticked on while another was lost, and that its computer answered each tick."""
    ticks = [row[0] for row in records(run / "agents" / agent / "attitude.jsonl")]
    lost_s, back_s = lost_and_back_s(run, lost)
    meanwhile = [tick for tick in ticks if lost_s < tick / HZ < back_s]
    assert len(meanwhile) >= RUN_MIN * (back_s - lost_s) * HZ
    if has_computer:
        document = json.loads((run / "run.json").read_text())
        flight = document["simulation"]["agents"][agent]["flight"]
        assert flight["answers"] + flight["unanswered"] == flight["ticks_sent"] == len(ticks)
