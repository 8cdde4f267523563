"""What an agent has sent right before it ends by itself arrives, in both time modes."""

import pytest
import yaml
from harness.cosmos_command import LOOSE, CosmosCommand

pytestmark = pytest.mark.process

PLUGIN = """
from dataclasses import dataclass
from madns_runtime.plugin.api import HOST, AgentSimulation, HostSimulation, Simulation
from madns_runtime.protocol.messages import Service

@dataclass(frozen=True)
class Parameters:
    where: str = "step"

class Host(HostSimulation):
    def setup(self, context):
        self.heard = []

    def receive(self, agent, message):
        self.heard.append(message)

    def agent_lost(self, agent, reason):
        self.heard.append("lost")

    def finish(self):
        return {"heard": self.heard}

class Agent(AgentSimulation):
    def setup(self, context, initial):
        self.context = context

    def step(self, tick):
        if (self.context.name, self.context.parameters.where) == ("agent-01", "step") and tick.index >= 3:
            for service in (Service.SYNC, Service.BEST, Service.RELIABLE):
                self.context.send(HOST, service.name, service)
            raise ValueError("told to")

    def finish(self):
        if self.context.parameters.where == "finish" and self.context.name == "agent-01":
            raise ValueError("told to")
        return {}

simulation = Simulation(name="last", parameters=Parameters, host=":Host", agent=":Agent")
"""


@pytest.fixture
def run(tmp_path):
    """Return a function that runs two agents for a second, the first of which raises somewhere."""

    def start(mode, where, **agents):
        (tmp_path / "last.py").write_text(PLUGIN)
        path = tmp_path / "last.yaml"
        scenario = {
            "name": "last",
            "simulation": "./last.py:simulation",
            "agents": {"count": 2, "tick_hz": 10, **agents},
            "time": {"mode": mode, "duration_s": 1},
            "on_agent_loss": "continue",
            "parameters": {"where": where},
        }
        path.write_text(yaml.safe_dump(scenario))
        return CosmosCommand(tmp_path).run(path, *LOOSE)[1]

    return start


@pytest.mark.parametrize("mode", ["realtime", "lockstep"])
@pytest.mark.parametrize("per_process", [1, 2])
def test_what_an_agent_sent_in_the_step_that_raised_is_received_before_its_loss(
    run, mode, per_process
):
    result = run(mode, "step", per_process=per_process)

    heard = result["simulation"]["host"]["heard"]
    assert sorted(heard[:-1]) == ["BEST", "RELIABLE", "SYNC"]
    assert heard[-1] == "lost"
    assert result["messages"]["reliable"]["lost"] == 0


@pytest.mark.parametrize("mode", ["realtime", "lockstep"])
def test_an_agent_that_raises_in_its_finish_is_not_started_again(run, mode):
    result = run(mode, "finish", restarts_max=3)

    assert result["agents"]["lost"] == ["agent-01"]
    assert result["simulation"]["agents"]["agent-01"] == {}
    assert result["agents"]["incarnations"] == {}


ACTING = """
from dataclasses import dataclass
from pathlib import Path
from madns_runtime.plugin.api import AgentSimulation, HostSimulation, Simulation
from madns_runtime.timeline.action import ActionKind

CALLS = Path(__file__).with_name("calls.txt")

@dataclass(frozen=True)
class Parameters:
    is_told: bool

class Host(HostSimulation):
    def setup(self, context):
        self.context = context

    def timer(self, t_s):
        if t_s >= 0.5 and self.context.parameters.is_told:
            for number in range(3):
                self.context.send("agent-01", number)
            return None
        return t_s + 0.5

class Agent(AgentSimulation):
    def note(self, call):
        with CALLS.open("a") as file:
            file.write(call + " ")

    def begin_action(self, action):
        self.receive(action)

    def receive(self, message):
        self.note("called")
        raise ValueError("told to")

    def abandon(self):
        self.note("abandon")

ACT = ActionKind(word="act", summary="Raises.", carried_out_by="agent")
simulation = Simulation(
    name="acting", parameters=Parameters, host=":Host", agent=":Agent", actions=(ACT,)
)
"""


@pytest.mark.parametrize("mode", ["realtime", "lockstep"])
@pytest.mark.parametrize("is_told", [True, False], ids=["message", "action"])
def test_an_agent_that_has_raised_is_called_for_nothing_more_that_came_with_it(
    tmp_path, mode, is_told
):
    (tmp_path / "acting.py").write_text(ACTING)
    path = tmp_path / "acting.yaml"
    act = {"at_s": 0.5, "action": "act", "agents": ["agent-01"]}
    scenario = {
        "name": "acting",
        "simulation": "./acting.py:simulation",
        "agents": {"count": 2, "tick_hz": 10},
        "time": {"mode": mode, "duration_s": 1},
        "on_agent_loss": "continue",
        "timeline": [] if is_told else [act, act],
        "parameters": {"is_told": is_told},
    }
    path.write_text(yaml.safe_dump(scenario))
    _, result = CosmosCommand(tmp_path).run(path, *LOOSE)

    assert result["agents"]["lost"] == ["agent-01"]
    assert (tmp_path / "calls.txt").read_text().split() == ["called", "abandon"]


RAISING_HOST = """
from dataclasses import dataclass
from pathlib import Path
from madns_runtime.plugin.api import HOST, AgentSimulation, HostSimulation, Simulation

CALLS = Path(__file__).with_name("calls.txt")

@dataclass(frozen=True)
class Parameters:
    pass

class Host(HostSimulation):
    def receive(self, agent, message):
        with CALLS.open("a") as file:
            file.write("called ")
        raise ValueError("told to")

class Agent(AgentSimulation):
    def setup(self, context, initial):
        self.context = context

    def step(self, tick):
        for number in range(3):
            self.context.send(HOST, number)

simulation = Simulation(name="raising", parameters=Parameters, host=":Host", agent=":Agent")
"""


@pytest.mark.parametrize("mode", ["realtime", "lockstep"])
def test_a_host_that_has_raised_is_called_for_nothing_more_that_came_with_it(tmp_path, mode):
    (tmp_path / "raising.py").write_text(RAISING_HOST)
    path = tmp_path / "raising.yaml"
    scenario = {
        "name": "raising",
        "simulation": "./raising.py:simulation",
        "agents": {"count": 1, "tick_hz": 10},
        "time": {"mode": mode, "duration_s": 1},
    }
    path.write_text(yaml.safe_dump(scenario))
    code, _ = CosmosCommand(tmp_path).run(path, *LOOSE)

    assert code == 1
    assert (tmp_path / "calls.txt").read_text().split() == ["called"]
