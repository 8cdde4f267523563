"""The scenario as a run's folder holds it: what was changed stands in comments before it."""

import pytest

from cosmos_cli.launch.execute import scenario_text
from cosmos_cli.models.loading import load_scenario

SCENARIO = """\
name: tiny
simulation: counter
agents: {count: 1, tick_hz: 10}
time: {duration_s: 1}
"""


@pytest.mark.parametrize("line_end", ["\n", "\r", "\x85", "\u2028"])
def test_value_of_several_lines_leaves_it_a_scenario(tmp_path, line_end):
    written, read_back = tmp_path / "tiny.yaml", tmp_path / "scenario.yaml"
    written.write_text(SCENARIO)
    override = f"timeline=[{{at_s: 0.5, action: stop}},\n {{at_s: 0.7, action: annotate, text: '{line_end}a'}}]"
    changed = load_scenario(written, [override])

    read_back.write_text(scenario_text(changed))

    assert load_scenario(read_back).to_written() == changed.to_written()
