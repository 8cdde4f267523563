"""kill -9 on each kind of process, at each time."""

from __future__ import annotations

import os
import re
import signal
from pathlib import Path

import pytest
from fault_harness import (
    SCENARIO,
    Laboratory,
    Run,
    check_ending,
    check_evidence,
    hang_on_import,
    wait_until_ended,
)
from faulty_simulation import INIT_DELAY
from harness.nights import by_night

from madns_runtime.recording.reader import read_stream

pytestmark = pytest.mark.process

HZ = SCENARIO["agents"]["tick_hz"]
LONG = ("--set", "time.duration_s=600")
CONTINUE = ("--set", "on_agent_loss=continue", *LONG)
RESTART = ("--set", "on_agent_loss=continue", "--set", "agents.restarts_max=1")
LATER = ("--set", "time.duration_s=10")
"""Who is killed before simulated time is back about when it begins, on a busy machine some seconds later."""


def kill(run: Run, name: str) -> int:
    pid = run.pid_of(name)
    os.kill(pid, signal.SIGKILL)
    return pid


def kill_before_hello(laboratory: Laboratory, *arguments: str) -> Run:
    run = laboratory.start(*arguments, environment={INIT_DELAY: "0.7"})
    kill(run, "agent-02")
    return run


def kill_in_setup(laboratory: Laboratory, *arguments: str) -> Run:
    faults = {"side": "agent", "method": "setup", "action": "sleep", "sleep_s": 1.0}
    run = laboratory.start(*arguments, faults=faults)
    run.wait_for("agents are setting up")
    kill(run, "agent-02")
    return run


def kill_in_run(laboratory: Laboratory, *arguments: str) -> Run:
    run = laboratory.start(*arguments)
    run.wait_until_running()
    kill(run, "agent-02")
    return run


WHEN = pytest.mark.parametrize(
    "start_and_kill", by_night([kill_before_hello, kill_in_setup, kill_in_run], day=[kill_in_run])
)


def first_tick(path: Path) -> int:
    return int(next(read_stream(path).records())[0])


def last_tick(path: Path) -> int:
    return max(int(record[0]) for record in read_stream(path).records())


@WHEN
def test_killed_agent_aborts_the_run_and_is_named(laboratory, start_and_kill):
    run = start_and_kill(laboratory, *LONG)

    document = check_ending(run, 1, "failed", "FAILED: agent-02: killed by SIGKILL")
    assert document["who"] == "agent-02"
    # In the middle of a call, that call is told as well.
    assert document["reason"].startswith("killed by SIGKILL")
    assert document["agents"]["lost"] == ["agent-02"]
    # The others were told, and closed their records.
    missing = document["data"]["missing"]
    assert not any(
        line.startswith(("agent-01", "agent-03", "host", "loopback")) for line in missing
    )


@WHEN
def test_others_complete_without_the_killed_agent_if_the_policy_is_to_continue(
    laboratory, start_and_kill
):
    run = start_and_kill(laboratory, *CONTINUE)
    run.wait_for("agent-02 is lost: killed by SIGKILL")
    run.complete()

    document = check_ending(
        run, 5, "complete", "agent-02 is lost: killed by SIGKILL", "DATA INCOMPLETE: agent-02: "
    )
    assert document["agents"]["lost"] == ["agent-02"]
    assert [line.split(":")[0] for line in document["data"]["missing"]] == ["agent-02"]
    result = run.result
    # The half was told of it, however early: not before its set-up.
    assert result["simulation"] == {"lost": ["agent-02"]}
    assert {name: agent["state"] for name, agent in result["agents"].items()} == {
        "agent-01": "stopped",
        "agent-02": "lost",
        "agent-03": "stopped",
    }
    assert result["agents"]["agent-01"]["ticks"]["due"] == round(document["duration_s"] * HZ)


@WHEN
def test_killed_agent_is_started_again_and_rejoins_at_the_present_time(laboratory, start_and_kill):
    is_in_run = start_and_kill is kill_in_run
    run = start_and_kill(laboratory, *RESTART, *(LONG if is_in_run else LATER))
    agents = run.directory / "agents"
    if is_in_run:
        run.wait_for("agent-02 has rejoined at t = ")
        run.wait_until_ticking(agents / "agent-02/ticks.2.jsonl")
        run.complete()

    # What the first incarnation had begun to write is cut, and said to be; if it had not begun, 4 is right.
    code = 4 if start_and_kill is kill_before_hello and run.finish() == 4 else 5
    document = check_ending(run, code, "complete", "agent-02 is lost: killed by SIGKILL")
    result = run.result
    assert result["agents"]["agent-02"]["state"] == "stopped"
    assert all(line.startswith("agent-02: ") for line in document["data"]["missing"])
    if not is_in_run:
        return
    assert document["agents"]["incarnations"] == {"agent-02": 2}
    # The second incarnation's streams are beside the first's, and begin where simulated time had come to.
    ended = last_tick(agents / "agent-02/ticks.jsonl")
    assert first_tick(agents / "agent-02/ticks.2.jsonl") > ended
    assert first_tick(agents / "agent-02/waves.2.jsonl") > ended
    assert result["agents"]["agent-01"]["ticks"]["due"] == round(document["duration_s"] * HZ)


def test_last_agent_killed_ends_the_run_whatever_the_policy(laboratory):
    run = laboratory.start("--set", "on_agent_loss=continue", "--set", "agents.count=1", *LONG)
    run.wait_until_running()
    kill(run, "agent-01")

    check_ending(run, 1, "failed", "FAILED: agent-01: killed by SIGKILL")


def test_killed_host_ends_the_run_and_what_is_there_can_be_collected(laboratory):
    run = laboratory.start(*LONG)
    run.wait_until_running()
    pid = kill(run, "host")

    check_ending(run, 1, "failed", "FAILED: host", f"host (pid {pid}) was killed by SIGKILL")
    assert "SIGKILL" in run.document["reason"]
    collected = laboratory.cosmos("collect", str(run.directory))
    assert collected.returncode == 5, collected.stderr
    assert "host: no result" in collected.stderr
    assert "SIGKILL" in collected.stdout.splitlines()[-1]
    check_evidence(run.directory, run.document)


@pytest.mark.nightly
def test_agents_of_a_killed_host_end_by_themselves_with_their_records_closed(laboratory):
    run = laboratory.start(*LONG, "--set", "timeouts.silence_s=5")
    run.wait_until_running()
    agents = [run.pid_of(f"agent-0{number}") for number in (1, 2, 3)]
    # Nobody may help them: the operator cannot notice.
    run.signal(signal.SIGSTOP)
    kill(run, "host")

    wait_until_ended(laboratory, but=[run.process.pid])
    for number in range(len(agents)):
        folder = run.directory / f"agents/agent-0{number + 1}"
        assert all(not read_stream(path).state.is_cut for path in folder.glob("*.jsonl"))
        assert "host: silent for 5 s" in (folder / "events.jsonl").read_text()
    run.signal(signal.SIGCONT)
    check_ending(run, 1, "failed", "host", "was killed by SIGKILL")


def test_nothing_survives_a_killed_operator_and_its_run_can_be_collected(laboratory):
    run = laboratory.start(*LONG)
    run.wait_until_running()
    assert len(laboratory.living()) >= 6  # operator, host, supervisor, three agents
    run.process.kill()

    assert run.finish() == -signal.SIGKILL
    wait_until_ended(laboratory)
    collected = laboratory.cosmos("collect", "last")
    # Host and agents had time to close their records: nothing is missing.
    assert collected.returncode == 0, collected.stderr
    document = run.document
    assert (document["status"], document["exit_code"]) == ("aborted", 1)
    assert (document["who"], document["reason"]) == ("operator", "the operator's process is gone")
    assert collected.stdout.splitlines()[-1].startswith("ABORTED: operator: the operator")
    check_evidence(run.directory, document)
    assert "no run lives" in laboratory.cosmos("ps").stderr
    assert laboratory.leftovers() == []


@pytest.mark.parametrize("side", ["host", "agent"])
def test_not_even_a_process_stuck_in_a_plugin_survives_a_killed_operator(laboratory, side):
    method = {"host": "timer", "agent": "step"}[side]
    faults = {"side": side, "method": method, "action": "sleep", "sleep_s": 600.0}
    run = laboratory.start(*LONG, "--set", "timeouts.shutdown_s=1", faults=faults)
    run.wait_until_struck()
    run.process.kill()
    run.finish()

    # The time for shutdown, and a grace of 2 s beyond it.
    wait_until_ended(laboratory)
    folder = "host" if side == "host" else "machines/loopback"
    stack = (run.directory / folder / "stderr.txt").read_text()
    assert f"in {method}\n" in stack
    collected = laboratory.cosmos("collect", "last")
    assert collected.returncode == 5
    assert ("host: " if side == "host" else "agent-02: ") in collected.stderr


@pytest.mark.parametrize(
    "text",
    by_night(
        ["records go to", "waiting for agents", "agents are setting up"],
        day=["waiting for agents"],
    ),
)
def test_nothing_survives_an_operator_that_is_killed_before_the_run(laboratory, text):
    faults = {"side": "agent", "method": "setup", "action": "sleep", "sleep_s": 1.0}
    run = laboratory.start(*LONG, faults=faults)
    run.wait_for(text)
    run.process.kill()
    run.finish()

    wait_until_ended(laboratory)


def test_plugin_that_is_still_being_imported_does_not_survive_a_killed_operator(laboratory):
    hang_on_import(laboratory)
    run = laboratory.start(
        *("--set", "timeouts.agents_ready_s=600", "--set", "timeouts.loading_s=600"),
        *("--set", "timeouts.shutdown_s=5"),
    )
    run.pid_of("loopback")
    run.process.kill()
    run.finish()

    wait_until_ended(laboratory)


@pytest.mark.nightly
def test_collect_refuses_a_run_that_still_lives(laboratory):
    run = laboratory.start(*LONG)
    run.wait_until_running(0.0)
    refused = laboratory.cosmos("collect", "last")

    assert refused.returncode == 2
    assert "is still running: " in refused.stderr
    run.signal(signal.SIGTERM)
    check_ending(run, 130, "interrupted")


def test_killed_supervisor_ends_the_run_and_takes_its_agents_along(laboratory):
    run = laboratory.start(*LONG)
    run.wait_until_running()
    pid = kill(run, "loopback")

    document = check_ending(run, 1, "failed", f"agents@loopback (pid {pid}) was killed by SIGKILL")
    assert document["who"].startswith("agent-0")
    assert "supervisor" in document["reason"]
    assert str(pid) in document["reason"]


def test_killed_worker_ends_the_run_and_is_named(laboratory):
    faults = {"side": "host", "method": "long job"}
    run = laboratory.start("--set", "executor.kind=process", *LONG, faults=faults)
    host = run.pid_of("host")
    run.wait_for("setting up")
    workers = Path(f"/proc/{host}/task/{host}/children").read_text().split()
    for worker in workers:
        os.kill(int(worker), signal.SIGKILL)

    # By the job that it had, or by the first that is given to it.
    document = check_ending(run, 1, "failed", "a worker of the executor has died")
    assert document["who"] == "host"
    assert re.match(r"(FaultyHost: job 1: )?a worker of the executor has died", document["reason"])
