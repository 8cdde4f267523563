"""Entries of a constellation's timeline that are refused before a run, each with its place and cure."""

from pathlib import Path

import pytest

from cosmos_cli.errors import InputError
from cosmos_cli.models.loading import load_scenario

SCENARIO = """\
name: broken
simulation: constellation
agents: {{count: 2, tick_hz: 1}}
time: {{mode: lockstep, duration_s: 100}}
parameters: {{satellites: {{walker: "86.4:2/2/0", altitude_km: 780}}}}
timeline:
  - {{at_s: 1, {entry}}}
"""
STUCK = "action: stick_thruster_open, agents: [agent-01]"
TOLD = "action: telecommand, agents: [agent-01]"
BROKEN = [
    ("action: stick_thruster_open", "action", "needs agents"),
    (f"{STUCK}, thrust_n: 0", "thrust_n", "expected > 0, got 0"),
    (f"{STUCK}, thrust_n: 1e9", "thrust_n", "1000000"),
    (f"{STUCK}, frame: rtx", "frame", "did you mean rtn?"),
    (f"{STUCK}, direction: [0, 1]", "direction[2]", "missing"),
    (f"{STUCK}, thrust: 1", "thrust", "did you mean thrust_n"),
    ("action: lose_satellite", "action", "needs agents"),
    ("action: lose_satellite, agents: [agent-09]", "agents[0]", "no agent is named agent-09"),
    ("action: lose_satellite, agents: [agent-01], for_s: -1", "for_s", "got -1"),
    (TOLD, "text", "missing"),
    (f"{TOLD}, text: ''", "text", "at least 1"),
    (f"{TOLD}, text: a, for_s: 3", "for_s", "has no end"),
    (f"{TOLD}, text: a, statoin: x", "statoin", "did you mean station?"),
    ("action: darken_station", "station", "missing"),
]


@pytest.mark.parametrize(("entry", "field", "words"), BROKEN)
def test_an_entry_is_refused_with_its_place_and_cure(
    tmp_path: Path, entry: str, field: str, words: str
) -> None:
    path = tmp_path / "broken.yaml"
    path.write_text(SCENARIO.format(entry=entry))

    with pytest.raises(InputError) as refused:
        load_scenario(path)

    told = {fault.path: (fault.line, fault.text) for fault in refused.value.faults}
    assert f"timeline[0].{field}" in told, told
    line, text = told[f"timeline[0].{field}"]
    assert line == 7
    assert words in text
