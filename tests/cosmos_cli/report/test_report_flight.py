"""What the report draws of maneuvers, estimates, links and sensors."""

import numpy as np
import pytest
from harness.synthetic_run import SyntheticRun, make_config
from test_report_browser import CHROMIUM, INSPECT, WATCH, browse

from cosmos_cli.collect.finish import finish_run
from cosmos_cli.report.build import build_sections
from cosmos_cli.report.html import write_report
from cosmos_cli.report.plotly_figures import to_plotly
from madns_runtime.analysis.values import Figure, TableBlock
from madns_runtime.recording.records import Field, StreamSchema

AXES = tuple(Field(f"{axis}_m", "m") for axis in "xyz")
GNSS = StreamSchema("gnss", (Field("tick", "", "int"), Field("t_s", "s"), *AXES))
ESTIMATES = StreamSchema(
    "estimates",
    (Field("tick", "", "int"), Field("slot_error_deg", "deg"), Field("sma_m", "m")),
)
COMMANDS = StreamSchema("commands", (Field("tick", "", "int"), Field("x", "m/s")))
MANEUVERS = StreamSchema(
    "maneuvers",
    (
        Field("commanded_s", "s"),
        Field("agent", "", "str"),
        Field("status", "", "str"),
        Field("executed_s", "s"),
        Field("dv_commanded_m_s", "m/s"),
        Field("dv_given_m_s", "m/s"),
        Field("slack_s", "s"),
        *(Field(name, "s") for name in ("at_s", "propagation_s", "network_s")),
    ),
)
LINKS = StreamSchema(
    "links",
    (
        Field("sent_s", "s"),
        Field("sender", "", "str"),
        Field("to", "", "str"),
        Field("outcome", "", "str"),
        Field("arrives_s", "s"),
        Field("distance_m", "m"),
    ),
)
REFUSALS = StreamSchema(
    "refusals", (Field("tick", "", "int"), Field("number", "", "int"), Field("reason", "", "str"))
)
CONTACTS = StreamSchema(
    "contacts",
    (
        Field("event", "", "str"),
        Field("agent", "", "str"),
        Field("station", "", "str"),
        Field("rise_s", "s"),
        Field("set_s", "s"),
        Field("elevation_deg_max", "deg"),
    ),
)
ERROR_M, TICKS, TICK_HZ = 3.0, 100, 10.0


def record(made, *, slack_s=2.9):
    """Two maneuvers and four messages per agent; measurements are 3 m off and known a tick late."""
    host = made.recorder("host", "host", MANEUVERS, LINKS, CONTACTS)
    host.record("contacts", ("rise", "agent-01", "Kiruna", 1.0, None, None))
    host.record("contacts", ("set", "agent-01", "Kiruna", 1.0, 9.0, 42.0))
    host.record("contacts", ("rise", "agent-02", "Kiruna", 5.0, None, None))
    for number, name in enumerate(made.names):
        agent = made.recorder(f"agents/{name}", name, GNSS, ESTIMATES, COMMANDS, REFUSALS)
        truth = np.loadtxt(
            [line.strip("[]") for line in lines_of(made, name, "state")], delimiter=","
        )
        for tick in range(TICKS):
            agent.record("estimates", (tick, 0.1 * (number + 1), 7e6))
            if tick:
                x, y, z = truth[tick - 1, 1:4].tolist()
                agent.record("gnss", (tick, (tick - 1) / TICK_HZ, x + ERROR_M, y, z))
        agent.record("commands", (1, 0.5))
        for reason in ("no_radio", "too_long", "no_radio")[: 3 - number]:
            agent.record("refusals", (2, 0, reason))
        agent.close()
        host.record("maneuvers", (1.0, name, "accepted", 4.0, 0.5, 0.49, slack_s, 4.0, 0.06, 0.02))
        host.record("maneuvers", (5.0, name, "postponed", 5.5, 0.25, 0.26, -0.01, 5.4, 0.01, 0.2))
        host.record("maneuvers", (8.0, name, "refused", None, 9.0, 0.0, None, 8.5, None, None))
        for t_s in (1.0, 2.0, 3.0):
            host.record("links", (t_s, name, "agent-01", "delivered", t_s + 0.01, 3e6))
        host.record("links", (4.0, name, "agent-01", "lost", None, 3e6))
    host.close()


def lines_of(made, agent, stream):
    return [line for line in made.stream(agent, stream).read_text().splitlines() if line[:1] == "["]


@pytest.fixture
def made(tmp_path):
    made = SyntheticRun(tmp_path / "runs", make_config(2, ticks=TICKS, tick_hz=TICK_HZ))
    made.write(with_states=True)
    record(made)
    finish_run(made.run, made.result(), made.expected, has_report=False)
    return made


@pytest.fixture
def blocks(made):
    return blocks_of(made)


def blocks_of(made):
    document = made.run.read_json(made.run.run_json)
    sections = {s.title: s.blocks for s in build_sections(made.run, document)}
    return {
        title: {getattr(block, "title", ""): block for block in found}
        for title, found in sections.items()
    }


def cells(table):
    assert isinstance(table, TableBlock)
    names = [heading.text for heading in table.headings]
    return [dict(zip(names, row, strict=True)) for row in table.rows]


def test_delta_v_is_summed_up_over_executed_maneuvers(blocks):
    figure = blocks["Control"]["Delta-v spent"]
    trace = figure.choices[0].marks[0]

    assert isinstance(figure, Figure)
    assert trace.x.tolist() == [0.0, 4.0, 5.5, 10.0]
    assert trace.y.tolist() == pytest.approx([0.0, 0.49, 0.75, 0.75])
    assert to_plotly(figure).choices[0][1][0]["line"]["shape"] == "hv"


def test_delta_v_that_a_stop_came_before_was_not_given(tmp_path):
    made = SyntheticRun(tmp_path / "runs", make_config(2, ticks=TICKS, tick_hz=TICK_HZ))
    made.write(with_states=True)
    record(made)
    finish_run(made.run, made.result(duration_s=5.0), made.expected, has_report=False)

    control = blocks_of(made)["Control"]

    rows = cells(control["Maneuvers by agent"])
    trace = control["Delta-v spent"].choices[0].marks[0]
    assert (trace.x.tolist(), trace.y.tolist()) == ([0.0, 4.0, 5.0], [0.0, 0.49, 0.49])
    assert [(one["commanded"], one["given, m/s"]) for one in rows] == [(3, 0.49)] * 2


def test_delta_v_of_a_burn_under_way_at_the_end_is_not_counted(tmp_path):
    made = SyntheticRun(tmp_path / "runs", make_config(2, ticks=TICKS, tick_hz=TICK_HZ))
    made.write(with_states=True)
    record(made, slack_s=1.4)  # from 2.5 s to 5.5 s
    finish_run(made.run, made.result(duration_s=5.0), made.expected, has_report=False)

    rows = cells(blocks_of(made)["Control"]["Maneuvers by agent"])

    assert [(one["commanded"], one["given, m/s"]) for one in rows] == [(3, 0.0)] * 2


def test_delta_v_that_a_failure_came_before_was_not_given(tmp_path):
    made = SyntheticRun(tmp_path / "runs", make_config(2, ticks=TICKS, tick_hz=TICK_HZ))
    made.write(with_states=True, shutdown_s=5.0)
    record(made)
    finish_run(made.run, made.result(status="failed"), made.expected, has_report=False)

    control = blocks_of(made)["Control"]

    rows = cells(control["Maneuvers by agent"])
    trace = control["Delta-v spent"].choices[0].marks[0]
    assert (trace.x.tolist(), trace.y.tolist()) == ([0.0, 4.0, 5.0], [0.0, 0.49, 0.49])
    assert [(one["commanded"], one["given, m/s"]) for one in rows] == [(3, 0.49)] * 2


def test_delta_v_that_the_end_of_a_killed_host_came_before_was_not_given(tmp_path, monkeypatch):
    made = SyntheticRun(tmp_path / "runs", make_config(2, ticks=TICKS, tick_hz=TICK_HZ))
    made.ticks = TICKS // 2  # nobody told a shutdown: the records of its agents end with the host
    monkeypatch.setitem(record.__globals__, "TICKS", made.ticks)
    made.write(with_states=True)
    record(made)
    finish_run(made.run, None, made.expected, has_report=False)

    control = blocks_of(made)["Control"]

    rows = cells(control["Maneuvers by agent"])
    trace = control["Delta-v spent"].choices[0].marks[0]
    assert (trace.x.tolist(), trace.y.tolist()) == ([0.0, 4.0, 4.9], [0.0, 0.49, 0.49])
    assert [(one["commanded"], one["given, m/s"]) for one in rows] == [(3, 0.49)] * 2


def test_a_broken_inequality_is_drawn_apart_and_counted(blocks):
    figure = blocks["Control"]["Slack of the synchronous inequality"]
    trace, drawn = figure.choices[0].marks[0], to_plotly(figure).choices[0][1][0]
    first = cells(blocks["Control"]["Maneuvers by agent"])[0]

    assert trace.y.tolist() == pytest.approx([2.9, -0.01])
    assert drawn["marker"]["color"][0] != drawn["marker"]["color"][1]
    assert (first["commanded"], first["postponed"], first["refused"]) == (3, 1, 1)
    assert (first["inequality broken"], first["least slack, s"]) == (1, -0.01)
    assert first["given, m/s"] == pytest.approx(0.75)


def test_slot_error_is_drawn_of_all_and_by_agent(blocks):
    largest, rms = blocks["Control"]["Slot error believed, of all agents"].choices[0].marks

    assert largest.y == pytest.approx(0.2)
    assert rms.y == pytest.approx(np.sqrt((0.1**2 + 0.2**2) / 2))
    assert "Slot error believed, by agent" in blocks["Control"]
    assert "Estimate: sma" in blocks["Control"]


def test_messages_are_counted_by_outcome(blocks):
    delivered, lost = blocks["Links"]["Messages by outcome"].choices[0].marks
    rows = cells(blocks["Links"]["Messages by sender"])

    assert (delivered.name, int(sum(delivered.counts))) == ("delivered", 6)
    assert (lost.name, int(sum(lost.counts))) == ("lost", 2)
    assert rows[-1] == {"sender": "all", "messages": 8, "delivered": 6, "lost": 2}


def test_refused_messages_are_told_by_sender_and_reason(blocks):
    first, second = cells(blocks["Links"]["Refused messages, as told to their senders"])

    assert first == {"sender": "agent-01", "refused": 3, "no radio": 2, "too long": 1}
    assert second == {"sender": "agent-02", "refused": 2, "no radio": 1, "too long": 1}


def test_passes_are_told_by_station(blocks):
    (row,) = cells(blocks["Links"]["Passes over ground stations"])

    assert (row["station"], row["begun"], row["ended"], row["vehicles"]) == ("Kiruna", 2, 1, 2)
    assert (row["longest, s"], row["highest elevation, deg"]) == (8.0, 42.0)


def test_error_of_a_sensor_is_against_truth_at_the_time_it_was_valid(blocks):
    (row, _) = cells(blocks["Sensors"]["Error of gnss, position, m"])
    trace = blocks["Sensors"]["Error of gnss, position"].choices[0].marks[0]

    assert row["measurements"] == TICKS - 1
    assert row["rms"] == pytest.approx(ERROR_M, abs=1e-6)
    assert trace.x[0] == 0.0


def test_what_the_host_tells_better_is_not_drawn_twice(blocks):
    """Nor as lines of `commands`, whose title would be the field's name."""
    assert sorted(blocks["Control"]) == [
        "Delta-v spent",
        "Estimate: sma",
        "Maneuvers by agent",
        "Slack of the synchronous inequality",
        "Slot error believed, by agent",
        "Slot error believed, of all agents",
    ]


@pytest.mark.browser
@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here")
def test_every_one_of_these_figures_draws_in_a_browser(made, tmp_path):
    page = tmp_path / "report.html"
    write_report(made.run, made.run.read_json(made.run.run_json), page)
    text = page.read_text().replace("<style>", WATCH + "<style>", 1)
    page.write_text(text.replace("</body>", INSPECT + "</body>", 1))

    dom = browse(page, "--dump-dom")

    assert 'data-inspected="yes"' in dom
    for told in ('data-failed="0"', 'data-errors=""', 'data-empty=""', 'data-violations="0"'):
        assert told in dom, dom[:500]
