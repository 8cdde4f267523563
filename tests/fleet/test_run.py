"""Runs on virtual boards over real SSH: whole, on a board's host, detached, and through every fault of the tower."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator

import pytest
from run_tower import ENDLESS, PATIENT, RunTower
from tower import Tower
from tower.fixtures import need_tower

pytestmark = pytest.mark.root

RETURNING = {"on_agent_loss": "continue", "agents": {"count": 6, "tick_hz": 20, "restarts_max": 5}}
QUICK = {"time": {"duration_s": 3, "rtf_tolerance": 0.9}, "timeouts": PATIENT}
BOOT_DELAY_S = 1.0


@pytest.fixture(scope="module")
def ready_tower(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunTower]:
    """Start eight boards and make them ready: the environment is the same for every scenario here."""
    need_tower()
    with Tower(count=8, boot_delay_s=BOOT_DELAY_S) as tower:
        made = RunTower(
            tower, tmp_path_factory.mktemp("operator"), tmp_path_factory.mktemp("cache")
        )
        made.choose()
        up = made.cosmos("up", "-i", made.inventory, made.scenario())
        assert up.returncode == 0, up.stdout + up.stderr
        made.choose("pi01")
        up = made.cosmos("up", "-i", made.inventory, "--host", "pi01", made.scenario())
        assert up.returncode == 0, up.stdout + up.stderr
        yield made


@pytest.fixture
def tower(ready_tower: RunTower) -> Iterator[RunTower]:
    """Return three boards; afterwards nothing of a run may live that the test has not waited for."""
    ready_tower.choose("pi01", "pi02", "pi03")
    try:
        yield ready_tower
        assert ready_tower.living() == {}, ready_tower.talk
    finally:
        ready_tower.mend()


def check_whole(tower: RunTower, agents: int) -> None:
    document = tower.document
    assert (document["status"], document["data"]["missing"]) == ("complete", [])
    assert document["agents"]["lost"] == []
    assert [document["messages"][service]["lost"] for service in ("best", "reliable", "sync")] == (
        [0, 0, 0]
    )
    assert len(list((tower.directory / "agents").iterdir())) == agents
    for name in tower.boards:
        assert tower.tower.run(name, "ls cosmos/runs").stdout == ""


def test_constellation_on_eight_boards_passes_with_nothing_lost(tower: RunTower) -> None:
    tower.choose()
    tower.start(
        simulation="constellation",
        agents={"count": 8, "tick_hz": 10},
        time={"duration_s": 5, "rtf_tolerance": 0.9},
        timeouts=PATIENT,
        parameters={"satellites": {"walker": "56:8/2/1", "altitude_km": 780}},
    )

    code = tower.finish()

    assert code == 0, tower.talk
    check_whole(tower, 8)
    machines = sorted(path.name for path in (tower.directory / "machines").iterdir())
    assert machines == [f"pi0{number}" for number in range(1, 9)]


def test_boards_and_this_computer_run_the_same_scenario_together(tower: RunTower) -> None:
    tower.choose("pi01", "pi02", here=True, cosmos_cpu_affinity=[0])
    tower.start(**QUICK)

    code = tower.finish()

    assert code == 0, tower.talk
    check_whole(tower, 6)
    assert (tower.directory / "machines/here/health.jsonl").exists()
    scheduling = (tower.directory / "agents/agent-01/events.jsonl").read_text()
    assert '"cpu_affinity":[0]' in scheduling


def test_host_on_a_board_serves_boards_and_this_computer(tower: RunTower) -> None:
    tower.choose("pi01", "pi02", here=True)
    tower.start("--host", "pi01", **QUICK)

    code = tower.finish()

    assert code == 0, tower.talk
    check_whole(tower, 6)
    assert (tower.directory / "host/events.jsonl").exists()


@pytest.mark.nightly
def test_detached_run_goes_on_on_boards_and_is_ended_by_its_number(tower: RunTower) -> None:
    tower.start("--detach", "--host", "pi01", time=ENDLESS, timeouts=PATIENT)
    assert tower.finish() == 0, tower.talk
    number = str(int(tower.directory.name[:4]))

    listed = json.loads(tower.cosmos("ps", "--json").stdout)
    refused = tower.cosmos("collect", number)
    elsewhere = tower.cosmos("inject", number, "agent-01", "hang", "for_s=0.1")
    ended = tower.cosmos("down", number)
    collected = tower.cosmos("collect", number)

    (run,) = listed["runs"]
    roles = {(process["machine"], process["role"]) for process in run["processes"]}
    assert {("pi01", "host"), ("pi02", "supervisor"), ("pi03", "agent")} <= roles
    assert run["directory"] == str(tower.directory)
    assert refused.returncode == 2
    assert elsewhere.returncode == 2
    assert "its host runs on another computer" in elsewhere.stderr
    # Boards whose host is gone end by themselves: whether `down` finds them living is chance.
    assert ended.returncode == 0, ended.stdout + ended.stderr
    assert "pi01: ended" in ended.stdout
    assert not tower.living()
    assert collected.returncode == 0, collected.stderr
    assert tower.document["status"] == "interrupted"


def test_detached_run_survives_its_operators_cable_and_is_collected_whole(tower: RunTower) -> None:
    time = {"duration_s": 5, "rtf_tolerance": 0.9}
    tower.start("--detach", "--host", "pi01", time=time, timeouts=PATIENT)
    assert tower.finish() == 0, tower.talk

    tower.wait_until(lambda: not tower.living(), "end by itself")

    collected = tower.cosmos("collect", "last")
    assert collected.returncode == 0, collected.stderr
    assert tower.document["exit_code"] == 0
    check_whole(tower, 6)


@pytest.mark.parametrize(
    ("fault", "mending"),
    [
        pytest.param("down", "up", id="link-down"),
        pytest.param("freeze", "thaw", id="frozen", marks=pytest.mark.nightly),
    ],
)
def test_board_that_is_cut_off_ends_the_run_by_name_and_is_collected_later(
    tower: RunTower, fault: str, mending: str
) -> None:
    tower.start()
    tower.wait_until_running()
    ordered = tower.cosmos("inject", "last", "agent-01", "hang", "for_s=0.1", "--json")
    tower.tower.fault("pi02", fault)

    code = tower.finish()
    tower.tower.fault("pi02", mending)

    # Who notices first, its host or its operator, is chance; each says it in words of its own.
    text = "machine pi02 is lost: "
    assert ordered.returncode == 0, ordered.stdout + ordered.stderr
    orders = (tower.directory / "host/events.jsonl").read_text()
    assert '"event":"action_began"' in orders
    assert code == 3, tower.talk
    assert any(problem.startswith(text) for problem in tower.problems("pi02"))
    assert tower.document["status"] == "failed"
    assert any(name in tower.document["reason"] for name in (text, "silent for 2.5 s"))
    tower.wait_until(lambda: not tower.living(), "end of the board's agents by themselves")
    collected = tower.cosmos("collect", "last")
    assert collected.returncode == 0, collected.stdout + collected.stderr
    check_records(tower)


def check_records(tower: RunTower) -> None:
    """All agents' records are here, whole."""
    assert tower.document["data"]["missing"] == []
    assert len(list((tower.directory / "agents").glob("*/ticks.jsonl"))) == 6


@pytest.mark.nightly
def test_power_cut_ends_the_run_by_name_and_says_what_is_missing(tower: RunTower) -> None:
    tower.start()
    tower.wait_until_running()
    boots = tower.tower.state()["boards"]["pi02"]["boots"]
    tower.tower.fault("pi02", "crash")

    code = tower.finish()
    tower.tower.wait_until_on("pi02", boots + 1)
    collected = tower.cosmos("collect", "last")

    assert code == 3, tower.talk
    assert any("machine pi02 is lost" in text for text in tower.problems("pi02"))
    # What had not reached the disk is gone with the power: named, and nothing of it is taken for whole.
    named = {line.split(":")[0] for line in tower.document["data"]["missing"]}
    assert collected.returncode == 5, collected.stdout
    assert named <= {"agent-03", "agent-04", "pi02"} and named


@pytest.mark.parametrize(
    "fault",
    ["crash", *(pytest.param(fault, marks=pytest.mark.nightly) for fault in ("reboot", "down"))],
)
def test_board_that_returns_is_given_its_agents_again(tower: RunTower, fault: str) -> None:
    tower.start(**RETURNING, time=ENDLESS)
    tower.wait_until_running()
    tower.tower.fault("pi02", fault)
    tower.wait_until(lambda: "pi02" in tower.talk, "word of pi02")
    if fault == "down":
        time.sleep(3.0)
        tower.tower.fault("pi02", "up")
    tower.wait_for("pi02 has returned; its agents agent-03, agent-04 rejoin")
    tower.wait_for("agent-03 has rejoined")
    tower.wait_for("agent-04 has rejoined")
    tower.stop()

    code = tower.finish()

    document = tower.document
    assert document["status"] == "complete", tower.talk
    # A board that reboots ends its agents in good order: they may have said so before it is missed itself.
    assert code == 3 or (fault == "reboot" and code == 4)
    assert set(document["agents"]["incarnations"]) == {"agent-03", "agent-04"}
    streams = sorted(path.name for path in (tower.directory / "agents/agent-03").glob("ticks.*"))
    assert streams[0] == "ticks.2.jsonl" or streams[0] == "ticks.3.jsonl"


@pytest.mark.nightly
def test_lost_packets_cost_no_message_that_must_arrive(tower: RunTower) -> None:
    for name in ("pi01", "pi02", "pi03"):
        tower.tower.fault(name, "udploss", 5)
    tower.start(time={"duration_s": 6, "rtf_tolerance": 0.9}, timeouts=PATIENT)

    code = tower.finish()

    document = tower.document
    assert document["status"] == "complete", tower.talk
    assert code in (0, 4), tower.talk
    assert [document["messages"][service]["lost"] for service in ("reliable", "sync")] == [0, 0]
    assert document["data"]["missing"] == []


def test_board_with_a_read_only_disk_is_named_and_nothing_is_started(tower: RunTower) -> None:
    tower.tower.fault("pi02", "ro")
    boots = tower.tower.state()["boards"]["pi02"]["boots"]
    try:
        tower.start()
        code = tower.finish()
    finally:
        tower.tower.fault("pi02", "reboot")
        tower.tower.wait_until_on("pi02", boots + 1)

    assert code == 3, tower.talk
    assert "the run was not started: 1 of 3 machines failed:\n  pi02: " in tower.talk
    assert "Read-only file system" in tower.talk


@pytest.mark.nightly
def test_second_ctrl_c_does_not_wait_for_a_board_that_does_not_answer(tower: RunTower) -> None:
    tower.start()
    tower.wait_until_running()
    tower.tower.fault("pi02", "down")
    tower.interrupt()
    tower.wait_for("press Ctrl-C again")
    tower.interrupt()
    asked_s = time.monotonic()

    code = tower.finish()

    assert code == 130
    assert time.monotonic() - asked_s < 30.0
    assert "pi02 cannot be reached; its agents end by themselves within" in tower.talk
    tower.tower.fault("pi02", "up")
    tower.wait_until(lambda: not tower.living(), "end of the board's agents by themselves")


def test_board_ends_its_agents_when_the_operator_vanishes_without_a_word(tower: RunTower) -> None:
    tower.start()
    tower.wait_until_running()
    for name in ("pi01", "pi02", "pi03"):
        tower.tower.fault(name, "down")
    assert tower.process is not None
    tower.process.kill()  # the boards do not hear of it
    tower.finish()
    time.sleep(4.0)
    for name in ("pi01", "pi02", "pi03"):
        tower.tower.fault(name, "up")

    tower.wait_until(lambda: not tower.living(), "end by themselves")


def test_broken_ssh_sessions_of_one_board_and_of_all_end_no_run(tower: RunTower) -> None:
    tower.start(time=ENDLESS, timeouts=PATIENT)
    tower.wait_until_running()

    for broken in (("pi02",), tower.boards):
        expected = tower.talk.count("goes on over another one") + len(broken)
        for name in broken:
            # Also the session by which this is said.
            tower.tower.run(name, "pkill -KILL -f '^sshd.*@notty'", check=False)
        tower.wait_until(
            lambda n=expected: tower.talk.count("goes on over another one") >= n,
            "new connections",
        )
    tower.stop()

    assert tower.finish() == 0, tower.talk
    check_whole(tower, 6)
