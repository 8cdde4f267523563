"""Whole runs in lockstep by the real command: what the verdict says, that they repeat, and how they end."""

import json
import signal

import pytest
from harness.cosmos_command import SCENARIOS, CosmosCommand
from harness.waiting import wait_until

from cosmos_cli.evidence.run_directory import RunDirectory
from madns_runtime.processes import list_processes

pytestmark = pytest.mark.process

LOCKSTEP = ("--set", "time.mode=lockstep")


class LockstepCommand(CosmosCommand):
    """The command, every run of which is in lockstep."""

    def run(self, scenario, *settings, **more):
        return super().run(scenario, "time.mode=lockstep", *settings, **more)


@pytest.fixture
def cosmos(tmp_path):
    return LockstepCommand(tmp_path)


CONSTELLATION = ("agents.tick_hz=1", "time.duration_s=300", "seed=3")


def test_constellation_repeats_to_the_bit_and_its_records_are_all_there(cosmos):
    first = cosmos.run("iridium10.yaml", *CONSTELLATION, options=())
    second = cosmos.run("iridium10.yaml", *CONSTELLATION, "agents.per_process=4")

    for code, result in (first, second):
        assert (code, result["status"], result["time_mode"]) == (0, "complete", "lockstep")
        assert result["data"]["complete"]
        assert result["timing"]["ticks"] == 10 * 300
        assert result["timing"]["missed"] == 0
        assert result["rtf"] > 1
        names = [check["name"] for check in result["checks"]]
        assert not {"time.rtf", "deadline.miss_ratio", "deadline.overrun_ratio"} & set(names)
        assert "messages.reliable.lost" in names and "constellation.underruns" in names
        assert any("lockstep" in remark for remark in result["remarks"])
        assert [a["underruns"] for a in result["simulation"]["agents"].values()] == [0] * 10
    assert first[1]["records_sha256"] == second[1]["records_sha256"]
    assert first[1]["simulation"] == second[1]["simulation"]
    run = RunDirectory(cosmos.runs / first[1]["run"])
    assert (run.tables / "state.parquet").is_file()
    assert "The figures of" not in run.report_html.read_text()
    assert run.bundle.is_file()


def test_messages_over_links_and_passes_repeat_to_the_bit(cosmos):
    results = [
        cosmos.run("groundpass.yaml", "time.duration_s=600", f"agents.per_process={number}")
        for number in (1, 2)
    ]

    assert [code for code, _ in results] == [0, 0]
    assert results[0][1]["simulation"]["host"]["links"]["sent"] > 0
    assert results[0][1]["records_sha256"] == results[1][1]["records_sha256"]


@pytest.mark.nightly
def test_neither_records_nor_summaries_tell_how_many_computed_the_truth(cosmos):
    many = ("agents.count=501", "parameters.satellites.walker=56:501/3/1", "agents.tick_hz=1")
    results = [
        cosmos.run("walker24.yaml", *many, "time.duration_s=2", f"executor.workers={workers}")
        for workers in (1, 2)
    ]

    assert [code for code, _ in results] == [0, 0]
    assert results[0][1]["records_sha256"] == results[1][1]["records_sha256"]
    assert results[0][1]["simulation"] == results[1][1]["simulation"]


def test_a_run_that_is_collected_again_says_the_same(cosmos):
    _, result = cosmos.run("counter24.yaml", "agents.count=3", "time.duration_s=1")
    again = json.loads(cosmos("collect", result["run"], "--json").stdout)
    listed = json.loads(cosmos("runs", "--json").stdout)

    assert result["exit_code"] == 0
    assert (again["verdict"], again["records_sha256"]) == (
        result["verdict"],
        result["records_sha256"],
    )
    assert "complete" in json.dumps(listed)


def running(cosmos):
    """Start a run that would take an hour, and wait until it runs."""
    endless = ("--set", "time.duration_s=300000", "--set", "timeouts.shutdown_s=60", "--no-report")
    process = cosmos.start("run", SCENARIOS / "counter24.yaml", *LOCKSTEP, *endless)
    for line in process.stderr:
        if line.strip() == "running":
            return process
    raise AssertionError("it ended before it ran")


def wait_until_nobody_is_left(cosmos, monkeypatch):
    monkeypatch.setenv("COSMOS_STATE_DIR", cosmos.environment["COSMOS_STATE_DIR"])
    wait_until(lambda: not list_processes(), "the end of all processes")


def test_ctrl_c_ends_it_in_good_order(cosmos, monkeypatch):
    process = running(cosmos)
    process.send_signal(signal.SIGINT)
    out, _ = process.communicate(timeout=120)

    assert process.returncode == 130
    assert out.startswith("INTERRUPTED by operator")
    wait_until_nobody_is_left(cosmos, monkeypatch)
    (result,) = cosmos.runs.glob("*/run.json")
    assert json.loads(result.read_text())["data"] == {"complete": True, "missing": []}


def test_it_ends_after_its_operator_was_killed(cosmos, monkeypatch):
    process = running(cosmos)
    process.kill()
    process.communicate(timeout=60)

    wait_until_nobody_is_left(cosmos, monkeypatch)
    (result,) = cosmos.runs.glob("*/host/result.json")
    assert json.loads(result.read_text())["reason"] == "the operator's process is gone"


def test_it_goes_on_without_its_operator_takes_orders_and_ends_by_down(cosmos, monkeypatch):
    endless = ("--set", "time.duration_s=300000", "--detach")
    left = cosmos("run", SCENARIOS / "counter24.yaml", *LOCKSTEP, *endless)
    shown = cosmos("ps").stdout
    wait_until(lambda: list(cosmos.runs.glob("*/.actions.sock")), "the run's socket for actions")
    ordered = cosmos("inject", "last", "agent-01", "hang", "--json")
    in_force = json.loads(cosmos("inject", "last", "--list", "--json").stdout)["in_force"]
    down = cosmos("down", "--all")

    assert left.returncode == 0, left.stderr
    assert "24 agents" in shown
    assert ordered.returncode == 0, ordered.stdout + ordered.stderr
    assert [(each["action"], each["agents"]) for each in in_force] == [("hang", ["agent-01"])]
    assert down.returncode == 0
    wait_until_nobody_is_left(cosmos, monkeypatch)


def test_what_cannot_be_done_in_lockstep_is_refused_with_what_to_do(cosmos, tmp_path):
    inventory = tmp_path / "tower.yaml"
    inventory.write_text("all:\n  hosts: {pi01: {ansible_host: 10.0.0.1}}\n")
    scenario = SCENARIOS / "counter24.yaml"
    refused = {
        "an inventory": cosmos("run", scenario, *LOCKSTEP, "-i", inventory),
        "a plan for it": cosmos("plan", scenario, *LOCKSTEP, "-i", inventory),
        "by hand": cosmos("run", scenario, *LOCKSTEP, "--manual", "agent-01"),
    }

    assert [done.returncode for done in refused.values()] == [2, 2, 2]
    for name in ("an inventory", "a plan for it"):
        assert "lockstep runs on this computer alone" in refused[name].stderr
    assert "--set time.mode=realtime" in refused["by hand"].stderr
    assert not cosmos.runs.exists()


def test_plan_tells_the_processes_and_judges_no_inequality(cosmos):
    scenario = SCENARIOS / "counter24.yaml"
    done = cosmos("plan", scenario, *LOCKSTEP, "--set", "agents.per_process=8", "--json")
    plan = json.loads(done.stdout)

    assert done.returncode == 0
    assert [len(p) for p in plan["plan"]["machines"]["loopback"]["processes"]] == [8, 8, 8]
    assert plan["feasibility"] is None
