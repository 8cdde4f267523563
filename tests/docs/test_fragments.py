"""The parts of scenarios that guides show without the rest: each is right where it is laid over a constellation."""

import re
import shutil
import textwrap

import pytest
import yaml
from guides import ROOT, blocks

from cosmos_cli import app

REST = {
    "name": "fragment",
    "simulation": "constellation",
    "agents": {"count": 10, "tick_hz": 10},
    "time": {"mode": "lockstep", "duration_s": 500},
    "parameters": {"satellites": {"elements": "data/iridium10.tle"}},
}
FLIGHT = """
from madns_runtime.simulations.constellation.flight.api import FlightSoftware


class Guidance(FlightSoftware):
    pass
"""
NUMBER = {"name": "line", "elements": [{"shape": "constant"}]}
VECTOR = {"name": "moment", "unit": "A m^2", "components": ["x", "y", "z"], "elements": [{}, {}, {}]}  # fmt: skip
DEVICES = [
    {"name": name, "kind": "synthetic", "parameters": {"channels": [channel]}}
    for name, channel in (("valve", NUMBER), ("coil", VECTOR))
]
COMMANDS_OF_DEVICES = {"hardware": {"devices": DEVICES}}


def shown(guide, containing):
    """Return the one piece of YAML of a guide, fenced or indented, that contains some words."""
    text = (ROOT / "docs" / guide).read_text("utf-8")
    indented = re.findall(
        r"(?:^    .*\n)+", re.sub(r"^```.*?^```", "", text, flags=re.M | re.S), re.M
    )
    (found,) = (one for one in (*blocks(text, "yaml"), *indented) if containing in one)
    return yaml.safe_load(textwrap.dedent(found))


def laid_over(rest, *parts):
    result = dict(rest)
    for part in parts:
        for key, value in part.items():
            old = result.get(key)
            result[key] = laid_over(old, value) if isinstance(old, dict) else value
    return result


@pytest.mark.process
@pytest.mark.parametrize(
    ("guide", "containing", "others"),
    [
        ("links.md", "crosslinks:", {}),
        ("lockstep.md", "86400", {}),
        ("maneuvers.md", "ballistic_m2_kg_range", {}),
        ("parallel-truth.md", "kind: dask", {}),
        ("plan.md", "batch_compute_s", {}),
        ("hardware.md", "command: delta_v", COMMANDS_OF_DEVICES),
    ],
)
def test_what_a_guide_shows_of_a_scenario_is_right(tmp_path, capsys, guide, containing, others):
    (tmp_path / "data").mkdir()
    shutil.copy(ROOT / "scenarios/data/iridium10.tle", tmp_path / "data")
    (tmp_path / "guidance.py").write_text(FLIGHT)
    scenario = laid_over(REST, others, shown(guide, containing))
    (tmp_path / "a.yaml").write_text(yaml.safe_dump(scenario, sort_keys=False))

    assert app.run(["validate", str(tmp_path / "a.yaml")]) == 0, capsys.readouterr().err
