"""A timeline's faults on loopback, in real time: named, survived, not judged; what was not ordered is."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
import yaml
from fault_harness import Laboratory
from harness.acting import ACTING

from madns_runtime.recording.reader import read_stream

pytestmark = pytest.mark.process

SIMULATION = Path(__file__).parents[1] / "harness/fault_simulation.py"
LENIENT = {
    "deadline": {"overrun_ms": 1000, "max_miss_ratio": 1},
    "timeouts": {"start_lead_s": 0.3, "shutdown_s": 60, "silence_s": 30, "complete_s": 60},
    "recording": {"flush_interval_s": 0.1},
}
"""Nothing here depends on how busy the machine is."""


def run_faults(laboratory: Laboratory, timeline, *, per_process=1, duration_s=9, **settings):
    """Run four agents with a timeline to the end, and return run.json and the run's folder."""
    shutil.copy(SIMULATION, laboratory.folder)
    path = laboratory.folder / "faults.yaml"
    document = {
        "name": "faults",
        "simulation": "./fault_simulation.py:simulation",
        "agents": {"count": 4, "tick_hz": 10, "per_process": per_process},
        "time": {"duration_s": duration_s, "rtf_tolerance": 0.9},
        "on_agent_loss": "continue",
        **LENIENT,
        "timeline": timeline,
    }
    path.write_text(yaml.safe_dump(document | settings))
    done = laboratory.cosmos("run", str(path), "--no-report", "--json")
    assert done.stdout, done.stderr
    result = json.loads(done.stdout)
    assert laboratory.living() == [] and laboratory.leftovers() == []
    return result, laboratory.runs / result["run"]


def ticks(folder: Path, agent: str, number: str = "") -> list[int]:
    stream = read_stream(folder / f"agents/{agent}/steps{number}.jsonl")
    return [int(row[1]) for row in stream.records()]


def events(folder: Path, who: str) -> list[dict]:
    lines = (folder / who / "events.jsonl").read_text().splitlines()
    return [event for line in lines if "event" in (event := json.loads(line))]


def test_processes_that_are_killed_on_purpose_return_and_cost_no_verdict(laboratory):
    result, folder = run_faults(
        laboratory,
        [
            {"at_s": 1, "action": "kill", "agents": ["agent-01"], "for_s": 1},
            {"at_s": 1, "action": "kill", "agents": ["agent-02"]},
            {"at_s": 1, "action": "hang", "agents": ["agent-03"], "for_s": 2},
            {"at_s": 1.5, "action": "lose_messages", "agents": ["agent-04"], "for_s": 2},
            {"at_s": 4, "action": "restart", "agents": ["agent-03"]},
            {"at_s": 4, "action": "duplicate_messages", "agents": ["agent-04"], "for_s": 1},
            {"at_s": 5, "action": "slow", "agents": ["agent-04"], "factor": 2, "for_s": 1},
            {"at_s": 6, "action": "link_down", "agents": ["agent-04"], "for_s": 1},
        ],
    )

    assert (result["exit_code"], result["status"]) == (0, "complete"), result["verdict"]
    assert result["agents"]["lost"] == []
    assert result["agents"]["lost_on_purpose"] == ["agent-01", "agent-02", "agent-03"]
    assert result["agents"]["incarnations"] == {"agent-01": 2, "agent-03": 2}
    # Back at the present time, with the ticks between it and the kill never its own.
    assert 20 <= ticks(folder, "agent-01", ".2")[0] <= 85
    assert ticks(folder, "agent-02")[-1:] < [60]
    lost = [e for e in events(folder, "host") if e.get("state") == "lost"]
    assert [(e["reason"], e["is_intended"]) for e in lost] == [("killed by SIGKILL", True)] * 3
    own = {e["event"]: e for e in events(folder, "agents/agent-03")}
    assert own["hang_ends"]["ticks_withheld"] > 0
    counts = result["faults"]["agents"]["agent-04"]
    assert counts["seen"] == counts["passed"] + counts["lost"] + counts["late"]
    assert counts["lost"] > 0 and counts["doubled"] > 0
    assert counts["late"] == counts["released"]
    assert result["messages"]["reliable"]["lost"] == result["messages"]["sync"]["lost"] == 0


@pytest.mark.nightly
def test_an_end_on_purpose_takes_no_return_from_an_agent_that_fails_later(laboratory):
    (laboratory.folder / "acting.py").write_text(ACTING)
    back = {"stream": "events", "agents": ["host"], "field": "event", "equals": "agent_rejoined"}
    result, _ = run_faults(
        laboratory,
        [
            {"at_s": 1, "action": "restart", "agents": ["agent-01"]},
            {"when": back, "action": "act", "agents": ["agent-01"]},
        ],
        duration_s=10,
        simulation="./acting.py:simulation",
        agents={"count": 2, "tick_hz": 10, "restarts_max": 1},
    )

    assert result["agents"]["incarnations"] == {"agent-01": 3}, result["verdict"]


HELPED = """
import dataclasses
import subprocess
from fault_simulation import *


class HelpedAgent(FaultAgent):
    def setup(self, context, initial):
        super().setup(context, initial)
        self.helper = subprocess.Popen(["sleep", "600"])

    def abandon(self):
        self.helper.kill()
        self.helper.wait()

    def finish(self):
        self.abandon()
        return super().finish()


simulation = dataclasses.replace(simulation, agent=":HelpedAgent")
"""


def test_who_is_killed_on_purpose_leaves_nothing_behind_that_it_has_started(laboratory):
    (laboratory.folder / "helped.py").write_text(HELPED)
    result, folder = run_faults(
        laboratory,
        [{"at_s": 1, "action": "kill", "agents": ["agent-01"], "for_s": 1}],
        duration_s=4,
        simulation="./helped.py:simulation",
        agents={"count": 2, "tick_hz": 10, "per_process": 1},
    )

    assert (result["exit_code"], result["status"]) == (0, "complete"), result["verdict"]
    reasons = [e["reason"] for e in events(folder, "host") if e.get("state") == "lost"]
    assert reasons == ["killed by SIGKILL"]


def test_of_a_process_that_others_share_only_the_half_is_dropped_and_it_returns_there(laboratory):
    result, folder = run_faults(
        laboratory,
        [
            {"at_s": 1, "action": "kill", "agents": ["agent-01", "agent-02"], "for_s": 1},
            {"at_s": 1, "action": "kill", "agents": ["agent-03"], "for_s": 1},
            {"at_s": 4, "action": "partition", "agents": ["agent-03"], "for_s": 2},
            {"at_s": 4, "action": "reorder_messages", "agents": ["agent-04"], "for_s": 2},
            {"at_s": 6, "action": "restart", "agents": ["agent-03"]},
        ],
        per_process=2,
        duration_s=14,
    )

    assert (result["exit_code"], result["status"]) == (0, "complete"), result["verdict"]
    assert result["agents"]["lost_on_purpose"] == ["agent-01", "agent-02", "agent-03"]
    assert result["agents"]["incarnations"] == {"agent-01": 2, "agent-02": 2, "agent-03": 3}
    pids = {
        event["pid"]
        for name in ("agent-01", "agent-02")
        for number in ("", ".2")
        for line in (folder / f"agents/{name}/events{number}.jsonl").read_text().splitlines()
        if (event := json.loads(line)).get("event") == "start"
    }
    assert len(pids) == 1
    # Its records were closed, not cut.
    said = [event["event"] for event in events(folder, "agents/agent-01")]
    assert "killed" in said and said[-1] == "end"
    assert "emergency" not in said
    # The other half went on beside it: whatever tick a busy machine had it miss is told.
    ran = ticks(folder, "agent-04")
    missed = sum(row[3] for row in read_stream(folder / "agents/agent-04/ticks.jsonl").records())
    assert ran[-1] > 60
    assert len(ran) + missed == ran[-1] + 1
    assert not (folder / "agents/agent-04/ticks.2.jsonl").exists()
    assert result["faults"]["between_agents"]["lost"] > 0


@pytest.mark.nightly
def test_a_loss_that_nobody_ordered_is_judged_beside_one_that_was(laboratory):
    result, _ = run_faults(
        laboratory,
        [
            {"at_s": 1, "action": "kill", "agents": ["agent-01"], "for_s": 1},
            {"at_s": 1, "action": "kill", "agents": ["agent-02"], "for_s": 1},
        ],
        duration_s=4,
        parameters={"dies": "agent-03"},
    )

    assert result["status"] == "complete"
    assert result["agents"]["lost"] == ["agent-03"]
    assert result["agents"]["lost_on_purpose"] == ["agent-01", "agent-02"]
    assert result["exit_code"] == 4
    assert "agents.lost 1" in result["verdict"]
