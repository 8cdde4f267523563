"""What was typed or stands in a file cannot look like a message of its own: its ends of lines are told."""

import pytest

from cosmos_cli.app import run
from cosmos_cli.errors import Fault

HOSTILE = "a\nall: PASSED\r\n\x1b[31mb"
SCENARIO = "{{name: a, simulation: counter, time: {{duration_s: 1}}, agents: {{count: 1, tick_hz: 1}}, {} }}"


@pytest.mark.parametrize(
    "arguments",
    [
        ["collect", HOSTILE],
        ["report", HOSTILE],
        ["diff", HOSTILE, "x"],
        ["down", HOSTILE],
        ["logs", "x", "--runs", HOSTILE],
        ["tabulate", "x", f"--runs={HOSTILE}"],
        ["devices", HOSTILE],
        ["ps", "--limit", HOSTILE],
        ["validate", "a.yaml", "--set", HOSTILE],
        ["validate", "a.yaml", "--set", f"{HOSTILE}=3"],
        ["validate", HOSTILE],
    ],
    ids=lambda arguments: " ".join(arguments).encode("unicode_escape").decode(),
)
def test_an_argument_stands_on_one_line_of_an_error(tmp_path, monkeypatch, capsys, arguments):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a.yaml").write_text(SCENARIO.format(""))

    assert run(arguments) == 2
    told = capsys.readouterr().err
    assert r"a\nall: PASSED" in told
    assert not [line for line in told.splitlines() if line.startswith("all:")]
    assert "\x1b" not in told and "\r" not in told


@pytest.mark.parametrize(
    "part",
    [
        r'"a\nall: PASSED": 1',
        r'executor: {kind: process, "a\nall: PASSED": 1}',
        r'executor: {kind: "a\nall: PASSED", address: "b:1"}',
    ],
)
def test_no_line_of_a_file_begins_where_a_fault_does(tmp_path, monkeypatch, capsys, part):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a.yaml").write_text(SCENARIO.format(part))

    assert run(["validate", "a.yaml"]) == 2
    told = capsys.readouterr().err
    assert not [line for line in told.splitlines() if line.startswith("all:")]


def test_a_fault_tells_ends_of_lines_and_keeps_its_caret():
    fault = Fault(
        text="expected 1\ngot 2", path="x\ny", file="f\n", line=1, column=3, source="a\nb"
    )

    assert fault.render() == "f\\n:1:3: x\\ny: expected 1\n    got 2\n    a b\n      ^"
