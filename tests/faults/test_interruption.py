"""Ctrl-C once and twice, SIGTERM, `cosmos down`, and agents started by hand."""

from __future__ import annotations

import json
import os
import re
import shlex
import signal
import subprocess
import time

import pytest
from fault_harness import (
    PATIENCE_S,
    Laboratory,
    Run,
    check_ending,
    check_evidence,
    wait_until_ended,
)

from madns_runtime.recording.reader import read_stream

pytestmark = pytest.mark.process

LONG = ("--set", "time.duration_s=600")
STUCK = {"side": "agent", "method": "step", "action": "sleep", "sleep_s": 300.0}


def started(laboratory: Laboratory, *arguments: str) -> Run:
    run = laboratory.start(*LONG, *arguments, new_group=True)
    run.wait_until_running()
    return run


def press_ctrl_c(run: Run) -> None:
    """Do as a terminal: SIGINT goes to the whole foreground process group."""
    os.killpg(run.process.pid, signal.SIGINT)


def send_sigint(run: Run) -> None:
    run.signal(signal.SIGINT)


@pytest.mark.parametrize("interrupt", [press_ctrl_c, send_sigint])
def test_ctrl_c_shuts_down_cleanly_and_collects(laboratory, interrupt):
    run = started(laboratory)
    interrupt(run)

    document = check_ending(run, 130, "interrupted", "INTERRUPTED by operator")
    assert document["who"] == "operator"
    assert document["reason"] == "interrupted by the operator"
    assert document["data"]["missing"] == []
    assert document["problems"] == []
    paths = sorted(run.directory.glob("agents/*/*.jsonl"))
    assert {path.parent.name for path in paths} == {"agent-01", "agent-02", "agent-03"}
    for path in paths:
        assert not read_stream(path).state.is_cut, path
    assert laboratory.leftovers() == []


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_other_stop_signals_do_as_ctrl_c_does(laboratory, number):
    run = started(laboratory)
    run.signal(number)

    document = check_ending(run, 130, "interrupted", "INTERRUPTED by operator")
    assert document["reason"] == f"interrupted by {number.name}"
    assert document["data"]["missing"] == []


def test_ctrl_c_before_any_agent_is_there_ends_the_run(laboratory):
    run = laboratory.start(*LONG)
    run.wait_for("records go to")
    run.signal(signal.SIGINT)

    check_ending(run, 130, "interrupted", "INTERRUPTED by operator")
    assert laboratory.leftovers() == []


def test_second_ctrl_c_ends_at_once_what_hangs(laboratory):
    run = laboratory.start(*LONG, "--set", "timeouts.shutdown_s=80", faults=STUCK, new_group=True)
    run.wait_until_struck()
    press_ctrl_c(run)
    run.wait_for("press Ctrl-C again to end at once")
    time.sleep(0.3)  # a terminal's second Ctrl-C comes no sooner
    press_ctrl_c(run)

    document = check_ending(run, 130, "interrupted", "ending at once", "killed with SIGKILL")
    # What was cut is named, nevertheless.
    assert any(line.startswith("agent-02: ") for line in document["data"]["missing"])


def test_one_ctrl_c_suffices_when_an_agent_hangs(laboratory):
    # Long enough for the others to close their records on a busy machine.
    run = laboratory.start(*LONG, "--set", "timeouts.shutdown_s=10", faults=STUCK, new_group=True)
    run.wait_until_struck()
    press_ctrl_c(run)

    document = check_ending(run, 130, "interrupted", "agent-02 did not end in time and was killed")
    assert [line.split(":")[0] for line in document["data"]["missing"]] == ["agent-02"]


def test_ps_lists_a_run_and_down_ends_it_cleanly(laboratory):
    run = started(laboratory)
    listed = json.loads(laboratory.cosmos("ps", "--json").stdout)["runs"]
    ended = laboratory.cosmos("down", "1")

    assert [entry["run"] for entry in listed] == ["0001-fault"]
    assert [entry["directory"] for entry in listed] == [str(run.directory)]
    names = [(process["role"], process["name"]) for process in listed[0]["processes"]]
    assert names == [
        ("operator", "operator"),
        ("host", "host"),
        ("supervisor", "loopback"),
        ("agent", "agent-01"),
        ("agent", "agent-02"),
        ("agent", "agent-03"),
    ]
    assert ended.returncode == 0, ended.stderr
    assert re.fullmatch(r"0001-fault: ended \d+ processes\n", ended.stdout)
    document = check_ending(run, 130, "interrupted", "INTERRUPTED by operator")
    assert document["reason"] == "interrupted by SIGTERM"
    assert document["data"]["missing"] == []
    assert "no run lives" in laboratory.cosmos("ps").stderr


@pytest.mark.nightly
def test_down_ends_a_run_whose_operator_hangs(laboratory):
    run = started(laboratory)
    run.signal(signal.SIGSTOP)
    ended = laboratory.cosmos("down", "--all", "--timeout", "10")

    assert ended.returncode == 0, ended.stderr
    assert "1 of them by force" in ended.stdout
    assert run.finish() == -signal.SIGKILL
    wait_until_ended(laboratory)
    collected = laboratory.cosmos("collect", "last")
    assert collected.returncode == 0, collected.stderr
    document = run.document
    assert (document["status"], document["who"]) == ("interrupted", "host")
    assert document["reason"] == "ended by SIGTERM"
    check_evidence(run.directory, document)


def start_by_hand(run: Run) -> subprocess.Popen[bytes]:
    """Do what the operator asks for: type the command that it prints."""
    asked = r"start agent-02 by hand within .*\n +(.*)\n"
    command = run.wait_until(lambda: re.search(asked, run.talk), "command to type")[1]
    environment = run.laboratory.environment
    return subprocess.Popen(shlex.split(command), env=environment, process_group=0)


def test_agent_started_by_hand_joins_the_run(laboratory):
    run = laboratory.start("--manual", "agent-02")
    with start_by_hand(run) as by_hand:
        document = check_ending(run, 0, "complete", "PASSED: ")

        assert by_hand.wait(PATIENCE_S) == 0
    assert document["agents"]["lost"] == []
    assert run.result["agents"]["agent-02"]["ticks"]["due"] == 40
    assert laboratory.leftovers() == []


@pytest.mark.nightly
def test_hand_started_agent_that_is_killed_is_lost(laboratory):
    # Nobody but the host can notice it.
    run = laboratory.start(*LONG, "--manual", "agent-02", "--set", "timeouts.silence_s=5")
    with start_by_hand(run) as by_hand:
        run.wait_until_running()
        by_hand.kill()

        check_ending(run, 1, "failed", "FAILED: agent-02: ")


@pytest.mark.nightly
def test_ctrl_c_on_a_terminal_of_its_own_ends_an_agent_started_by_hand(laboratory):
    run = laboratory.start(*LONG, "--manual", "agent-02")
    with start_by_hand(run) as by_hand:
        run.wait_until_running()
        os.killpg(by_hand.pid, signal.SIGINT)

        document = check_ending(run, 1, "failed", "FAILED: agent-02: ")
        assert by_hand.wait(PATIENCE_S) == 1
    assert "agent-02: ending: SIGINT" in run.talk
    assert document["data"]["missing"] == []


def test_ctrl_c_while_an_agent_is_awaited_ends_the_run(laboratory):
    run = laboratory.start("--manual", "agent-02")
    run.wait_for("start agent-02 by hand")
    run.signal(signal.SIGINT)

    check_ending(run, 130, "interrupted", "INTERRUPTED by operator")
    assert laboratory.leftovers() == []
