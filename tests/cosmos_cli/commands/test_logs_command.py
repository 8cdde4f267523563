"""`cosmos logs` shows what a run's processes said, in order, and follows a run that lives until it ends."""

from __future__ import annotations

import dataclasses
import json
import os
import shutil
import signal
import subprocess
import sys
from itertools import islice, pairwise
from pathlib import Path
from queue import SimpleQueue
from types import SimpleNamespace

import pytest
from harness.synthetic_run import MACHINE, SyntheticRun, make_config
from harness.waiting import wait_until

from cosmos_cli.app import run as cosmos
from cosmos_cli.collect import log_follower
from cosmos_cli.evidence import run_log
from cosmos_cli.evidence.run_directory import RunDirectory, begin_run
from cosmos_cli.evidence.run_log import LogReading
from cosmos_cli.fleet.connection import ConnectOptions
from cosmos_cli.fleet.failure import FailureKind, MachineFailure
from cosmos_cli.onboard import log_tail
from cosmos_cli.onboard.request_loop import VerbRequest

HARNESS = Path(__file__).parents[2] / "harness"
PATIENCE_S = 90
SCHEMA = '{"schema":1,"stream":"log","shape":"object","fields":[]}\n'
SCENARIO = """
name: talk
simulation: ./talkative.py:simulation
agents: {count: 2, tick_hz: 10}
time: {duration_s: 3, rtf_tolerance: 100}
deadline: {max_miss_ratio: 1}
timeouts: {agents_ready_s: 120, silence_s: 30, complete_s: 60, shutdown_s: 60}
"""


def record(second, level, text, t_s=None):
    utc = f"2026-01-01T00:00:{second:02d}.000000Z"
    return json.dumps({"t_s": t_s, "utc": utc, "level": level, "text": text}) + "\n"


@pytest.fixture
def made(tmp_path, monkeypatch):
    """A run directory with logs of a host and two agents, and no plan."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("COSMOS_RUNS", raising=False)
    run = tmp_path / "runs" / "0001-x"
    for folder in ("host", "agents/a1", "agents/a2", "machines/here"):
        (run / folder).mkdir(parents=True)
    (run / "host/log.jsonl").write_text(SCHEMA + record(5, "error", "host 5", 1.5))
    (run / "agents/a1/log.jsonl").write_text(
        SCHEMA + record(1, "info", "a1 1") + record(9, "warning", "a1 9") + '{"end":{}}\n'
    )
    (run / "agents/a1/log.2.jsonl").write_text(SCHEMA + record(7, "debug", "a1 again"))
    (run / "agents/a2/log.jsonl").write_text(SCHEMA + record(3, "info", "a2 3"))
    (run / "machines/here/stderr.txt").write_text("Traceback\nValueError\n")
    return run


def texts(capsys, *arguments):
    code = cosmos(["logs", *arguments, "--json"])
    told = capsys.readouterr()
    assert code == 0, told.err
    return [json.loads(line)["text"] for line in told.out.splitlines()]


def test_lines_come_in_order_of_time_and_those_without_one_at_the_end(made, capsys):
    assert texts(capsys) == [
        *("a1 1", "a2 3", "host 5", "a1 again", "a1 9", "Traceback", "ValueError"),
    ]


def write_log(path, zero, *records):
    """Write a stream whose schema, or the line after it as of a host, tells simulated time zero."""
    told = SCHEMA.replace("}\n", f',"t0_utc":"{zero}"}}\n')
    late = SCHEMA.replace("}\n", ',"t0_utc":null}\n') + f'{{"t0_utc":"{zero}"}}\n'
    path.write_text((late if path.parent.name == "host" else told) + "".join(records))


def test_lines_of_boards_whose_clocks_are_years_off_come_in_order_of_time(made, capsys):
    behind, ahead = (
        {"utc": f"{day}T12:00:01Z", "level": "info", "text": f"{day} {clock}"}
        for day, clock in (("2006-05-05", "early"), ("2056-05-05", "late"))
    )
    write_log(made / "host/log.jsonl", "2026-01-01T00:00:00.000000Z", record(2, "info", "host 2"))
    write_log(made / "agents/a1/log.jsonl", "2006-05-05T11:59:58Z", json.dumps(behind) + "\n")
    write_log(made / "agents/a2/log.jsonl", "2056-05-05T12:00:00Z", json.dumps(ahead) + "\n")
    (made / "agents/a1/log.2.jsonl").unlink()

    expected = ["2056-05-05 late", "host 2", "2006-05-05 early", "Traceback", "ValueError"]
    assert texts(capsys) == expected
    assert texts(capsys, "--lines", "4") == expected[1:]


def test_text_kept_beside_an_agents_records_is_told_as_that_agents(made, capsys):
    (made / "agents/a2/flight_stderr.txt").write_text("of a program\n")

    assert texts(capsys, "1", "a2") == ["a2 3", "of a program"]


def test_each_line_says_who_and_when_and_how_loud(made, capsys):
    assert cosmos(["logs", "1", "host"]) == 0

    (line,) = capsys.readouterr().out.splitlines()
    assert line.split() == ["00:00:05.000", "1.500", "host", "error", "host", "5"]


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["1", "a1"], ["a1 1", "a1 again", "a1 9"]),
        (["1", "here"], ["Traceback", "ValueError"]),
        (["--level", "warning"], ["host 5", "a1 9", "Traceback", "ValueError"]),
        (["--lines", "3"], ["a1 9", "Traceback", "ValueError"]),
        (["1", "a1", "-n", "1"], ["a1 9"]),
        (["-f"], ["a1 1", "a2 3", "host 5", "a1 again", "a1 9", "Traceback", "ValueError"]),
    ],
)
def test_part_of_a_log_can_be_had(made, capsys, arguments, expected):
    assert texts(capsys, *arguments) == expected


def test_an_agent_is_found_by_its_second_name_and_several_of_one_are_named(made, capsys):
    labels = {"a1": "north", "a2": "south"}
    (made / "plan.json").write_text(json.dumps({"labels": {"column": "tram", "names": labels}}))
    assert texts(capsys, "1", "south") == ["a2 3"]
    labels["a1"] = "south"
    (made / "plan.json").write_text(json.dumps({"labels": {"column": "tram", "names": labels}}))

    assert cosmos(["logs", "1", "south"]) == 2
    assert "2 agents are called 'south'; name one: a1, a2" in capsys.readouterr().err


def test_text_of_others_cannot_steer_a_terminal_nor_speak_for_another(made, capsys):
    (made / "agents/a1/log.jsonl").write_text(
        SCHEMA + record(1, "info", "\x1b[2Jgone\n00:00:05.000  host  error  forged")
    )
    assert cosmos(["logs", "1", "a1", "-n", "9"]) == 0

    first, second, *_ = capsys.readouterr().out.splitlines()
    assert first.endswith(r"\x1b[2Jgone")
    assert second.startswith("00:00:01.000") and " a1 " in second


def test_what_is_no_record_is_counted(made, capsys):
    with (made / "agents/a1/log.jsonl").open("ab") as file:
        file.write(
            b'{"half\n[1, 2]\n\xff\xfe\n{"t_s": NaN, "text": "odd", "level": {}, "utc": 7}\n'
        )

    assert "odd" in texts(capsys, "1", "a1")
    cosmos(["logs", "1", "a1"])
    assert "3 lines could not be read" in capsys.readouterr().err


def test_long_text_is_cut_and_says_so(made, capsys, monkeypatch):
    monkeypatch.setattr(run_log, "TEXT_CHARACTERS_MAX", 10)
    (made / "agents/a1/log.jsonl").write_text(SCHEMA + record(1, "info", "x" * 25))

    assert "x" * 10 + "... (15 more characters)" in texts(capsys)


def test_lines_left_out_are_counted(made, capsys, monkeypatch):
    monkeypatch.setattr("cosmos_cli.commands.logs.LINES_DEFAULT", 2)

    assert cosmos(["logs"]) == 0
    assert "5 earlier lines left out" in capsys.readouterr().err


def test_run_that_said_nothing_says_so(made, capsys):
    for path in made.rglob("*.*"):
        path.unlink()

    assert cosmos(["logs"]) == 0
    assert "0001-x: nothing was said" in capsys.readouterr().err


@pytest.mark.parametrize(("mode", "place"), [("realtime", MACHINE), ("lockstep", "host")])
def test_agent_that_said_nothing_is_told_with_where_its_process_prints(
    tmp_path, monkeypatch, capsys, mode, place
):
    config = make_config()
    config = dataclasses.replace(config, time=dataclasses.replace(config.time, mode=mode))
    run = SyntheticRun(tmp_path / "runs", config).run
    begin_run(run, config, {"machines": {MACHINE: {"agents": ["agent-01", "agent-02"]}}})
    monkeypatch.chdir(tmp_path)

    assert cosmos(["logs", "last", "agent-01"]) == 0
    err = capsys.readouterr().err
    assert err.endswith(f"; what its process printed: cosmos logs {run.shell_path} {place}\n")

    assert cosmos(["logs"]) == 0
    assert "its process" not in capsys.readouterr().err


def test_run_that_said_something_is_not_called_silent(made, capsys):
    assert cosmos(["logs", "-n", "0"]) == 0
    assert capsys.readouterr().err == ""

    assert cosmos(["logs", "1", "a2", "--level", "error"]) == 0
    assert capsys.readouterr().err == "0001-x: nothing as loud as error was said\n"


def test_only_whole_lines_are_told_and_each_once(made):
    path = made / "host/log.jsonl"
    reading = LogReading()
    path.write_text(SCHEMA + record(1, "info", "one") + record(2, "info", "two")[:20])
    first = [line.text for portion in reading.read_here(made) for line in portion]
    path.write_text(SCHEMA + record(1, "info", "one") + record(2, "info", "two"))
    second = [line.text for portion in reading.read_here(made) for line in portion]

    assert "one" in first and "two" not in first
    assert second == ["two"]


@pytest.mark.parametrize("arguments", [(), ("-f",)])
def test_last_line_of_a_text_needs_no_end_once_nothing_lives(made, capsys, arguments):
    path = made / "machines/here/stderr.txt"
    path.write_text("one line\nfatal: no newline")
    (made / "agents/a2/flight_stderr.txt").write_text("the line before a crash")

    told = texts(capsys, "1", *arguments)

    assert {"one line", "fatal: no newline", "the line before a crash"} <= set(told)


def test_machine_on_which_nothing_lives_tells_the_last_line_of_a_text(made, tmp_path):
    (made / "machines/here/stderr.txt").write_text("fatal: no newline")
    arguments = {"directory": str(made), "state": str(tmp_path / "state"), "offsets": {}}

    told = log_tail.tail(VerbRequest(arguments=arguments, body=b""))

    assert told["files"]["machines/here/stderr.txt"]["text"] == "fatal: no newline"


def test_last_line_of_a_text_waits_for_its_end_while_the_run_lives(made):
    path = made / "machines/here/stderr.txt"
    path.write_text("half a li")
    reading = LogReading(source="here")
    first = [line.text for portion in reading.read_here(made) for line in portion]
    path.write_text("half a line\nthe la")
    second = [line.text for portion in reading.read_here(made) for line in portion]
    third = [line.text for portion in reading.read_here(made, is_ended=True) for line in portion]

    assert (first, second, third) == ([], ["half a line"], ["the la"])


def test_record_of_any_length_a_recorder_writes_is_told(made, capsys):
    long = "é" * 100_000
    (made / "agents/a1/log.jsonl").write_text(
        SCHEMA + record(1, "info", long) + record(2, "info", "behind it")
    )

    assert cosmos(["logs", "1", "a1", "--json"]) == 0

    captured = capsys.readouterr()
    told = [json.loads(line)["text"] for line in captured.out.splitlines()]
    assert told[0].startswith("éé") and told[0].endswith("(96000 more characters)")
    assert "behind it" in told
    assert captured.err == ""


def test_answer_with_long_records_is_bounded(made):
    for folder in ("agents/a1", "agents/a2", "host"):
        (made / folder / "log.jsonl").write_text(record(1, "info", "x" * 1_000_000))

    portions = [log_tail.read_tails(str(made), {})]
    reading = LogReading()
    told = [line.text[0] for portion in reading.read_here(made) for line in portion]

    assert sum(len(f["text"]) for f in portions[0]["files"].values()) <= log_tail.ANSWER_BYTES_MAX
    assert portions[0]["more"]
    assert told.count("x") == 3


def test_file_of_any_size_is_told_in_bounded_portions(made, monkeypatch):
    monkeypatch.setattr(log_tail, "FILE_BYTES_MAX", 300)
    monkeypatch.setattr(log_tail, "ANSWER_BYTES_MAX", 500)
    lines = [record(second, "info", f"line {second}") for second in range(50)]
    (made / "agents/a1/log.jsonl").write_text(SCHEMA + "".join(lines))
    (made / "agents/a2/log.jsonl").write_text(SCHEMA + "".join(lines))
    reading = LogReading()

    portions = list(reading.read_here(made))

    told = [line for portion in portions for line in portion if line.source == "a1"]
    said = [line.text for line in told if line.text.startswith("line")]
    assert said == [f"line {second}" for second in range(50)]
    assert max(sum(len(line.text) for line in portion) for portion in portions) < 500
    assert reading.damaged == 0


def test_links_and_pipes_in_the_place_of_a_log_are_not_read(made, capsys, tmp_path):
    secret = tmp_path / "secret"
    secret.write_text("secret\n")
    (made / "host/stderr.txt").symlink_to(secret)
    (made / "machines/other").mkdir()
    os.mkfifo(made / "machines/other/stderr.txt")

    assert "secret" not in texts(capsys)


def test_what_a_machine_tells_again_is_taken_once(made):
    """While records are fetched, a file is told by the machine and by its copy here."""
    reading = LogReading()
    list(reading.read_here(made))
    again = {"host/log.jsonl": {"start": 0, "end": 99, "text": record(1, "info", "again")}}

    assert reading.take(again) == []


@pytest.fixture
def talking(tmp_path, monkeypatch):
    """A scenario whose host and agents talk."""
    shutil.copy(HARNESS / "talkative.py", tmp_path)
    (tmp_path / "talk.yaml").write_text(SCENARIO)
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("COSMOS_RUNS", raising=False)
    return tmp_path


def start(*words):
    return subprocess.Popen(
        [sys.executable, "-m", "cosmos_cli.app", *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        stdin=subprocess.DEVNULL,
        text=True,
    )


def wait_for_a_log(folder):
    wait_until(lambda: list(folder.glob("runs/*/agents/*/log.jsonl")), "log")


@pytest.mark.process
def test_run_that_lives_is_followed_until_it_ends(talking, capsys):
    run = start("run", "talk.yaml", "--no-report", "--quiet")
    try:
        wait_for_a_log(talking)
        follower = start("logs", "-f", "--json")
        out, err = follower.communicate(timeout=PATIENCE_S)
        assert run.wait(PATIENCE_S) == 0
    finally:
        run.kill()

    followed = [json.loads(line) for line in out.splitlines()]
    assert follower.returncode == 0
    assert "0001-talk has ended" in err
    assert cosmos(["logs", "--json"]) == 0
    whole = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert sorted(map(str, followed)) == sorted(map(str, whole))
    assert {"the host begins", "wrong 20", "a word on stderr"} <= {line["text"] for line in whole}
    assert {line["source"] for line in whole} == {"host", "agent-01", "agent-02", "loopback"}


@pytest.mark.process
def test_follower_ends_on_ctrl_c_and_the_run_goes_on(talking):
    run = start("run", "talk.yaml", "--no-report", "--quiet", "--duration", "60")
    try:
        wait_for_a_log(talking)
        follower = start("logs", "-f")
        assert follower.stdout.readline()
        follower.send_signal(signal.SIGINT)
        follower.communicate(timeout=PATIENCE_S)
        assert follower.returncode == 130
        assert run.poll() is None
    finally:
        run.send_signal(signal.SIGINT)
        run.communicate(timeout=PATIENCE_S)


@pytest.mark.process
def test_agent_that_the_run_has_not_is_bad_input(talking, capsys):
    assert start("run", "talk.yaml", "--no-report", "--quiet").wait(PATIENCE_S) == 0

    assert cosmos(["logs", "last", "agent-3"]) == 2
    assert "no agent, host or machine named agent-3, did you mean" in capsys.readouterr().err
    assert cosmos(["logs", "last", "nobody"]) == 2
    told = capsys.readouterr().err
    assert "named nobody; there are host, agent-01, " in told
    assert ", and as machines loopback" in told


@pytest.fixture
def elsewhere(made):
    """The same run, of which a machine holds a part that is not here yet."""
    target = {"name": "pi01", "address": "192.0.2.1"}
    machines = {"pi01": {"agents": ["a2"], "target": target}}
    (made / "plan.json").write_text(json.dumps({"session": "00" * 16, "machines": machines}))
    return made


@pytest.mark.parametrize("arguments", [(), ("--follow",)])
def test_fault_of_the_operators_own_ssh_configuration_is_told(
    elsewhere, capsys, monkeypatch, arguments
):
    monkeypatch.setenv("COSMOS_SSH_CONFIG", "/nonexistent/config")

    code = cosmos(["logs", *arguments])

    assert code == 2
    assert "COSMOS_SSH_CONFIG: /nonexistent/config: no such file" in capsys.readouterr().err


def test_surprise_at_a_machine_is_its_failure_and_all_else_is_told(elsewhere, capsys, monkeypatch):
    def connect(target, options):
        raise ZeroDivisionError("nobody thought of it")

    monkeypatch.setattr(log_follower, "connect", connect)

    code = cosmos(["logs"])
    told = capsys.readouterr()

    assert code == 3
    assert "pi01: its log cannot be read: unexpected ZeroDivisionError" in told.err
    assert "host 5" in told.out


def test_machine_that_is_not_found_may_have_moved(elsewhere, capsys, monkeypatch, tmp_path):
    def connect(target, options):
        raise MachineFailure(FailureKind.REFUSED, "nobody listens")

    monkeypatch.setattr(log_follower, "connect", connect)
    inventory = tmp_path / "i.yaml"
    inventory.write_text("all: {hosts: {pi01: {ansible_host: 192.0.2.3}}}\n")

    assert cosmos(["logs"]) == 3
    assert f"at another address by now? cosmos logs {elsewhere} -i FILE" in capsys.readouterr().err
    assert cosmos(["logs", "-i", str(inventory)]) == 3
    assert "at another address" not in capsys.readouterr().err


def fails_first(*failures):
    """Return what asks a machine: it fails so often, then tells one line and that the run has ended."""
    coming = list(failures)
    text = record(8, "info", "back again")
    told = {"files": {"agents/a3/log.jsonl": {"start": 0, "end": len(text), "text": text}}}

    def ask(self, source, offsets, *, is_following):
        if coming:
            raise coming.pop(0)
        self._stop.wait(0.2)  # who would not wait for it has ended by then
        ended = {**told, "living": False, "more": False}
        self._answers.put(log_follower._Answered(source.machine, told=ended))

    return ask


@pytest.fixture
def hosted(elsewhere, monkeypatch):
    """The same, with the host on that machine, which is asked again at once."""
    plan = json.loads((elsewhere / "plan.json").read_text())
    plan["host"] = {"target": plan["machines"]["pi01"]["target"]}
    (elsewhere / "plan.json").write_text(json.dumps(plan))
    monkeypatch.setattr(log_follower, "AGAIN_S", 0.0)
    monkeypatch.setattr(log_follower, "LOOK_INTERVAL_S", 0.0)
    return elsewhere


AWAY = [MachineFailure(kind, "away") for kind in (FailureKind.LOST, FailureKind.REFUSED)]


def test_the_hosts_machine_is_followed_again_when_it_is_back(hosted, capsys, monkeypatch):
    monkeypatch.setattr(log_follower.LogFollower, "_ask_connected", fails_first(*AWAY))

    code = cosmos(["logs", "--follow"])
    told = capsys.readouterr()

    assert "back again" in told.out
    assert told.err.count("pi01: its log cannot be read: away") == 1
    assert code == 0


@pytest.mark.parametrize(
    ("failure", "absence_s"),
    [(AWAY[0], 0.0), (MachineFailure(FailureKind.AUTHENTICATION, "away"), 60.0)],
)
def test_the_hosts_machine_is_not_waited_for_without_end(
    hosted, capsys, monkeypatch, failure, absence_s
):
    monkeypatch.setattr(log_follower, "ABSENCE_S", absence_s)
    monkeypatch.setattr(log_follower, "AGAIN_S", 60.0)
    monkeypatch.setattr(log_follower.LogFollower, "_ask_connected", fails_first(failure))

    code = cosmos(["logs", "--follow"])
    told = capsys.readouterr()

    assert code == 3
    assert "back again" not in told.out
    assert "has ended" not in told.err
    assert "0001-x: pi01, its host's machine, gives no answer" in told.err


class AnswersAtOnce(SimpleQueue):
    """A queue into which all answers come in just the moment in which they are waited for."""

    def __init__(self, answers):
        super().__init__()
        self.coming = list(answers)

    def get(self, block=True, timeout=None):
        for answer in self.coming if block else ():
            self.put(answer)
        self.coming = self.coming if not block else []
        return super().get(block, timeout)


def test_answers_of_a_machine_are_taken_in_their_order_whenever_they_come(made, monkeypatch):
    first, second = (record(second, "info", f"a2 {second}") for second in (7, 8))
    ends = (0, len(first), len(first + second))
    answers = [
        log_follower._Answered(
            "pi01",
            told={
                "files": {"agents/a3/log.jsonl": {"start": start, "end": end, "text": text}},
                "living": False,
                "more": text is first,
            },
        )
        for (start, end), text in zip(pairwise(ends), (first, second), strict=True)
    ]
    monkeypatch.setattr(log_follower.LogFollower, "_ask", lambda *_: None)
    follower = log_follower.LogFollower(
        run=RunDirectory(made),
        sources=[SimpleNamespace(machine="pi01")],
        reading=LogReading(source="a3"),
        options=ConnectOptions(),
        on_failure=lambda *_: None,
        _answers=AnswersAtOnce(answers),
    )

    portions = follower.lines(is_following=False)
    told = [line.text for portion in islice(portions, 20) for line in portion]

    assert told == ["a2 7", "a2 8"]
    assert next(portions, None) is None  # nobody is waited for any more


@pytest.mark.parametrize(
    ("words", "kind"), [(["99"], "input"), (["--nope"], "usage"), (["--lines", "x"], "usage")]
)
def test_error_as_json_is_one_line_as_all_of_its_lines_are(tmp_path, capsys, words, kind):
    assert cosmos(["logs", "--runs", str(tmp_path), "--json", *words]) == 2

    (line,) = capsys.readouterr().out.splitlines()
    assert json.loads(line)["error"]["kind"] == kind
