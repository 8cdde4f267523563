"""A lockstep run with on_agent_loss: continue goes on without an agent, and with it again, and repeats to the bit."""

import pytest
from harness.acting import ACTING

from madns_runtime.config import Timeouts
from madns_runtime.timeline.entries import ScheduledEntry

pytestmark = pytest.mark.process

IMPATIENT = Timeouts(tick_s=1.5, agent_setup_s=5.0, host_setup_s=5.0, shutdown_s=5.0)
TOLD = "(lockstep_simulation.py"


def heard(run, word):
    """Return what the host's half heard under a word: simulated time and what."""
    return [(t_s, what) for t_s, who, what in run.records("host/heard.jsonl") if who == word]


def steps(run, agent, number=""):
    """Return the ticks that an agent's incarnation has run."""
    rows = run.records(f"agents/{agent}/own{number}.jsonl")
    return [what[0] for _, what in rows if len(what) > 3]


@pytest.mark.parametrize(
    ("fault", "at_s", "said"),
    [
        ("setup_raise", -0.5, "Agent.setup raised ValueError: told to"),
        ("step_raise", 0.2, "Agent.step raised ValueError: told to"),
        ("receive_raise", 0.1, "Agent.receive raised ValueError: told to"),
        ("finish_raise", 1.0, "Agent.finish raised ValueError: told to"),
    ],
)
def test_an_agent_that_raises_is_lost_at_its_tick_and_the_run_goes_on(
    start_host, fault, at_s, said
):
    run = start_host(fault=fault, restarts_max=0)
    result = run.result()

    assert (result["status"], run.process.returncode) == ("complete", 0)
    assert result["lost"] == ["agent-04"]
    assert [name for name, a in result["agents"].items() if a["state"] == "lost"] == ["agent-04"]
    assert result["agents"]["agent-04"]["reason"].startswith(said)
    [(t_s, (agent, reason))] = heard(run, "lost")
    assert (t_s, agent, reason) == (at_s, "agent-04", result["agents"]["agent-04"]["reason"])
    assert result["agents"]["agent-03"]["ticks"]["run"] == 10
    assert result["not_stopped"] == []


def test_the_losses_of_a_run_repeat_to_the_bit_however_agents_share_processes(start_host):
    runs = [start_host(fault="step_raise", restarts_max=1, per_process=n) for n in (1, 2, 6)]
    results = [run.result() for run in runs]

    assert [result["status"] for result in results] == ["complete"] * 3
    assert runs[0].hashes() == runs[1].hashes() == runs[2].hashes()
    assert all(result["lost"] == ["agent-04"] for result in results)


def test_an_agent_returns_at_the_present_time_as_its_next_incarnation(start_host):
    run = start_host(fault="step_raise", restarts_max=1)
    result = run.result()

    assert steps(run, "agent-04") == [0, 1]
    assert steps(run, "agent-04", ".2") == [4, 5, 6, 7, 8, 9]
    assert heard(run, "rejoined") == [(0.4, "agent-04")]
    agent = result["agents"]["agent-04"]
    assert (agent["state"], agent["incarnations"], agent["ticks"]["run"]) == ("stopped", 2, 8)


@pytest.mark.parametrize("fault", ["step_kill", "step_exit", "step_hang"])
def test_a_process_that_dies_or_hangs_costs_its_agents_alone(start_host, fault):
    run = start_host(fault=fault, restarts_max=0, timeouts=IMPATIENT)
    result = run.result()

    assert (result["status"], result["lost"]) == ("complete", ["agent-03", "agent-04"])
    assert [what[0] for _, what in heard(run, "lost")] == ["agent-03", "agent-04"]
    assert "in the agent's step" in result["agents"]["agent-04"]["reason"] or (
        "the agent's step has not returned" in result["agents"]["agent-04"]["reason"]
    )
    assert result["agents"]["agent-05"]["ticks"]["run"] == 10


def test_agents_whose_process_died_return_in_another(start_host):
    run = start_host(fault="step_kill", restarts_max=1)
    result = run.result()

    assert (result["status"], result["lost"]) == ("complete", ["agent-03", "agent-04"])
    assert [what for _, what in heard(run, "rejoined")] == ["agent-03", "agent-04"]
    assert steps(run, "agent-03", ".2") == [4, 5, 6, 7, 8, 9]
    # Messages are handed in in the order of agents still.
    last = [who for t_s, who, what in run.records("host/heard.jsonl") if what == ["tick", 9]]
    assert last == sorted(last)


def test_a_run_that_has_lost_everybody_ends_and_says_why(start_host):
    run = start_host(fault="step_kill", restarts_max=0, per_process=6)
    result = run.result()

    assert result["status"] == "failed"
    assert result["who"].startswith("agent-01, agent-02")
    assert "was killed by SIGKILL in the agent's step, at t = 0.2 s" in result["reason"]


def test_an_agent_whose_action_raises_is_lost_alone(start_host, tmp_path):
    (tmp_path / "acting.py").write_text(ACTING)
    entry = ScheduledEntry(action="act", agents=("agent-04",), at_s=0.3, parameters={})
    run = start_host(
        simulation=f"{tmp_path}/acting.py:simulation", timeline=(entry,), restarts_max=0
    )
    result = run.result()

    assert (result["status"], result["lost"]) == ("complete", ["agent-04"])
    assert result["agents"]["agent-04"]["reason"].startswith(
        "Agent.begin_action raised ValueError: told to"
    )


def test_an_end_on_purpose_takes_no_return_from_an_agent_that_is_lost_later(start_host, tmp_path):
    (tmp_path / "acting.py").write_text(ACTING)
    timeline = tuple(
        ScheduledEntry(action=action, agents=("agent-04",), at_s=at_s, parameters={})
        for action, at_s in (("restart", 0.1), ("act", 0.5))
    )
    run = start_host(
        simulation=f"{tmp_path}/acting.py:simulation", timeline=timeline, restarts_max=1
    )
    agent = run.result()["agents"]["agent-04"]

    assert (agent["state"], agent["incarnations"]) == ("stopped", 3)


UNMADE = """
from dataclasses import dataclass
from madns_runtime.plugin.api import AgentSimulation, Simulation
@dataclass(frozen=True)
class Parameters:
    fault: str = ""
MADE = []
class Agent(AgentSimulation):
    def __init__(self):
        MADE.append(self)
        if len(MADE) == 7:
            raise ValueError("its port is taken")
    def setup(self, context, initial):
        self.name = context.name
    def step(self, tick):
        if (self.name, tick.index) == ("agent-04", 2):
            raise ValueError("told to")
simulation = Simulation(name="unmade", parameters=Parameters, agent=":Agent")
"""


@pytest.mark.parametrize(("restarts_max", "state"), [(1, "lost"), (2, "stopped")])
def test_an_agent_that_cannot_be_made_anew_is_lost_again_and_the_run_goes_on(
    start_host, tmp_path, restarts_max, state
):
    (tmp_path / "unmade.py").write_text(UNMADE)
    run = start_host(
        simulation=f"{tmp_path}/unmade.py:simulation", restarts_max=restarts_max, per_process=6
    )
    result = run.result()

    assert (result["status"], run.process.returncode) == ("complete", 0)
    assert (result["lost"], result["not_stopped"]) == (["agent-04"], [])
    agent = result["agents"]["agent-04"]
    assert (agent["state"], agent["incarnations"]) == (state, restarts_max + 1)
    assert agent["reason"].startswith("Agent.__init__ raised ValueError: its port is taken")
    told = [event["event"] for event in run.events_of("agents/agent-04", ".2")]
    assert told == ["start", "emergency", "end"]


FORKING = """
import os
from dataclasses import dataclass
from madns_runtime.plugin.api import AgentSimulation, Simulation
@dataclass(frozen=True)
class Parameters:
    fault: str = ""
class Agent(AgentSimulation):
    def setup(self, context, initial):
        self.name = context.name
    def step(self, tick):
        if (self.name, tick.index) == ("agent-05", 5):
            raise ValueError("told to")
    def abandon(self):
        child = os.fork() if self.name == "agent-04" else 0
        if child:
            os.waitpid(child, 0)
simulation = Simulation(name="forking", parameters=Parameters, agent=":Agent")
"""


@pytest.mark.parametrize("is_killed", [True, False])
def test_a_process_that_comes_back_from_abandon_is_ended_there_and_closes_no_records(
    start_host, tmp_path, is_killed
):
    (tmp_path / "forking.py").write_text(FORKING)
    kill = ScheduledEntry(action="kill", agents=("agent-04",), at_s=0.3, parameters={})
    run = start_host(
        simulation=f"{tmp_path}/forking.py:simulation",
        timeline=(kill,) if is_killed else (),
        restarts_max=0 if is_killed else None,
        per_process=6,
    )
    reason = run.result()["reason"]

    told = "the agent's abandon forked a process that came back" if is_killed else "told to"
    assert told in reason
    for agent in ("agent-04", "agent-05", "agent-06"):
        lines = (run.folder / f"agents/{agent}/events.jsonl").read_text().splitlines()
        assert [line.startswith('{"end"') for line in lines].count(True) == 1
