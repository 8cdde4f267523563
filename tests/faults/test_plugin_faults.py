"""Plug-ins that raise, print, leave, or take too long, on either side."""

from __future__ import annotations

import pytest
from fault_harness import (
    PLUGIN,
    SCENARIO,
    Laboratory,
    check_ending,
    do_on_import,
    hang_on_import,
)
from harness.nights import by_night

pytestmark = pytest.mark.process

SHORT = ("--set", "time.duration_s=1")
SOME_S = 4
SOME = ("--set", f"time.duration_s={SOME_S}")
"""For what is to end well: of a second a busy machine may let no agent have two ticks, and then there is no rate to judge."""
LONG = ("--set", "time.duration_s=600")
"""For what ends a run in one of its ticks: a busy machine may let an agent miss all that a short run has."""
AT_ONCE = {"tick": 0}
"""For what does not end it: in the first tick that is run."""
HOST_METHODS = ("setup", "initial_data", "start", "receive", "timer", "result", "finish")
AGENT_METHODS = ("setup", "step", "receive", "finish")
CASES = [("host", method) for method in HOST_METHODS] + [("agent", m) for m in AGENT_METHODS]
BY_DAY = [("host", "receive"), ("host", "finish"), ("agent", "setup"), ("agent", "step")]
SIDES = by_night([("host", "receive"), ("agent", "step")], day=[("agent", "step")])


def line_of(comment: str) -> int:
    lines = PLUGIN.read_text().splitlines()
    return next(number for number, text in enumerate(lines, start=1) if comment in text)


@pytest.mark.parametrize(("side", "method"), by_night(CASES, day=BY_DAY))
def test_exception_ends_the_run_and_names_method_file_and_line(
    laboratory: Laboratory, side, method
):
    length = SHORT if method == "finish" else LONG
    run = laboratory.start(*length, faults={"side": side, "method": method})

    who = "host" if side == "host" else "agent-02"
    reason = (
        f"Faulty{side.title()}.{method} raised ValueError: {method} is broken on purpose"
        f" (faulty_simulation.py:{line_of('the line that messages must name')})"
    )
    document = check_ending(run, 1, "failed", f"FAILED: {who}: {reason}")
    assert (document["who"], document["reason"]) == (who, reason)
    assert document["data"]["missing"] == []
    # The whole traceback is in the log of whom it befell.
    folder = run.directory / ("host" if side == "host" else "agents/agent-02")
    assert "Traceback (most recent call last)" in (folder / "log.jsonl").read_text()
    assert laboratory.leftovers() == []


@pytest.mark.parametrize("kind", ["process", "thread"])
def test_exception_in_a_submitted_job_ends_the_run_and_names_its_line(laboratory, kind):
    run = laboratory.start(
        "--set", f"executor.kind={kind}", faults={"side": "host", "method": "job"}
    )

    line = line_of("the line that messages about a job must name")
    reason = (
        "FaultyHost: job 1: divide raised ZeroDivisionError: integer division or modulo by zero"
        f" (faulty_simulation.py:{line})"
    )
    document = check_ending(run, 1, "failed", f"FAILED: host: {reason}")
    assert (document["who"], document["reason"]) == ("host", reason)
    assert "Traceback (most recent call last)" in (run.directory / "host/log.jsonl").read_text()


@pytest.mark.parametrize(("side", "method"), SIDES)
def test_plugin_that_calls_exit_is_treated_as_one_that_raised(laboratory, side, method):
    run = laboratory.start(*LONG, faults={"side": side, "method": method, "action": "exit"})

    who = "host" if side == "host" else "agent-02"
    said = f"{who}: Faulty{side.title()}.{method} raised SystemExit: {method} leaves"
    document = check_ending(run, 1, "failed", f"FAILED: {said}")
    assert document["data"]["missing"] == []


def test_exception_in_one_agent_is_its_loss_if_the_policy_is_to_continue(laboratory):
    run = laboratory.start(
        *(*SOME, "--set", "on_agent_loss=continue"),
        faults={"side": "agent", "method": "step", **AT_ONCE},
    )

    why = "FaultyAgent.step raised ValueError: step is broken on purpose (faulty_simulation.py:"
    broken = f"CHECK BROKEN: agents.lost 1 (limit 0); lost: agent-02: {why}"
    document = check_ending(run, 4, "complete", f"agent-02 is lost: {why}", broken)
    assert document["agents"]["lost"] == ["agent-02"]


@pytest.mark.parametrize(("side", "method"), SIDES)
def test_what_a_plugin_prints_is_kept_and_taken_for_no_event(laboratory, side, method):
    faults = {"side": side, "method": method, "action": "print", **AT_ONCE}
    run = laboratory.start(*SOME, faults=faults)

    check_ending(run, 0, "complete", "PASSED: ")
    folder = run.directory / ("host" if side == "host" else "machines/loopback")
    assert "a plug-in talks\n" in (folder / "stderr.txt").read_text()
    assert "a plug-in talks" not in run.out


@pytest.mark.parametrize(
    ("max_miss_ratio", "code", "verdict"),
    by_night(
        [("1e-3", 4, "CHECK BROKEN: deadline.miss_ratio"), ("0.99", 0, "PASSED: ")],
        day=[("1e-3", 4, "CHECK BROKEN: deadline.miss_ratio")],
    ),
)
def test_step_of_50_ms_on_one_tick_costs_accounted_ticks(laboratory, max_miss_ratio, code, verdict):
    run = laboratory.start(
        *SOME,
        *("--set", "agents.tick_hz=100", "--set", f"deadline.max_miss_ratio={max_miss_ratio}"),
        faults={"side": "agent", "method": "step", "action": "sleep", "sleep_s": 0.05},
    )

    document = check_ending(run, code, "complete", verdict)
    ticks = run.result["agents"]["agent-02"]["ticks"]
    # Tick 10 is in time, 11 to 14 cannot be run any more; a busy machine may cost others.
    assert ticks["missed"] >= 4
    assert ticks["run"] + ticks["missed"] == ticks["due"] == SOME_S * 100
    assert document["timing"]["missed"] >= 4


@pytest.mark.nightly
def test_step_of_10_s_aborts_the_run_and_names_the_agent(laboratory):
    run = laboratory.start(
        *("--set", "time.duration_s=5", "--set", "timeouts.shutdown_s=1"),
        *("--set", "timeouts.silence_s=2.5"),
        faults={"side": "agent", "method": "step", "action": "sleep", "sleep_s": 10.0},
    )

    document = check_ending(
        run,
        1,
        "failed",
        "FAILED: agent-02: silent for 2.5 s while running",
        "agent-02 did not end in time and was killed; machines/loopback/stderr.txt shows where it",
    )
    assert [line.split(":")[0] for line in document["data"]["missing"]] == ["agent-02"]
    stack = (run.directory / "machines/loopback/stderr.txt").read_text()
    assert (
        f'{PLUGIN.name}", line {line_of("time.sleep(self.parameters.sleep_s)")} in strike' in stack
    )


@pytest.mark.nightly
def test_host_half_that_is_stuck_for_10_s_aborts_the_run_and_is_blamed(laboratory):
    run = laboratory.start(
        *("--set", "time.duration_s=5", "--set", "timeouts.silence_s=2.5"),
        faults={"side": "host", "method": "timer", "action": "sleep", "sleep_s": 10.0},
    )

    document = check_ending(
        run, 1, "failed", ": host: silent for 2.5 s", "FaultyHost.timer took 10."
    )
    assert document["who"].startswith("agent-0")
    assert document["data"]["missing"] == []


def test_slow_setup_of_one_agent_is_not_held_against_those_who_share_its_process(laboratory):
    run = laboratory.start(
        *SOME,
        "--set",
        "agents.per_process=3",
        faults={"side": "agent", "method": "setup", "action": "sleep", "sleep_s": 4.0},
    )

    check_ending(run, 0, "complete", "PASSED: ")


def test_setup_that_takes_too_long_is_named(laboratory):
    run = laboratory.start(
        *SHORT,
        *("--set", "timeouts.agent_setup_s=10", "--set", "timeouts.shutdown_s=0.5"),
        faults={"side": "agent", "method": "setup", "action": "sleep", "sleep_s": 60.0},
    )

    check_ending(run, 1, "failed", "FAILED: agent-02: no AGENT_SIMULATION_READY in ")


def test_unregistered_simulation_is_bad_input_and_starts_nothing(laboratory):
    run = laboratory.start("--set", "simulation=countr")

    assert run.finish() == 2
    assert "no simulation named 'countr', did you mean counter?" in run.talk
    assert "constellation" in run.talk
    assert not laboratory.runs.exists()
    assert laboratory.leftovers() == []


def test_agent_half_that_takes_for_ever_to_import_is_named(laboratory):
    hang_on_import(laboratory)
    # A fifth of it is left, when it is stopped, to come up in and to say so.
    run = laboratory.start(*SHORT, "--set", "timeouts.agents_ready_s=20")

    check_ending(run, 1, "failed", "half.py:4: it was not done within ")
    assert run.document["who"].startswith("agent-0")


def test_agent_half_whose_import_cannot_be_stopped_is_given_up(laboratory):
    deaf = "import signal; signal.pthread_sigmask(signal.SIG_BLOCK, signal.valid_signals())"
    do_on_import(laboratory, f"{deaf}; time.sleep(600)")
    run = laboratory.start(
        *SHORT, "--set", "timeouts.agents_ready_s=2", "--set", "timeouts.shutdown_s=1"
    )

    document = check_ending(run, 1, "failed", "no AGENT_READY in ", "agents@loopback (pid ")
    assert document["who"] == "agent-01, agent-02, agent-03"


def test_agent_half_that_cannot_be_imported_is_named_with_its_line(laboratory):
    do_on_import(laboratory, "raise RuntimeError('no such board')")
    run = laboratory.start(*SHORT)

    check_ending(run, 1, "failed", "half.py:4: RuntimeError: no such board")
    assert run.document["who"].startswith("agent-0")


def test_scenario_of_these_tests_passes_when_nothing_is_wrong(laboratory):
    run = laboratory.start(*SOME)

    document = check_ending(run, 0, "complete", "PASSED: ")
    nobody = {"lost": [], "lost_on_purpose": [], "incarnations": {}}
    assert document["agents"] == {"count": 3, **nobody}
    assert document["timing"]["ticks"] == 3 * SOME_S * SCENARIO["agents"]["tick_hz"]
    assert laboratory.leftovers() == []
