import json
from pathlib import Path

import jsonschema
import pytest
import yaml

from cosmos_cli.models.document import read_document
from cosmos_cli.models.schema import schema_text
from cosmos_cli.models.yaml_source import read_source
from madns_runtime.plugin.registry import is_shipped, registered_names, resolve

ROOT = Path(__file__).parents[3]
KEPT = ROOT / "scenarios/scenario.schema.json"


@pytest.fixture(scope="module")
def validator():
    schema = json.loads(KEPT.read_text())
    jsonschema.Draft202012Validator.check_schema(schema)
    return jsonschema.Draft202012Validator(schema)


def test_kept_schema_is_current():
    current = schema_text(
        {name: resolve(name, ROOT) for name in filter(is_shipped, registered_names())}
    )

    assert KEPT.read_text() == current, (
        "write it with: cosmos schema -o scenarios/scenario.schema.json"
    )


def timeline(entry, simulation="counter"):
    scenario = {"name": "a", "simulation": simulation, "agents": {"count": 2}, "timeline": [entry]}
    if simulation == "constellation":
        scenario["parameters"] = {"satellites": {"elements": "data/ring93.csv"}}
    return scenario


@pytest.mark.parametrize(
    "entry",
    [
        {"at_s": 1, "action": "annotate", "text": "now"},
        {"every_s": 5, "to_s": "${end}", "action": "kill", "agents": ["agent-01"], "for_s": 2},
        {"when": {"stream": "ticks", "field": "tick", "above": 3}, "action": "stop"},
        {"at_s": 1, "action": "${what}", "agents": ["*"]},
    ],
    ids=str,
)
def test_schema_takes_entries_of_a_timeline(validator, entry):
    validator.validate(timeline(entry))


@pytest.mark.parametrize(
    "entry",
    [
        {"at_s": 1, "action": "anotate", "text": "now"},
        {"at_s": -1, "action": "stop"},
        {"at_s": 1, "action": "annotate"},
        {"at_s": 1, "action": "kill"},
        {"at_s": 1, "action": "stress", "agents": ["*"], "workers": 1},
        {"at_s": 1, "action": "stress", "agents": ["*"], "workers": 0, "for_s": 1},
        {"at_s": 1, "action": "fail_wheels", "agents": ["*"]},
        {"when": {"field": "tick", "above": 3}, "action": "stop"},
    ],
    ids=str,
)
def test_schema_refuses_entries_that_validate_refuses(validator, entry):
    with pytest.raises(jsonschema.ValidationError):
        validator.validate(timeline(entry))


def test_schema_knows_the_actions_of_the_simulation_that_is_named(validator):
    validator.validate(
        timeline({"at_s": 1, "action": "fail_wheels", "agents": ["*"]}, "constellation")
    )
    with pytest.raises(jsonschema.ValidationError):
        validator.validate(
            timeline({"at_s": 1, "action": "weaken_thruster", "agents": ["*"]}, "constellation")
        )
    # Any word may be one of a simulation that nobody registered.
    validator.validate(timeline({"at_s": 1, "action": "honk", "agents": ["*"]}, "./cars.py:cars"))


SHIPPED = [
    path for path in (ROOT / "scenarios").glob("**/*.yaml") if path.parent.name != "baselines"
]


@pytest.mark.parametrize("path", sorted(SHIPPED), ids=lambda p: p.name)
def test_shipped_scenarios_fulfil_the_schema(validator, path):
    validator.validate(read_document(read_source(path)).value)


@pytest.mark.parametrize(
    "change",
    [
        {"sed": 1},
        {"agents": {"count": 0}},
        {"agents": {"count": 1, "hz": 3}},
        {"name": "Big"},
        {"parameters": {"servce": "best"}},
        {"parameters": {"service": "bets"}},
        {"simulation": "conter"},
        {"simulation": "constellation", "parameters": {}},
    ],
    ids=str,
)
def test_schema_refuses_what_the_models_refuse(validator, change):
    scenario = {"name": "a", "simulation": "counter", "agents": {"count": 1}}

    assert validator.is_valid(scenario)
    assert not validator.is_valid(scenario | change)


def test_schema_accepts_a_file_beside_the_scenario_with_any_parameters(validator):
    text = "{name: a, simulation: './p.py:simulation', agents: {count: 1}, parameters: {x: [1]}}"

    assert validator.is_valid(yaml.safe_load(text))


def test_descriptions_reach_the_schema(validator):
    agents = validator.schema["$defs"]["Agents"]["properties"]

    assert agents["tick_hz"]["description"] == "Rate of every agent's loop, Hz."
    assert validator.schema["properties"]["seed"]["description"]
    assert validator.schema["additionalProperties"] is False


@pytest.mark.parametrize(
    "value",
    [
        {"extends": "base.yaml"},
        {"extends": "base.yaml", "root": "..", "agents": {"tick_hz": 5}},
        {"extends": "base.yaml", "simulation": "constellation", "parameters": {"flight": None}},
        {
            "name": "a-${n}",
            "simulation": "counter",
            "vars": {"n": 2},
            "seed": "${n}",
            "time": {"mode": "${mode}"},
            "agents": {"count": "${n}", "names": "${names}"},
            "parameters": {"read_on_tick": "${x}", "service": "${service}"},
            "agent_parameters": [{"agents": ["*"], "parameters": {"payload_bytes": 3}}],
        },
    ],
)
def test_extending_scenarios_and_variables_fulfil_the_schema(validator, value):
    validator.validate(value)


@pytest.mark.parametrize(
    "change",
    [
        {"root": "../../.."},
        {"vars": {"x": [1]}},
        {"seed": "5"},
        {"agent_parameters": [{"agents": ["*"], "parameters": {"payload_byte": 3}}]},
        {"agent_parameters": [{"parameters": {}}]},
    ],
)
def test_what_cannot_be_authored_does_not_fulfil_the_schema(validator, change):
    value = {"name": "a", "simulation": "counter", "agents": {"count": 1}} | change

    assert not validator.is_valid(value)
