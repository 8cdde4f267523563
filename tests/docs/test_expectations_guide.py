"""The guide to expectations: its scenarios are right, its tables tell all keys and statistics, and its runs come out as it says."""

import json
import re
from typing import get_args

import pytest
from docs.guides import ROOT, blocks
from harness.cosmos_command import CosmosCommand

from cosmos_cli.models.check_rules import CheckRule, Statistic
from cosmos_cli.models.loading import check_scenario
from cosmos_cli.models.value_rules import field_names
from madns_runtime.plain_values import written_name

GUIDE = (ROOT / "docs" / "expectations.md").read_text("utf-8")
EXAMPLES = blocks(GUIDE, "yaml")


def test_every_key_and_every_statistic_has_a_row():
    section = GUIDE.split("## What comes of them")[0]
    told = set(re.findall(r"`(\w+)", "\n".join(re.findall(r"^\|([^|]*)\|", section, flags=re.M))))

    assert {written_name(CheckRule, name) for name in field_names(CheckRule)} | set(
        get_args(Statistic)
    ) <= told


@pytest.mark.parametrize("text", EXAMPLES)
def test_each_example_is_right(text, tmp_path):
    assert check_scenario(text, tmp_path / "scenario.yaml").expectations


@pytest.mark.process
def test_examples_end_as_the_guide_says_and_the_run_is_judged_again(tmp_path):
    cosmos = CosmosCommand(tmp_path)
    codes = []
    for text in EXAMPLES:
        name = re.search(r"^name: (\w+)", text, flags=re.M)[1]
        path = tmp_path / f"{name}.yaml"
        path.write_text(text, "utf-8")
        code, document = cosmos.run(path)
        codes.append(code)
    again = cosmos("judge", "1", "--json")
    other = cosmos("judge", "1", "-s", path, "--json")

    assert codes == [0, 4]
    assert document["status"] == "broken"
    assert (again.returncode, other.returncode) == (0, 4)
    assert [each["name"] for each in json.loads(other.stdout)["checks"]] == ["few"]
