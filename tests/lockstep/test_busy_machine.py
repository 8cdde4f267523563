"""Lockstep waits for a processor as long as it takes, and for nothing that hangs: real processes, really starved."""

import json
import os
import signal
import subprocess
import sys
import time

import pytest
from harness.waiting import wait_until
from lockstep_host import HERE
from processor_quota import make_quota, remove_quota, throttled_count

from madns_runtime.config import Timeouts

pytestmark = pytest.mark.process

SHORT_S = 2.0
"""The limits of these runs, but of shutdown, where the disk counts: far below what they take with a small share."""
SHARE = 0.04
SCENARIO = f"""
name: starved
simulation: {HERE}/lockstep_simulation.py:simulation
agents: {{count: 4, tick_hz: 10}}
time: {{mode: lockstep, duration_s: 0.5}}
timeouts: {{host_start_s: {5 * SHORT_S}, agents_ready_s: {SHORT_S}, host_setup_s: {SHORT_S},
  agent_setup_s: {SHORT_S}, complete_s: {SHORT_S}, tick_s: {SHORT_S}, shutdown_s: 60}}
executor: {{workers: 2}}
parameters: {{fault: step_work}}
"""


@pytest.fixture
def quota():
    group = make_quota(SHARE)
    if group is None:
        pytest.skip("no control group can be made here")
    yield group
    remove_quota(group)


def host_of(state):
    """Return the process of a host that has entered itself, as soon as it has."""
    for path in state.glob("processes/[0-9]*.json"):
        entry = json.loads(path.read_text())
        if entry["role"] == "host":
            return entry["pid"]
    return None


def test_a_starved_run_comes_to_its_end(tmp_path, quota):
    scenario = tmp_path / "starved.yaml"
    scenario.write_text(SCENARIO)
    command = [sys.executable, "-m", "cosmos_cli.app", "run", str(scenario), "--json", "--quiet"]
    began_s = time.monotonic()
    with subprocess.Popen(
        [*command, "--no-report", "--runs", str(tmp_path / "runs")],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        env={**os.environ, "COSMOS_STATE_DIR": str(tmp_path / "state")},
    ) as process:
        try:
            while process.poll() is None and (pid := host_of(tmp_path / "state")) is None:
                time.sleep(0.005)
            (quota / "cgroup.procs").write_text(str(pid))  # and all that it starts from now on
            out, err = process.communicate(timeout=300)
        finally:
            process.kill()
    result = json.loads(out)

    assert throttled_count(quota) > 20
    assert time.monotonic() - began_s > 2 * SHORT_S
    assert (result["status"], result["exit_code"]) == ("complete", 0), err.decode()


@pytest.mark.parametrize(
    "fault",
    [
        *(
            pytest.param(f"{call}_work", marks=pytest.mark.nightly)
            for call in ("step", "timer", "job")
        ),
        "setup_work",
    ],
)
def test_a_call_that_is_starved_for_longer_than_its_limit_returns(start_host, quota, fault):
    limits = Timeouts(tick_s=SHORT_S, host_setup_s=SHORT_S, agent_setup_s=SHORT_S, shutdown_s=60.0)
    run = start_host(fault=fault, timeouts=limits, executor="process")
    (quota / "cgroup.procs").write_text(awaited_word(run, "working"))
    began_s = time.monotonic()

    assert run.result()["status"] == "complete"
    assert time.monotonic() - began_s > 2 * SHORT_S


@pytest.mark.parametrize(
    ("fault", "tick_s"),
    [
        ("step_hang", 6.0),
        # Of one that computes, only the little time counts that it is let compute.
        pytest.param("step_spin", 1.0, marks=pytest.mark.nightly),
    ],
)
def test_a_starved_hang_still_ends(start_host, quota, fault, tick_s):
    timeouts = Timeouts(tick_s=tick_s, shutdown_s=30.0)  # it hangs until all are held down
    run = start_host(fault=fault, timeouts=timeouts)
    until_s = time.monotonic() + 120.0
    while not any(e.get("state") == "SIMULATION_START" for e in run.events):
        assert time.monotonic() < until_s
        time.sleep(0.01)
    for pid in (run.process.pid, *children_of(run.process.pid)):
        (quota / "cgroup.procs").write_text(str(pid))
    result = run.result()

    assert (result["status"], result["who"]) == ("failed", "agent-04")
    assert (
        f"the agent's step has not returned within {tick_s:g} s, at t = 0.2 s" in result["reason"]
    )


def test_a_worker_that_is_stopped_is_named(start_host):
    run = start_host(fault="step_stop", timeouts=Timeouts(tick_s=0.5, shutdown_s=1.0))
    result = run.result()

    assert (result["status"], result["who"]) == ("failed", "agent-04")
    assert "has not returned within 0.5 s, at t = 0.2 s (it is stopped)" in result["reason"]


def children_of(pid):
    with open(f"/proc/{pid}/task/{pid}/children", encoding="ascii") as file:
        return [int(number) for number in file.read().split()]


def test_a_stop_shorter_than_the_limit_costs_nothing_but_time(start_host):
    run = start_host(fault="step_pause", timeouts=Timeouts(tick_s=20.0, shutdown_s=10.0))
    pid = int(awaited_word(run, "paused"))
    wait_until(lambda: is_stopped(pid), "its stop")
    time.sleep(1.0)
    os.kill(pid, signal.SIGCONT)

    assert run.result()["status"] == "complete"


def is_stopped(pid):
    """Return whether a process is held up by a signal."""
    with open(f"/proc/{pid}/stat", encoding="ascii") as file:
        return file.read().rpartition(")")[2].split()[0] == "T"


def awaited_word(run, before):
    """Return the word that a process of a run writes behind another one, as soon as it does."""
    text = run.folder / "stderr.txt"
    until_s = time.monotonic() + 120.0
    while len(words := text.read_text().partition(f"{before} ")[2].split()) < 1:
        assert time.monotonic() < until_s, before
        time.sleep(0.005)
    return words[0]
