"""What a simulation recorded and did not declare is a remark of run.json."""

import json
from pathlib import Path

import pytest
from harness.cosmos_command import CosmosCommand
from harness.synthetic_run import ROUND_TRIPS, SyntheticRun

from cosmos_cli.collect.finish import finish_run
from cosmos_cli.errors import InputError
from cosmos_cli.evidence.remarks import (
    NOT_DECLARED,
    REMARKS_MAX,
    declared_streams,
    undeclared_remarks,
)
from cosmos_cli.evidence.run_directory import write_json
from cosmos_cli.evidence.streams import RecordFile, StreamScan
from cosmos_cli.models.declared_streams import AgentStreams
from cosmos_cli.models.loading import load_scenario
from madns_runtime.config import to_mapping
from madns_runtime.plugin.api import DeclaredStream
from madns_runtime.recording.records import TICKS, Field

TICK, RANGE = Field("tick", "", "int"), Field("range_m", "m")


def scan(stream, *fields, source="agent-01", role="agent"):
    path = Path(source) / f"{stream}.jsonl"
    file = RecordFile(
        path=path, role=role, source=source, stream=stream, incarnation=1, fields=fields
    )
    return StreamScan(file=file, size_bytes=1, sha256="")


def told(declared, *scans):
    listed = [to_mapping(stream) for stream in declared]
    return undeclared_remarks(declared_streams({"streams": listed}), scans)


def of_agents(*fields, is_open=False):
    return [DeclaredStream(role="agent", name="radar", fields=fields, is_open=is_open)]


def test_what_is_declared_and_what_the_framework_records_is_no_remark():
    assert told(of_agents(TICK, RANGE), scan("radar", TICK, RANGE)) == ()
    assert told([], scan("ticks", *TICKS.fields)) == ()
    assert told([], scan("health", TICK, role="machine")) == ()


def test_undeclared_stream_is_told_once_with_who_recorded_it():
    scans = [scan("radar", TICK, source=f"agent-0{n}") for n in (1, 2, 3)]

    assert told([], *scans) == (f"agent-01 and 2 more: stream radar is {NOT_DECLARED}",)
    host = scan("radar", TICK, source="host", role="host")
    assert told(of_agents(TICK), host) == (f"host: stream radar is {NOT_DECLARED}",)


@pytest.mark.parametrize(
    ("fields", "text"),
    [
        ((TICK, Field("range_m", "km")), "field range_m is float in km where float in m is"),
        ((TICK, Field("range_m", "m", "int")), "field range_m is int in m where float in m is"),
        ((TICK, RANGE, Field("x")), f"field x is {NOT_DECLARED}"),
        ((TICK,), "field range_m is declared and not recorded"),
    ],
)
def test_field_that_differs_is_told(fields, text):
    (remark,) = told(of_agents(TICK, RANGE), scan("radar", *fields))

    assert remark.startswith(f"agent-01: stream radar: {text}")


def test_open_stream_takes_further_fields_and_holds_those_it_declares():
    assert told(of_agents(TICK, is_open=True), scan("radar", TICK, RANGE)) == ()
    (remark,) = told(of_agents(TICK, is_open=True), scan("radar", Field("tick"), RANGE))
    assert "field tick is float where int is declared" in remark


def test_what_is_declared_for_some_agents_is_remarked_on_by_their_own_declaration():
    own = AgentStreams(agents=("agent-02",), streams=tuple(of_agents(TICK, Field("range_m", "km"))))
    plan = {
        "streams": [to_mapping(stream) for stream in of_agents(TICK, RANGE)],
        "agent_streams": [to_mapping(own)],
    }
    in_km = scan("radar", TICK, Field("range_m", "km"), source="agent-02")
    fitting = [scan("radar", TICK, RANGE), in_km]
    swapped = [scan("radar", *in_km.file.fields), scan("radar", TICK, RANGE, source="agent-02")]

    assert undeclared_remarks(declared_streams(plan), fitting) == ()
    assert undeclared_remarks(declared_streams(plan), swapped) == (
        "agent-01: stream radar: field range_m is float in km where float in m is declared",
        "agent-02: stream radar: field range_m is float in m where float in km is declared",
    )


def test_a_stream_that_other_agents_parameters_declare_is_none_of_an_agent_without_them():
    """The host's half may record of agents what their parameters declare."""
    of_host = DeclaredStream(role="host", name="echoes", fields=(TICK,))
    own = AgentStreams(agents=("agent-02",), streams=(*of_agents(TICK), of_host))
    plan = {"streams": [], "agent_streams": [to_mapping(own)]}
    scans = [
        scan("radar", TICK),
        scan("radar", TICK, source="agent-02"),
        scan("echoes", TICK, role="host", source="host"),
    ]

    assert undeclared_remarks(declared_streams(plan), scans) == (
        f"agent-01: stream radar is {NOT_DECLARED}",
    )


def test_remarks_are_bounded_and_the_rest_is_counted():
    remarks = told([], *(scan(f"s{n}", TICK) for n in range(REMARKS_MAX + 5)))

    assert len(remarks) == REMARKS_MAX + 1
    assert remarks[-1].startswith("5 more faults")


@pytest.mark.parametrize("plan", [None, {}, {"streams": 3}, {"streams": [{"role": "agent"}]}])
def test_plan_without_a_declaration_judges_nothing(plan):
    assert undeclared_remarks(declared_streams(plan), [scan("radar", TICK)]) == ()


def test_remark_stands_in_run_json_and_changes_no_verdict(tmp_path):
    made = SyntheticRun(tmp_path).write()
    declared = DeclaredStream(role="agent", name="round_trips", fields=ROUND_TRIPS.fields[:1])
    plan = json.loads(made.run.plan_json.read_bytes())
    write_json(made.run.plan_json, {**plan, "streams": [to_mapping(declared)]})

    summary = finish_run(made.run, made.result(), made.expected)

    assert summary.exit_code == 0
    last = ROUND_TRIPS.fields[-1].name
    assert any(
        text == f"agent-01 and 1 more: stream round_trips: field {last} is {NOT_DECLARED}"
        for text in summary.document["remarks"]
    )


PLUGIN = """
from dataclasses import dataclass
from madns_runtime.plugin.api import AgentSimulation, DeclaredStream, Simulation
from madns_runtime.recording.records import Field

@dataclass(frozen=True, slots=True, kw_only=True)
class Parameters:
    pass

class A(AgentSimulation):
    def setup(self, context, initial):
        context.open_stream("declared", [Field("x_m", "m")])
        context.open_stream("extra", [Field("y_m", "m")])

def streams(parameters, agents):
    assert agents == ("agent-01", "agent-02")
    return [DeclaredStream(role="agent", name="declared", fields=(Field("x_m", "m"),))]

simulation = Simulation(name="p", parameters=Parameters, agent=":A", streams=":streams")
"""


@pytest.mark.process
@pytest.mark.parametrize("mode", ["lockstep", "realtime"])
def test_run_tells_what_its_simulation_did_not_declare(tmp_path, mode):
    (tmp_path / "p.py").write_text(PLUGIN)
    (tmp_path / "a.yaml").write_text(
        "name: a\nsimulation: ./p.py:simulation\nagents: {count: 2}\n"
        f"time: {{mode: {mode}, duration_s: 0.5, rtf_tolerance: 100}}\ndeadline: {{max_miss_ratio: 1}}\n"
        "timeouts: {agents_ready_s: 60, silence_s: 30}\n"
    )

    done = CosmosCommand(tmp_path)("run", "a.yaml", "--json", "--no-report")

    remarks = json.loads(done.stdout)["remarks"]
    expected = f"agent-01 and 1 more: stream extra is {NOT_DECLARED}"
    assert [text for text in remarks if "stream" in text] == [expected]


IN_UNITS = """
from dataclasses import dataclass
from typing import Literal
from madns_runtime.plugin.api import AgentSimulation, DeclaredStream, Simulation
from madns_runtime.recording.records import Field

@dataclass(frozen=True, slots=True, kw_only=True)
class Parameters:
    unit: Literal["m", "km"] = "m"

def fields(parameters):
    return (Field("tick", "", "int"), Field("range_", parameters.unit))

class A(AgentSimulation):
    def setup(self, context, initial):
        self.context = context
        context.open_stream("path", fields(context.parameters))
    def step(self, tick):
        self.context.record("path", (tick.index, 1.0 if self.context.parameters.unit == "km" else 100.0))

def streams(parameters, agents):
    return [DeclaredStream(role="agent", name="path", fields=fields(parameters))]

simulation = Simulation(name="p", parameters=Parameters, agent=":A", streams=":streams")
"""


@pytest.mark.process
@pytest.mark.parametrize("agent", ["agent-01", "agent-02"])
@pytest.mark.parametrize("unit", [", unit: m", ""])
def test_an_agent_that_records_in_another_unit_is_judged_in_that_of_the_limit(
    tmp_path, agent, unit
):
    (tmp_path / "p.py").write_text(IN_UNITS)
    (tmp_path / "a.yaml").write_text(
        "name: a\nsimulation: ./p.py:simulation\nagents: {count: 2}\n"
        "time: {mode: lockstep, duration_s: 0.5}\n"
        f"agent_parameters: [{{agents: [{agent}], parameters: {{unit: km}}}}]\n"
        f"checks: [{{name: near, stream: path, field: range_, statistic: max, below: 500{unit}}}]\n"
    )

    done = CosmosCommand(tmp_path)("run", "a.yaml", "--json", "--no-report")

    document = json.loads(done.stdout)
    (near,) = (each for each in document["checks"] if each["name"] == "near")
    assert (near["got"], near["limit"], near["unit"]) == (1000.0, 500.0, "m")
    assert (near["passed"], near["agent"]) == (False, agent)
    assert [text for text in document["remarks"] if "stream" in text] == []


@pytest.mark.process
def test_columns_that_name_no_declared_field_are_a_fault_of_the_scenario(tmp_path):
    columns = 'columns=("declared.x_m", "declared.y_m")'
    (tmp_path / "p.py").write_text(PLUGIN.replace('streams=":', f'{columns}, streams=":'))
    path = tmp_path / "a.yaml"
    path.write_text("name: a\nsimulation: ./p.py:simulation\nagents: {count: 2}\n")

    with pytest.raises(InputError) as caught:
        load_scenario(path)

    told = str(caught.value)
    assert "'declared.y_m' is no field of an agent's stream that streams() declares" in told
    assert "declared.x_m" not in told
