"""A program that flies a vehicle ends with its agent, also where other agents' process goes on."""

import json
import subprocess
import sys

import pytest
from harness.cosmos_command import LOOSE, CosmosCommand
from test_flight_process import Ship, patience  # noqa: F401 - a fixture

from madns_runtime.errors import BlamedError
from madns_runtime.simulations.constellation.flight.interface import program

pytestmark = pytest.mark.process

PROGRAM = """
import json, os, sys, time

name = json.loads(sys.stdin.readline())["setup"]["name"]
before = open(name + ".pid").read() if os.path.exists(name + ".pid") else None
open(name + ".pid", "w").write(str(os.getpid()))
lives = before is not None and os.path.exists("/proc/" + before)
print("born", file=sys.stderr, flush=True)
for line in sys.stdin:
    births = 1 + (before is not None)
    print(json.dumps({"estimate": {"lives_count": int(lives), "births_count": births}}), flush=True)
time.sleep(20)  # whoever only closes its input waits for so long
"""
SCENARIO = """
name: lost
simulation: constellation
agents: {count: 2, tick_hz: 10, per_process: 2}
time: {duration_s: 120}
on_agent_loss: continue
parameters:
  satellites: {walker: "56:2/1/0", altitude_km: 780}
  propagator: {kind: scipy, forces: [two_body]}
  flight:
    - {agents: [agent-01], command: [python3, program.py], answer_s: 20}
timeline:
  - {when: {stream: estimates, field: births_count, above: 0}, action: kill, agents: [agent-01], for_s: 0.5}
  - {when: {stream: estimates, field: births_count, above: 1}, action: stop}
"""


@pytest.mark.parametrize("mode", ["lockstep", "realtime"])
def test_the_program_of_an_agent_that_is_killed_is_gone_when_the_next_one_starts(tmp_path, mode):
    (tmp_path / "program.py").write_text(PROGRAM)
    (tmp_path / "lost.yaml").write_text(SCENARIO)
    cosmos = CosmosCommand(tmp_path)

    code, document = cosmos.run(tmp_path / "lost.yaml", *LOOSE, f"time.mode={mode}")

    assert document["status"] == "complete" and code in (0, 4), document["verdict"]
    assert document["agents"]["incarnations"] == {"agent-01": 2}
    folder = cosmos.directory(document) / "agents" / "agent-01"
    lines = (folder / "estimates.2.jsonl").read_text().splitlines()
    lives = [row[1] for row in map(json.loads, lines) if isinstance(row, list)]
    assert lives and set(lives) == {0}
    # What the first one said is kept, too.
    assert (folder / "flight_stderr.txt").read_text().count("born") == 2


def test_a_program_that_cannot_be_told_who_it_is_does_not_live_on(tmp_path, monkeypatch):
    started = []

    class Started(subprocess.Popen):
        def __init__(self, *arguments, **options):
            super().__init__(*arguments, **options)
            started.append(self)

    monkeypatch.setattr(program.subprocess, "Popen", Started)
    command = [sys.executable, "-c", "import time; time.sleep(60)"]
    with pytest.raises(BlamedError, match="no room for its setup"):
        Ship(tmp_path, command, flight={"settings": {"text": "x" * 2_000_000}})

    assert [each.poll() is not None for each in started] == [True]
