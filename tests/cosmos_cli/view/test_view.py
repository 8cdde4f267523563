from __future__ import annotations

import io
import re

import pytest

from cosmos_cli.launch.events import Progress
from cosmos_cli.models.agent_labels import AgentLabels
from cosmos_cli.view import factory
from cosmos_cli.view.live import LiveView
from cosmos_cli.view.plain import PlainView, SilentView
from cosmos_cli.view.words import lateness_words, progress_line, rtf_words, value_words

RUNNING = Progress(
    t_s=12.34,
    rtf=1.00004,
    running=10,
    ticks=1230,
    missed=2,
    lateness_us_p50=31,
    lateness_us_p99=212,
)


class Clock:
    def __init__(self) -> None:
        self.now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


class ClosedTerminal(Terminal):
    def write(self, text: str) -> int:
        raise OSError(5, "Input/output error")


def test_progress_is_one_line_with_units() -> None:
    assert progress_line(RUNNING, 180.0) == (
        "12.3 / 180 s; RTF 1.0000; agents: 10 running, 0 lost; missed 2 of 1232 ticks;"
        " lateness p50 0.03 p99 0.21 ms; 0 messages lost"
    )


@pytest.mark.parametrize(
    ("value", "words"),
    [
        (None, "-"),
        (7, "7"),
        ("gear", "gear"),
        (0.0012345678, "0.001235"),
        (7144092.875, "7144092.9"),
    ],
)
def test_a_recorded_value_is_short(value: float | str | None, words: str) -> None:
    assert value_words(value) == words


def test_what_is_not_known_yet_is_a_dash() -> None:
    assert rtf_words(Progress()) == "RTF -"
    assert lateness_words(Progress()) == "lateness p50 - p99 - ms"


def test_troubles_and_phases_are_named() -> None:
    line = progress_line(Progress(ready=1, complete=2, lost=3, records_dropped=4), 1.0)

    assert "1 ready, 0 running, 2 complete, 3 lost" in line
    assert "4 records dropped" in line


def test_plain_view_writes_at_state_changes_and_every_ten_seconds() -> None:
    stream, clock = io.StringIO(), Clock()
    view = PlainView(stream, 180.0, now_s=clock)

    view.state("SIMULATION_START")
    for _ in range(50):
        clock.now_s += 0.5
        view.progress(RUNNING)
    view.state("END_HOST")
    view.state("BEGIN_SHUTDOWN")

    lines = stream.getvalue().splitlines()
    assert [line.split(";")[0] for line in lines] == [
        "running",
        "12.3 / 180 s",
        "12.3 / 180 s",
        "shutting down",
    ]


def test_plain_view_shows_no_progress_before_time_runs() -> None:
    stream, clock = io.StringIO(), Clock()
    view = PlainView(stream, 180.0, now_s=clock)

    view.progress(Progress(t_s=-0.3))
    view.progress(Progress())

    assert stream.getvalue() == ""


def test_plain_view_names_each_stage_of_the_work_once() -> None:
    stream = io.StringIO()
    view = PlainView(stream, 180.0, now_s=Clock())

    for what in ("reading agent-01/ticks", "reading agent-02/ticks", "packing", "packing"):
        view.work(what, 0.5)

    assert stream.getvalue().splitlines() == ["reading the records", "packing"]


def test_plain_view_marks_levels() -> None:
    stream = io.StringIO()
    view = PlainView(stream, 1.0, now_s=Clock())

    view.say("a", "info")
    view.say("b", "warning")
    view.say("c", "critical")

    assert stream.getvalue() == "a\nwarning: b\nerror: c\n"


def test_silent_view_shows_errors_and_what_a_person_must_do() -> None:
    stream = io.StringIO()
    view = SilentView(stream, 1.0, now_s=Clock())

    view.state("SIMULATION_START")
    view.progress(RUNNING)
    view.work("packing", 1.0)
    view.say("a", "info")
    view.say("b", "warning")
    view.say("c", "error")
    view.say("d", "manual")

    assert stream.getvalue() == "error: c\nd\n"


def test_plain_view_survives_a_closed_stream() -> None:
    view = PlainView(ClosedTerminal(), 1.0, now_s=Clock())

    view.say("a")
    view.state("SIMULATION_START")
    view.close()


def plain_text(terminal: Terminal) -> str:
    return re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", terminal.getvalue())


@pytest.fixture
def terminal(monkeypatch: pytest.MonkeyPatch) -> Terminal:
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "100")
    monkeypatch.delenv("NO_COLOR", raising=False)
    return Terminal()


def test_live_view_shows_the_run_and_talk_above_it(terminal: Terminal) -> None:
    clock = Clock()
    view = LiveView(terminal, "0007-iridium10", duration_s=180.0, now_s=clock)

    view.state("SIMULATION_START")
    clock.now_s += 1
    view.progress(RUNNING)
    view.say("agent-03 is lost: [silent]", "error")
    view.close()

    text = plain_text(terminal)
    assert "agent-03 is lost: [silent]" in text
    for part in ("0007-iridium10", "running", "12.3 / 180 s", "RTF 1.0000", "missed 2 of 1232"):
        assert part in text


def test_live_view_shows_newest_values_and_second_names_of_the_first_agents(
    terminal: Terminal, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("LINES", "20")
    labels = AgentLabels(column="car", names={"agent-00": "RING 1", "agent-01": "RING 2"})
    clock = Clock()
    view = LiveView(terminal, "0007-cars", duration_s=60.0, labels=labels, now_s=clock)
    values = {f"agent-{number:02}": [0.5 + number, None] for number in range(15)}
    columns = ("drive.speed_m_s", "drive.gear")

    clock.now_s += 1
    view.progress(Progress(columns=columns, values=values, values_left_out=85))
    view.close()

    lines = [" ".join(line.split()) for line in plain_text(terminal).splitlines()]
    assert "agent car drive.speed_m_s drive.gear" in lines
    assert "agent-01 RING 2 1.5 -" in lines
    assert "agent-11 11.5 -" in lines
    assert not any(line.startswith("agent-12") for line in lines)
    assert "and 88 more agents" in lines


def test_live_view_redraws_at_most_four_times_a_second(terminal: Terminal) -> None:
    clock = Clock()
    view = LiveView(terminal, "0007-iridium10", duration_s=180.0, now_s=clock)
    before = plain_text(terminal).count("RTF")

    for _ in range(1000):
        clock.now_s += 0.01
        view.progress(RUNNING)
        view.state("SIMULATION_START")
        view.say("chatter")
        view.work("packing", 0.5)

    redraws = plain_text(terminal).count("RTF") - before
    assert 10 <= redraws <= 41


def test_live_view_bounds_waiting_talk_and_counts_the_rest(terminal: Terminal) -> None:
    view = LiveView(terminal, "0007-iridium10", duration_s=180.0, now_s=Clock())
    view.progress(RUNNING)

    for index in range(1000):
        view.say(f"line {index}", "info")
    view.close()

    text = plain_text(terminal)
    assert text.count("line ") < 250
    assert "lines were too many to show" in text


def test_live_view_keeps_a_command_on_one_line(terminal: Terminal) -> None:
    view = LiveView(terminal, "0007-iridium10", duration_s=180.0, now_s=Clock())
    command = "python -m madns_runtime.agent --launch /tmp/" + "x" * 200

    view.say(command, "manual")
    view.close()

    assert command in plain_text(terminal)


def test_live_view_survives_a_closed_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TERM", "xterm")
    view = LiveView(ClosedTerminal(), "0007-iridium10", duration_s=180.0, now_s=Clock())

    view.state("SIMULATION_START")
    view.progress(RUNNING)
    view.close()


@pytest.mark.parametrize(
    ("stream", "quiet", "kind"),
    [
        (io.StringIO(), False, PlainView),
        (Terminal(), True, SilentView),
        (Terminal(), False, LiveView),
    ],
)
def test_view_fits_standard_error(
    stream: io.StringIO, quiet: bool, kind: type, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setattr("sys.stderr", stream)

    view = factory.make_view("0007-iridium10", 180.0, quiet=quiet)
    view.close()

    assert type(view) is kind


def test_lockstep_shows_its_speed_and_no_lateness():
    progress = Progress(t_s=43_200.0, rtf=412.3456, running=93, ticks=4_017_600, is_lockstep=True)

    assert progress_line(progress, 86_400.0) == (
        "43200.0 / 86400 s; 412.3 x real time; agents: 93 running, 0 lost; 4017600 ticks;"
        " 0 messages lost"
    )
