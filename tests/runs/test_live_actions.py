"""Actions ordered while a run goes on, by the words of a timeline."""

import json

import pytest
import yaml
from harness.cosmos_command import CosmosCommand
from harness.waiting import wait_until

pytestmark = pytest.mark.process

PATIENCE_S = 120.0
REFUSED = [
    (("run", "annotate"), "missing text"),
    (("run", "annotate", "text=a", "txt=b"), "unknown txt"),
    (("run", "annotate", "text=''"), "at least 1"),
    (("run", "annotate", "text=a", "for_s=-1"), "more than 0 s"),
    (("run", "stop", "for_s=3"), "has no end"),
    (("agent-01", "stop"), "expected 'run', got 'agent-01'"),
    (("agent-01", "explode"), "there are annotate, stop"),
    (("car-*", "device_fault", "device=a", "fault=freeze"), "no agent is named car-*"),
    (("agent-01", "device_fault", "device=a", "fault=melt"), "expected one of"),
]


def test_orders_are_taken_listed_refused_and_recorded_and_a_stop_completes_the_run(tmp_path):
    cosmos = CosmosCommand(tmp_path)
    scenario = {
        "name": "live",
        "simulation": "counter",
        "agents": {"count": 2, "tick_hz": 10},
        "time": {"mode": "lockstep", "duration_s": 1e7},
    }
    path = tmp_path / "live.yaml"
    path.write_text(yaml.safe_dump(scenario))

    def inject(*arguments):
        done = cosmos("inject", "last", *arguments, "--json")
        return done.returncode, json.loads(done.stdout) if done.stdout else done.stderr

    with cosmos.start_run(path) as run:
        wait_until(
            lambda: list(cosmos.runs.glob("*/.actions.sock")),
            "the run's socket for actions",
            process=run,
        )
        assert inject("run", "annotate", "text=hello", "for_s=1e7")[0] == 0
        assert inject("run", "annotate", "text=5", "for_s=1e7")[0] == 0
        code, listed = inject("--list")
        refusals = [(inject(*arguments), words) for arguments, words in REFUSED]
        slowed = inject("agent-0*", "slow", "factor=2", "for_s=10")
        stopped, _ = inject("run", "stop")
        out, _ = run.communicate(timeout=PATIENCE_S)

    assert (code, slowed[0], stopped) == (0, 0, 0), slowed
    assert {"annotate", "stop", "device_fault", "slow", "kill"} <= {
        each["action"] for each in listed["actions"]
    }
    assert [e["parameters"] for e in listed["actions"] if e["action"] == "slow"] == [["factor"]]
    # Of real time alone.
    assert not {"stress", "step_clock", "drift_clock"} & {e["action"] for e in listed["actions"]}
    assert [each["parameters"] for each in listed["in_force"]] == [{"text": "hello"}, {"text": "5"}]
    for (code, answer), words in refusals:
        assert code == 1, answer
        assert words in answer["refusal"]
    result = json.loads(out)
    assert (result["exit_code"], result["status"]) == (0, "complete")
    assert result["duration_s"] < 1e7
    lines = (cosmos.directory(result) / "host" / "events.jsonl").read_text().splitlines()
    found = [e["action"] for e in map(json.loads, lines) if e.get("event") == "action_began"]
    assert found == ["annotate", "annotate", "slow", "stop"]
    assert not list(cosmos.runs.glob("*/.actions.sock"))


def test_what_is_no_order_is_bad_input(tmp_path):
    cosmos = CosmosCommand(tmp_path)
    (tmp_path / "runs" / "0001-x").mkdir(parents=True)
    (tmp_path / "runs" / "0001-x" / "run.json").write_text("{}")

    for arguments in (
        ("agent-01",),
        ("--list",),
        ("run", "annotate", "text"),
        ("a/b", "bias", "x"),
    ):
        done = cosmos("inject", "0001-x", *arguments)
        assert done.returncode == 2, (arguments, done)
        assert done.stderr.startswith("error: ")
