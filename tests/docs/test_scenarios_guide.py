"""The reference of the scenario file: each of its examples is a scenario, and does what is said beside it."""

import json
import re
from pathlib import Path

import pytest
import yaml
from guides import ROOT, blocks
from harness.cosmos_command import CosmosCommand

from cosmos_cli.models.extending import FILES_MAX
from cosmos_cli.models.loading import load_scenario
from cosmos_cli.models.resolved import resolved_lines
from cosmos_cli.models.scenario import Scenario

TEXT = (ROOT / "docs/scenarios.md").read_text("utf-8")
EXAMPLES = [
    block for block in blocks(TEXT, "yaml") if re.search("^(name|extends):", block, flags=re.M)
]


def place_of(example):
    """Return where an example lies, as its first comment says; by its name if it says nothing."""
    named = re.match(r"# (\S+\.yaml)", example)
    return named[1] if named else f"{yaml.safe_load(example)['name']}.yaml"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("examples")
    for example in EXAMPLES:
        path = folder / place_of(example)
        path.parent.mkdir(exist_ok=True)
        path.write_text(example)
    return folder


@pytest.mark.parametrize("example", EXAMPLES, ids=place_of)
def test_every_example_is_a_scenario_and_so_is_what_results(folder, example, tmp_path):
    found = load_scenario(folder / place_of(example))
    again = tmp_path / "again.yaml"
    again.write_text("\n".join(resolved_lines(found)))

    assert load_scenario(again).to_mapping() == found.to_mapping()


def test_examples_result_in_what_is_said(folder):
    longer = load_scenario(folder / "longer.yaml")
    variables = load_scenario(folder / "variables.yaml").scenario
    few = load_scenario(folder / "few/few.yaml")
    some = load_scenario(folder / "some-agents.yaml")

    assert (longer.scenario.agents.tick_hz, longer.scenario.time.duration_s) == (20, 3600)
    assert variables.description == "4 boards at 20 Hz; ${x} is no variable"
    assert (few.base_directory, few.scenario.agents.count) == (folder.resolve(), 2)
    assert [rule.agents for rule in some.agent_parameters] == [
        ("agent-01",),
        ("agent-02", "agent-03", "agent-04"),
    ]
    assert f"at most {FILES_MAX} in a chain" in TEXT


@pytest.mark.process
@pytest.mark.timeout(400)
def test_examples_run(folder):
    cosmos = CosmosCommand(folder)
    shortened = ("time.mode=lockstep", "time.duration_s=20", "checks=[]")
    words = [part for setting in shortened for part in ("--set", setting)]

    done = cosmos("test", ".", *words, "--json", "--quiet", patience_s=360)

    document = json.loads(done.stdout)
    assert done.returncode == 0, done.stderr
    outcomes = {Path(each["scenario"]).name: each["outcome"] for each in document["tests"]}
    assert outcomes == {Path(place_of(example)).name: "passed" for example in EXAMPLES}


def test_every_key_of_a_scenario_has_its_row():
    table = TEXT.split("## All keys", 1)[1].split("\n###", 1)[0]
    keys = re.findall(r"^\| (\w+) \|", table, flags=re.M)

    assert [key for key in keys if key != "key"] == list(Scenario.model_fields)


def test_the_page_is_found_from_the_readme():
    assert "docs/scenarios.md" in Path(ROOT / "README.md").read_text("utf-8")
