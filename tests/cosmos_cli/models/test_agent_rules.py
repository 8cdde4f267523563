"""Parameters of some agents: which rule holds for whom, what results, and what is refused where."""

import pytest

from cosmos_cli.errors import InputError
from cosmos_cli.launch.place_plan import place_notes
from cosmos_cli.models.loading import load_scenario
from madns_runtime.config import RunConfig, from_mapping, to_mapping
from madns_runtime.plugin.half import RoleProgram

HEAD = "name: a\nsimulation: counter\nagents: {count: 4}\nparameters: {payload_bytes: 8, answer_hz: 5}\n"
PLUGIN = """
from dataclasses import dataclass, field
from typing import Annotated
from annotated_types import Gt
from madns_runtime.plugin.api import AgentSimulation, DeclaredStream, Field, PlaceUse, Simulation

@dataclass(frozen=True, kw_only=True)
class Engine:
    power_w: Annotated[float, Gt(0)] = 10.0
    fuel: str = "none"

@dataclass(frozen=True, kw_only=True)
class Parameters:
    mass_kg: float = 1.0
    engine: Engine = Engine()
    wheels: tuple[int, ...] = (1, 2)
    port: int = 0
    extra_stream: str = ""

def check(parameters, agents, base_directory):
    return ["engine.power_w: expected at most 100 a kg"] if parameters.engine.power_w > 100 * parameters.mass_kg else []

def streams(parameters, agents):
    names = ["drive", *([parameters.extra_stream] if parameters.extra_stream else [])]
    return [DeclaredStream(role="agent", name=name, fields=(Field("x", ""),)) for name in names]

def labels(parameters, agents, base_directory):
    return {agent: f"CAR {number}" for number, agent in enumerate(agents)}

def place_uses(parameters, agents, base_directory):
    return [PlaceUse(agent=agent, field="parameters.port", place=f"port {parameters.port}") for agent in agents]

class Agent(AgentSimulation):
    pass

simulation = Simulation(
    name="p", parameters=Parameters, agent=":Agent", check=":check", streams=":streams", labels=":labels",
    place_uses=":place_uses",
)
"""
OWN = """\
name: a
simulation: ./plug.py:simulation
agents: {count: 3, names: [agent-1, agent-2, agent-3]}
parameters: {mass_kg: 2, engine: {power_w: 20, fuel: wood}}
agent_parameters:
"""


@pytest.fixture
def load(tmp_path):
    (tmp_path / "plug.py").write_text(PLUGIN)

    def load(text, *overrides):
        path = tmp_path / "a.yaml"
        path.write_text(text)
        return load_scenario(path, overrides)

    return load


@pytest.fixture
def refusal(load, tmp_path):
    def refusal(text):
        with pytest.raises(InputError) as caught:
            load(text)
        return str(caught.value).replace(f"{tmp_path}/", "")

    return refusal


def by_agent(found):
    config = from_mapping(RunConfig, to_mapping(found.run_config("0001-a")))
    program = RoleProgram.load(config, "agent")
    return {name: program.parameters_of(name) for name in config.agents.resolved_names()}


def test_the_first_rule_that_fits_an_agent_holds_for_it(load):
    found = by_agent(
        load(
            HEAD
            + "agent_parameters:\n"
            + "  - {agents: [agent-02], parameters: {payload_bytes: 1}}\n"
            + "  - {agents: ['agent-0[23]'], parameters: {service: sync}}\n"
        )
    )

    assert [each.payload_bytes for each in found.values()] == [8, 1, 8, 8]
    assert [each.service for each in found.values()] == ["best", "best", "sync", "best"]
    assert {each.answer_hz for each in found.values()} == {5.0}


@pytest.mark.process
def test_mappings_of_a_rule_merge_and_lists_replace(load):
    found = by_agent(
        load(OWN + "  - {agents: [CAR 1], parameters: {engine: {power_w: 50}, wheels: [3]}}\n")
    )

    changed, other = found["agent-2"], found["agent-1"]
    assert (changed.mass_kg, changed.engine.power_w, changed.engine.fuel) == (2, 50, "wood")
    assert changed.wheels == (3,)
    assert (other.engine.power_w, other.wheels) == (20, (1, 2))


@pytest.mark.process
def test_what_a_rule_makes_agents_declare_and_take_is_theirs(load):
    found = load(OWN + "  - {agents: [agent-3], parameters: {port: 7, extra_stream: more}}\n")

    assert [stream.name for stream in found.streams] == ["drive"]
    (own,) = found.agent_streams
    assert (own.agents, [each.name for each in own.streams]) == (("agent-3",), ["drive", "more"])
    assert {use.agent: use.place for use in found.place_uses} == {
        "agent-1": "port 0",
        "agent-2": "port 0",
        "agent-3": "port 7",
    }


@pytest.mark.process
def test_fields_that_a_rule_makes_agents_declare_in_a_stream_of_all_may_be_judged(load, tmp_path):
    plugin = PLUGIN.replace('fields=(Field("x", ""),)', "fields=fields(parameters)").replace(
        "def streams(",
        "def fields(parameters):\n"
        "    own = (Field('y', 'm'),) if parameters.mass_kg > 2 else ()\n"
        "    return (Field('t_s', 's'), Field('x', 'km' if own else 'm'), *own)\n\ndef streams(",
    )
    (tmp_path / "plug.py").write_text(plugin)
    check = "checks: [{name: c, stream: drive, field: %s, statistic: max, below: 1%s}]\n"
    rule = "  - {agents: [agent-3], parameters: {mass_kg: 3}}\n"

    found = load(OWN + rule + check % ("y", ", stop_when_broken: true"))

    assert [[field.name for field in each.fields] for each in found.streams] == [["t_s", "x"]]
    (own,) = found.agent_streams
    assert own.agents == ("agent-3",)
    assert [field.name for field in own.streams[0].fields] == ["t_s", "x", "y"]
    assert [each.unit for each in found.expectations] == [""]
    (in_metres,) = load(OWN + rule + check % ("x", "")).expectations
    assert in_metres.unit == "m"
    told = "stream drive has x in m and in km, by who records it, so nothing acts on it in the run"
    with pytest.raises(InputError, match=told):
        load(OWN + rule + check % ("x", ", stop_when_broken: true"))


@pytest.mark.process
def test_a_column_is_a_field_of_what_some_agents_declare(load, refusal, tmp_path):
    columns = 'columns=("drive.x", "more.x"), place_uses='
    (tmp_path / "plug.py").write_text(PLUGIN.replace("place_uses=", columns, 1))
    rule = "  - {agents: [agent-3], parameters: {mass_kg: 3, extra_stream: %s}}\n"

    load(OWN + rule % "more")
    told = refusal(OWN + rule % "other")

    unknown = "columns: 'more.x' is no field of an agent's stream that streams() declares"
    assert told.count(unknown) == 1
    assert "drive.x" not in told


@pytest.mark.process
def test_streams_that_could_not_be_asked_make_no_column_a_fault(load, refusal, tmp_path):
    plugin = PLUGIN.replace("place_uses=", 'columns=("more.x",), place_uses=', 1)
    (tmp_path / "plug.py").write_text(
        plugin.replace("    names = [", "    assert not parameters.extra_stream\n    names = [", 1)
    )

    told = refusal(OWN + "  - {agents: [agent-3], parameters: {extra_stream: more}}\n")

    assert "AssertionError" in told
    assert "columns" not in told


@pytest.mark.process
def test_what_is_odd_in_a_rule_is_remarked_at_the_rule_and_of_all_once(load, tmp_path):
    (tmp_path / "plug.py").write_text(
        PLUGIN.replace(
            "def check(parameters, agents, base_directory):\n    return ",
            "def check(parameters, agents, base_directory):\n"
            "    odd = [f'remark: engine.power_w: {parameters.engine.power_w:g} is much',"
            " 'remark: mass_kg: is odd']\n    return odd if parameters.engine.power_w > 15 else ",
        )
    )

    found = load(OWN + "  - {agents: [agent-3], parameters: {engine: {power_w: 30}}}\n")

    assert [(each.line, each.path, each.text) for each in found.remarks] == [
        (4, "parameters.engine.power_w", "20 is much"),
        (4, "parameters.mass_kg", "is odd"),
        (6, "agent_parameters[0].parameters.engine.power_w", "30 is much"),
    ]


@pytest.mark.process
def test_the_cure_of_a_shared_place_is_one_that_the_simulation_has(load, refusal):
    own = "agent_parameters, where the simulation lets it differ, tells them apart"
    shared = "port 0: agent-1, agent-2, agent-3 cannot have it at once on one machine"
    text = OWN.replace("agent_parameters:\n", "")

    (note,) = place_notes(load(text))
    told = refusal(text + "time: {mode: lockstep}\n")

    assert f"{shared}; {own}; so do machines of their own\n" in note
    assert f"{shared}; {own}\n" in told


def test_the_host_sees_the_parameters_of_all_and_those_of_each_agent(load):
    found = load(
        HEAD + "agent_parameters: [{agents: [agent-03], parameters: {payload_bytes: 1}}]\n"
    )

    program = RoleProgram.load(found.run_config("0001-a"), "host")

    assert program.parameters.payload_bytes == 8
    assert [each.payload_bytes for each in program.agent_parameters.values()] == [8, 8, 1, 8]


def test_variables_hold_in_rules(load):
    found = load(
        HEAD
        + "vars: {few: 2}\nagent_parameters:\n  - agents: ['agent-0${few}']\n    parameters: {payload_bytes: '${few}'}\n"
    )

    assert by_agent(found)["agent-02"].payload_bytes == 2


@pytest.mark.process
@pytest.mark.parametrize(
    ("rules", "expected"),
    [
        ("  - {agents: [agnt-1], parameters: {}}\n", "a.yaml:6:15: agent_parameters[0].agents[0]: no agent is named agnt-1, did you mean agent-1?"),
        ("  - {agents: ['x*'], parameters: {}}\n", "a.yaml:6:15: agent_parameters[0].agents[0]: no agent is like x*"),
        ("  - {agents: [], parameters: {}}\n", "a.yaml:6:14: agent_parameters[0].agents: expected at least 1 items"),
        ("  - {parameters: {}}\n", "agent_parameters[0].agents: missing"),
        ("  - {agents: [agent-1]}\n", "agent_parameters[0].parameters: missing"),
        ("  - {agents: [agent-1], parameters: {}, port: 1}\n", "a.yaml:6:41: agent_parameters[0].port: unknown key"),
        (
            "  - {agents: ['*'], parameters: {}}\n  - {agents: [agent-1], parameters: {}}\n",
            "a.yaml:7:14: agent_parameters[1].agents: expected agents that no rule above finds, got those of agent_parameters[0]",
        ),
        ("  - {agents: [agent-1], parameters: {mass: 1}}\n", "a.yaml:6:38: agent_parameters[0].parameters.mass: unknown key, did you mean mass_kg?"),
        (
            "  - {agents: [agent-1], parameters: {engine: {power_w: -5}}}\n",
            "a.yaml:6:56: agent_parameters[0].parameters.engine.power_w: expected > 0, got -5",
        ),
        (
            "  - {agents: [agent-1], parameters: {engine: {power_w: 500}}}\n",
            "a.yaml:6:56: agent_parameters[0].parameters.engine.power_w: expected at most 100 a kg",
        ),
        ("  - {agents: [agent-1], parameters: {port: '${x}'}}\n", "a.yaml:6:44: agent_parameters[0].parameters.port: no variable is named x"),
    ],
)  # fmt: skip
def test_a_rule_that_cannot_hold_is_refused_with_its_place(refusal, rules, expected):
    assert expected in refusal(OWN + rules)


def test_what_host_and_agents_have_in_common_is_refused(refusal):
    told = refusal(HEAD + "agent_parameters: [{agents: [agent-01], parameters: {answer_hz: 2}}]\n")

    assert told.startswith(
        "a.yaml:5:54: agent_parameters[0].parameters.answer_hz: holds for all agents of counter: "
        "per agent are service, payload_bytes, read_on_tick\n"
    )


def test_what_they_have_in_common_may_be_said_again(load):
    load(
        HEAD
        + "agent_parameters: [{agents: [agent-01], parameters: {answer_hz: 5, payload_bytes: 1}}]\n"
    )


@pytest.mark.process
def test_a_fault_of_what_all_share_is_told_once(refusal):
    told = refusal(
        OWN.replace("fuel: wood", "fuel: 3") + "  - {agents: [agent-1], parameters: {port: 1}}\n"
    )

    assert told.count("fuel: expected a text") == 1


@pytest.mark.parametrize(
    "override",
    [
        "agent_parameters=[{agents: [agent-01], parameters: {payload_bytes: -1, size: 2}}]",
        "agent_parameters[0]={agents: [agent-01], parameters: {payload_bytes: -1, size: 2}}",
    ],
)
def test_a_rule_that_an_option_gives_has_its_faults_there(tmp_path, override):
    path = tmp_path / "a.yaml"
    path.write_text(HEAD)

    with pytest.raises(InputError) as caught:
        load_scenario(path, [override])

    assert [(each.override, each.path) for each in caught.value.faults] == [
        (override.partition("=")[0], "agent_parameters[0].parameters.payload_bytes"),
        (override.partition("=")[0], "agent_parameters[0].parameters.size"),
    ]


@pytest.mark.process
def test_a_check_that_changes_what_it_is_given_changes_no_parameters(tmp_path):
    plugin = PLUGIN.replace("tuple[int, ...] = (1, 2)", "list[int] = field(default_factory=list)")
    found = "    return ["
    (tmp_path / "plug.py").write_text(
        plugin.replace(found, f"    parameters.wheels.append(7)\n{found}", 1)
    )
    path = tmp_path / "a.yaml"
    path.write_text(OWN + "  - {agents: [agent-3], parameters: {mass_kg: 3}}\n")

    scenario = load_scenario(path)

    assert scenario.parameters["wheels"] == []
    assert [each.parameters["wheels"] for each in scenario.agent_parameters] == [[]]


@pytest.mark.process
def test_faults_by_the_hundred_thousand_are_counted(tmp_path):
    condition = "if parameters.engine.power_w > 100 * parameters.mass_kg else []"
    (tmp_path / "plug.py").write_text(PLUGIN.replace(condition, "* 200_000"))
    path = tmp_path / "a.yaml"
    path.write_text(OWN.removesuffix("agent_parameters:\n"))

    with pytest.raises(InputError) as told:
        load_scenario(path)

    assert told.value.omitted == 200_000 - len(told.value.faults)


@pytest.mark.process
@pytest.mark.parametrize("column", ["x", "offset_us"])
def test_label_column_that_a_stream_has_as_a_field_is_remarked_on(load, tmp_path, column):
    plugin = PLUGIN.replace('place_uses=":place_uses"', f'label_column="{column}"')
    (tmp_path / "plug.py").write_text(plugin)

    scenario = load(OWN + "  - {agents: [agent-2], parameters: {mass_kg: 3}}\n")

    stream = "drive" if column == "x" else "clock"
    assert [remark.text for remark in scenario.remarks] == [
        f"label_column: stream {stream} has a field {column!r} of its own, so that its table names no agent by its label;"
        " choose another name"
    ]
