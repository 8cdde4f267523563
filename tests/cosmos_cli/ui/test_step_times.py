"""-v tells how long each step of each machine took, on stderr, and nothing without it."""

from __future__ import annotations

import re
import subprocess
import sys

import pytest

from cosmos_cli.app import run as cosmos
from cosmos_cli.commands.command_group import TIMED, load_command
from cosmos_cli.ui import step_times

SCENARIO = """
name: timed
simulation: counter
agents: {count: 1, tick_hz: 10}
time: {duration_s: 1, rtf_tolerance: 100}
deadline: {max_miss_ratio: 1}
timeouts: {agents_ready_s: 120, silence_s: 30, complete_s: 60}
"""
LINE = re.compile(r" +\d+\.\d{3} s  ([^:]+): (.+)")


@pytest.fixture(autouse=True)
def off_again():
    yield
    step_times.set_verbosity(0)


@pytest.fixture
def inventory(tmp_path, monkeypatch):
    monkeypatch.setenv("COSMOS_STATE_DIR", str(tmp_path / "state"))
    monkeypatch.setenv("COSMOS_CACHE", str(tmp_path / "cache"))
    for name in ("COSMOS_INVENTORY", "COSMOS_LIMIT", "COSMOS_FORKS", "COSMOS_RUNS"):
        monkeypatch.delenv(name, raising=False)
    path = tmp_path / "i.yaml"
    path.write_text("all: {hosts: {here: {ansible_connection: local, ansible_become: false}}}\n")
    return str(path)


def steps(text):
    return [found.groups() for line in text.splitlines() if (found := LINE.fullmatch(line))]


@pytest.mark.process
def test_nothing_is_told_unless_it_is_asked_for(inventory, capsys):
    assert cosmos(["facts", "-i", inventory]) == 0

    assert steps(capsys.readouterr().err) == []


@pytest.mark.process
@pytest.mark.parametrize(
    ("option", "expected"),
    [
        ("-v", ["start the helper there", "all of it"]),
        ("-vv", ["start the helper there", "ask: facts", "all of it"]),
        ("-vvvv", ["start the helper there", "ask: facts", "all of it"]),
    ],
)
def test_steps_are_told_and_questions_if_asked_twice(inventory, capsys, option, expected):
    assert cosmos(["facts", "-i", inventory, option, "--json"]) == 0

    assert steps(capsys.readouterr().err) == [("here", step) for step in expected]


def test_step_that_fails_is_told_too(inventory, capsys):
    assert cosmos(["ping", "-i", "no-such-machine.invalid,", "-v"]) == 3

    assert steps(capsys.readouterr().err) == [
        ("no-such-machine.invalid", "connect (failed)"),
        ("no-such-machine.invalid", "all of it (failed)"),
    ]


@pytest.mark.process
def test_phases_of_a_run_are_told(inventory, tmp_path):
    (tmp_path / "s.yaml").write_text(SCENARIO)
    command = [sys.executable, "-m", "cosmos_cli.app", "run", "s.yaml", "-v", "--no-report"]
    done = subprocess.run(
        command, cwd=tmp_path, capture_output=True, text=True, timeout=120, check=False
    )

    told = steps(done.stderr)
    assert done.returncode == 0, done.stderr
    assert {machine for machine, _ in told} == {"0001-timed"}
    assert {"running", "reading the records", "packing"} <= {step for _, step in told}


@pytest.mark.parametrize("verb", TIMED)
def test_option_is_the_same_for_every_command(verb):
    (option,) = [p for p in load_command(verb).params if p.name == "verbose"]

    assert option.opts == ["--verbose", "-v"]


def test_phase_ends_when_another_begins(capsys):
    step_times.set_verbosity(1)
    now_s = iter([0.0, 1.0, 3.5, 4.0])
    phases = step_times.Phases("r", now_s=lambda: next(now_s))
    for step in ("a", "a", "b", ""):
        phases.begin(step)

    assert capsys.readouterr().err == "    2.500 s  r: a\n    0.500 s  r: b\n"
