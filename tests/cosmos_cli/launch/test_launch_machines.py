"""Runs on machines that pretend to be others: whole, cut, frozen, returned, detached, ended. See pretended_fleet.py."""

from __future__ import annotations

import contextlib
import json
import os
import re
import secrets
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from harness.emulated_flight import (
    assert_returned,
    assert_untouched,
    count_commands,
    emulated_flight,
    has_commanded,
)
from harness.firmware import needs_emulator
from harness.talking_process import TalkingProcess, find_marked
from harness.waiting import wait_until

from madns_runtime.reactor.operator_link import OPERATOR_SIDE_GONE

pytestmark = pytest.mark.process

DRIVER = Path(__file__).parents[2] / "harness" / "pretended_fleet.py"
PATIENCE_S = 120.0
QUICK = {
    "machine_watch.RETURN_INTERVAL_S": 0.3,
    "operator.CLEAN_S": 1.0,
    "supervision.STOP_GRACE_S": 1.0,
}
PATIENT = {**QUICK, "machine_watch.SILENCE_S": 60.0}
"""For runs in which nobody is lost: on a busy computer a process may have to wait for its turn for long."""
SCENARIO: dict[str, Any] = {
    "name": "tiny",
    "simulation": "counter",
    "agents": {"count": 4, "tick_hz": 20},  # two on pi01, one on pi02, one here
    "time": {"duration_s": 60, "rtf_tolerance": 0.9},
    "deadline": {"overrun_ms": 1000, "max_miss_ratio": 1},
    "timeouts": {"silence_s": 10, "agents_ready_s": 90, "complete_s": 60, "shutdown_s": 20},
}
LOSING: dict[str, Any] = {"timeouts": {"agents_ready_s": 90, "shutdown_s": 5}}
"""Machines are given up as soon as they are for users."""
RETURNING = {
    # The others' agents may wait for a processor.
    "timeouts": {**LOSING["timeouts"], "silence_s": 10},
    "on_agent_loss": "continue",
    "agents": {"count": 4, "tick_hz": 20, "restarts_max": 3},
}


class Fleet(TalkingProcess):
    """Two machines and this computer, and whatever `cosmos` does with them."""

    patience_s = PATIENCE_S

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.state = folder / "state"
        self.runs = folder / "runs"
        self.key = secrets.token_hex(32)
        self.mark = f"COSMOS_TEST_FLEET={folder}"
        self.environment = {
            **os.environ,
            "COSMOS_TEST_FLEET": str(folder),
            "COSMOS_STATE_DIR": str(self.state),
            "COSMOS_RUNS": str(self.runs),
            # Reversed, so that a search of environments for the key finds only a leak.
            "COSMOS_TEST_KEY_REVERSED": self.key[::-1],
            "NO_COLOR": "1",
        }
        hosts = {
            name: {"ansible_host": "127.0.0.1", "cosmos_root": str(folder / name)}
            for name in ("pi01", "pi02")
        }
        inventory = {"all": {"hosts": {**hosts, "here": {"ansible_connection": "local"}}}}
        self.inventory = folder / "inventory.yaml"
        self.inventory.write_text(yaml.safe_dump(inventory, sort_keys=False))

    # Commands ---------------------------------------------------------------------------------------

    def start(self, *arguments: str, **changes: Any) -> None:
        """Start `cosmos run -i` of the scenario with *changes*."""
        scenario = self.folder / "tiny.yaml"
        scenario.write_text(yaml.safe_dump({**SCENARIO, **changes}))
        loses = "timeouts" in changes
        self.environment["COSMOS_CONSTANTS"] = json.dumps(QUICK if loses else PATIENT)
        command = [sys.executable, str(DRIVER), "run", str(scenario), "-i", str(self.inventory)]
        self.launch([*command, "--no-report", *arguments], self.environment)

    def cosmos(
        self, *arguments: str, folder: Path | None = None
    ) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, str(DRIVER), *arguments],
            env=self.environment,
            cwd=folder,
            capture_output=True,
            text=True,
            timeout=PATIENCE_S,
            check=False,
        )

    def stop_run(self) -> None:
        """End the run in good order: what had to happen in it has happened."""
        order = ("inject", "last", "run", "stop")
        # Refused until simulated time runs, which is a moment after the run is said to.
        wait_until(lambda: self.cosmos(*order).returncode == 0, "stop", patience_s=PATIENCE_S)

    # Faults -----------------------------------------------------------------------------------------

    def break_link(self, machine: str, how: str) -> None:
        path = self.folder / f"{machine}.fault"
        path.with_suffix(".new").write_text(how)
        path.with_suffix(".new").replace(path)

    def mend_link(self, machine: str) -> None:
        (self.folder / f"{machine}.fault").unlink()

    def power_off(self, machine: str) -> None:
        """Cut the link and end everything there, as a power cut does."""
        self.break_link(machine, "cut")
        for pid in self.living_on(machine):
            with contextlib.suppress(ProcessLookupError):  # an emulator dies with who started it
                os.kill(pid, signal.SIGKILL)

    # What there is ----------------------------------------------------------------------------------

    @property
    def verdict(self) -> str:
        return self.out.splitlines()[-1]

    @property
    def directory(self) -> Path:
        (path,) = self.runs.glob("[0-9]*-tiny")
        return path

    @property
    def document(self) -> dict[str, Any]:
        return dict(json.loads((self.directory / "run.json").read_text()))

    def problems(self, machine: str) -> list[str]:
        return [p["text"] for p in self.document["problems"] if p["machine"] == machine]

    def living(self) -> list[int]:
        return [process.pid for process in find_marked(self.mark)]

    def living_on(self, machine: str) -> list[int]:
        return [process.pid for process in find_marked(*self.on(machine))]

    def on(self, machine: str) -> tuple[str, str]:
        """Return the variables that all processes of a machine have."""
        return self.mark, f"COSMOS_STATE_DIR={self.folder / machine}/state"

    def pid_of(self, machine: str, role: str) -> int:
        """Wait for a process of a role to register on a machine."""
        state = self.state if machine == "here" else self.folder / machine / "state"

        def find() -> int | None:
            for path in state.glob("processes/[0-9]*.json"):
                try:
                    entry = json.loads(path.read_text())
                except (OSError, ValueError):
                    continue
                if entry["role"] == role:
                    return int(entry["pid"])
            return None

        return int(self.wait_until(find, f"{role} on {machine}"))

    def wait_until_running(self) -> None:
        self.wait_for("\nrunning\n")
        time.sleep(1.0)  # the machines are asked for signs of life, and answer


@pytest.fixture
def fleet(tmp_path: Path) -> Iterator[Fleet]:
    fleet = Fleet(tmp_path)
    yield fleet
    try:
        until_s = time.monotonic() + PATIENCE_S
        while fleet.living() and time.monotonic() < until_s:
            time.sleep(0.1)
        assert fleet.living() == [], f"processes were left\n{fleet.talk}"
    finally:
        for pid in fleet.living():
            os.kill(pid, signal.SIGKILL)
        if fleet.process is not None:
            fleet.finish()


def test_run_on_machines_and_here_passes_and_its_evidence_is_all_here(fleet: Fleet) -> None:
    fleet.start(time={"duration_s": 2, "rtf_tolerance": 0.9})

    code = fleet.finish()

    assert code == 0, fleet.talk
    document = fleet.document
    assert (document["status"], document["data"]["missing"]) == ("complete", [])
    assert document["timing"]["ticks"] == 160
    agents = sorted(path.name for path in (fleet.directory / "agents").iterdir())
    assert agents == [f"agent-0{number}" for number in range(1, 5)]
    plan = json.loads((fleet.directory / "plan.json").read_text())
    assert plan["machines"]["pi01"]["directory"].startswith(f"{fleet.folder}/pi01/runs/0001-tiny-")
    assert "directory" not in plan["machines"]["here"]
    assert plan["config"]["network"]["address"] == "0.0.0.0"
    for machine in ("pi01", "pi02"):
        assert list((fleet.folder / machine / "runs").iterdir()) == []
        assert (fleet.directory / "machines" / machine / "health.jsonl").exists()
    kept = yaml.safe_load((fleet.directory / "inventory.yaml").read_text())
    assert list(kept["all"]["hosts"]) == ["pi01", "pi02", "here"]


def test_host_on_a_machine_leaves_its_evidence_here_as_well(fleet: Fleet) -> None:
    fleet.start("--host", "pi02", time={"duration_s": 2, "rtf_tolerance": 0.9})
    assert fleet.pid_of("pi02", "host")

    code = fleet.finish()

    assert code == 0, fleet.talk
    assert fleet.document["status"] == "complete"
    assert (fleet.directory / "host" / "events.jsonl").exists()
    assert list((fleet.folder / "pi02" / "runs").iterdir()) == []


def test_machine_that_cannot_be_reached_is_named_and_nothing_is_started(fleet: Fleet) -> None:
    fleet.break_link("pi02", "cut")
    fleet.start()

    code = fleet.finish()

    assert code == 3
    assert "the run was not started: 1 of 2 machines failed:\n  pi02: no answer" in fleet.talk
    assert not fleet.runs.exists()


def test_program_that_cannot_be_started_on_a_machine_is_quoted(fleet: Fleet) -> None:
    fleet.environment["COSMOS_TEST_PYTHON_pi02"] = "/nonexistent/python"
    fleet.start()

    code = fleet.finish()

    assert code == 3
    assert "exited with code 127 before its agents" in fleet.problems("pi02")[0]
    assert re.search(r"/nonexistent/python.*No such file or directory", fleet.talk), fleet.talk


def test_killed_supervisor_ends_the_run_and_is_named(fleet: Fleet) -> None:
    fleet.start()
    fleet.wait_until_running()
    os.kill(fleet.pid_of("pi01", "supervisor"), signal.SIGKILL)

    code = fleet.finish()

    assert code == 3
    assert "was killed by SIGKILL before its agents agent-01, agent-02" in fleet.problems("pi01")[0]
    assert fleet.document["status"] == "failed"


@pytest.mark.parametrize("how", ["cut", pytest.param("silent", marks=pytest.mark.nightly)])
def test_lost_machine_ends_the_run_and_its_evidence_is_collected_when_it_answers(
    fleet: Fleet, how: str
) -> None:
    fleet.start(**LOSING)
    fleet.wait_until_running()
    fleet.break_link("pi01", how)

    code = fleet.finish()

    text = "machine pi01 is lost: no sign of life for 2.5 s"
    assert code == 3
    assert text in fleet.problems("pi01")
    # With the link no datagram is cut here: the agents' farewell may come before the operator's word.
    assert fleet.document["reason"] in (text, OPERATOR_SIDE_GONE)
    assert "pi01 cannot be reached; its agents end by themselves within" in fleet.talk
    fleet.wait_until(lambda: not fleet.living(), "end of the agents by themselves")
    fleet.mend_link("pi01")
    collected = fleet.cosmos("collect", "last")
    assert collected.returncode == 0, collected.stderr
    assert (fleet.directory / "agents" / "agent-01" / "ticks.jsonl").exists()


@pytest.mark.nightly
def test_frozen_supervisor_is_lost_and_does_not_outlive_the_run(fleet: Fleet) -> None:
    fleet.start(**LOSING)
    fleet.wait_until_running()
    os.kill(fleet.pid_of("pi01", "supervisor"), signal.SIGSTOP)

    code = fleet.finish()

    assert code == 3
    assert "machine pi01 is lost: no sign of life for 2.5 s" in fleet.problems("pi01")
    assert fleet.living() == []


@pytest.mark.parametrize("how", ["link", pytest.param("power", marks=pytest.mark.nightly)])
def test_machine_that_returns_is_given_its_agents_again(fleet: Fleet, how: str) -> None:
    fleet.start(**RETURNING, time={"duration_s": 600, "rtf_tolerance": 0.9})
    fleet.wait_until_running()
    if how == "link":
        fleet.break_link("pi01", "silent")
    else:
        fleet.power_off("pi01")
    fleet.wait_for("machine pi01 is lost")
    fleet.mend_link("pi01")
    fleet.wait_for("pi01 has returned; its agents agent-01, agent-02 rejoin")
    fleet.wait_for("agent-01 has rejoined")
    fleet.wait_for("agent-02 has rejoined")
    fleet.stop_run()

    code = fleet.finish()

    document = fleet.document
    assert document["status"] == "complete"
    assert document["agents"]["incarnations"] == {"agent-01": 2, "agent-02": 2}
    assert "MACHINES FAILED: pi01: machine pi01 is lost" in fleet.verdict
    assert code == 3
    folder = fleet.directory / "agents" / "agent-01"
    streams = sorted(path.name for path in folder.glob("ticks*.jsonl"))
    assert streams == ["ticks.2.jsonl", "ticks.jsonl"]
    health = fleet.directory / "machines" / "pi01"
    assert sorted(path.name for path in health.glob("health*.jsonl")) == [
        "health.2.jsonl",
        "health.jsonl",
    ]


@pytest.mark.nightly
@needs_emulator
def test_flight_computer_of_a_board_that_was_lost_is_started_anew_with_it(fleet: Fleet) -> None:
    changes = emulated_flight(fleet.folder, "agent-01", "agent-03", count=4, duration_s=600)
    fleet.start(**changes, **LOSING)
    fleet.wait_until_running()
    fleet.wait_until(lambda: has_commanded(fleet.directory, "agent-01"), "command of agent-01")
    fleet.power_off("pi01")
    fleet.wait_for("machine pi01 is lost")
    assert [each for each in find_marked(*fleet.on("pi01")) if "qemu" in each.command] == []
    fleet.mend_link("pi01")
    fleet.wait_for("agent-01 has rejoined")
    fleet.wait_for("agent-02 has rejoined")
    before = count_commands(fleet.directory, "agent-01")
    fleet.wait_until(
        lambda: has_commanded(fleet.directory, "agent-01", before=before),
        "command of agent-01 after its return",
    )
    fleet.stop_run()

    code = fleet.finish()

    assert code == 3
    document = fleet.document
    assert document["status"] == "complete"
    assert document["agents"]["incarnations"] == {"agent-01": 2, "agent-02": 2}
    assert "MACHINES FAILED: pi01: machine pi01 is lost" in fleet.verdict
    # Not exactly once: on a busy machine an emulator may also be silent for longer than it may.
    assert document["devices"]["agent-01/mcu"]["lost"] >= 1
    opened = fleet.directory.glob("devices/agent-01/mcu/events*.jsonl")
    assert [path.read_text().count('"event":"opened"') for path in opened] == [1, 1]
    assert_returned(fleet.directory, "agent-01")
    assert_untouched(fleet.directory, "agent-03", "agent-01", has_computer=True)
    assert_untouched(fleet.directory, "agent-04", "agent-01", has_computer=False)


@pytest.mark.nightly
def test_detached_run_is_seen_and_ended_from_another_folder(fleet: Fleet, tmp_path: Path) -> None:
    fleet.start("--detach")
    code = fleet.finish()
    del fleet.environment["COSMOS_RUNS"]
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()

    listed = fleet.cosmos("ps", folder=elsewhere)
    refused = fleet.cosmos("collect", "1", folder=elsewhere)
    ended = fleet.cosmos("down", "1", folder=elsewhere)
    again = fleet.cosmos("down", "1", folder=elsewhere)
    collected = fleet.cosmos("collect", "1", folder=elsewhere)

    words = "detached: run 0001-tiny goes on; see cosmos ps, cosmos down 1, cosmos collect 1"
    assert (code, fleet.verdict) == (0, words)
    lines = [line.split() for line in listed.stdout.splitlines()]
    assert ["0001-tiny", "(here)", "host", "host"] in [line[:4] for line in lines]
    assert ["0001-tiny", "pi01", "supervisor", "pi01"] in [line[:4] for line in lines]
    assert ["0001-tiny", "pi01", "agents", "2"] in [line[:4] for line in lines]
    assert refused.returncode == 2
    assert "0001-tiny is still running" in refused.stderr
    assert ended.returncode == 0, ended.stderr
    assert "0001-tiny: ended" in ended.stdout
    assert "by force" not in ended.stdout
    assert fleet.living() == []
    assert (again.returncode, again.stdout.count("nothing of it lives")) == (0, 2)
    assert collected.returncode == 0, collected.stderr
    assert fleet.document["status"] == "interrupted"


@pytest.mark.nightly
def test_machine_that_does_not_answer_is_named_by_ps_and_down(fleet: Fleet) -> None:
    fleet.start("--detach")
    assert fleet.finish() == 0
    fleet.break_link("pi02", "cut")

    listed = fleet.cosmos("ps")
    ended = fleet.cosmos("down", "1")

    assert (listed.returncode, ended.returncode) == (3, 3)
    assert "pi02: failed: no answer" in listed.stderr
    assert "pi02 could not be asked" in listed.stderr
    assert " pi01 " in listed.stdout
    assert "0001-tiny: pi02: failed: no answer" in ended.stdout


@pytest.mark.nightly
def test_inventory_finds_a_run_of_which_this_user_knows_nothing(fleet: Fleet) -> None:
    fleet.start("--detach", "--host", "pi01")
    assert fleet.finish() == 0
    state = fleet.environment["COSMOS_STATE_DIR"]
    fleet.environment["COSMOS_STATE_DIR"] = str(fleet.folder / "stranger")
    fleet.environment["COSMOS_RUNS"] = str(fleet.folder / "strangers-runs")

    unknown = fleet.cosmos("down", "1")
    listed = fleet.cosmos("ps", "-i", str(fleet.inventory), "--json")
    ended = fleet.cosmos("down", "1", "-i", str(fleet.inventory))
    fleet.environment["COSMOS_STATE_DIR"] = state
    here = fleet.cosmos("down", "--all")

    assert unknown.returncode == 2
    (machines,) = [
        {process["machine"] for process in run["processes"]}
        for run in json.loads(listed.stdout)["runs"]
        if any(process["role"] == "host" for process in run["processes"])
    ]
    assert machines == {"pi01"}
    assert ended.returncode == 0, ended.stderr
    assert ended.stdout.startswith("0001-tiny: pi01: ended ")
    assert here.returncode == 0, here.stderr


def test_detached_run_ends_by_itself_and_is_collected_whole(fleet: Fleet) -> None:
    fleet.start("--detach", "--host", "pi01", time={"duration_s": 3, "rtf_tolerance": 0.9})
    assert fleet.finish() == 0
    fleet.wait_until(lambda: not fleet.living(), "end by itself")

    collected = fleet.cosmos("collect", "last")

    assert collected.returncode == 0, collected.stderr
    assert fleet.document["status"] == "complete"
    assert fleet.document["exit_code"] == 0


def test_agents_of_a_detached_run_do_not_outlive_their_host(fleet: Fleet) -> None:
    fleet.start("--detach")
    assert fleet.finish() == 0
    os.kill(fleet.pid_of("here", "host"), signal.SIGKILL)

    fleet.wait_until(lambda: not fleet.living(), "end of the agents")

    collected = fleet.cosmos("collect", "last")
    assert collected.returncode == 5
    assert "host: no result" in collected.stderr


def test_ctrl_c_ends_all_machines_cleanly(fleet: Fleet) -> None:
    fleet.start()
    fleet.wait_until_running()
    assert fleet.process is not None
    fleet.process.send_signal(signal.SIGINT)

    code = fleet.finish()

    assert code == 130
    assert fleet.living() == []
    assert fleet.document["status"] == "interrupted"
    assert fleet.document["problems"] == []
    assert fleet.document["data"]["missing"] == []


@pytest.mark.nightly
def test_second_ctrl_c_kills_on_all_machines_and_leaves_their_records_for_later(
    fleet: Fleet,
) -> None:
    fleet.start()
    fleet.wait_until_running()
    assert fleet.process is not None
    supervisor = fleet.pid_of("pi01", "supervisor")
    os.kill(supervisor, signal.SIGSTOP)  # so that there is time for a second word
    fleet.process.send_signal(signal.SIGINT)
    fleet.wait_for("press Ctrl-C again")
    fleet.process.send_signal(signal.SIGINT)

    code = fleet.finish()

    assert code == 130
    assert fleet.living() == []
    assert any("on the operator's word" in text for text in fleet.problems("pi01"))
    assert any("its records were not fetched" in text for text in fleet.problems("pi02"))
    assert "records on pi01, pi02 were not fetched; fetch them with: cosmos collect" in fleet.talk
    collected = fleet.cosmos("collect", "last")
    assert collected.returncode in (0, 5), collected.stderr
    assert (fleet.directory / "agents" / "agent-03" / "ticks.jsonl").exists()


def test_machines_end_by_themselves_when_the_operator_is_killed(fleet: Fleet) -> None:
    fleet.start()
    fleet.wait_until_running()
    assert fleet.process is not None
    fleet.process.kill()
    fleet.finish()

    fleet.wait_until(lambda: not fleet.living(), "end of everything")

    collected = fleet.cosmos("collect", "last")
    assert collected.returncode == 0, collected.stderr
    assert fleet.document["reason"] == "the operator's process is gone"


def read_if_there(path: str) -> bytes:
    """Return what a file of a run that goes on holds: it may be gone since it was listed."""
    with contextlib.suppress(FileNotFoundError, ProcessLookupError):
        return Path(path).read_bytes()
    return b""


def contents_below(folder: Path) -> list[bytes]:
    """Return what the files below a folder hold, while some come and go; nobody answers at a socket."""
    paths = (Path(top, name) for top, _, names in os.walk(folder) for name in names)
    return [read_if_there(str(path)) for path in paths if path.is_file()]


def test_run_key_is_in_no_argument_environment_or_file(fleet: Fleet) -> None:
    fleet.start("--host", "pi02")
    fleet.wait_until_running()
    key = fleet.key.encode()
    pids = fleet.living()

    seen = b"".join(
        read_if_there(f"/proc/{pid}/{n}") for pid in pids for n in ("cmdline", "environ")
    )
    written = contents_below(fleet.folder)
    assert fleet.process is not None
    fleet.process.send_signal(signal.SIGINT)
    fleet.finish()
    written += contents_below(fleet.folder)

    assert len(pids) >= 8
    assert len(written) > 20
    assert b"COSMOS_TEST_KEY_REVERSED" in seen  # that is: it was looked at
    assert key not in seen
    assert key not in b"".join(written)
    assert key.decode() not in fleet.talk
