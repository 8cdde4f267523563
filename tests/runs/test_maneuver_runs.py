"""A whole run with maneuvers on loopback agents: what is counted and recorded, not how fast the machine was."""

import math

import orjson
import pytest
from harness.cosmos_command import LOOSE, CosmosCommand

pytestmark = pytest.mark.process

SCENARIO = """
name: burns
simulation: constellation
agents: {count: 3, tick_hz: 10}
time: {mode: MODE, duration_s: 8.5}
deadline: {max_miss_ratio: 1}
parameters:
  satellites: {walker: "86.4:66/6/2", altitude_km: 780}
  vehicles:
    - agents: [agent-02]
      mass_kg: 500
      thruster: {isp_s: 220, propellant_kg: 100, thrust_n: 500, magnitude_error: 0.01}
    - {thruster: {isp_s: 220, propellant_kg: 1, direction_error_deg: 1}}
  crosslinks: {range_km_max: 20000}
  flight: {software: "burn.py:Burn", input: truth}
"""
FLIGHT = '''
from madns_runtime.simulations.constellation.flight.api import FlightSoftware


class Burn(FlightSoftware):
    """Burns at 6.3 s, commanded at 2 s, and tells its neighbours."""

    def setup(self, context):
        self.context, self.told, self.heard = context, [], []
        self.is_new = True

    def step(self, t_s, readings):
        # In real time a busy machine may miss the tick at 2 s.
        if self.is_new and t_s > 2.0 - 1e-6:
            self.is_new = False
            self.context.delta_v((0.0, 2.0, 0.0), at_s=6.3)
            self.context.broadcast("burning")

    def receive(self, message):
        self.heard.append(message.sender)

    def command_result(self, result):
        self.told.append(f"{result.status} {result.at_s:g} {result.revision}")

    def finish(self):
        return {"told": self.told, "heard": sorted(self.heard)}
'''


def run(tmp_path, mode, *settings):
    (tmp_path / "burns.yaml").write_text(SCENARIO.replace("MODE", mode))
    (tmp_path / "burn.py").write_text(FLIGHT)
    cosmos = CosmosCommand(tmp_path)
    code, result = cosmos.run(tmp_path / "burns.yaml", *LOOSE, *settings)
    assert code == 0, result["verdict"]
    return result, tmp_path / "runs" / result["run"]


def rows(path):
    return [
        line for line in map(orjson.loads, path.read_bytes().splitlines()) if isinstance(line, list)
    ]


def speeds(evidence, agent):
    path = evidence / "agents" / agent / "state.jsonl"
    return {row[0]: math.hypot(*row[4:]) for row in rows(path)}


def phase_s(evidence, agent):
    lines = (evidence / "agents" / agent / "events.jsonl").read_bytes().splitlines()
    return next(e["phase_s"] for e in map(orjson.loads, lines) if e.get("event") == "phase")


def test_every_vehicle_burns_when_it_was_told_to(tmp_path):
    result, evidence = run(tmp_path, "realtime")

    maneuvers = result["simulation"]["host"]["maneuvers"]
    assert (maneuvers["commanded"], maneuvers["executed"], maneuvers["refused"]) == (3, 3, 0)
    assert maneuvers["inequality_broken"] == 0
    assert result["messages"]["sync"]["lost"] == 0
    records = rows(evidence / "host" / "maneuvers.jsonl")
    assert [(row[1], row[4], row[7]) for row in sorted(records, key=lambda row: row[1])] == [
        (agent, "accepted", 6.3) for agent in ("agent-01", "agent-02", "agent-03")
    ]
    for agent, summary in result["simulation"]["agents"].items():
        assert summary["underruns"] == 0
        assert summary["flight"]["told"] == ["accepted 6.3 1", "executed 6.3 1"]
        # By its own time, which lies a phase behind.
        (change,) = rows(evidence / "agents" / agent / "truth_changes.jsonl")
        assert change[:2] == [1, pytest.approx(5.3 if agent == "agent-02" else 6.3, abs=0.01)]
        assert change[3] == pytest.approx(
            change[1] + phase_s(evidence, agent) - change[2], abs=1e-6
        )
        assert change[3] > 0.0
        before_and_after = speeds(evidence, agent)
        # agent-02 burns for 2 s around it, the others at once; its tick at 6.3 s may be a missed one.
        after = next(v for k, v in sorted(before_and_after.items()) if k >= 75)
        before = next(v for k, v in sorted(before_and_after.items(), reverse=True) if k <= 52)
        assert after - before == pytest.approx(2.0, abs=0.1)
    links = result["simulation"]["host"]["links"]
    heard = [summary["flight"]["heard"] for summary in result["simulation"]["agents"].values()]
    assert links["delivered"] == sum(map(len, heard))


def test_a_lockstep_run_repeats_to_the_bit_whatever_the_processes(tmp_path):
    evidence = [run(tmp_path, "lockstep", f"agents.per_process={count}")[1] for count in (1, 3)]

    for name in ("host/maneuvers.jsonl", "host/links.jsonl", "agents/agent-02/state.jsonl"):
        first, second = (rows(folder / name) for folder in evidence)
        assert first == second != []
