"""A program that flies a vehicle ends with its agent, also where other agents' process goes on."""

import json

import pytest
from harness.cosmos_command import LOOSE, CosmosCommand

pytestmark = pytest.mark.process

PROGRAM = """
import json, os, sys, time

name = json.loads(sys.stdin.readline())["setup"]["name"]
before = open(name + ".pid").read() if os.path.exists(name + ".pid") else None
open(name + ".pid", "w").write(str(os.getpid()))
lives = before is not None and os.path.exists("/proc/" + before)
print("born", file=sys.stderr, flush=True)
for line in sys.stdin:
    print(json.dumps({"estimate": {"lives_count": int(lives)}}), flush=True)
time.sleep(20)  # whoever only closes its input waits for so long
"""
SCENARIO = """
name: lost
simulation: constellation
agents: {count: 2, tick_hz: 10, per_process: 2}
time: {duration_s: 4}
on_agent_loss: continue
parameters:
  satellites: {walker: "56:2/1/0", altitude_km: 780}
  propagator: {kind: scipy, forces: [two_body]}
  flight:
    - {agents: [agent-01], command: [python3, program.py], answer_s: 20}
timeline: [{at_s: 1, action: kill, agents: [agent-01], for_s: 0.5}]
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
