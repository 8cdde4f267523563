"""The timelines of the guide hold in scenarios that have what they name, and its tables name every action."""

import re
import shutil

import pytest
import yaml
from guides import ROOT, blocks
from harness.cosmos_command import CosmosCommand

from cosmos_cli.models.loading import load_scenario
from madns_runtime.simulations.constellation.actions import ACTIONS
from madns_runtime.timeline.kinds import FRAMEWORK_ACTIONS

GUIDE = (ROOT / "docs" / "timeline.md").read_text("utf-8")
FAULTS = (ROOT / "docs" / "faults.md").read_text("utf-8")
EXAMPLES = re.findall(r"^```yaml\n(.*?)^```$", GUIDE, flags=re.MULTILINE | re.DOTALL)
COUNTER = {
    "name": "guide",
    "simulation": "counter",
    "agents": {"count": 2},
    "time": {"duration_s": 500},
    "hardware": {
        "devices": [
            {"name": "gps", "kind": "synthetic", "parameters": {"channels": [{"name": "u"}]}}
        ]
    },
}
EQUIPMENT = {
    "propagator": {"kind": "scipy"},
    "vehicles": [
        {"thruster": {"isp_s": 220, "propellant_kg": 2}, "sensors": {"gnss": {"rate_hz": 1}}}
    ],
}
"""What the second example's failures need."""


@pytest.mark.process
@pytest.mark.parametrize("number", range(2))
def test_an_example_of_the_guide_is_accepted(tmp_path, number):
    scenario = COUNTER
    if number:
        scenario = yaml.safe_load((ROOT / "scenarios" / "groundpass.yaml").read_text())
        scenario["parameters"] |= EQUIPMENT
        for name in ("data", "flight"):
            shutil.copytree(ROOT / "scenarios" / name, tmp_path / name)
    path = tmp_path / "guide.yaml"
    path.write_text(yaml.safe_dump(scenario | yaml.safe_load(EXAMPLES[number])))

    assert load_scenario(path).timeline.entries


@pytest.mark.process
def test_the_example_of_faults_survives_them_as_its_name_says(tmp_path):
    (example,) = blocks(FAULTS, "yaml")
    path = tmp_path / "survivors.yaml"
    path.write_text(example)

    code, document = CosmosCommand(tmp_path).run(path)

    assert (code, document["agents"]["lost_on_purpose"]) == (0, ["agent-02"]), document["verdict"]


def test_the_guide_has_every_action_of_the_framework_and_of_a_constellation():
    assert len(EXAMPLES) == 2
    rows = set(re.findall(r"^\| `(\w+)` \|", GUIDE + FAULTS, flags=re.MULTILINE))

    assert {kind.word for kind in (*FRAMEWORK_ACTIONS, *ACTIONS)} - rows == set()
