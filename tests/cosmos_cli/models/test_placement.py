import json

import pytest

from cosmos_cli.errors import InputError
from cosmos_cli.models.agent_labels import AgentLabels
from cosmos_cli.models.loading import load_scenario
from cosmos_cli.models.placement import PlacementRule, claim_agents

HEAD = "name: s\nsimulation: counter\nagents: {count: 4, names: [a, b, c1, c2]}\n"


@pytest.fixture
def read(tmp_path):
    def read_text(text, *overrides):
        path = tmp_path / "s.yaml"
        path.write_text(HEAD + text)
        return load_scenario(path, overrides)

    return read_text


def faults_of(read, text, *overrides):
    with pytest.raises(InputError) as caught:
        read(text, *overrides)
    return [(fault.line, fault.column, fault.path, fault.text) for fault in caught.value.faults]


def test_rules_and_requirements_are_read_and_written_again(read):
    scenario_file = read(
        "requirements: [numpy, 'pyserial[cp2110]>=3.5,<4; python_version > \"3.10\"', x @ file:///x.whl]\n"
        "placement:\n"
        "  - {agents: ['c*'], machines: 'tower:!chiefs', per_machine: 2}\n"
        "  - {count: 1, devices: [sense_hat]}\n"
    )

    assert scenario_file.scenario.placement == (
        PlacementRule(agents=("c*",), machines="tower:!chiefs", per_machine=2),
        PlacementRule(count=1, devices=("sense_hat",)),
    )
    mapping = scenario_file.to_mapping()
    assert json.loads(json.dumps(mapping)) == mapping
    assert mapping["placement"][1]["devices"] == ["sense_hat"]
    assert mapping["requirements"][0] == "numpy"


def test_scenario_without_rules_has_none(read):
    scenario = read("").scenario

    assert (scenario.placement, scenario.requirements) == ((), ())


@pytest.mark.parametrize(
    ("rules", "expected"),
    [
        ("[{agents: [d]}]", [(4, 23, "placement[0].agents[0]", "no agent is named d; there are a, b, c1, c2")]),
        ("[{agents: []}]", [(4, 22, "placement[0].agents", "expected at least 1 items, got a list")]),
        ("[{agents: ['d*']}]", [(4, 23, "placement[0].agents[0]", "no agent is like d*; there are a, b, c1, c2")]),
        ("[{agents: [a, a]}]",
         [(4, 26, "placement[0].agents[1]", "expected each agent once, a is taken above in this rule")]),
        ("[{agents: ['c*']}, {agents: [c2, b]}]",
         [(4, 41, "placement[1].agents[0]", "expected each agent once, c2 is taken by placement[0]")]),
        ("[{count: 5}]",
         [(4, 21, "placement[0].count", "expected <= 4, the agents that no earlier rule takes, got 5")]),
        ("[{count: 1, agents: [a]}]",
         [(4, 21, "placement[0].count", "expected agents or count, got both: agents names them all")]),
        ("[{machines: x}, {machines: y}]",
         [(4, 28, "placement[1]", "placement[0] takes all agents that are left: none is left here")]),
        ("[{machin: x}]", [(4, 14, "placement[0].machin", "unknown key, did you mean machines?")]),
        ("[{count: 0}]", [(4, 21, "placement[0].count", "expected >= 1, got 0")]),
        ("{machines: x}", [(4, 12, "placement", "expected a list, got a mapping")]),
    ],
)  # fmt: skip
def test_rule_that_cannot_be_meant_is_told_with_its_place(read, rules, expected):
    assert faults_of(read, f"placement: {rules}\n") == expected


def test_requirement_that_is_an_option_or_a_path_from_the_root_is_refused(read):
    faults = faults_of(read, "requirements: [numpy, --pre, /x/y, 'a b', '']\n")

    assert [column for _, column, *_ in faults] == [23, 30, 36, 43]
    assert all("expected a Python requirement" in text for *_, text in faults)


def test_rest_may_be_empty_so_that_a_scenario_can_be_tried_with_fewer_agents(read):
    scenario_file = read(
        "placement: [{count: 1}, {machines: x}]\n", "agents.count=1", "agents.names=[a]"
    )

    assert scenario_file.scenario.agents.count == 1


def test_later_fault_is_found_in_the_file(read):
    scenario_file = read("placement:\n  - {count: 1,\n     machines: x}\n")

    written = scenario_file.fault(("placement", 0, "machines"), "no such")
    missing = scenario_file.fault(("placement", 0, "devices"), "no such")

    assert (written.line, written.column, written.source) == (6, 16, "     machines: x}")
    assert (missing.line, missing.column) == (5, 5)


def test_later_fault_of_an_option_names_the_option(read):
    scenario_file = read("placement: [{count: 1, machines: x}]\n", "placement[0].machines=y")

    fault = scenario_file.fault(("placement", 0, "machines"), "no such")

    assert fault.override == "placement[0].machines"


def test_claims_leave_what_no_rule_takes():
    claims = claim_agents(["a", "b", "c"], [PlacementRule(agents=("b",)), PlacementRule(count=1)])

    assert (claims.taken, claims.left, claims.faults) == ((("b",), ("a",)), ("c",), ())


def test_rules_find_agents_by_their_second_names():
    labels = AgentLabels(column="satellite", names={"a": "IRIDIUM 7", "b": "IRIDIUM 8", "c": "X"})
    rules = [PlacementRule(agents=("X",)), PlacementRule(agents=("IRIDIUM*",))]

    claims = claim_agents(["a", "b", "c", "d"], rules, labels)

    assert (claims.taken, claims.left, claims.faults) == ((("c",), ("a", "b")), ("d",), ())
    (fault,) = claim_agents(["a", "b", "c"], [PlacementRule(agents=("IRIDIUM 77",))], labels).faults
    assert fault[1] == "no agent is named IRIDIUM 77, did you mean IRIDIUM 7?"


def test_a_second_name_with_brackets_is_found_by_itself_and_as_a_glob():
    names = {"a": "IRIDIUM 7 [-]", "b": "IRIDIUM 8 [-]", "c": "IRIDIUM 8 -"}
    labels = AgentLabels(column="satellite", names=names)

    assert labels.like("IRIDIUM 7 [-]", ["a", "b", "c"]) == ["a"]
    assert labels.like("IRIDIUM 8 [-]", ["a", "b", "c"]) == ["b", "c"]
    assert labels.labelled(["IRIDIUM 7 [-]"]) == ["a"]


CONSTELLATION = """
name: a
simulation: constellation
agents: {count: 2}
parameters: {satellites: {walker: "56:2/1/0", altitude_km: 780}}
placement: [{agents: ["GLOB"]}]
"""


@pytest.fixture
def load_placed(tmp_path):
    """Load a constellation whose placement names an agent, with changes of its text."""

    def load(glob, old="", new=""):
        path = tmp_path / "a.yaml"
        path.write_text(CONSTELLATION.replace("GLOB", glob).replace(old, new))
        return load_scenario(path)

    return load


def test_simulation_tells_placement_what_it_calls_its_agents(load_placed):
    labels = load_placed("*").labels
    first = labels.names["agent-01"]

    assert (labels.column, len(labels.names)) == ("satellite", 2)
    assert first != "agent-01"
    assert load_placed(first).scenario.placement[0].agents == (first,)
    with pytest.raises(InputError, match="no agent is named nobody"):
        load_placed("nobody")


def test_second_names_that_a_fault_elsewhere_hides_are_no_faults_of_their_own(load_placed):
    with pytest.raises(InputError) as caught:
        load_placed("SAT*", "780", "high")

    (fault,) = caught.value.faults
    assert fault.path == "parameters.satellites.altitude_km"
