"""The operator's loop over real processes that misbehave as told; see launch_fake_child.py."""

from __future__ import annotations

import json
import os
import re
import secrets
import shlex
import signal
import stat
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from harness.waiting import is_alive

pytestmark = pytest.mark.process

DRIVER = Path(__file__).parents[2] / "harness" / "launch_driver.py"
FAKE_CHILD = Path(__file__).parents[2] / "harness" / "launch_fake_child.py"
PATIENCE_S = 60.0
QUICK = {
    "supervision.STOP_GRACE_S": 0.1,
    "supervision.END_MARGIN_S": 0.2,
    "children.TERM_GRACE_S": 0.5,
    "children.GROUP_GRACE_S": 0.5,
}


class Launched:
    """A driver process, and what its children noted."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.notes_file = folder / "notes"
        self.directory = folder / "run"
        self.stderr_file = folder / "stderr"
        self.key = secrets.token_hex(32)
        self.process: subprocess.Popen[bytes] | None = None

    def start(
        self,
        *,
        host: dict[str, Any] | None = None,
        agents: dict[str, Any] | None = None,
        constants: dict[str, Any] | None = None,
        timeouts: dict[str, float] | None = None,
        manual: str = "",
        stderr: int | None = None,
    ) -> None:
        environment = {
            **os.environ,
            "COSMOS_FAKE": json.dumps({"host": host or {}, "agents": agents or {}}),
            "COSMOS_FAKE_NOTES": str(self.notes_file),
            "COSMOS_CONSTANTS": json.dumps({**QUICK, **(constants or {})}),
            "COSMOS_TIMEOUTS": json.dumps({"shutdown_s": PATIENCE_S, **(timeouts or {})}),
            "COSMOS_MANUAL": manual,
            # Reversed, so that a search of environments for the key finds only a leak.
            "COSMOS_TEST_KEY_REVERSED": self.key[::-1],
        }
        self.directory.mkdir()
        with self.stderr_file.open("wb") as stderr_stream:
            self.process = subprocess.Popen(
                [sys.executable, str(DRIVER), "operator", str(self.directory)],
                stdout=subprocess.PIPE,
                stderr=stderr_stream if stderr is None else stderr,
                env=environment,
            )

    def outcome(self) -> dict[str, Any]:
        assert self.process is not None
        out, _ = self.process.communicate(timeout=PATIENCE_S)
        assert self.process.returncode == 0, self.talk
        return dict(json.loads(out))

    def signal(self, number: signal.Signals) -> None:
        assert self.process is not None
        self.process.send_signal(number)

    @property
    def talk(self) -> str:
        return self.stderr_file.read_text()

    @property
    def notes(self) -> str:
        return self.notes_file.read_text() if self.notes_file.exists() else ""

    def pids(self) -> list[int]:
        words = [line.split() for line in self.notes.splitlines()]
        workers = [int(line[3]) for line in words if line[2] == "worker"]
        return sorted({int(line[1]) for line in words} | set(workers))

    def note(self, text: str) -> None:
        assert self.process is not None
        with self.notes_file.open("a") as notes:
            notes.write(f"test {self.process.pid} {text}\n")

    def wait_for(self, condition: Callable[[], bool], what: str) -> None:
        until_s = time.monotonic() + PATIENCE_S
        while not condition():
            assert time.monotonic() < until_s, f"no {what}; talk: {self.talk}; notes: {self.notes}"
            time.sleep(0.02)

    def wait_for_note(self, text: str) -> None:
        self.wait_for(lambda: text in self.notes, f"note {text!r}")

    def wait_for_talk(self, text: str) -> None:
        self.wait_for(lambda: text in self.talk, f"talk {text!r}")


def texts(outcome: dict[str, Any]) -> list[str]:
    return [problem["text"] for problem in outcome["problems"]]


@pytest.fixture
def launched(tmp_path: Path) -> Iterator[Launched]:
    launched = Launched(tmp_path)
    yield launched
    try:
        survivors = [pid for pid in launched.pids() if is_alive(pid)]
        assert survivors == [], f"processes were left: {launched.talk}"
    finally:
        for pid in launched.pids():
            if is_alive(pid):
                os.kill(pid, signal.SIGKILL)
        if launched.process is not None and launched.process.poll() is None:
            launched.process.kill()
            launched.process.wait()
        if launched.process is not None and launched.process.stdout is not None:
            launched.process.stdout.close()


def test_run_that_completes_hands_back_the_hosts_result(launched: Launched) -> None:
    launched.start()

    outcome = launched.outcome()

    assert outcome["host_result"]["status"] == "complete"
    assert outcome["interruption"] == "no"
    assert texts(outcome) == []
    assert 'launched ["agent-01", "agent-02"] loopback port 40001' in launched.notes
    assert "running\n" in launched.talk


def test_host_that_never_listens_is_ended_and_named(launched: Launched) -> None:
    launched.start(host={"silent_start": True}, timeouts={"host_start_s": 1.0})

    outcome = launched.outcome()

    assert outcome["host_result"] is None
    assert "has not listened within 1 s (timeouts.host_start_s)" in texts(outcome)[0]
    assert texts(outcome)[0].startswith("host (pid ")


def test_host_that_dies_before_it_listens_is_quoted(launched: Launched) -> None:
    launched.start(host={"dies_at_start": 3})

    outcome = launched.outcome()

    assert outcome["host_result"] is None
    assert "exited with code 3 before the run was over" in texts(outcome)[0]
    assert "  | OSError: address already in use" in launched.talk


def test_killed_host_is_reported_with_its_last_words_and_supervisors_are_stopped(
    launched: Launched,
) -> None:
    launched.start(host={"killed_after_s": 0.2, "runs_s": 30})

    outcome = launched.outcome()

    assert outcome["host_result"] is None
    assert "was killed by SIGKILL before the run was over" in texts(outcome)[0]
    assert "  | last words of the host" in launched.talk
    assert "stopped" in launched.notes


def test_operator_that_was_stopped_says_so_and_what_it_costs(launched: Launched) -> None:
    launched.start(host={"runs_until": "went on"}, constants={"operator.STALL_S": 1.5})
    launched.wait_for_note("launched [")

    launched.signal(signal.SIGSTOP)
    time.sleep(1.6)  # for longer than STALL_S
    launched.signal(signal.SIGCONT)
    launched.note("went on")
    outcome = launched.outcome()

    assert texts(outcome) == []  # it came to its end all the same
    assert "this computer slept, or this command was stopped, for " in launched.talk
    assert "keep it awake" in launched.talk


def test_verdict_of_a_failed_run_hears_that_its_operator_was_stopped(launched: Launched) -> None:
    launched.start(
        host={"runs_s": 60},
        agents={"agent_killed_on": "went on"},
        constants={"operator.STALL_S": 1.5},
    )
    launched.wait_for_note("launched [")

    launched.signal(signal.SIGSTOP)
    time.sleep(1.6)  # for longer than STALL_S
    launched.signal(signal.SIGCONT)
    launched.note("went on")
    outcome = launched.outcome()

    assert outcome["host_result"]["status"] == "failed"
    told = [text for text in texts(outcome) if text.startswith("this computer slept, or this ")]
    assert len(told) == 1


def test_workers_that_a_killed_host_leaves_in_its_group_are_killed(launched: Launched) -> None:
    launched.start(
        host={"killed_after_s": 0.2, "runs_s": 30, "leaves_worker": True},
    )

    outcome = launched.outcome()

    assert any("left 1 running that should have ended" in line for line in texts(outcome))
    assert len(launched.pids()) == 3


def test_killed_agent_is_told_to_the_host(launched: Launched) -> None:
    launched.start(host={"runs_s": 30}, agents={"agent_killed_after_s": 0.1})

    outcome = launched.outcome()

    assert outcome["host_result"]["status"] == "failed"
    assert outcome["host_result"]["reason"] == "agent-01: killed by SIGKILL"


def test_killed_supervisor_is_reported_and_each_of_its_agents_told_to_the_host(
    launched: Launched,
) -> None:
    launched.start(
        host={"runs_until": '"agent_exited", "agent": "agent-02"', "ignores_exits": True},
        agents={"killed_after_s": 0.1},
    )

    outcome = launched.outcome()

    assert "was killed by SIGKILL before its agents agent-01, agent-02" in texts(outcome)[0]
    assert outcome["problems"][0]["machine"] == "loopback"
    told = [line for line in launched.notes.splitlines() if "agent_exited" in line]
    assert [re.findall("agent-..|killed by SIGKILL", line) for line in told] == [
        ["agent-01", "killed by SIGKILL"],
        ["agent-02", "killed by SIGKILL"],
    ]


@pytest.mark.parametrize("how", ["file", "nothing", "cut"])
def test_result_that_did_not_come_through_the_line_is_read_from_its_file(
    launched: Launched, how: str
) -> None:
    launched.start(host={"leaves_result": True, "finishes_with": how})

    outcome = launched.outcome()

    assert outcome["host_result"]["status"] == "complete"
    assert outcome["host_result"]["left"] is True
    assert texts(outcome) == []


def test_host_that_was_killed_after_it_left_its_result_is_still_told(launched: Launched) -> None:
    launched.start(host={"leaves_result": True, "finishes_with": "SIGKILL"})

    outcome = launched.outcome()

    assert outcome["host_result"]["status"] == "complete"
    assert "was killed by SIGKILL before the run was over" in texts(outcome)[0]


def test_host_that_ends_without_any_result_is_told(launched: Launched) -> None:
    launched.start(host={"finishes_with": "nothing"})

    outcome = launched.outcome()

    assert outcome["host_result"] is None
    assert "exited with code 0 before the run was over" in texts(outcome)[0]


def test_children_that_heed_neither_stop_nor_sigterm_are_killed_and_named(
    launched: Launched,
) -> None:
    launched.start(
        # A process that is just starting would heed SIGTERM.
        host={"runs_until": 'launched ["agent-01"', "stays": True, "ignores_sigterm": True},
        agents={"ignores_stop": True, "ignores_life_line": True, "ignores_sigterm": True},
        timeouts={"shutdown_s": 0.3},
    )

    outcome = launched.outcome()

    assert outcome["host_result"]["status"] == "complete"
    killed = [line for line in texts(outcome) if "killed with SIGKILL" in line]
    assert [line.split(" ")[0] for line in killed] == ["host", "agents@loopback"]
    machines = {p["machine"] for p in outcome["problems"] if p["text"].startswith("agents@")}
    assert machines == {"loopback"}
    assert {p["machine"] for p in outcome["problems"] if p["text"].startswith("host")} == {None}
    assert all("did not heed SIGTERM for 0.5 s" in line for line in killed)


def test_output_that_is_no_event_is_shown_a_few_times_and_is_not_fatal(launched: Launched) -> None:
    launched.start(host={"noise": 50, "raw": '{"event": "state"}\n[1]\n"x"\n'})

    outcome = launched.outcome()

    assert outcome["host_result"]["status"] == "complete"
    assert "host: this is no event 0\n" in launched.talk
    assert "host: this is no event 49\n" not in launched.talk
    assert "host: 53 lines in all that are no events" in launched.talk


def test_running_host_that_falls_silent_is_ended(launched: Launched) -> None:
    launched.start(
        host={"runs_s": 30, "is_silent": True},
        constants={"host_limits.HOST_SILENCE_S": 1.0, "host_limits.MARGIN_S": -2.0},
    )

    outcome = launched.outcome()

    assert "has said nothing for 1 s" in texts(outcome)[0]


def test_host_that_stays_in_a_state_for_too_long_is_ended(launched: Launched) -> None:
    # The states before have time enough on a busy machine, although the margin is taken from them, too.
    patient = dict.fromkeys(("agents_ready_s", "host_setup_s", "agent_setup_s"), 69.0 + PATIENCE_S)
    launched.start(host={"runs_s": 30}, constants={"host_limits.MARGIN_S": -69.0}, timeouts=patient)

    outcome = launched.outcome()

    # start_lead_s + duration_s + complete_s of the defaults are 70.5 s.
    assert "has been in SIMULATION_START for 1.5 s" in texts(outcome)[0]


@pytest.mark.parametrize(
    ("number", "reason"),
    [
        (signal.SIGINT, "interrupted by the operator"),
        (signal.SIGTERM, "interrupted by SIGTERM"),
        (signal.SIGHUP, "interrupted by SIGHUP"),
    ],
)
def test_one_signal_stops_the_run_cleanly(
    launched: Launched, number: signal.Signals, reason: str
) -> None:
    launched.start(host={"runs_s": 60})
    launched.wait_for_note("launched [")
    launched.signal(number)

    outcome = launched.outcome()

    assert outcome["interruption"] == "clean"
    assert outcome["host_result"]["status"] == "interrupted"
    assert outcome["host_result"]["reason"] == reason
    assert texts(outcome) == []
    assert "stopping; press Ctrl-C again to end at once" in launched.talk
    assert "stopped" in launched.notes


def test_second_ctrl_c_kills_at_once(launched: Launched) -> None:
    launched.start(host={"runs_s": 60, "ignores_stop": True, "ignores_sigterm": True})
    launched.wait_for_note("launched [")
    launched.signal(signal.SIGINT)
    launched.wait_for_note("told")
    launched.signal(signal.SIGINT)

    outcome = launched.outcome()

    assert outcome["interruption"] == "at once"
    assert outcome["host_result"] is None
    assert len([line for line in texts(outcome) if "on the operator's word" in line]) == 2


def test_second_hangup_of_a_closing_terminal_is_no_second_word(launched: Launched) -> None:
    launched.start(host={"runs_until": "second hangup", "ignores_stop": True})
    launched.wait_for_note("launched [")
    launched.signal(signal.SIGHUP)
    launched.wait_for_note("told")
    launched.signal(signal.SIGHUP)
    launched.note("second hangup")

    outcome = launched.outcome()

    assert outcome["interruption"] == "clean"
    assert outcome["host_result"]["status"] == "complete"


def test_host_that_ignores_the_stop_is_ended_after_its_deadline(launched: Launched) -> None:
    launched.start(
        host={"runs_s": 60, "ignores_stop": True},
        timeouts={"shutdown_s": 0.5},
        constants={"host_limits.MARGIN_S": 0.5},
    )
    launched.wait_for_note("launched [")
    launched.signal(signal.SIGINT)

    outcome = launched.outcome()

    assert outcome["interruption"] == "clean"
    assert "has not stopped within 1 s of being told to" in texts(outcome)[0]


def test_interrupt_before_the_host_listens_starts_no_agents(launched: Launched) -> None:
    launched.start(
        host={"silent_start": True},
        timeouts={"shutdown_s": 0.5},
        constants={"host_limits.MARGIN_S": 0.1},
    )
    launched.wait_for_note("launched")
    launched.signal(signal.SIGINT)

    outcome = launched.outcome()

    assert outcome["interruption"] == "clean"
    assert "agents" not in launched.notes


def test_children_end_by_themselves_when_the_operator_is_killed(launched: Launched) -> None:
    launched.start(host={"runs_s": 60})
    launched.wait_for_note("launched [")
    assert launched.process is not None
    launched.process.kill()
    launched.process.wait()

    launched.wait_for(lambda: launched.notes.count("life line gone") == 2, "word of both children")
    launched.wait_for(lambda: not any(map(is_alive, launched.pids())), "end of the children")

    assert launched.notes.count("life line gone") == 2


def test_program_that_cannot_be_started_ends_the_run_and_is_named(launched: Launched) -> None:
    launched.start(host={"runs_s": 60}, constants={"child.AGENT_PROGRAM": ["/nonexistent/python"]})

    outcome = launched.outcome()

    assert outcome["host_result"]["status"] == "failed"
    assert "agents@loopback cannot be started" in texts(outcome)[0]
    assert "/nonexistent/python" in outcome["host_result"]["reason"]


def test_host_that_cannot_be_started_is_named(launched: Launched) -> None:
    launched.start(constants={"child.HOST_PROGRAM": ["/nonexistent/python"]})

    outcome = launched.outcome()

    assert outcome["host_result"] is None
    assert "host cannot be started" in texts(outcome)[0]


def test_host_that_goes_on_without_agents_is_told_to_stop(launched: Launched) -> None:
    launched.start(
        host={"runs_s": 60, "ignores_exits": True},
        agents={"killed_after_s": 0.1},
        timeouts={"silence_s": 0.25, "complete_s": 0.25, "shutdown_s": 2},
        constants={"host_limits.MARGIN_S": 2},
    )

    outcome = launched.outcome()

    # silence_s, complete_s, shutdown_s and the margin are 4.5 s.
    assert outcome["host_result"]["status"] == "failed"
    assert outcome["host_result"]["reason"] == "the host has gone on without agents for 4.5 s"


def test_closed_standard_error_does_not_end_the_run(launched: Launched) -> None:
    reader, writer = os.pipe()
    os.close(reader)
    launched.start(stderr=writer)
    os.close(writer)

    outcome = launched.outcome()

    assert outcome["host_result"]["status"] == "complete"


def manual_command(launched: Launched) -> list[str]:
    launched.wait_for_talk("--launch")
    launched.wait_for(
        lambda: (
            launched.talk.count("\n") > launched.talk[: launched.talk.index("--launch")].count("\n")
        ),
        "whole line",
    )
    line = next(line for line in launched.talk.splitlines() if "--launch" in line)
    return shlex.split(line)


def test_manual_agent_gets_its_launch_from_a_private_socket(launched: Launched) -> None:
    launched.start(host={"runs_s": 60}, manual="agent-02")
    command = manual_command(launched)
    socket_path = Path(command[-1])

    assert command[:-1] == [sys.executable, "-P", "-m", "madns_runtime.agent", "--launch"]
    assert stat.S_IMODE(socket_path.stat().st_mode) == 0o600
    assert stat.S_IMODE(socket_path.parent.stat().st_mode) == 0o700
    assert "start agent-02 by hand within 600 s" in launched.talk
    launched.wait_for_note('launched ["agent-01"]')

    environment = {**os.environ, "COSMOS_FAKE_NOTES": str(launched.notes_file)}
    by_hand = [sys.executable, str(FAKE_CHILD), "agents", "--launch", str(socket_path)]
    agent = subprocess.Popen(by_hand, env=environment)
    launched.wait_for_note('launched ["agent-02"]')
    launched.signal(signal.SIGINT)
    outcome = launched.outcome()

    assert agent.wait(PATIENCE_S) == 0
    assert outcome["host_result"]["status"] == "interrupted"
    assert texts(outcome) == []
    assert not socket_path.parent.exists()


def test_manual_agent_that_vanishes_is_told_to_the_host(launched: Launched) -> None:
    launched.start(host={"runs_s": 60}, manual="agent-02")
    socket_path = manual_command(launched)[-1]
    environment = {**os.environ, "COSMOS_FAKE_NOTES": str(launched.notes_file)}
    agent = subprocess.Popen(
        [sys.executable, str(FAKE_CHILD), "agents", "--launch", socket_path], env=environment
    )
    launched.wait_for_note('launched ["agent-02"]')
    agent.kill()
    agent.wait()

    outcome = launched.outcome()

    assert outcome["host_result"]["reason"] == "agent-02: its hand-started process is gone"


def test_manual_agent_for_whom_there_is_no_socket_ends_the_run_and_is_named(
    launched: Launched,
) -> None:
    launched.start(
        host={"runs_s": 60}, manual="agent-02", constants={"manual_line.FOLDER_PREFIX": "no/such/"}
    )

    outcome = launched.outcome()

    assert outcome["host_result"]["status"] == "failed"
    assert "agent-02 cannot be started: no socket for it: " in outcome["host_result"]["reason"]


def test_manual_agent_that_never_comes_does_not_keep_the_run_open(launched: Launched) -> None:
    launched.start(host={"runs_s": 1}, manual="agent-02")

    outcome = launched.outcome()

    assert outcome["host_result"]["status"] == "complete"


def test_run_key_is_in_no_argument_environment_or_file(launched: Launched) -> None:
    launched.start(host={"runs_s": 60}, manual="agent-02")
    launched.wait_for_note("launched [")
    socket_path = manual_command(launched)[-1]
    assert launched.process is not None
    key = launched.key.encode()
    pids = [launched.process.pid, *launched.pids()]

    seen = b"".join(
        Path(f"/proc/{pid}/{name}").read_bytes() for pid in pids for name in ("cmdline", "environ")
    )
    launched.signal(signal.SIGINT)
    launched.outcome()
    written = b"".join(p.read_bytes() for p in launched.folder.rglob("*") if p.is_file())

    assert len(pids) == 3
    assert key not in seen
    assert key not in written + socket_path.encode()
