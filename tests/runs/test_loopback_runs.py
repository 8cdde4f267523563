"""Whole runs on loopback agents: what they count, record and show, not how fast the machine was."""

import json
import resource

import orjson
import pyarrow.parquet as pq
import pytest
from harness.cosmos_command import LOOSE, SCENARIOS, CosmosCommand
from harness.nights import by_night

from madns_runtime.simulations.constellation.orbit.constants import GRAVITY_MODELS

pytestmark = pytest.mark.process


def run(tmp_path, scenario, *settings):
    cosmos = CosmosCommand(tmp_path)
    code, result = cosmos.run(scenario, *LOOSE, *settings)
    assert code == 0, result["verdict"]
    return result, cosmos.directory(result)


def records(path):
    lines = [orjson.loads(line) for line in path.read_bytes().splitlines()]
    return [line for line in lines if isinstance(line, list)]


def test_ten_iridium_satellites_lose_nothing_and_record_little(tmp_path):
    result, evidence = run(tmp_path, "iridium10.yaml", "time.duration_s=25")

    messages = result["messages"]
    assert messages["reliable"]["lost"] == messages["sync"]["lost"] == 0
    agents = result["simulation"]["agents"]
    assert len(agents) == 10
    assert [a["underruns"] for a in agents.values()] == [0] * 10
    assert all(a["segments"] >= 2 for a in agents.values())
    assert result["simulation"]["host"]["energy_drift_max"] < 1e-12
    recorded = sum(p.stat().st_size for p in evidence.glob("agents/*/*.jsonl"))
    # Of those that were due: one that a busy machine has missed is on record, too.
    assert recorded / result["timing"]["ticks"] <= 160


def test_recorded_states_follow_the_recorded_energy(tmp_path):
    result, evidence = run(tmp_path, "iridium10.yaml", "time.duration_s=2")

    mu = GRAVITY_MODELS["EGM-96"].mu_m3_s2
    table = pq.read_table(evidence / "tables" / "state.parquet").to_pydict()
    names = ("x_teme_m", "y_teme_m", "z_teme_m", "vx_teme_m_s", "vy_teme_m_s", "vz_teme_m_s")
    for values in zip(*(table[name] for name in names), strict=True):
        radius_m = sum(x * x for x in values[:3]) ** 0.5
        energy_j_kg = sum(v * v for v in values[3:]) / 2 - mu / radius_m
        # Specific orbital energy includes the potential: about -27.9 MJ/kg at 780 km.
        assert -mu / (2 * 7_080_000) < energy_j_kg < -mu / (2 * 7_230_000)
    assert len(table["x_teme_m"]) == result["timing"]["ticks"] - result["timing"]["missed"]


def test_agents_of_one_process_record_more_files_than_it_may_have_open_at_first(tmp_path):
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    few = 160  # 1024 on most computers, and some hundred agents
    together = ("agents.count=40", "agents.per_process=40", "agents.tick_hz=2", "time.duration_s=4")
    settings = [word for each in (*LOOSE, *together) for word in ("--set", each)]
    cosmos = CosmosCommand(tmp_path)

    ended = cosmos(
        *("run", SCENARIOS / "counter24.yaml", "--no-report", "--json", "--quiet", *settings),
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_NOFILE, (few, hard)),
    )

    result = json.loads(ended.stdout)
    assert ended.returncode == 0, result["verdict"]
    assert len(list(cosmos.directory(result).glob("agents/*/*.jsonl"))) >= 7 * 40 > few


def test_sgp4_truth_serves_any_tick_rate(tmp_path):
    settings = ("parameters.propagator={kind: sgp4}", "agents.tick_hz=33", "time.duration_s=3")
    result, _ = run(tmp_path, "iridium10.yaml", *settings)

    assert result["simulation"]["host"]["propagator"] == "sgp4"
    served = sum(a["ticks_served"] for a in result["simulation"]["agents"].values())
    assert served == result["timing"]["ticks"] - result["timing"]["missed"]


@pytest.mark.parametrize("service", by_night(["best", "reliable", "sync"], day=["reliable"]))
def test_counter_loses_nothing_in_any_class_of_service(tmp_path, service):
    settings = (
        "agents.count=8",
        "time.duration_s=3",
        f"parameters.service={service}",
        "agents.per_process=4",
    )
    result, _ = run(tmp_path, "counter24.yaml", *settings)

    agents = result["simulation"]["agents"]
    assert len(agents) == 8
    totals = {
        name: sum(a[name] for a in agents.values())
        for name in ("sent", "returned", "lost", "duplicated", "wrong_values")
    }
    ran = result["timing"]["ticks"] - result["timing"]["missed"]
    assert totals == {
        "sent": ran,
        "returned": ran,
        "lost": 0,
        "duplicated": 0,
        "wrong_values": 0,
    }


def test_stress_and_health_run_beside_the_agents(tmp_path):
    settings = (
        "agents.count=2",
        "time.duration_s=4",
        "health.stress_workers=1",
        "health.period_s=0.5",
    )
    _, evidence = run(tmp_path, "counter24.yaml", *settings)

    health = records(next(evidence.glob("machines/*/health.jsonl")))
    assert len(health) >= 3
    schema = json.loads(next(evidence.glob("machines/*/health.jsonl")).read_text().splitlines()[0])
    names = [field["name"] for field in schema["fields"]]
    assert {"cpu_percent", "temperature_c", "throttled"} & set(names)


def test_two_runs_at_once_do_not_meet(tmp_path):
    cosmos = CosmosCommand(tmp_path)
    settings = (*LOOSE, "agents.count=2", "time.duration_s=2")
    both = [cosmos.start_run("counter24.yaml", *settings) for _ in range(2)]

    results = [json.loads(one.communicate(timeout=120)[0]) for one in both]

    assert [r["exit_code"] for r in results] == [0, 0]
    assert len({r["run"].partition("-")[0] for r in results}) == 2


ECHO = """
import time
from dataclasses import dataclass
from madns_runtime.plugin.api import HOST, AgentSimulation, HostSimulation, Simulation

@dataclass(frozen=True)
class Parameters:
    pass

class Host(HostSimulation):
    is_held_up = False

    def setup(self, context):
        self.context = context

    def receive(self, agent, message):
        if message >= 15 and not self.is_held_up:  # of 20, in two seconds
            self.is_held_up = True
            time.sleep(1.5)
        self.context.send(agent, message)

class Agent(AgentSimulation):
    def setup(self, context, initial):
        self.context, self.sent, self.returned = context, 0, 0

    def step(self, tick):
        self.sent += 1
        self.context.send(HOST, tick.index)

    def receive(self, message):
        self.returned += 1

    def finish(self):
        return {"sent": self.sent, "returned": self.returned}

simulation = Simulation(name="echo", parameters=Parameters, host=":Host", agent=":Agent")
"""


def test_answers_of_a_host_that_is_held_up_at_the_end_are_waited_for(tmp_path):
    (tmp_path / "echo.py").write_text(ECHO)
    (tmp_path / "echo.yaml").write_text(
        "name: echo\nsimulation: ./echo.py:simulation\nagents: {count: 2, tick_hz: 10}\n"
        "time: {duration_s: 2}\n"
    )

    result, _ = run(tmp_path, tmp_path / "echo.yaml")

    for agent in result["simulation"]["agents"].values():
        assert agent["returned"] == agent["sent"] > 0
