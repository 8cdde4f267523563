"""Conditions of a run in lockstep: what is met when, and what follows."""

from pathlib import Path

import pytest

from madns_runtime.conditions.condition import Condition, ValueBounds
from madns_runtime.timeline.entries import ScheduledEntry

pytestmark = pytest.mark.process

HARNESS = Path(__file__).resolve().parents[1] / "harness"

FINISHING = """
from dataclasses import dataclass
from madns_runtime.plugin.api import AgentSimulation, HostSimulation, Simulation
from madns_runtime.recording.records import Field
@dataclass(frozen=True)
class Parameters:
    fault: str = ""
class Half:
    def finish(self):
        self.context.record(self.stream, (self.context.now_s(), 1.0))
        return {}
class Host(Half, HostSimulation):
    stream = "of_host"
    def setup(self, context):
        self.context = context
        context.open_stream(self.stream, (Field("t_s", "s"), Field("value")))
class Agent(Half, AgentSimulation):
    stream = "of_agents"
    def setup(self, context, initial):
        self.context = context
        context.open_stream(self.stream, (Field("t_s", "s"), Field("value")))
simulation = Simulation(name="finishing", parameters=Parameters, host=":Host", agent=":Agent")
"""


def test_what_is_met_in_finish_is_noted_and_nothing_follows_as_in_real_time(start_host, tmp_path):
    (tmp_path / "finishing.py").write_text(FINISHING)
    of_agent, of_host = (
        Condition(
            number=number,
            name=f"timeline[{number}]",
            stream=stream,
            field="value",
            bounds=ValueBounds.above(0.0),
            agents=agents,
            is_of_host=agents == ("host",),
            ends_run=True,
        )
        for number, (stream, agents) in enumerate(
            [("of_agents", ("agent-04",)), ("of_host", ("host",))]
        )
    )
    entries = tuple(
        ScheduledEntry(action="annotate", condition=number, parameters={"text": "late"})
        for number in (0, 1)
    )
    run = start_host(
        simulation=f"{tmp_path}/finishing.py:simulation",
        timeline=entries,
        conditions=(of_agent, of_host),
    )
    result = run.result()

    assert (result["status"], result["agents"]["agent-04"]["messages"]["too_late"]) == (
        "complete",
        0,
    )
    events = [each for each in run.events_of("host") if each["event"] != "state"]
    told = [(each["event"], each.get("condition"), each.get("agent")) for each in events]
    assert told == [
        ("condition_met", "timeline[0]", "agent-04"),
        ("condition_met", "timeline[1]", "host"),
        ("end", None, None),
    ]


def test_what_an_agent_records_of_a_fault_is_heard_of(start_host):
    hangs = Condition(
        number=0,
        name="hangs",
        stream="events",
        field="event",
        bounds=ValueBounds.equals("hang_begins"),
        agents=("agent-04",),
    )
    run = start_host(
        simulation=f"{HARNESS}/fault_simulation.py:simulation",
        timeline=(
            ScheduledEntry(action="hang", agents=("agent-04",), at_s=0.3, for_s=0.2),
            ScheduledEntry(action="annotate", condition=0, parameters={"text": "it hangs"}),
        ),
        conditions=(hangs,),
    )
    run.result()

    told = {each["event"]: each["t_s"] for each in run.events_of("host")}
    assert told["condition_met"] == pytest.approx(0.3)
