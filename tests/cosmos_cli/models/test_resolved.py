"""What results of a scenario, and where each of its values came from."""

import json

import pytest
import yaml

from cosmos_cli.app import main
from cosmos_cli.models.loading import load_scenario
from cosmos_cli.models.resolved import origins, resolved_lines, resolved_values
from cosmos_cli.models.scenario_outline import check_test, read_outline

BASE = "name: base\nsimulation: counter\nvars: {rate: 5}\nagents: {count: 3, tick_hz: '${rate}'}\n"
SCENARIO = """\
extends: base.yaml
name: a
placement:
  - {agents: [agent-01], machines: pi00}
agent_parameters:
  - {agents: ["agent-0[12]"], parameters: {payload_bytes: 4}}
"""


@pytest.fixture
def scenario(tmp_path):
    (tmp_path / "base.yaml").write_text(BASE)
    (tmp_path / "a.yaml").write_text(SCENARIO)
    return load_scenario(tmp_path / "a.yaml", ["vars.rate=10", "time.duration_s=4"])


def run(*arguments):
    with pytest.raises(SystemExit) as caught:
        main(list(arguments))
    assert caught.value.code == 0


def test_each_value_tells_its_file_and_line_the_option_or_that_it_is_a_default(scenario, tmp_path):
    found = {one.path: one for one in resolved_values(scenario)}

    def origin(*path):
        return str(found[path].origin).replace(f"{tmp_path}/", "")

    assert origin("name") == "a.yaml:2"
    assert origin("agents", "count") == "base.yaml:4"
    assert origin("agents", "tick_hz") == "base.yaml:4, ${rate} of --set vars.rate"
    assert origin("time", "duration_s") == "--set time.duration_s"
    assert origin("seed") == "default"
    assert origin("placement", 0, "machines") == "a.yaml:4"
    assert found["agents", "tick_hz"].value == 10


def test_an_item_of_a_list_tells_its_variable_or_option_where_the_list_has_another(tmp_path):
    path = tmp_path / "a.yaml"
    path.write_text(
        "name: a\nsimulation: counter\nvars: {tower: upper}\n"
        "agents: {count: 3, names: ['${tower}-1', b, c]}\n"
        "test: {tags: [quick, slow]}\n"
    )
    scenario = load_scenario(path, ["agents.names[2]=spare"])
    found = {one.path: str(one.origin) for one in resolved_values(scenario)}
    again = tmp_path / "again.yaml"
    again.write_text("\n".join(resolved_lines(scenario)))

    assert found["agents", "names", 0] == f"{path}:4, ${{tower}} of {path}:3"
    assert found["agents", "names", 1] == f"{path}:4"
    assert found["agents", "names", 2] == "--set agents.names[2]"
    assert found["test", "tags"] == f"{path}:5"
    assert load_scenario(again).to_mapping() == scenario.to_mapping()


def test_parameters_of_some_agents_tell_their_rule_and_the_rest_what_holds_for_all(
    scenario, tmp_path
):
    found = origins(scenario)

    assert found["agent_parameters[0].parameters.payload_bytes"]["line"] == 6
    assert found["agent_parameters[0].parameters.service"]["default"] is True


def test_what_is_printed_is_a_scenario_that_results_in_the_same(scenario, tmp_path):
    path = tmp_path / "again.yaml"
    path.write_text("\n".join(resolved_lines(scenario)))

    assert load_scenario(path).to_mapping() == scenario.to_mapping()


def test_the_command_prints_it_in_both_forms(tmp_path, scenario, capsys):
    path = str(tmp_path / "a.yaml")

    run("validate", "--resolved", path)
    text = capsys.readouterr().out
    run("validate", "--resolved", "--json", path)
    (document,) = json.loads(capsys.readouterr().out)["scenarios"]

    assert yaml.safe_load(text)["agents"]["tick_hz"] == 5
    assert f"# {tmp_path}/base.yaml:4" in text
    assert document["origins"]["agents.count"] == {
        "file": f"{tmp_path}/base.yaml",
        "line": 4,
        "column": 17,
        "override": None,
        "default": False,
    }
    assert document["files"] == [path, f"{tmp_path}/base.yaml"]


@pytest.mark.parametrize("says_root", ["few/few.yaml", "base.yaml", "nobody"])
def test_a_root_above_is_told_so_that_what_is_printed_finds_its_files(tmp_path, says_root):
    (tmp_path / "few").mkdir()
    files = {
        "base.yaml": "simulation: counter\nagents: {count: 2}\nrequirements: [./wheels]\n",
        "few/few.yaml": "extends: ../base.yaml\nname: few\n",
        "few/own.yaml": "name: own\nsimulation: counter\nagents: {count: 2}\n",
    }
    for name, text in files.items():
        root = (
            {"few/few.yaml": "root: ..\n", "base.yaml": "root: .\n"}[name]
            if name == says_root
            else ""
        )
        (tmp_path / name).write_text(text + root)
    wheels = tmp_path / "wheels"
    wheels.mkdir()
    (wheels / "pyproject.toml").touch()
    if says_root == "nobody":
        lines = list(resolved_lines(load_scenario(tmp_path / "few/own.yaml")))
        assert not any(line.startswith("root") for line in lines)
        return
    scenario = load_scenario(tmp_path / "few/few.yaml")
    again = tmp_path / "few/again.yaml"
    again.write_text("\n".join(resolved_lines(scenario)))

    line = again.read_text().partition("\n")[0]
    assert line.startswith('root: ".."') and line.endswith(
        f"{says_root}:{3 if 'few' in says_root else 4}"
    )
    assert load_scenario(again).root == scenario.root == tmp_path


SHORTENED = """\
name: shortened
simulation: counter
vars: {n: 4, word: late, limit: 3, unused: 1}
description: "${n} agents, ${word}"
agents: {count: "${n}", tick_hz: 20}
time: {mode: lockstep, duration_s: 60}
timeline:
  - {at_s: 5, action: annotate, text: "${word} at ${n} of ${limit}"}
parameters: {payload_bytes: "${limit}"}
checks:
  - {name: few, stream: round_trips, field: packet, within: [0, "${limit}"]}
test:
  set: {vars.n: 2, time.duration_s: 10, vars.word: '$${n}', "timeline[0].at_s": "${limit}", vars.limit: 007, vars.unused: 2}
"""


@pytest.mark.parametrize("given", [(), ("vars.n=3",), ("agents.count=5",)])
def test_what_results_is_the_same_as_a_test_too_where_that_sets_variables(tmp_path, given):
    """Whose names what results does not have: `cosmos validate` refused it, and a run's own scenario.yaml."""
    path, again = tmp_path / "a.yaml", tmp_path / "again.yaml"
    path.write_text(SHORTENED)
    found = load_scenario(path, given)
    again.write_text("\n".join(resolved_lines(found)))
    outline, other = read_outline(path), read_outline(again)

    check_test(load_scenario(again), print)

    shortened = outline.load(outline.overrides(given), print)
    same = other.load(other.overrides(given if "vars" not in "".join(given) else ()), print)
    assert same.timeline.entries[0].at_s == 7
    assert shortened.to_mapping() | {"test": None} == same.to_mapping() | {"test": None}
    assert [one for one in other.settings if one.startswith("vars")] == []
    lines = {line.partition(":")[0].strip(): line for line in again.read_text().splitlines()}
    assert lines['"checks[0].within[1]"'].endswith("/a.yaml:13")
