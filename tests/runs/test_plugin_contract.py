"""What a plug-in may not do: the verdict names the call, whatever it returns or however it ends."""

import json
import os
import subprocess
import sys

import pytest

pytestmark = pytest.mark.process

PLUGIN = """
import os
from dataclasses import dataclass
from madns_runtime.plugin.api import HOST, AgentSimulation, HostSimulation, Simulation
from madns_runtime.protocol.messages import Service

@dataclass(frozen=True, slots=True, kw_only=True)
class Parameters:
    evil: str = ""

class H(HostSimulation):
    def setup(self, context):
        self.context, self.evil = context, context.parameters.evil

    def initial_data(self, agent):
        return {1, 2} if self.evil == "initial_data" else {}

    def receive(self, agent, message):
        self.heard_s = self.context.now_s()
        self.context.wake(self.heard_s + 0.1)
        self.context.wake(9e9)

    def timer(self, t_s):
        if self.evil == "wake" and hasattr(self, "heard_s"):
            self.woken = 0.0 <= t_s - (self.heard_s + 0.1)
            return None
        if self.evil == "timer":
            return float("nan")
        if self.evil == "best_deadline" and t_s >= 0:
            self.context.send("agent-01", 1, Service.BEST, deadline_s=t_s + 1.0)
        if self.evil in ("deadline", "best_deadline"):
            for agent in self.context.agents:
                self.context.send(agent, "late", Service.SYNC, deadline_s=t_s - 1.0)
            return t_s + 0.2
        return None

    def finish(self):
        if self.evil == "wake":
            return {"woken": self.woken}
        return None if self.evil == "host_finish" else {}

class A(AgentSimulation):
    def setup(self, context, initial):
        self.context, self.evil = context, context.parameters.evil

    def step(self, tick):
        if self.evil == "exit" and self.context.name == "agent-01" and tick.index == 3:
            os._exit(0)
        if self.evil == "text" and tick.index == 3:
            raise ValueError("\\udcff" + "x" * 100_000)
        if self.evil == "wake" and self.context.name == "agent-01" and tick.index == 3:
            self.context.send(HOST, 1)
        if self.evil == "service":
            self.context.send(HOST, 1, "SYNC")

    def finish(self):
        return {"set": {1, 2}} if self.evil == "agent_finish" else {}

simulation = Simulation(name="evil", parameters=Parameters, host=":H", agent=":A")
"""
SCENARIO = """
name: evil
simulation: ./evil.py:simulation
agents: {count: 2, tick_hz: 20}
time: {duration_s: 1, rtf_tolerance: 1}
deadline: {max_miss_ratio: 1}
"""


FAULTS = [
    ("initial_data", "host", "H.initial_data returned a set: expected a mapping"),
    ("timer", "host", "H.timer returned nan: expected a simulated time"),
    ("host_finish", "host", "H.finish returned None: expected a mapping; is a return"),
    ("agent_finish", "agent-0", "A.finish returned a summary without a JSON form"),
    ("text", "agent-0", "A.step raised ValueError: \\udcffxxx"),
    ("service", "agent-0", "expected a Service, such as Service.RELIABLE, got 'SYNC'"),
    ("best_deadline", "host", "deadline_s goes with Service.SYNC, not with <Service.BEST"),
]


@pytest.mark.parametrize("mode", ["realtime", "lockstep"])
@pytest.mark.parametrize(("evil", "who", "expected"), FAULTS, ids=[fault[0] for fault in FAULTS])
def test_the_verdict_names_the_call_in_both_modes(tmp_path, evil, who, expected, mode):
    result = run(tmp_path, evil, f"time.mode={mode}")

    assert result["exit_code"] == 1
    assert result["who"].startswith(who)
    assert expected in result["reason"]
    assert len(result["reason"]) < 3000


def test_an_agent_that_ends_its_process_is_named(tmp_path):
    result = run(tmp_path, "exit")

    assert (result["exit_code"], result["who"]) == (1, "agent-01")
    assert "its process ended by itself, exit code 0" in result["reason"]


def test_broken_sync_deadline_breaks_its_check(tmp_path):
    result = run(tmp_path, "deadline")

    broken = [check["name"] for check in result["checks"] if not check["passed"]]
    assert broken == ["messages.sync.deadlines_broken"]
    assert result["messages"]["sync"]["deadlines_broken"] >= 8
    assert result["exit_code"] == 4


@pytest.mark.parametrize("mode", ["realtime", "lockstep"])
def test_a_half_that_hears_something_can_ask_for_its_timer(tmp_path, mode):
    result = run(tmp_path, "wake", f"time.mode={mode}")

    assert result["simulation"]["host"] == {"woken": True}
    assert result["exit_code"] == 0


def run(tmp_path, evil, *settings):
    (tmp_path / "evil.py").write_text(PLUGIN, "utf-8")
    (tmp_path / "evil.yaml").write_text(SCENARIO, "utf-8")
    command = [sys.executable, "-m", "cosmos_cli.app", "run", str(tmp_path / "evil.yaml")]
    command += ["--json", "--quiet", "--no-report", "--runs", str(tmp_path / "runs")]
    for setting in (f"parameters.evil={evil}", *settings):
        command += ["--set", setting]
    done = subprocess.run(
        command,
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
        env={**os.environ, "COSMOS_STATE_DIR": str(tmp_path / "state")},
    )
    result = json.loads(done.stdout)
    assert done.returncode == result["exit_code"], done.stderr
    return result
