"""Broken timelines: each fault is told at its place, with what was expected and what to do."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path

import pytest

from cosmos_cli.errors import InputError
from cosmos_cli.models.loading import ScenarioFile, load_scenario
from cosmos_cli.models.timeline_rules import RULE_KEYS
from madns_runtime.timeline.kinds import ENTRY_KEYS, FRAMEWORK_ACTIONS

HEAD = """\
name: broken
simulation: counter
agents: {{count: 4, tick_hz: 10}}
time: {{mode: {mode}, duration_s: 100}}
hardware:
  devices:
    - {{name: gps, kind: synthetic, parameters: {{channels: [{{name: u}}]}}}}
    - {{name: imu, kind: synthetic, agents: [agent-02, agent-03], parameters: {{channels: [{{name: w}}]}}}}
timeline:
"""
DEVICE = 'at_s: 1, action: device_fault, agents: ["*"], '
WHEN = "{action: stop, when: {%s}}"
BROKEN_WHEN = [
    ("stream: round_trips, field: packet", "", "expected a limit: one of below"),
    ("stream: round_trip, field: packet, above: 1", ".stream", "did you mean round_trips?"),
    ("stream: round_trips, field: paket, above: 1", ".field", "did you mean packet?"),
    ("stream: round_trips, above: 1", ".field", "missing"),
    ("stream: round_trips, field: packet, above: 1, below: 3", ".above", "got below as well"),
    ("stream: round_trips, field: packet, equals: a", ".equals", "holds no texts"),
    ("stream: round_trips, field: packet, above: 1, unit: km", ".unit", "has no unit"),
    (
        "stream: round_trips, field: round_trip_us, above: 1e308, unit: h",
        ".above",
        "1e+308 h is more than a number in us can tell",
    ),
    ("stream: round_trips, field: packet, within: [3, 1]", ".within", "the lesser bound first"),
    (
        "stream: round_trips, field: packet, above: 1, agents: [car]",
        ".agents[0]",
        "no agent is named",
    ),
    (
        "stream: round_trips, field: packet, above: 1, agents: [host]",
        ".agents[0]",
        "by agents alone",
    ),
    ("stream: round_trips, field: packet, above: 1, for_s: -1", ".for_s", "expected >= 0"),
    (
        "stream: round_trips, field: packet, above: 1, for_s: 100",
        ".for_s",
        "cannot hold for so long",
    ),
    ("stream: events, field: event, equals: strt", ".equals", "did you mean start?"),
    ("stream: events, field: event, equals: agent_rejoined", ".equals", "write agents: [host]"),
    (
        "stream: events, field: event, equals: hang_begins, agents: [host]",
        ".equals",
        "an event of agents alone",
    ),
    ("stream: imu.w, field: w, above: 1", ".stream", "recorded by a device and not by agents"),
    ("stream: health, field: ram_percent, above: 1", ".stream", "name a stream of the simulation"),
    (
        "stream: ticks, field: margin_us, above: 1",
        ".stream",
        "is not recorded in time.mode lockstep",
    ),
]
BROKEN = [
    *((WHEN % words, f"timeline[0].when{place}", text) for words, place, text in BROKEN_WHEN),
    ("{at_s: 1, action: stop, when: {}}", "timeline[0].when.stream", "missing"),
    (
        "{at_s: 1, action: stop, when: {stream: a, field: b}}",
        "timeline[0].when",
        "got at_s as well",
    ),
    ("3", "timeline[0]", "expected a mapping, got 3"),
    ("{at_s: 1}", "timeline[0].action", "missing; expected a text"),
    ("{at_s: 1, action: 3}", "timeline[0].action", "expected a text"),
    ("{at_s: 1, action: ''}", "timeline[0].action", "expected"),
    ("{at_s: 1, action: anotate, text: a}", "timeline[0].action", "did you mean annotate?"),
    ("{at_s: 1, action: explode}", "timeline[0].action", "known here: annotate, stop"),
    ("{action: stop}", "timeline[0].action", "one of at_s, every_s"),
    ("{at_s: 1, every_s: 2, action: stop}", "timeline[0].every_s", "got at_s as well"),
    ("{at_s: 1, rate_per_h: 2, action: stop}", "timeline[0].rate_per_h", "got at_s as well"),
    ("{at_s: -1, action: stop}", "timeline[0].at_s", "expected >= 0, got -1"),
    ("{at_s: soon, action: stop}", "timeline[0].at_s", "expected a number, got 'soon'"),
    ("{at_s: 100, action: stop}", "timeline[0].at_s", "the run is over then"),
    ("{at_s: 1e9, action: stop}", "timeline[0].at_s", "less than time.duration_s (100)"),
    ("{at: 1, action: stop}", "timeline[0].at", "unknown key, did you mean at_s?"),
    ("{at_s: 1, from_s: 2, action: stop}", "timeline[0].from_s", "goes with every_s"),
    ("{at_s: 1, to_s: 2, action: stop}", "timeline[0].to_s", "goes with every_s"),
    ("{every_s: 0, action: annotate, text: a}", "timeline[0].every_s", "expected > 0, got 0"),
    (
        "{every_s: 5, from_s: 9, to_s: 3, action: annotate, text: a}",
        "timeline[0].to_s",
        "expected >= from_s (9), got 3",
    ),
    (
        "{every_s: 5, from_s: 200, action: annotate, text: a}",
        "timeline[0].from_s",
        "the run is over then",
    ),
    (
        "{every_s: 5, to_s: 200, action: annotate, text: a}",
        "timeline[0].to_s",
        "leave it out for the end",
    ),
    (
        "{every_s: 0.001, action: annotate, text: a}",
        "timeline",
        "make them rarer, most of all timeline[0]",
    ),
    ("{every_s: 5.0e-324, action: annotate, text: a}", "timeline", "make them rarer"),
    (
        '{at_s: 1, action: partition, agents: ["agent-0[1-3]", agent-04]}',
        "timeline[0].agents",
        "expected some of the agents, got all 4",
    ),
    ("{rate_per_h: 0, action: annotate, text: a}", "timeline[0].rate_per_h", "expected > 0"),
    ("{rate_per_h: 1e9, action: annotate, text: a}", "timeline[0].rate_per_h", "expected <= 3600"),
    ("{at_s: 1, action: annotate}", "timeline[0].text", "missing"),
    ("{at_s: 1, action: annotate, text: ''}", "timeline[0].text", "at least 1"),
    ("{at_s: 1, action: annotate, txt: a}", "timeline[0].txt", "did you mean text?"),
    (
        "{at_s: 1, action: annotate, text: a, agents: ['*']}",
        "timeline[0].agents",
        "acts on the whole run",
    ),
    ("{at_s: 1, action: annotate, text: a, for_s: 0}", "timeline[0].for_s", "expected > 0"),
    ("{at_s: 1, action: stop, for_s: 3}", "timeline[0].for_s", "stop has no end"),
    ("{" + DEVICE + "device: gps}", "timeline[0].fault", "missing"),
    ("{" + DEVICE + "device: gps, fault: biass}", "timeline[0].fault", "did you mean bias?"),
    ("{" + DEVICE + "device: gps, fault: bias}", "timeline[0].fault", "bias needs a value"),
    ("{" + DEVICE + "device: gps, fault: drop, value: 2}", "timeline[0].value", "0 to 1"),
    ("{" + DEVICE + "device: gps, fault: freeze, value: 2}", "timeline[0].value", "no value"),
    ("{" + DEVICE + "device: gsp, fault: freeze}", "timeline[0].device", "did you mean gps?"),
    (
        "{at_s: 1, action: device_fault, device: gps, fault: freeze}",
        "timeline[0].action",
        "needs agents",
    ),
    (
        "{at_s: 1, action: device_fault, agents: [agent-9], device: gps, fault: freeze}",
        "timeline[0].agents[0]",
        "no agent is named agent-9",
    ),
    (
        '{at_s: 1, action: device_fault, agents: ["sat-*"], device: gps, fault: freeze}',
        "timeline[0].agents[0]",
        "no agent is named sat-*",
    ),
    (
        "{at_s: 1, action: device_fault, agents: [agent-02, agent-01], device: imu, fault: freeze}",
        "timeline[0].agents[1]",
        "expected an agent that uses device imu (agent-02, agent-03), got agent-01",
    ),
    (
        '{at_s: 1, action: stress, agents: ["*"], for_s: 3}',
        "timeline[0].action",
        "time.mode realtime alone",
    ),
    (
        '{at_s: 1, action: step_clock, agents: ["*"], by_ms: 50}',
        "timeline[0].action",
        "time.mode realtime alone",
    ),
    ('{at_s: 1, action: step_clock, agents: ["*"]}', "timeline[0].by_ms", "missing"),
    ('{at_s: 1, action: step_clock, agents: ["*"], by_ms: 1e6}', "timeline[0].by_ms", "10000"),
    ('{at_s: 1, action: drift_clock, agents: ["*"]}', "timeline[0].ppm", "missing"),
    ('{at_s: 1, action: drift_clock, agents: ["*"], ppm: 900}', "timeline[0].ppm", "500"),
    (
        '{at_s: 1, action: delay_messages, agents: ["*"], delay_s: 1, jitter_s: -1}',
        "timeline[0].jitter_s",
        "expected >= 0, got -1",
    ),
    ("{at_s: 1, action: drift_clock, ppm: 90}", "timeline[0].action", "needs agents"),
]


def load(folder: Path, *entries: str, mode: str = "lockstep") -> ScenarioFile:
    path = folder / "broken.yaml"
    path.write_text(HEAD.format(mode=mode) + "".join(f"  - {entry}\n" for entry in entries))
    return load_scenario(path)


@pytest.mark.parametrize(("entry", "place", "words"), BROKEN)
def test_a_broken_entry_is_refused_with_its_place_and_cure(
    tmp_path: Path, entry: str, place: str, words: str
) -> None:
    with pytest.raises(InputError) as refused:
        load(tmp_path, entry)

    told = {fault.path: fault.text for fault in refused.value.faults}
    assert place in told, told
    assert words in told[place]
    assert all(fault.line and fault.line >= 6 for fault in refused.value.faults)


@pytest.mark.parametrize(
    "when", ["at_s: .nan", "every_s: 1e400", "when: {stream: log, field: t_s, above: .inf}"]
)
def test_a_time_that_is_no_number_is_one_fault(tmp_path: Path, when: str) -> None:
    with pytest.raises(InputError) as refused:
        load(tmp_path, f"{{{when}, action: stop}}")

    (fault,) = refused.value.faults
    assert "expected a finite number" in fault.text


def test_all_entries_are_told_of_at_once(tmp_path: Path) -> None:
    with pytest.raises(InputError) as refused:
        load(tmp_path, "{at_s: 1, action: anotate}", "{at_s: 1}", "4")

    assert [fault.line for fault in refused.value.faults] == [10, 11, 12]


def test_stress_needs_to_be_told_how_long(tmp_path: Path) -> None:
    with pytest.raises(InputError) as refused:
        load(tmp_path, '{at_s: 1, action: stress, agents: ["*"]}', mode="realtime")

    assert "needs for_s" in refused.value.faults[0].text


def test_too_many_entries_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError) as refused:
        load(tmp_path, *["{at_s: 1, action: stop}"] * 1001)

    assert "at most 1000 items" in refused.value.faults[0].text


def test_globs_become_names_and_defaults_are_filled_in(tmp_path: Path) -> None:
    entry = '{every_s: 20, action: device_fault, agents: ["agent-0[12]"], device: gps, fault: freeze, for_s: 5}'

    (found,) = load(tmp_path, entry).run_config("0001-x").timeline

    assert found.agents == ("agent-01", "agent-02")
    assert found.parameters == {"device": "gps", "fault": "freeze", "value": None}
    assert (found.every_s, found.from_s, found.to_s, found.for_s) == (20.0, 0.0, None, 5.0)


def test_a_partition_by_chance_is_of_each_agent_for_itself(tmp_path: Path) -> None:
    entry = '{rate_per_h: 100, action: partition, agents: ["*"], for_s: 5}'

    (found,) = load(tmp_path, entry).run_config("0001-x").timeline

    assert len(found.agents) == 4


def test_a_condition_travels_with_its_agents_and_in_the_unit_of_its_field(tmp_path: Path) -> None:
    when = "{stream: round_trips, field: round_trip_us, above: 2, unit: ms, agents: [agent-02], for_s: 3}"

    config = load(
        tmp_path, "{at_s: 5, action: stop}", f"{{when: {when}, action: stop}}"
    ).run_config("r")

    (condition,) = config.conditions
    assert [entry.condition for entry in config.timeline] == [None, 0]
    assert (condition.number, condition.stream, condition.agents) == (
        0,
        "round_trips",
        ("agent-02",),
    )
    assert (condition.bounds.low, condition.for_s) == (2000.0, 3.0)


def test_a_condition_without_agents_is_of_agents_where_the_host_records_the_stream_too(
    tmp_path: Path,
) -> None:
    when = "{stream: log, field: level, equals: error}"

    (condition,) = load(tmp_path, f"{{when: {when}, action: stop}}").run_config("r").conditions

    assert (condition.agents[0], condition.is_of_host) == ("agent-01", False)


def test_no_action_has_a_parameter_that_a_timelines_entry_has_itself() -> None:
    assert set(ENTRY_KEYS) == set(RULE_KEYS)
    for kind in FRAMEWORK_ACTIONS:
        assert not {field.name for field in fields(kind.parameters)} & set(RULE_KEYS), kind.word


VALVES = """
from dataclasses import dataclass, field
from typing import Any
from madns_runtime.plugin.api import ActionKind, AgentSimulation, HostSimulation, Simulation

@dataclass(frozen=True)
class Parameters:
    pass

@dataclass(frozen=True)
class Valve:
    opening: float = 1
    FIELD

VALVE = ActionKind(word="open_valve", summary="Opens.", parameters=Valve, takes_agents=False)
simulation = Simulation(
    name="tanks", parameters=Parameters, agent=":Tank", host=":Farm", actions=(VALVE,)
)

class Farm(HostSimulation):
    def begin_action(self, action):
        pass

class Tank(AgentSimulation):
    pass
"""


def of_tanks(folder: Path, field: str) -> ScenarioFile:
    """Load a scenario whose simulation has an action with one more parameter."""
    (folder / "tanks.py").write_text(VALVES.replace("FIELD", field))
    scenario = "name: a\nsimulation: ./tanks.py:simulation\nagents: {count: 1}\n"
    (folder / "a.yaml").write_text(f"{scenario}timeline:\n  - {{at_s: 1, action: open_valve}}\n")
    return load_scenario(folder / "a.yaml")


@pytest.mark.process
@pytest.mark.parametrize(
    ("field", "told"),
    [
        ("more: Any = object()", "more: expected None, true or false, a number, a text"),
        ("more: Any = float('nan')", "more: expected a finite number, got nan"),
        ("more: int = 10**30", "more: expected a whole number from -2^63 to 2^63 - 1"),
        ("more: str = chr(0xDC80)", "more: expected text that UTF-8 can hold"),
        ("more: Any = field(default_factory=lambda: {1: 2})", "more: expected texts as keys"),
        ("more: float = 'wide'", "more: expected float, got 'wide'; a default must be of its"),
        (
            "def __post_init__(self): object.__setattr__(self, 'opening', self.opening + 1)",
            "opening came out another",
        ),
        ("def __post_init__(self): raise KeyError('x')", "KeyError: 'x'"),
    ],
)
def test_a_default_of_an_actions_parameter_that_no_file_can_hold_is_told_with_the_plugins_line(
    tmp_path: Path, field: str, told: str
) -> None:
    with pytest.raises(InputError) as refused:
        of_tanks(tmp_path, field)

    (fault,) = refused.value.faults
    assert fault.path == "timeline[0].action"
    assert f"{tmp_path}/tanks.py:" in fault.text
    assert told in fault.text


@pytest.mark.process
def test_defaults_of_an_actions_parameters_are_filled_in(tmp_path: Path) -> None:
    (found,) = of_tanks(tmp_path, "more: str = 'x'").run_config("0001-x").timeline

    assert found.parameters == {"opening": 1, "more": "x"}
