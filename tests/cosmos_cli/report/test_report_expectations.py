"""The report's figures of what was expected."""

from pathlib import Path

import numpy as np
import pytest
from harness.synthetic_run import RECORDING, SyntheticRun, make_config

from cosmos_cli.collect.finish import finish_run
from cosmos_cli.evidence.run_directory import write_json
from cosmos_cli.evidence.run_documents import EXPECTATIONS
from cosmos_cli.evidence.tables import open_recorded_run
from cosmos_cli.models.expectation import Expectation
from cosmos_cli.report.build import build_sections
from madns_runtime.analysis.lines import field_lines
from madns_runtime.analysis.values import Axis, Figure
from madns_runtime.conditions.condition import ValueBounds
from madns_runtime.config import to_mapping
from madns_runtime.recording.record_files import RecordFiles
from madns_runtime.recording.recorder import Recorder
from madns_runtime.recording.records import Field, StreamSchema

SEEN = StreamSchema("seen", (Field("t_s", "s"), Field("agent", "", "str"), Field("range_m", "m")))


def drawn(made: SyntheticRun, expectation: Expectation) -> list[str]:
    """Return the names of the lines in an expectation's figure."""
    plan = made.run.read_json(made.run.plan_json) or {}
    listed = to_mapping({"": (expectation,)})[""]
    write_json(made.run.plan_json, {**plan, EXPECTATIONS: listed})
    summary = finish_run(made.run, made.result(), made.expected)
    sections = build_sections(made.run, summary.document)
    (section,) = (each for each in sections if each.title == "Expectations")
    return [
        mark.name
        for block in section.blocks
        if isinstance(block, Figure)
        for choice in block.choices
        for mark in choice.marks
    ]


def near(*agents: str) -> Expectation:
    return Expectation(
        name="near",
        words="max of seen.range_m below 5 m",
        stream="seen",
        field="range_m",
        agents=agents,
        statistic="max",
        bounds=ValueBounds.below(5.0),
    )


@pytest.mark.parametrize("agents", [("agent-01", "agent-02"), ("agent-02",)])
def test_agents_that_record_others_have_a_line_for_each_of_these(
    tmp_path: Path, agents: tuple[str, ...]
) -> None:
    made = SyntheticRun(tmp_path, make_config(2)).write()
    for agent, range_m in (("agent-01", 1.0), ("agent-02", 9.0)):
        recorder = made.recorder(f"agents/{agent}", agent, SEEN)
        for t_s in (0.0, 1.0):
            recorder.record("seen", (t_s, "car-0", range_m))
            recorder.record("seen", (t_s, "car-1", range_m))
        recorder.close()

    names = drawn(made, near(*agents))

    worst = ["agent-02 · car-0", "agent-02 · car-1"]
    assert names[:2] == worst
    assert names[2:] == (["agent-01 · car-0", "agent-01 · car-1"] if len(agents) > 1 else [])


def test_the_host_has_a_line_for_each_agent_that_its_records_are_about(tmp_path: Path) -> None:
    made = SyntheticRun(tmp_path, make_config(2)).write()
    recorder = made.recorder("host", "host", SEEN)
    for agent in ("agent-02", None, "agent-01"):
        recorder.record("seen", (0.0, agent, 1.0))
    recorder.close()

    assert drawn(made, near("host")) == ["agent-02", "host", "agent-01"]


def test_records_about_nobody_are_a_line_of_who_recorded_them(tmp_path: Path) -> None:
    made = SyntheticRun(tmp_path, make_config(1)).write()
    for number, name in ((1, "agent-01"), (2, "agent-01")):
        folder = tmp_path / str(number)
        files = RecordFiles(folder, run=made.run.name, source=name)
        recorder = Recorder(files, RECORDING)
        recorder.open_stream(SEEN)
        for row in range(4):
            about = "car-0" if row % 2 else None
            recorder.record("seen", (float(row + 10 * number), about, float(row)))
        recorder.close()
        suffix = "" if number == 1 else f".{number}"
        place = made.run.path / "agents" / name / f"seen{suffix}.jsonl"
        (folder / "seen.jsonl").rename(place)
    finish_run(made.run, made.result(), made.expected)
    recorded = open_recorded_run(made.run, {})

    series, _ = recorded.series(recorded.tables["seen"], "range_m")
    (figure,) = field_lines(
        recorded.tables["seen"], recorded, "range_m", title="range", y=Axis(unit="m")
    )

    told = {name: y.tolist() for name, (_, y) in series.items()}
    assert told == {"agent-01": [0.0, 2.0] * 2, "agent-01 · car-0": [1.0, 3.0] * 2}
    assert [mark.name for mark in figure.choices[0].marks] == list(told)
    assert [np.isfinite(mark.y).sum() for mark in figure.choices[0].marks] == [4, 4]
