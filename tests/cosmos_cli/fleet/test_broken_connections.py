"""A run over real SSH whose connections break: it goes on, and what was said meanwhile is neither lost nor doubled."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from harness.waiting import PATIENCE_S, wait_until
from ssh_harness import needs_sshd
from sshd import Sshd

pytestmark = pytest.mark.process

DRIVER = Path(__file__).parents[2] / "harness" / "pretended_fleet.py"
SCENARIO: dict[str, Any] = {
    "name": "tiny",
    "simulation": "counter",
    "agents": {"count": 2, "tick_hz": 10},
    "time": {"duration_s": 20, "rtf_tolerance": 0.9},
    "deadline": {"overrun_ms": 1000, "max_miss_ratio": 1},
    # Time for a new connection also on a busy computer.
    "timeouts": {"silence_s": 30, "agents_ready_s": 120, "complete_s": 60, "shutdown_s": 30},
}


class BoardsOverSsh:
    """Two machines behind one SSH server, and a run on them."""

    def __init__(self, folder: Path, home: Path) -> None:
        self.folder = folder
        self.server = Sshd(folder / "sshd")
        self.talk_file = folder / "talk"
        (home / ".ssh" / "known_hosts").write_text(self.server.known_hosts_line())
        self.environment = {
            **os.environ,
            "COSMOS_TEST_OVER_SSH": "1",
            "COSMOS_STATE_DIR": str(folder / "state"),
            "COSMOS_RUNS": str(folder / "runs"),
            # The connections are hurt here, and nobody is to be lost for being busy.
            "COSMOS_CONSTANTS": json.dumps({"machine_watch.SILENCE_S": 60.0}),
            "NO_COLOR": "1",
        }
        # A root that is longer than a socket's path may be.
        roots = {name: folder / f"{name}-{'long' * 20}" for name in ("pi01", "pi02")}
        hosts = {
            name: {**self.server.variables, "cosmos_root": str(root)}
            for name, root in roots.items()
        }
        self.inventory = folder / "inventory.yaml"
        self.hosts: dict[str, Any] = hosts
        self.process: subprocess.Popen[str] | None = None

    def start(self, *arguments: str, **changes: Any) -> None:
        self.inventory.write_text(yaml.safe_dump({"all": {"hosts": self.hosts}}, sort_keys=False))
        scenario = self.folder / "tiny.yaml"
        scenario.write_text(yaml.safe_dump({**SCENARIO, **changes}))
        command = [sys.executable, str(DRIVER), "run", str(scenario), "-i", str(self.inventory)]
        with self.talk_file.open("w") as talk:
            self.process = subprocess.Popen(
                [*command, "--no-report", *arguments],
                stdout=talk,
                stderr=talk,
                text=True,
                env=self.environment,
            )

    def finish(self) -> int:
        assert self.process is not None
        return self.process.wait(PATIENCE_S)

    def interrupt(self) -> None:
        """End the run: what had to happen in it has happened, however long it took."""
        assert self.process is not None
        self.process.send_signal(signal.SIGINT)

    @property
    def talk(self) -> str:
        return self.talk_file.read_text()

    @property
    def document(self) -> dict[str, Any]:
        (path,) = (self.folder / "runs").glob("[0-9]*-tiny/run.json")
        return dict(json.loads(path.read_text()))

    def wait_for(self, condition: Callable[[], Any], what: str) -> None:
        wait_until(condition, lambda: f"no {what}\n{self.talk}")

    def wait_until_running(self) -> None:
        self.wait_for(lambda: "\nrunning\n" in self.talk, "running run")

    def break_and_wait(self, count: int) -> None:
        """Break all connections, and wait until the run has *count* more new ones."""
        before = self.talk.count("goes on over another one")
        assert self.server.break_connections() > 0
        self.wait_for(
            lambda: self.talk.count("goes on over another one") >= before + count, "new lines"
        )


@pytest.fixture
def boards(tmp_path: Path, home: Path) -> Iterator[BoardsOverSsh]:
    needs_sshd()
    made = BoardsOverSsh(tmp_path, home)
    with made.server:
        yield made
        if made.process is not None and made.process.poll() is None:
            made.process.kill()
            made.process.wait()


def check_whole(boards: BoardsOverSsh) -> None:
    document = boards.document
    assert (document["status"], document["problems"]) == ("complete", [])
    assert (document["data"]["missing"], document["agents"]["lost"]) == ([], [])
    assert document["timing"]["ticks"] == 2 * 300


@pytest.mark.parametrize(
    "host",
    [
        pytest.param((), id="host-here"),
        pytest.param(("--host", "pi02"), id="host-there", marks=pytest.mark.nightly),
    ],
)
def test_run_goes_on_when_all_its_connections_break_again_and_again(
    boards: BoardsOverSsh, host: tuple[str, ...]
) -> None:
    boards.start(*host, time={"duration_s": 30, "rtf_tolerance": 0.9})
    boards.wait_until_running()

    for _ in range(3):
        boards.break_and_wait(2)

    assert boards.finish() == 0, boards.talk
    check_whole(boards)


@pytest.mark.nightly
def test_agent_that_dies_while_the_connection_is_broken_is_told_afterwards(
    boards: BoardsOverSsh,
) -> None:
    boards.start(
        on_agent_loss="continue",
        agents={"count": 2, "tick_hz": 10, "restarts_max": 1},
        time={"duration_s": 600, "rtf_tolerance": 0.9},
    )
    boards.wait_until_running()
    (agent,) = [
        json.loads(path.read_text())["pid"]
        for path in boards.folder.glob("pi01-*/state/processes/[0-9]*.json")
        if json.loads(path.read_text())["role"] == "agent"
    ]
    boards.server.freeze_logins()
    boards.server.break_connections()
    os.kill(agent, signal.SIGKILL)
    boards.server.thaw_logins()

    boards.wait_for(lambda: "agent-01 has rejoined" in boards.talk, "return of the agent")

    boards.interrupt()
    assert boards.finish() == 130
    assert boards.document["agents"]["incarnations"] == {"agent-01": 2}
    assert boards.talk.count("agent-01 is lost") == 1


@pytest.mark.nightly
def test_connection_that_does_not_come_back_in_time_loses_the_machine(
    boards: BoardsOverSsh,
) -> None:
    boards.start(timeouts={"silence_s": 6, "shutdown_s": 5})
    boards.wait_until_running()
    boards.server.freeze_logins()
    boards.server.break_connections()

    assert boards.finish() == 3, boards.talk

    assert "machine pi01 is lost: " in boards.talk
    assert boards.document["status"] == "failed"
    boards.wait_for(lambda: not boards.server.left("madns_runtime"), "end of what ran there")


@pytest.mark.nightly
def test_machine_whose_connection_comes_back_too_late_gets_its_agents_again(
    boards: BoardsOverSsh,
) -> None:
    boards.hosts["here"] = {"ansible_connection": "local"}  # a run ends with its last agent
    boards.start(
        on_agent_loss="continue",
        agents={"count": 3, "tick_hz": 10, "restarts_max": 3},
        time={"duration_s": 600, "rtf_tolerance": 0.9},
        timeouts={"silence_s": 6, "shutdown_s": 5},
    )
    boards.wait_until_running()
    boards.server.freeze_logins()
    boards.server.break_connections()
    boards.wait_for(lambda: "machine pi01 is lost: " in boards.talk, "loss")
    boards.server.thaw_logins()

    boards.wait_for(lambda: "agent-01 has rejoined" in boards.talk, "return of the agent")

    boards.interrupt()
    assert boards.finish() == 130
    assert "pi01 has returned; its agents agent-01 rejoin" in boards.talk
    assert boards.document["agents"]["incarnations"]["agent-01"] == 2
