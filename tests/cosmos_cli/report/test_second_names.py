import numpy as np

from cosmos_cli.models.agent_labels import NO_LABELS, AgentLabels
from cosmos_cli.report.second_names import with_second_names
from madns_runtime.analysis.lines import grouped_lines
from madns_runtime.analysis.values import Axis, ReportRemark, Section

LABELS = AgentLabels(column="car", names={"agent-01": "RING 1", "agent-05": "RING 5"})


def sections(agents):
    values = np.arange(3.0)
    series = {f"agent-{number:02}": (values, values) for number in range(1, agents + 1)}
    blocks = [
        *grouped_lines(series, title="speed", y=Axis(unit="m/s")),
        ReportRemark(text="agent-01"),
    ]
    return [Section(title="Cars", blocks=blocks)]


def test_groups_of_agents_and_their_lines_bear_second_names():
    (section,) = with_second_names(sections(6), LABELS)

    figure, remark = section.blocks
    first, second = figure.choices
    assert (first.name, second.name) == ("agent-01 (RING 1) … agent-05 (RING 5)", "agent-06")
    assert [mark.name for mark in first.marks][:2] == ["agent-01 (RING 1)", "agent-02"]
    assert remark.text == "agent-01"


def test_figures_of_a_run_without_second_names_stay_as_they_are():
    before = sections(2)

    assert with_second_names(before, NO_LABELS) == before
