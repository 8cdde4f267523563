"""What a timeline did, as a report shows it: rows of a table, and bands in figures over simulated time."""

import json
import os
from types import SimpleNamespace

import numpy as np
import pytest
from harness.synthetic_run import SyntheticRun, make_config

from cosmos_cli.collect.finish import finish_run
from cosmos_cli.report.build import build_sections
from cosmos_cli.report.timeline import (
    note_agents_refusals,
    read_actions,
    timeline_sections,
    with_bands,
)
from madns_runtime.analysis.values import (
    Axis,
    Figure,
    FigureChoice,
    Section,
    Series,
    TableBlock,
)
from madns_runtime.recording.records import LATE_TICKS

EVENTS = [
    {"t_s": 0.0, "event": "state", "state": "SIMULATION_START"},
    {
        "t_s": 10.0,
        "event": "action_began",
        "number": 0,
        "action": "sensor_fault",
        "agents": ["a", "b"],
        "parameters": {"sensor": "gnss", "fault": "dead", "value": None},
        "delay_s": 0.5,
        "lasts": True,
    },
    {"t_s": 30.0, "event": "action_ended", "number": 0, "action": "sensor_fault"},
    {
        "t_s": 40.0,
        "event": "action_began",
        "number": 1,
        "action": "annotate",
        "agents": [],
        "parameters": {"text": "here"},
        "delay_s": 0.0,
        "lasts": False,
    },
    {
        "t_s": 50.0,
        "event": "action_refused",
        "number": 2,
        "action": "kill",
        "agents": ["a"],
        "parameters": {},
        "reason": "not there",
    },
]


def a_run(folder, events):
    (folder / "host").mkdir()
    lines = [json.dumps(event) for event in events]
    (folder / "host" / "events.jsonl").write_text("\n".join([*lines, "{cut"]))
    return SimpleNamespace(path=folder)


def a_figure(**more):
    return Figure(title="t", choices=[FigureChoice(marks=[Series(x=[0, 1], y=[0, 1])])], **more)


def test_actions_are_rows_and_bands_in_figures_over_simulated_time_alone(tmp_path):
    actions = read_actions(a_run(tmp_path, EVENTS))
    over_time, other = a_figure(), a_figure(x=Axis(quantity="distance", unit="m"))

    (section,) = with_bands([Section(title="s", blocks=[over_time, other])], actions, 100.0)
    (told,) = timeline_sections(actions)

    bands = [(band.start, band.end, band.name) for band in section.blocks[0].events]
    assert bands == [
        (10.0, 30.0, "sensor_fault sensor=gnss fault=dead"),
        (40.0, 40.2, "annotate text=here"),
    ]
    assert section.blocks[1].events == ()
    (table,) = told.blocks
    assert isinstance(table, TableBlock)
    assert [row[0] for row in table.rows] == [10.0, 40.0, 50.0]
    assert table.rows[0][2:5] == ["a, b", 30.0, 0.5]
    assert table.rows[2][-1] == "not there"


@pytest.mark.parametrize(
    ("x", "begin"),
    [
        (Axis(quantity="valid at simulated time", unit="s"), 10.0),
        (Axis(quantity="simulated time", unit="h"), 10.0 / 3600.0),
        (Axis(quantity="simulated time", unit="m"), None),
        (Axis(quantity="simulated time", unit="s", is_logarithmic=True), None),
        (Axis(quantity="time since the first sample", unit="s"), None),
    ],
)
def test_bands_stand_where_the_action_was_on_every_axis_of_simulated_time(tmp_path, x, begin):
    actions = read_actions(a_run(tmp_path, EVENTS))[:1]

    (section,) = with_bands([Section(title="s", blocks=[a_figure(x=x)])], actions, 100.0)

    bands = [(band.start, band.end) for band in section.blocks[0].events]
    assert bands == ([] if begin is None else [(pytest.approx(begin), pytest.approx(3 * begin))])


def test_figures_of_expectations_show_the_bands(tmp_path):
    made = SyntheticRun(tmp_path, make_config(1)).write()
    low = {"name": "low", "words": "max of ticks.lateness_us below 1", "stream": "ticks"}
    low |= {"field": "lateness_us", "agents": ["agent-01"], "statistic": "max"}
    low |= {"bounds": {"high": 1.0}, "unit": "us"}
    plan = json.loads(made.run.plan_json.read_text())
    made.run.plan_json.write_text(json.dumps({**plan, "expectations": [low]}))
    with (made.run.path / "host" / "events.jsonl").open("a") as file:
        file.writelines(json.dumps(event) + "\n" for event in EVENTS[1:3])
    summary = finish_run(made.run, made.result(), made.expected)

    sections = build_sections(made.run, summary.document)

    (section,) = [one for one in sections if one.title == "Expectations"]
    (figure,) = [block for block in section.blocks if isinstance(block, Figure)]
    assert [(band.start, band.end) for band in figure.events] == [(10.0, 30.0)]


@pytest.mark.parametrize("shutdown_s", [5.0, None])  # None: the host was killed, and told of no end
def test_time_that_a_run_did_not_reach_is_in_no_figure(tmp_path, shutdown_s):
    """Planned for 2000 s, ended after 5 s, while an action was in force."""
    made = SyntheticRun(tmp_path / "runs", make_config(1, ticks=2000, tick_hz=1.0))
    made.ticks = 6
    made.write(shutdown_s=shutdown_s)
    late = made.recorder("agents/agent-01", "agent-01", LATE_TICKS)
    late.record("late_ticks", (3, 9000, 0, "wake_up"))
    late.close()
    finish_run(made.run, made.result(status="interrupted"), made.expected, has_report=False)
    began = {"t_s": 1.0, "event": "action_began", "number": 0, "action": "slow", "lasts": True}
    with (made.run.path / "host/events.jsonl").open("a") as events:
        events.write(json.dumps(began) + "\n")

    sections = build_sections(made.run, made.run.read_json(made.run.run_json))

    blocks = {
        block.title: block
        for section in sections
        for block in section.blocks
        if isinstance(block, Figure)
    }
    (band,) = blocks["Lateness of the ticks over time"].events
    assert (band.start, band.end) == (1.0, 5.0)
    assert blocks["Missed and late ticks over time, by cause"].choices[0].marks[0].edges[-1] == 5.0


class AgentEvents:
    """Events of agents, as a table: each refused the action of a number, for a reason."""

    def __init__(self, *refusals):
        self._refusals = refusals
        self.sources = tuple(agent for agent, _, _ in refusals)

    def has(self, *names):
        return True

    def batches(self, source, names, rows_max):
        (agent, number, reason) = next(one for one in self._refusals if one[0] == source)
        details = json.dumps({"number": number, "action": "x", "reason": reason})
        words = np.array(["start", "action_refused"], dtype=object)
        yield {"event": words, "details": np.array([None, details], dtype=object)}


def test_what_agents_refused_stands_beside_the_action_and_its_band_stays(tmp_path):
    actions = read_actions(a_run(tmp_path, EVENTS))

    refusals = [
        ("a", 0, "no gnss"),
        ("b", 0, "no gnss"),
        ("c", 7, "of none"),
        ("d", [0], "garbled"),
    ]
    note_agents_refusals(actions, AgentEvents(*refusals))

    (section,) = timeline_sections(actions)
    assert [row[-1] for row in section.blocks[0].rows] == [
        "by a and 1 more: no gnss",
        "",
        "not there",
    ]
    (drawn,) = with_bands([Section(title="s", blocks=[a_figure()])], actions, 100.0)
    assert [band.start for band in drawn.blocks[0].events] == [10.0, 40.0]


def test_a_run_without_a_timeline_has_no_chapter_of_one(tmp_path):
    actions = read_actions(a_run(tmp_path, EVENTS[:1]))
    figure = a_figure()

    (section,) = with_bands([Section(title="s", blocks=[figure])], actions, 100.0)

    assert timeline_sections(actions) == []
    assert section.blocks[0] is figure


def test_events_that_cannot_be_read_tell_of_nothing(tmp_path):
    assert read_actions(SimpleNamespace(path=tmp_path)) == []


@pytest.mark.timeout(60)
@pytest.mark.parametrize("make", [os.mkfifo, lambda path: path.symlink_to("/dev/zero")])
def test_events_that_are_no_file_are_not_waited_for(tmp_path, make):
    (tmp_path / "host").mkdir()
    make(tmp_path / "host/events.jsonl")

    assert read_actions(SimpleNamespace(path=tmp_path)) == []


def test_actions_are_told_however_many_other_events_there_are(tmp_path):
    others = [{"t_s": 0.0, "event": "sync_deadline_broken"}] * 50_001

    assert [each.number for each in read_actions(a_run(tmp_path, [*others, *EVENTS]))] == [0, 1, 2]


def test_event_whose_number_is_none_is_no_action(tmp_path):
    garbled = EVENTS[1] | {"number": [0]}

    assert len(read_actions(a_run(tmp_path, [garbled, *EVENTS]))) == 3
