"""Failures in whole lockstep runs: measurements change and truth does not, or truth does as the failure says."""

import json

import pytest
import yaml
from harness.cosmos_command import SCENARIOS, CosmosCommand

pytestmark = pytest.mark.process


@pytest.fixture
def cosmos(tmp_path):
    return CosmosCommand(tmp_path)


def rows(folder, agent, stream):
    lines = (folder / "agents" / agent / f"{stream}.jsonl").read_text().splitlines()
    return [row for line in lines if isinstance(row := json.loads(line), list)]


def write(folder, name, timeline):
    scenario = yaml.safe_load((SCENARIOS / "iridium10.yaml").read_text())
    scenario |= {
        "name": name,
        "agents": {"count": 2, "tick_hz": 1},
        "time": {"mode": "lockstep", "duration_s": 60},
        "timeline": timeline,
    }
    scenario["parameters"]["vehicles"] = [{"sensors": {"gnss": {"rate_hz": 1, "noise": 0}}}]
    scenario["parameters"]["satellites"] = {"walker": "86.4:2/2/0", "altitude_km": 780}
    path = folder / f"{name}.yaml"
    path.write_text(yaml.safe_dump(scenario))
    return path


def test_a_biased_receiver_measures_beside_the_truth_which_stays_as_it_was(cosmos, tmp_path):
    bias = {
        "at_s": 20,
        "action": "sensor_fault",
        "agents": ["agent-01"],
        "sensor": "gnss",
        "fault": "biased",
        "bias": [500.0],
        "for_s": 20,
    }
    runs = {}
    for name, timeline in (("undisturbed", []), ("biased", [bias])):
        code, result = cosmos.run(write(tmp_path, name, timeline))
        assert code == 0, result
        runs[name] = cosmos.directory(result)

    for agent in ("agent-01", "agent-02"):
        states = [rows(folder, agent, "state") for folder in runs.values()]
        assert states[0] == states[1]
    measured = [rows(folder, "agent-01", "gnss") for folder in runs.values()]
    moved = {round(b[1]): round(b[2] - a[2], 3) for a, b in zip(*measured, strict=True)}
    assert {t_s for t_s, by_m in moved.items() if by_m == 500.0} == set(range(20, 40))
    assert {by_m for t_s, by_m in moved.items() if not 20 <= t_s < 40} == {0.0}


def test_an_action_that_a_vehicle_cannot_carry_out_is_refused_on_record(cosmos, tmp_path):
    entry = {"at_s": 5, "action": "weaken_thruster", "agents": ["agent-02"], "factor": 0.5}

    code, result = cosmos.run(write(tmp_path, "weak", [entry]))

    events = (cosmos.directory(result) / "host" / "events.jsonl").read_text().splitlines()
    refused = [e for e in map(json.loads, events) if e.get("event") == "action_refused"]
    assert code == 0
    assert [(e["t_s"], e["reason"]) for e in refused] == [
        (5.0, "without a thruster in parameters.vehicles: agent-02")
    ]
