"""
Code that hangs, or ends the process, while it is imported or asked: the command fails, and names file and stage.

Real processes; which of them the plug-in misbehaves in is told to it by its environment.
"""

from __future__ import annotations

from pathlib import Path

import pytest
from harness.cosmos_command import CosmosCommand

pytestmark = pytest.mark.process

PLUGIN = """
from __future__ import annotations
import os, signal, sys, time, traceback
from dataclasses import dataclass
from madns_runtime.plugin.api import AgentSimulation, Demand, Simulation

def misbehave(stage):
    if os.environ.get("COSMOS_TEST_STAGE") != stage:
        return
    match os.environ["COSMOS_TEST_MISDEED"]:
        case "exit":
            os._exit(0)
        case "kill":
            os.kill(os.getpid(), signal.SIGKILL)
        case "loop":
            while True:
                pass
        case "deaf":
            while True:
                try:
                    while True:
                        time.sleep(0.01)
                except BaseException:
                    pass

def process():
    files = {os.path.basename(frame.filename) for frame in traceback.extract_stack()}
    if "supervisor.py" in files or "worker.py" in files:
        return "agent"
    return "operator" if "cosmos_cli.app" in sys.modules or "typer" in sys.modules else "host"

misbehave(process())

@dataclass(frozen=True, kw_only=True)
class Parameters:
    gain: float = 1.0
    def __post_init__(self):
        misbehave("parameters")

class Agent(AgentSimulation):
    pass

def check(parameters, agents, base_directory):
    misbehave("check")
    return []

def demand(parameters, agents, tick_hz, base_directory):
    misbehave("demand")

simulation = Simulation(
    name="odd", parameters=Parameters, agent=":Agent", check=":check", demand=":demand"
)
"""
SCENARIO = """
name: odd
simulation: ./odd.py:simulation
agents: {count: 2}
time: {duration_s: 1}
timeouts: {loading_s: 2, agents_ready_s: 120}
"""
FLIGHT = """
name: odd
simulation: constellation
agents: {count: 1}
time: {duration_s: 1, mode: lockstep}
timeouts: {loading_s: 2, agents_ready_s: 120}
parameters:
  satellites: {elements: one.tle}
  flight: ./odd.py:Flight
"""
ONE_TLE = """\
IRIDIUM 8
1 24792U 97020A   17066.30480103  .00000181  00000-0  57411-4 0  9993
2 24792  86.4004   1.2813 0002235  84.4150 275.7300 14.34220922 38595
"""
ONE = ("--set", "agents.count=1")
"""Each agent that loops takes a core."""


@pytest.fixture
def answer(tmp_path: Path):
    """Return a function that runs a command while the plug-in misbehaves, and returns its exit code and words."""
    (tmp_path / "odd.py").write_text(PLUGIN)
    (tmp_path / "a.yaml").write_text(SCENARIO)

    def run(stage: str, misdeed: str, *arguments: str) -> tuple[int, str]:
        told = {"COSMOS_TEST_STAGE": stage, "COSMOS_TEST_MISDEED": misdeed}
        done = CosmosCommand(tmp_path, **told)(*arguments)
        return done.returncode, done.stdout + done.stderr

    return run


def line_of(text: str) -> int:
    return PLUGIN.splitlines().index(text) + 1


@pytest.mark.parametrize(
    ("misdeed", "told"),
    [
        ("exit", f"odd.py:{line_of('            os._exit(0)')}: it called os._exit(0)"),
        ("loop", ": it was not done within 2 s"),
        ("kill", "importing ./odd.py:simulation: its process was killed by SIGKILL without a word"),
        ("deaf", "importing ./odd.py:simulation: its process exited with code 70 without a word"),
    ],
)
def test_an_import_that_never_comes_back_is_a_fault(answer, misdeed, told):
    code, words = answer("operator", misdeed, "validate", "a.yaml")

    assert (code, told in words) == (2, True), words
    assert words.count("a.yaml:3:13: simulation: ") == 1


@pytest.mark.parametrize("command", ["run", "plan"])
def test_no_command_ends_green_with_such_a_file(answer, command):
    code, words = answer("operator", "exit", command, "a.yaml")

    assert (code, "it called os._exit(0)" in words) == (2, True), words


@pytest.mark.parametrize(
    ("stage", "command", "told"),
    [
        ("parameters", "validate", "Parameters: it called os._exit(0)"),
        ("check", "validate", "check(): it called os._exit(0)"),
        ("demand", "plan", "demand(): it called os._exit(0)"),
    ],
)
def test_a_question_that_ends_the_process_is_named(answer, stage, command, told):
    code, words = answer(stage, "exit", command, "a.yaml")

    assert (code, told in words) == (2, True), words


@pytest.mark.parametrize(
    ("stage", "command", "told"),
    [
        ("parameters", "validate", "Parameters: it was not done within 2 s"),
        ("check", "validate", "check() of odd: its process was killed by SIGKILL without a word"),
        ("demand", "plan", "demand() of ./odd.py:simulation: its process was killed by SIGKILL"),
    ],
)
def test_a_question_without_an_answer_is_named(answer, stage, command, told):
    misdeed = "loop" if "not done" in told else "kill"
    code, words = answer(stage, misdeed, command, "a.yaml")

    assert (code, told in words) == (2, True), words


@pytest.mark.parametrize(
    ("process", "misdeed", "told"),
    [
        ("host", "kill", "was killed by SIGKILL while importing ./odd.py:simulation"),
        ("agent", "loop", "it was not done within 2 s"),
        ("agent", "kill", "was killed by SIGKILL while importing ./odd.py:simulation"),
    ],
)
def test_a_run_names_what_its_processes_were_importing(answer, process, misdeed, told):
    code, words = answer(process, misdeed, "run", "a.yaml", *(ONE if misdeed == "loop" else ()))
    verdict = next(line for line in words.splitlines() if line.startswith("FAILED: "))

    assert (code in (1, 3), told in verdict) == (True, True), words
    assert "odd.py" in verdict


def test_lockstep_names_the_line_as_well(answer):
    code, words = answer("agent", "loop", "run", "a.yaml", *("--set", "time.mode=lockstep"), *ONE)

    assert (code, "odd.py" in words, "it was not done within 2 s" in words) == (1, True, True)


@pytest.mark.nightly
def test_flight_software_is_held_to_the_same(answer, tmp_path):
    (tmp_path / "odd.py").write_text("while True: pass\nclass Flight: pass\n")
    (tmp_path / "one.tle").write_text(ONE_TLE)
    (tmp_path / "f.yaml").write_text(FLIGHT)
    code, words = answer("", "", "run", "f.yaml")

    assert (code, "odd.py:1: it was not done within 2 s" in words) == (1, True), words
