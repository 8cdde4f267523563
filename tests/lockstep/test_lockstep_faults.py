"""What goes wrong in lockstep is named: who, in which call, why; and nothing of the run lives on."""

import os
import re
import signal

import pytest
from harness.waiting import is_alive, wait_until

from madns_runtime.config import Timeouts
from madns_runtime.lockstep.workers import _await_exit
from madns_runtime.processes import list_processes

pytestmark = pytest.mark.process

IMPATIENT = Timeouts(tick_s=1.5, agent_setup_s=1.5, host_setup_s=1.5, shutdown_s=5.0)


def workers_of(run):
    """Return the process numbers of a living host's children."""
    pid = run.process.pid
    with open(f"/proc/{pid}/task/{pid}/children", encoding="ascii") as file:
        return [int(number) for number in file.read().split()]


@pytest.mark.parametrize(
    ("fault", "who", "expected"),
    [
        (
            "setup_raise",
            "agent-04",
            "Agent.setup raised ValueError: told to (lockstep_simulation.py",
        ),
        ("step_raise", "agent-04", "Agent.step raised ValueError: told to (lockstep_simulation.py"),
        ("receive_raise", "agent-04", "Agent.receive raised ValueError: told to"),
        ("finish_raise", "agent-04", "Agent.finish raised ValueError: told to"),
        (
            "hostsetup_raise",
            "host",
            "Host.setup raised ValueError: told to (lockstep_simulation.py",
        ),
        ("hostreceive_raise", "host", "Host.receive raised ValueError: told to"),
        ("timer_raise", "host", "Host.timer raised ValueError: told to"),
        ("timer_same", "host", "Host.timer returned -0.5, called for t = -0.5 s: expected a later"),
        ("timer_stands", "host", "Host.timer asked 100000 times in a row for t = -0.5 s"),
        ("step_fork", "agent-04", "the agent's step forked a process that came back from the call"),
        ("finish_fork", "agent-04", "the agent's finish forked a process that came back from"),
        ("timer_fork", "host", "Host.timer forked a process that came back from the call"),
        ("hostfinish_fork", "host", "Host.finish forked a process that came back from the call"),
        ("job_kill", "host", "Host: job 13: a worker of the executor has died: was it"),
        ("job_raise", "host", "Host: job 13: square raised ValueError: no such job"),
        (
            "send_set",
            "agent-04",
            "Agent.step raised UnencodableValue: a message cannot carry a set",
        ),
        ("send_large", "agent-04", "Agent.step raised MessageTooLarge: a BEST message must fit"),
        ("step_term", "agent-04", "its process was ended by SIGTERM"),
    ],
)
def test_a_fault_of_a_plug_in_is_named(start_host, fault, who, expected):
    run = start_host(fault=fault, executor="process" if fault == "job_kill" else "thread")
    result = run.result()

    assert (result["status"], run.process.returncode) == ("failed", 1)
    # A process of two agents that is told to end blames the first of them.
    assert result["who"] == (who if fault != "step_term" else "agent-03")
    assert result["reason"].startswith(expected)
    assert result["not_stopped"] == []
    ends = [path.read_text().splitlines()[-1] for path in run.folder.rglob("*.jsonl")]
    assert ends and all(end.startswith('{"end"') for end in ends)


def test_a_slow_timer_that_lets_simulated_time_stand_is_ended_after_the_time_of_a_call(start_host):
    run = start_host(fault="timer_drags", timeouts=IMPATIENT)
    result = run.result()

    assert (result["status"], run.process.returncode) == ("failed", 1)
    assert result["who"] == "host"
    told = r"Host.timer asked \d+ times in a row for t = -0.5 s, for longer than 1.5 s: simulated time stands"
    assert re.match(told, result["reason"])
    assert result["reason"].endswith(" (limit: timeouts.tick_s)")


@pytest.mark.parametrize(("fault", "abandoned"), [("step_raise", 6), ("", 0)])
def test_agents_let_go_of_what_outlives_them_where_a_run_ends_early(start_host, fault, abandoned):
    run = start_host(fault=fault)
    run.result()

    told = [path.read_text() for path in run.folder.rglob("abandoned.txt")]
    assert told == ["once\n"] * abandoned


@pytest.mark.parametrize(
    ("fault", "who", "expected"),
    [
        ("step_hang", "agent-04", "the agent's step has not returned within 1.5 s, at t = 0.2 s"),
        ("setup_hang", "agent-04", "the agent's setup has not returned within 1.5 s"),
        ("timer_hang", "host", "Host.timer has not returned within 1.5 s, at t = 0.2"),
        ("job_hang", "host", "Host: job 13 has not ended within 1.5 s, at t = 0.2"),
    ],
)
def test_who_hangs_is_named_with_the_place(start_host, fault, who, expected):
    run = start_host(fault=fault, timeouts=IMPATIENT)
    result = run.result()

    assert (result["status"], run.process.returncode) == ("failed", 1)
    assert result["who"] == who
    assert result["reason"].startswith(expected)
    if fault != "job_hang":
        assert "host/stderr.txt shows where it hung" in result["reason"]
        assert "in go_wrong" in (run.folder / "stderr.txt").read_text()
    if (setting := {"step_hang": "tick_s", "setup_hang": "agent_setup_s"}.get(fault)) is not None:
        assert result["reason"].endswith(f" (limit: timeouts.{setting})")


@pytest.mark.parametrize(
    ("fault", "expected"),
    [
        ("step_kill", "was killed by SIGKILL in the agent's step, at t = 0.2 s"),
        ("step_exit", "ended, exit code 0 in the agent's step, at t = 0.2 s"),
        ("setup_kill", "was killed by SIGKILL in the agent's setup"),
    ],
)
def test_a_worker_that_dies_is_noticed_at_once_and_named(start_host, fault, expected):
    run = start_host(fault=fault)
    result = run.result()

    assert (result["status"], result["who"]) == ("failed", "agent-04")
    assert result["reason"].startswith("the process of agent-03 to agent-04 (pid ")
    assert result["reason"].endswith(expected)
    assert result["lost"] == ["agent-03", "agent-04"]
    assert result["agents"]["agent-01"]["state"] == "stopped"
    assert result["not_stopped"] == ["agent-03", "agent-04"]


def slow_host(start_host):
    """Return a run that stands at t = 0.2 s with all its workers, and who they are."""
    run = start_host(fault="job_hang", timeouts=Timeouts(shutdown_s=60.0))
    wait_until(lambda: any(e.get("state") == "SIMULATION_START" for e in run.events), "no start")
    return run, workers_of(run)


def test_the_operators_word_ends_it_in_good_order(start_host):
    run, workers = slow_host(start_host)
    run.say({"command": "dance"})
    run.say({"command": "stop", "reason": "interrupted by the operator", "status": "interrupted"})
    result = run.result()

    assert [e["text"] for e in run.events if e.get("level") == "warning"] == [
        "no command here: {'command': 'dance'}"
    ]

    assert (result["status"], result["who"]) == ("interrupted", "operator")
    assert result["reason"] == "interrupted by the operator"
    assert {agent["state"] for agent in result["agents"].values()} == {"stopped"}
    assert not any(map(is_alive, workers))


def test_the_operator_is_heard_between_two_calls_of_a_slow_half(start_host):
    run = start_host(fault="hostreceive_idle")  # 6 s for the messages of the first tick
    wait_until(lambda: "idle" in (run.folder / "stderr.txt").read_text(), "no message")
    run.say({"command": "stop", "reason": "enough", "status": "interrupted"})
    result = run.result()

    assert (result["status"], result["reason"]) == ("interrupted", "enough")
    heard = [who for _, who, what in run.records("host/heard.jsonl") if "tick" in str(what)]
    assert 0 < len(heard) < 6


def test_sigterm_ends_it_in_good_order(start_host):
    run, workers = slow_host(start_host)
    run.process.terminate()
    result = run.result()

    assert (result["status"], result["reason"]) == ("interrupted", "ended by SIGTERM")
    assert not any(map(is_alive, workers))


def test_sigterm_shows_where_a_host_hangs(start_host):
    run = start_host(fault="hostsetup_hang")
    wait_until(lambda: any(e.get("state") == "SIMULATION_SETUP" for e in run.events), "no setup")
    wait_until(lambda: run.process.send_signal(signal.SIGTERM) or stuck(run), "no stack")


def stuck(run):
    return "in go_wrong" in (run.folder / "stderr.txt").read_text()


def test_it_ends_with_its_operator(start_host):
    run, workers = slow_host(start_host)
    run.process.stdin.close()
    result = run.result()

    assert (result["status"], result["who"]) == ("aborted", "operator")
    assert result["reason"] == "the operator's process is gone"
    assert not any(map(is_alive, workers))


def test_workers_end_with_a_killed_host_and_keep_their_records(start_host):
    run, workers = slow_host(start_host)
    run.process.send_signal(signal.SIGKILL)
    run.process.wait()

    wait_until(lambda: not any(map(is_alive, workers)), "workers live on")
    paths = sorted(run.folder.glob("agents/*/own.jsonl"))
    assert [path.parent.name for path in paths] == [f"agent-{n:02}" for n in range(1, 7)]
    for path in paths:
        assert path.read_text().splitlines()[-1].startswith('{"end"')


def test_its_processes_are_registered_while_they_live(start_host, monkeypatch):
    run, _ = slow_host(start_host)
    monkeypatch.setenv("COSMOS_STATE_DIR", str(run.folder.parent / "state"))
    wait_until(lambda: len(list_processes()) == 4, "not all registered")
    roles = sorted((entry.role, entry.name) for entry in list_processes())
    run.say({"command": "stop"})
    run.result()

    assert roles[0] == ("agent", "agent-01,agent-02")
    assert roles[-1] == ("host", "host")
    assert list_processes() == []


def test_worker_whose_end_a_plugin_has_ignored_has_ended():
    earlier = signal.signal(signal.SIGCHLD, signal.SIG_IGN)
    try:
        pid = os.posix_spawn("/bin/true", ["true"], {})
        assert _await_exit(pid) == 0
    finally:
        signal.signal(signal.SIGCHLD, earlier)


def test_words_of_a_finish_that_come_too_late_are_counted(start_host):
    result = start_host(fault="finish_say").result()

    assert result["status"] == "complete"
    assert [agent["messages"]["too_late"] for agent in result["agents"].values()] == [2] * 6


def test_a_worker_without_standard_error_ends_as_a_worker(start_host):
    run = start_host(fault="step_mute")
    result = run.result()

    assert (result["status"], run.process.returncode) == ("complete", 0)
    assert "Traceback" not in (run.folder / "stderr.txt").read_text()
