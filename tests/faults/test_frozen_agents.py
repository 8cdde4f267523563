"""SIGSTOP on an agent: shortly, past its deadline, and thawed afterwards."""

from __future__ import annotations

import os
import signal
import time

import pytest
from fault_harness import SCENARIO, Laboratory, Run, check_ending
from harness.nights import by_night

from madns_runtime.recording.reader import read_stream

pytestmark = pytest.mark.process

SILENT_S = 8
"""A busy machine lets the others' processes wait for some seconds, too."""
SILENCE = ("--set", f"timeouts.silence_s={SILENT_S}")
LOST = f"silent for {SILENT_S} s while running"
HZ = SCENARIO["agents"]["tick_hz"]
LONG = ("--set", "time.duration_s=600")


def freeze(laboratory: Laboratory, *arguments: str) -> tuple[Run, int]:
    run = laboratory.start(*arguments)
    run.wait_until_running()
    pid = run.pid_of("agent-02")
    os.kill(pid, signal.SIGSTOP)
    return run, pid


@pytest.mark.parametrize(
    ("max_miss_ratio", "code", "verdict"),
    by_night(
        [("1e-3", 4, "CHECK BROKEN: deadline.miss_ratio"), ("0.9", 0, "PASSED: ")],
        day=[("0.9", 0, "PASSED: ")],
    ),
)
def test_shortly_frozen_agent_costs_its_missed_ticks_only(
    laboratory, max_miss_ratio, code, verdict
):
    run, pid = freeze(laboratory, *LONG, "--set", f"deadline.max_miss_ratio={max_miss_ratio}")
    time.sleep(0.5)
    os.kill(pid, signal.SIGCONT)
    run.complete()

    document = check_ending(run, code, "complete", verdict)
    assert document["agents"]["lost"] == []
    ticks = run.result["agents"]["agent-02"]["ticks"]
    # 20 ticks a second, and half a second at least.
    assert ticks["missed"] >= 9
    assert ticks["run"] + ticks["missed"] == ticks["due"] == round(document["duration_s"] * HZ)
    assert document["timing"]["missed"] >= ticks["missed"]


@pytest.mark.nightly
def test_agent_frozen_past_its_deadline_aborts_the_run_and_closes_its_records_when_thawed(
    laboratory,
):
    run, pid = freeze(laboratory, *SILENCE, *LONG)
    run.wait_for(f"agent-02 is lost: {LOST}")
    os.kill(pid, signal.SIGCONT)

    document = check_ending(run, 1, "failed", f"FAILED: agent-02: {LOST}")
    assert document["agents"]["lost"] == ["agent-02"]
    assert document["data"]["missing"] == []
    events = (run.directory / "agents/agent-02/events.jsonl").read_text()
    assert f"agent-02: {LOST}" in events


@pytest.mark.nightly
def test_agent_that_stays_frozen_is_killed_and_named(laboratory):
    run, _ = freeze(laboratory, *SILENCE, *LONG, "--set", "timeouts.shutdown_s=10")

    document = check_ending(
        run,
        1,
        "failed",
        f"FAILED: agent-02: {LOST}",
        "agent-02 did not end in time and was killed",
    )
    assert [line.split(":")[0] for line in document["data"]["missing"]] == ["agent-02"]


@pytest.mark.nightly
def test_thawed_agent_is_expelled_and_the_others_complete(laboratory):
    run, pid = freeze(laboratory, *SILENCE, *LONG, "--set", "on_agent_loss=continue")
    run.wait_for(f"agent-02 is lost: {LOST}")
    os.kill(pid, signal.SIGCONT)
    events = run.directory / "agents/agent-02/events.jsonl"
    run.wait_until(lambda: f"expelled by the host: {LOST}" in events.read_text(), "expulsion")
    run.complete()

    # Its records are all there, but the run lacks a part of its flight.
    document = check_ending(run, 4, "complete", "CHECK BROKEN: agents.lost 1 (limit 0)")
    assert document["agents"]["lost"] == ["agent-02"]
    due = run.result["agents"]["agent-03"]["ticks"]["due"]
    assert due == round(document["duration_s"] * HZ)


def test_expelled_agent_rejoins_if_it_may_be_restarted(laboratory):
    run, pid = freeze(
        laboratory,
        *SILENCE,
        *LONG,
        "--set",
        "on_agent_loss=continue",
        "--set",
        "agents.restarts_max=1",
    )
    run.wait_for(f"agent-02 is lost: {LOST}")
    os.kill(pid, signal.SIGCONT)
    run.wait_for("agent-02 has rejoined at t = ")
    second = run.directory / "agents/agent-02/ticks.2.jsonl"
    run.wait_until_ticking(second)
    run.complete()

    document = check_ending(run, 4, "complete")
    assert document["agents"]["incarnations"] == {"agent-02": 2}
    ticks = [record[0] for record in read_stream(second).records()]
    assert ticks[0] > SILENT_S * HZ
    # It goes on to the end: whatever a busy machine had it miss is told.
    account = run.result["agents"]["agent-02"]
    assert account["state"] == "stopped"
    told = account["ticks"]
    assert len(ticks) == told["run"] == told["due"] - told["missed"] - told["not_run"]
    assert told["due"] == round(document["duration_s"] * HZ)


def test_agent_that_stays_frozen_does_not_keep_the_others_from_completing(laboratory):
    run, _ = freeze(
        laboratory,
        *(*SILENCE, *LONG),
        *("--set", "on_agent_loss=continue", "--set", "timeouts.shutdown_s=10"),
    )
    run.wait_for(f"agent-02 is lost: {LOST}")
    run.complete()

    check_ending(
        run,
        5,
        "complete",
        f"agent-02 is lost: {LOST}",
        "agent-02 did not end in time and was killed",
        "DATA INCOMPLETE: agent-02: ",
    )
