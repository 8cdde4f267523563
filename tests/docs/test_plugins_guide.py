"""The guide to simulations of one's own: its descriptor has every field, and records have the form that it tells."""

import dataclasses
import json
import re

import pytest
from guides import ROOT, blocks
from harness.cosmos_command import CosmosCommand

from madns_runtime.plugin.api import Demand, Flow, Simulation, Tick

GUIDE = (ROOT / "docs/plugins.md").read_text("utf-8")
SCENARIO = """
name: form
simulation: counter
agents: {count: 1, tick_hz: 10}
time: {mode: lockstep, duration_s: 1}
"""


def test_the_descriptor_has_a_line_for_each_field_of_a_simulation():
    shown = next(block for block in blocks(GUIDE, "python") if "name=" in block)

    assert set(re.findall(r"^    (\w+)=", shown, flags=re.M)) == {
        field.name for field in dataclasses.fields(Simulation)
    }


def test_it_names_all_that_a_demand_and_a_tick_hold():
    table = GUIDE.split("\n| `Demand` |")[1].split("\n\n")[0]
    tick = GUIDE.split("\nA `Tick` has ")[1].split("\n\n")[0]
    told = set(re.findall(r"`(\w+)`", table))

    assert {field.name for cls in (Demand, Flow) for field in dataclasses.fields(cls)} == told - {
        "Flow"
    }
    assert set(Tick._fields) == set(re.findall(r"`(\w+)`", tick))


@pytest.mark.process
def test_a_file_of_records_has_its_schema_first_and_its_count_last(tmp_path):
    (tmp_path / "form.yaml").write_text(SCENARIO)
    code, document = CosmosCommand(tmp_path).run(tmp_path / "form.yaml")
    assert code == 0, document["verdict"]

    for path, shape, record in (
        ("agents/agent-01/round_trips.jsonl", "array", list),
        ("host/events.jsonl", "object", dict),
    ):
        (file,) = tmp_path.glob(f"**/{document['run']}/{path}")
        first, *records, last = map(json.loads, file.read_text().splitlines())
        assert first["shape"] == shape
        assert {"name", "unit", "kind"} <= set(first["fields"][0])
        assert {type(each) for each in records} == {record}
        assert last["end"]["records"] == len(records)
