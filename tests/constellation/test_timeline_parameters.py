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
parameters:
  satellites: {{walker: "86.4:2/2/0", altitude_km: 780}}
  stations: [{{name: svalbard, latitude_deg: 78.2, longitude_deg: 15.4}}]
  flight: [{{agents: [agent-01], command: [/bin/true]}}]
  vehicles:
    - agents: [agent-01]
      thruster: {{isp_s: 220, propellant_kg: 2}}
      sensors: {{gyro: {{}}, gnss: {{}}, star_tracker: {{}}}}
      attitude: {{inertia_kg_m2: [1, 1, 1]}}
timeline:
  - {{at_s: 1, {entry}}}
"""
STUCK = "action: stick_thruster_open, agents: [agent-01]"
TOLD = "action: telecommand, agents: [agent-01]"
SENSED = "action: sensor_fault, agents: [agent-01], fault: dead"
BIASED = "action: sensor_fault, agents: [agent-01], fault: biased"
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
    ("action: darken_station, station: svalbrd", "station", "did you mean svalbard?"),
    ("action: darken_station, station: kiruna", "station", "there are svalbard"),
    (f"{TOLD}, text: a, station: Svalbard", "station", "did you mean svalbard?"),
    ("action: telecommand, agents: ['*'], text: a", "agents", "agent-02: no flight software"),
    (f"{SENSED}, sensor: clock", "sensor", "agent-01 has no clock, its model has gnss, gyro"),
    (f"{SENSED}, sensor: gps", "sensor", "expected gnss, gyro"),
    ("action: sensor_fault, agents: ['*'], fault: dead, sensor: gyro", "sensor", "agent-02 has no"),
    (f"{SENSED}, sensor: gyro, bias: [1]", "bias", "goes with fault: biased, got dead"),
    (f"{BIASED}, sensor: gyro", "fault", "biased needs bias"),
    (f"{BIASED}, sensor: gyro, bias: [0]", "bias", "other than 0"),
    (f"{BIASED}, sensor: gyro, bias: [1, 1, 1, 1]", "bias", "at most 3 numbers, of gyro in rad/s"),
    (f"{BIASED}, sensor: gnss, bias: [1, 1, 1, 1, 1, 1, 1]", "bias", "in m, then m/s, got 7"),
    ("action: weaken_thruster, agents: [agent-02], factor: 0.5", "agents", "agent-02: no thruster"),
    ("action: fail_wheels, agents: ['*']", "agents", "agent-02: no wheels"),
    (STUCK, "action", "its burns are impulses, so give thrust_n"),
    (f"{STUCK}, thrust_n: 1, direction: [0, 0, 0]", "direction", "expected a direction"),
    (
        "action: stick_thruster_open, agents: [agent-02], thrust_n: 1, frame: body",
        "frame",
        "agent-02: no body axes",
    ),
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
    assert line == 15
    assert words in text
