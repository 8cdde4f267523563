"""`cosmos ps` and `cosmos down` over processes that only enter themselves into the register."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest
from harness.ports import free_port
from harness.waiting import is_alive, wait_until

from cosmos_cli.app import run as cosmos
from cosmos_cli.collect.machine_sources import RecordingMachine
from cosmos_cli.commands.down import Doomed, choose
from cosmos_cli.commands.ps import age_words
from cosmos_cli.errors import InputError
from cosmos_cli.evidence.run_index import remember_run
from cosmos_cli.fleet.failure import FailureKind, MachineFailure
from cosmos_cli.fleet.outcome import Outcome
from cosmos_cli.fleet.target import Target
from cosmos_cli.launch.living_processes import (
    Fleetwide,
    LivingRun,
    Seen,
    is_called,
    living_runs,
)
from cosmos_cli.onboard import processes
from cosmos_cli.onboard.processes import HOST_LEAD_S, end_entries
from madns_runtime.processes import ProcessEntry

pytestmark = pytest.mark.process

PATIENCE_S = 30.0

MEMBER = """
import os, signal, subprocess, sys, time
from madns_runtime.processes import register

run, role, name, directory, manner = sys.argv[1:]
entry = register(run, role, name, directory)
if manner == "stubborn":
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
else:
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
if manner == "with-worker":
    # A worker of an executor is in the group, not in the register, and does not heed SIGTERM.
    code = "import signal, time; signal.signal(15, signal.SIG_IGN); print(1, flush=True); time.sleep(600)"
    worker = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE)
    worker.stdout.readline()
    print(worker.pid, flush=True)
print("ready", flush=True)
time.sleep(600)
"""

Start = Callable[..., subprocess.Popen[str]]


@pytest.fixture
def start(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Start]:
    monkeypatch.setenv("COSMOS_STATE_DIR", str(tmp_path / "state"))
    started: list[subprocess.Popen[str]] = []

    def start(
        run: str, role: str, name: str, manner: str = "", *, folder: str = "runs"
    ) -> subprocess.Popen[str]:
        directory = tmp_path / folder / run / ("host" if role == "host" else "")
        process = subprocess.Popen(
            [sys.executable, "-c", MEMBER, run, role, name, str(directory), manner],
            stdout=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )
        started.append(process)
        assert process.stdout is not None
        if manner == "with-worker":
            process.worker_pid = int(process.stdout.readline())  # type: ignore[attr-defined]
        assert process.stdout.readline() == "ready\n"
        return process

    yield start
    for process in started:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait(PATIENCE_S)
        assert process.stdout is not None
        process.stdout.close()


def test_ps_says_when_nothing_lives(start: Start, capsys: pytest.CaptureFixture[str]) -> None:
    code = cosmos(["ps"])

    captured = capsys.readouterr()
    assert code == 0
    assert captured.out == ""
    assert captured.err == "no run lives on this machine\n"


def test_ps_of_a_run_that_does_not_live_names_those_that_do(
    start: Start, capsys: pytest.CaptureFixture[str]
) -> None:
    start("0001-a", "operator", "operator")

    code = cosmos(["ps", "99"])

    captured = capsys.readouterr()
    assert (code, captured.out) == (0, "")
    assert captured.err == "99: no such run lives on this machine; living runs: 0001-a\n"


def test_ps_groups_by_run_and_counts_agents(
    start: Start, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    start("0002-b", "agent", "agent-01,agent-02")
    start("0002-b", "agent", "agent-03")
    host = start("0002-b", "host", "host")
    start("0001-a", "operator", "operator")

    code = cosmos(["ps"])

    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert code == 0
    assert lines[0] == ["run", "machine", "role", "name", "pid", "age", "directory"]
    assert [line[:4] for line in lines[1:]] == [
        ["0001-a", "(here)", "operator", "operator"],
        ["0002-b", "(here)", "host", "host"],
        ["0002-b", "(here)", "agents", "3"],
    ]
    assert lines[2][4] == str(host.pid)
    assert {line[-1] for line in lines[2:]} == {str(tmp_path / "runs" / "0002-b")}


def test_role_of_another_version_is_shown_last_and_hides_nobody(
    start: Start, capsys: pytest.CaptureFixture[str]
) -> None:
    start("0002-b", "archivist", "records")
    start("0002-b", "agent", "agent-01")
    start("0002-b", "host", "host")

    code = cosmos(["ps", "--all"])

    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert code == 0
    assert [line[2:4] for line in lines[1:]] == [
        ["host", "host"],
        ["agent", "agent-01"],
        ["archivist", "records"],
    ]


def test_ps_lists_every_agent_on_request(start: Start, capsys: pytest.CaptureFixture[str]) -> None:
    pids = [start("0001-a", "agent", name).pid for name in ("agent-01", "agent-02")]

    cosmos(["ps", "--all"])

    lines = [line.split() for line in capsys.readouterr().out.splitlines()[1:]]
    assert [line[3:5] for line in lines] == [
        ["agent-01", str(pids[0])],
        ["agent-02", str(pids[1])],
    ]


def test_ps_json_holds_every_process(start: Start, capsys: pytest.CaptureFixture[str]) -> None:
    pids = {start("0001-a", role, role).pid for role in ("host", "agent")}

    cosmos(["ps", "--json"])

    (run,) = json.loads(capsys.readouterr().out)["runs"]
    assert run["run"] == "0001-a"
    assert {process["pid"] for process in run["processes"]} == pids
    assert all(0 <= process["age_s"] < 600 for process in run["processes"])


@pytest.fixture
def planned(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[list[str]]:
    """Two runs that go on elsewhere, in laboratories that both call a board pi01; holds the addresses that are asked."""
    monkeypatch.setenv("COSMOS_STATE_DIR", str(tmp_path / "state"))
    asked: list[list[str]] = []
    for name, address in (("0001-a", "192.0.2.1"), ("0002-b", "192.0.2.2")):
        target = Target(name="pi01", address=address)
        plan = {"machines": {"pi01": {"agents": ["a"], "target": target.to_mapping()}}}
        plan["machines"]["pi01"]["directory"] = f"/home/pi/cosmos/runs/{name}-aabbccdd"
        path = tmp_path / "runs" / name
        path.mkdir(parents=True)
        (path / "plan.json").write_text(json.dumps({**plan, "session": "aabbccdd00112233"}))
        (path / "run.json").write_text(json.dumps({"status": "running"}))
        remember_run(name, path)

    def look(fleet: Fleetwide, targets: Iterable[Target]) -> list[Outcome[list[Seen]]]:
        targets = list(targets)
        asked.append([target.address for target in targets])
        return [Outcome(machine=target.name, value=[seen_on(target)]) for target in targets]

    monkeypatch.setattr(Fleetwide, "look", look)
    return asked


def seen_on(target: Target) -> Seen:
    entry = ProcessEntry(
        run="0001-a",
        role="agent",
        name="agent-01",
        pid=7,
        start_ticks=1,
        boot_id="b",
        node="pi01",
        run_directory="/home/pi/cosmos/runs/0001-a-aabbccdd",
        utc="",
    )
    return Seen(target.name, entry, 1.0)


def test_machines_of_two_runs_that_are_called_alike_are_both_asked(
    planned: list[list[str]], capsys: pytest.CaptureFixture[str]
) -> None:
    assert cosmos(["ps"]) == 0

    told = capsys.readouterr().out
    assert planned == [["192.0.2.1", "192.0.2.2"]]
    assert "1 agent " in told, "what both told is one process"


def test_inventory_of_another_laboratory_hides_no_living_run(
    planned: list[list[str]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COSMOS_INVENTORY", machine_list(tmp_path))

    assert cosmos(["ps"]) == 0

    assert planned == [["192.0.2.1", "192.0.2.2", "192.0.2.3"]]


def test_ps_reaches_machines_of_runs_where_the_inventory_has_them_by_now(
    planned: list[list[str]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    look = Fleetwide.look
    listed: list[str] = []

    def noting(fleet: Fleetwide, targets: Iterable[Target]) -> list[Outcome[list[Seen]]]:
        listed.extend(target.address for target in fleet.options.listed.values())
        return look(fleet, targets)

    monkeypatch.setattr(Fleetwide, "look", noting)

    assert cosmos(["ps", "-i", machine_list(tmp_path)]) == 0

    assert listed == ["192.0.2.3"]


def test_down_reaches_machines_of_runs_where_the_inventory_has_them_by_now(
    planned: list[list[str]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    listed: list[str] = []

    def end(fleet: Fleetwide, sources: object, **_: float) -> list[object]:
        listed.extend(target.address for target in fleet.options.listed.values())
        return []

    monkeypatch.setattr(Fleetwide, "end", end)

    assert cosmos(["down", "1", "-i", machine_list(tmp_path)]) == 0

    assert set(listed) == {"192.0.2.3"}


@pytest.mark.parametrize("words", [["ps"], ["ps", "1"], ["down", "1"], ["down", "--all"]])
def test_machine_of_a_run_that_is_not_found_may_have_moved(
    planned: list[list[str]],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    words: list[str],
) -> None:
    gone = MachineFailure(FailureKind.UNREACHABLE, "no answer")
    outcomes: list[Outcome[Any]] = [Outcome(machine="pi01", failure=gone)]
    monkeypatch.setattr(Fleetwide, "look", lambda fleet, targets: outcomes if [*targets] else [])
    monkeypatch.setattr(Fleetwide, "end", lambda fleet, sources, **_: outcomes)
    hint = f"at another address by now? cosmos {' '.join(words)} -i FILE\n"

    assert cosmos(words) == 3
    assert hint in capsys.readouterr().err
    assert cosmos([*words, "-i", machine_list(tmp_path)]) == 3
    assert "at another address" not in capsys.readouterr().err


def machine_list(tmp_path: Path) -> str:
    inventory = tmp_path / "i.yaml"
    inventory.write_text("all: {hosts: {pi01: {ansible_host: 192.0.2.3}}}\n")
    return str(inventory)


@pytest.mark.parametrize(
    ("age_s", "words"), [(0.4, "0 s"), (59.9, "59 s"), (185, "3 min 05 s"), (7800, "2 h 10 min")]
)
def test_ages_are_words_with_units(age_s: float, words: str) -> None:
    assert age_words(age_s) == words


def test_down_without_an_operator_ends_host_and_supervisors_and_only_that_run(
    start: Start, capsys: pytest.CaptureFixture[str]
) -> None:
    host = start("0001-a", "host", "host")
    supervisor = start("0001-a", "supervisor", "loopback")
    other = start("0002-b", "host", "host")

    code = cosmos(["down", "1"])

    captured = capsys.readouterr()
    assert code == 0
    assert captured.out == "0001-a: ended 2 processes\n"
    assert f"asking host (pid {host.pid}), loopback (pid {supervisor.pid}) to stop" in captured.err
    assert [is_alive(p.pid) for p in (host, supervisor, other)] == [False, False, True]


def test_down_asks_a_living_operator_alone(
    start: Start, capsys: pytest.CaptureFixture[str]
) -> None:
    operator = start("0001-a", "operator", "operator")

    code = cosmos(["down", "0001-a"])

    captured = capsys.readouterr()
    assert code == 0
    assert captured.err == f"0001-a: asking its operator (pid {operator.pid}) to stop\n"


def test_down_kills_what_does_not_heed_sigterm_and_says_so(start: Start) -> None:
    start("0001-a", "operator", "operator", "stubborn")
    agent = start("0001-a", "agent", "agent-01", "stubborn")
    said: list[str] = []
    (run,) = living_runs()

    ending = end_entries(
        run.processes, directory=run.directory, clean_s=0.3, forced_s=PATIENCE_S, say=said.append
    )

    assert ending.left == ()
    assert len(ending.killed) == 2
    assert any(f"agent-01 (pid {agent.pid})" in line for line in said if "killing" in line)


def test_down_gives_the_parts_of_a_hanging_operator_the_time_for_a_clean_shutdown(
    start: Start, monkeypatch: pytest.MonkeyPatch
) -> None:
    start("0001-a", "operator", "operator", "stubborn")
    start("0001-a", "host", "host")
    (run,) = living_runs()
    waits: list[tuple[list[str], float]] = []
    monkeypatch.setattr(
        "cosmos_cli.onboard.processes._wait",
        lambda entries, timeout_s: waits.append((sorted(e.role for e in entries), timeout_s)),
    )

    end_entries(run.processes, directory=run.directory, clean_s=30.0, forced_s=5.0)

    assert waits[:3] == [(["host", "operator"], 30.0), (["host"], HOST_LEAD_S), (["host"], 30.0)]


def test_down_ends_workers_that_are_not_in_the_register(
    start: Start, monkeypatch: pytest.MonkeyPatch
) -> None:
    host = start("0001-a", "host", "host", "with-worker")
    worker_pid = host.worker_pid  # type: ignore[attr-defined]
    (run,) = living_runs()
    wait = processes._wait

    def wait_for_others(entries: Sequence[ProcessEntry], timeout_s: float) -> None:
        """Wait for the worker, who heeds nothing else, only when it is killed; for the host as long as it needs."""
        wait([entry for entry in entries if entry.pid != worker_pid] or entries, PATIENCE_S)

    monkeypatch.setattr(processes, "_wait", wait_for_others)
    ending = end_entries(
        run.processes, directory=run.directory, clean_s=4.0, forced_s=4.0, say=lambda _: None
    )

    assert [entry.pid for entry in ending.killed] == [worker_pid]
    assert not is_alive(worker_pid)


def test_down_all_ends_every_run(start: Start, capsys: pytest.CaptureFixture[str]) -> None:
    processes = [start(run, "host", "host") for run in ("0001-a", "0002-b")]

    code = cosmos(["down", "--all", "--json"])

    endings = json.loads(capsys.readouterr().out)["runs"]
    assert code == 0
    assert [(e["run"], len(e["ended"]), e["killed"], e["left"]) for e in endings] == [
        ("0001-a", 1, [], []),
        ("0002-b", 1, [], []),
    ]
    assert not any(is_alive(process.pid) for process in processes)


def test_down_of_an_unknown_run_lists_the_living(
    start: Start, capsys: pytest.CaptureFixture[str]
) -> None:
    start("0001-a", "host", "host")

    code = cosmos(["down", "0009-z"])

    assert code == 2
    assert "0009-z: no such run lives on this machine; living runs: 0001-a" in (
        capsys.readouterr().err
    )


def test_down_without_a_name_ends_nothing(start: Start, capsys: pytest.CaptureFixture[str]) -> None:
    host = start("0001-a", "host", "host")

    code = cosmos(["down"])

    assert code == 2
    assert "name the runs to end, or give --all" in capsys.readouterr().err
    assert is_alive(host.pid)


def test_down_of_the_last_run_ends_it_here_as_well(
    start: Start, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("COSMOS_RUNS", str(tmp_path / "runs"))
    earlier, last = start("0001-a", "host", "host"), start("0002-a", "host", "host")
    for name in ("0001-a", "0002-a"):
        (tmp_path / "runs" / name).mkdir(parents=True)
        (tmp_path / "runs" / name / "plan.json").touch()

    assert cosmos(["down", "last"]) == 0

    assert [is_alive(earlier.pid), is_alive(last.pid)] == [True, False]


def test_name_that_fits_runs_in_two_folders_asks_for_the_directory(
    start: Start, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    first = start("0001-a", "host", "host", folder="here")
    second = start("0001-a", "host", "host", folder="there")

    refused = cosmos(["down", "0001-a"])
    error = capsys.readouterr().err
    accepted = cosmos(["down", str(tmp_path / "there" / "0001-a")])

    assert (refused, accepted) == (2, 0)
    assert f"give the directory: {tmp_path / 'here' / '0001-a'}" in error
    assert [is_alive(first.pid), is_alive(second.pid)] == [True, False]


def test_down_json_names_the_machine_that_could_not_be_asked_and_why(
    start: Start,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    (tmp_path / "config").touch()
    monkeypatch.setenv("COSMOS_SSH_CONFIG", str(tmp_path / "config"))
    inventory = f"127.0.0.1:{free_port('127.0.0.1')},"

    code = cosmos(["down", "--all", "-i", inventory, "--json"])

    told = json.loads(capsys.readouterr().out)
    assert (code, told["exit_code"], told["runs"]) == (3, 3, [])
    assert [machine["failure"]["kind"] for machine in told["machines"]] == ["refused"]


def test_down_all_on_some_machines_leaves_runs_alone_that_have_no_part_there(
    start: Start, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    host = start("0001-a", "host", "host")

    def look(self: object, targets: Sequence[Target]) -> list[Outcome[list[Seen]]]:
        failure = MachineFailure(FailureKind.UNREACHABLE, "no route")
        return [Outcome(machine=target.name, failure=failure) for target in targets]

    monkeypatch.setattr(Fleetwide, "look", look)

    code = cosmos(["down", "--all", "-i", "pi01,pi02", "--limit", "pi02", "--json"])

    told = json.loads(capsys.readouterr().out)
    assert (code, told["runs"]) == (3, [])
    assert told["retry"] is None  # it would end what began since, too
    assert is_alive(host.pid)


def test_down_of_a_run_that_an_unreachable_machine_may_have_ends_with_3(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def look(self: object, targets: Sequence[Target]) -> list[Outcome[list[Seen]]]:
        failure = MachineFailure(FailureKind.UNREACHABLE, "no route")
        return [Outcome(machine=target.name, failure=failure) for target in targets]

    monkeypatch.setattr(Fleetwide, "look", look)

    code = cosmos(["down", "0009-z", "-i", "pi01,pi02"])

    assert code == 3
    assert "0009-z: no such run lives on this machine; living runs: none; pi[01:02]" in (
        capsys.readouterr().err.replace("pi01, pi02", "pi[01:02]")
    )


def test_runs_of_one_name_on_machines_are_told_apart_by_their_folders_there() -> None:
    folders = ["0001-a-11111111", "0001-a-22222222"]
    known = [
        Doomed(
            run="0001-a",
            directory=folder,
            there={
                "pi01": RecordingMachine(
                    target=Target(name="pi01", address="pi01"), directory=f"/home/pi/runs/{folder}"
                )
            },
        )
        for folder in folders
    ]

    with pytest.raises(InputError, match=f"give the directory: {', '.join(folders)}"):
        choose(known, ["1"], is_all=False)
    for which in (folders[1], f"/home/pi/runs/{folders[1]}"):
        assert choose(known, [which], is_all=False) == known[1:]


def test_down_of_nothing_says_of_which_machines_it_is_known(
    start: Start, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def look(self: object, targets: Sequence[Target]) -> list[Outcome[list[Seen]]]:
        return [Outcome(machine=target.name, value=[]) for target in targets]

    monkeypatch.setattr(Fleetwide, "look", look)

    code = cosmos(["down", "--all", "-i", "pi01,pi02"])

    assert code == 0
    assert capsys.readouterr().err == (
        "no run lives on this machine and on the 2 machines that answered\n"
    )


def test_down_fails_when_something_is_left(
    start: Start, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    host = start("0001-a", "host", "host", "stubborn")
    monkeypatch.setattr("cosmos_cli.onboard.processes.end_process", lambda entry, number: False)
    monkeypatch.setattr("cosmos_cli.commands.down.FORCED_TIMEOUT_S", 0.1)

    code = cosmos(["down", "0001-a", "--timeout", "0.1"])

    assert code == 1
    assert capsys.readouterr().out == f"0001-a: still living: {host.pid}\n"


def test_run_is_known_by_name_number_and_directory(tmp_path: Path) -> None:
    run = LivingRun(run="0007-iridium10", directory=str(tmp_path / "0007-iridium10"), processes=())

    assert [
        is_called(run.run, run.directory, which)
        for which in ("0007-iridium10", "7", "0007", run.directory)
    ] == ([True] * 4)
    assert [
        is_called(run.run, run.directory, which) for which in ("8", "iridium10", "./0007-iridium10")
    ] == [False] * 3


@pytest.mark.parametrize(
    ("which", "is_it"),
    [("7", True), ("00007", True), ("70", False), ("0", False), ("7" * 5000, False)],
)
def test_run_is_known_by_a_number_of_any_length(which: str, is_it: bool) -> None:
    assert is_called("0007-iridium10", "/runs/0007-iridium10", which) is is_it


def test_link_to_itself_is_no_run(tmp_path: Path) -> None:
    (tmp_path / "loop").symlink_to("loop")

    assert not is_called("0007-iridium10", "/runs/0007-iridium10", str(tmp_path / "loop"))


def test_dead_process_is_not_listed(start: Start) -> None:
    process = start("0001-a", "host", "host")
    process.kill()
    wait_until(lambda: not is_alive(process.pid), "end of the process")

    assert living_runs() == []
