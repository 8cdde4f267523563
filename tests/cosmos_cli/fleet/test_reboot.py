"""Rebooting machines that are played: who is asked, who is left alone, and when one is back."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, Self

import pytest

import cosmos_cli.fleet.reboot
from cosmos_cli.app import run as cosmos
from cosmos_cli.fleet.connection import Completed, ConnectOptions
from cosmos_cli.fleet.failure import FailureKind, MachineFailure
from cosmos_cli.fleet.local import LocalConnection
from cosmos_cli.fleet.reboot import Rebooting
from cosmos_cli.fleet.target import Target
from madns_runtime.processes import read_boot_id

TARGET = Target(name="pi01", address="10.0.0.1")
UNREACHABLE = MachineFailure(FailureKind.UNREACHABLE, "no answer", "switch it on")
LOST = MachineFailure(FailureKind.LOST, "broke")


class PlayedConnection:
    def __init__(self, boot_id: str = "") -> None:
        self.target = TARGET
        self.exit_status = int(boot_id.startswith("refused"))
        self.boot_id = boot_id
        self.is_closed = False

    def run(self, command: str, *, timeout_s: float, said_bytes_max: int) -> Completed:
        return Completed(
            exit_status=self.exit_status, stdout=f"{self.boot_id}\n".encode(), stderr=b""
        )

    def close(self) -> None:
        self.is_closed = True


class PlayedBoard:
    """Answers as told; what it was asked is in `asked`."""

    living: Sequence[dict[str, str]] = ()
    others: Sequence[str] = ()
    greeting: Mapping[str, Any] = MappingProxyType({"uid": 1000, "node": "pi01"})
    failures: dict[str, MachineFailure]
    asked: list[str]

    @classmethod
    def start(cls, connection: object, parts: object) -> Self:
        return cls()

    def call(self, verb: str, arguments: object = None, **more: object) -> Any:
        self.asked.append(verb)
        if verb in self.failures:
            raise self.failures[verb]
        told = {"boot_id": "old", "living": self.living, "others": self.others, "has_root": True}
        return type("Answer", (), {"value": told})()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        pass


class Clock:
    now_s = 100.0

    def monotonic(self) -> float:
        return self.now_s

    def sleep(self, seconds: float) -> None:
        self.now_s += seconds


@pytest.fixture
def board(monkeypatch: pytest.MonkeyPatch) -> type[PlayedBoard]:
    played = type("Board", (PlayedBoard,), {"failures": {}, "asked": []})
    monkeypatch.setattr(cosmos_cli.fleet.reboot, "Helper", played)
    monkeypatch.setattr(cosmos_cli.fleet.reboot, "time", Clock())
    return played


def rebooting(*tries: str | MachineFailure, **more: Any) -> Any:
    """Connections after the order find these boots, or fail so; the last one for ever."""
    left: Iterator[str | MachineFailure] = iter(tries)
    last: list[str | MachineFailure] = [UNREACHABLE]

    def connect(target: Target, options: ConnectOptions) -> Any:
        last[0] = next(left, last[0])
        if isinstance(last[0], MachineFailure):
            raise last[0]
        return PlayedConnection(last[0])

    values = {"timeout_s": 60.0, "own_boot_id": "mine", "connect": connect} | more
    return Rebooting(**values)


def test_machine_is_back_when_another_boot_answers(board: type[PlayedBoard]) -> None:
    connection = PlayedConnection()

    done = rebooting("old", UNREACHABLE, LOST, "new").reboot(connection)

    assert (done.boot_id, done.back_s) == ("new", 4.0)
    assert board.asked == ["boot", "lock", "reboot"]
    assert connection.is_closed


def test_machine_of_two_names_is_rebooted_once(board: type[PlayedBoard]) -> None:
    """Its other name may come while it goes down, or when it is back."""
    other = PlayedConnection()
    other.target = dataclasses.replace(TARGET, name="imu", address="10.0.1.1")
    twice = rebooting("new")

    done = twice.reboot(PlayedConnection())
    meanwhile = twice.reboot(other)

    assert (done.boot_id, done.why_not) == ("new", "")
    assert meanwhile.why_not == "it is pi01, under another name"
    assert twice.claims == {("old", "pi01"): "pi01", ("new", "pi01"): "pi01"}
    assert board.asked == ["boot", "lock", "reboot", "boot"]


def test_words_of_a_machine_that_runs_nothing_yet_are_no_boot(board: type[PlayedBoard]) -> None:
    done = rebooting("refused: it is starting", "new").reboot(PlayedConnection())

    assert (done.boot_id, done.back_s) == ("new", 2.0)


def test_connection_that_breaks_on_the_order_is_no_failure(board: type[PlayedBoard]) -> None:
    board.failures["reboot"] = LOST

    assert rebooting("new").reboot(PlayedConnection()).boot_id == "new"


def test_refused_order_is_the_machines_failure(board: type[PlayedBoard]) -> None:
    board.failures["reboot"] = MachineFailure(FailureKind.NO_SUDO, "a password is required")

    with pytest.raises(MachineFailure, match="a password is required"):
        rebooting("new").reboot(PlayedConnection())


@pytest.mark.parametrize(("uid", "is_done"), [(1000, False), (0, True)])
def test_sudo_that_the_inventory_forbids_is_not_used(
    board: type[PlayedBoard], uid: int, is_done: bool
) -> None:
    connection = PlayedConnection()
    connection.target = dataclasses.replace(TARGET, may_become_root=False)
    board.greeting = {"uid": uid, "node": "pi01"}

    if is_done:  # who logs in is root already
        assert rebooting("new").reboot(connection).boot_id == "new"
        return
    with pytest.raises(MachineFailure, match="ansible_become: false") as failure:
        rebooting("new").reboot(connection)

    assert failure.value.kind is FailureKind.NO_SUDO
    assert "reboot" not in board.asked


def test_machine_with_a_run_is_left_to_it(board: type[PlayedBoard]) -> None:
    board.living = [{"run": "0007-iridium10"}, {"run": "0007-iridium10"}]

    with pytest.raises(MachineFailure, match="0007-iridium10 lives there") as failure:
        rebooting("new").reboot(PlayedConnection())

    assert failure.value.kind is FailureKind.BUSY
    assert "reboot" not in board.asked


def test_machine_with_a_run_of_somebody_else_is_left_to_it(board: type[PlayedBoard]) -> None:
    board.others = ["0009-other in /srv/second/runs", "a run of anna"]

    with pytest.raises(MachineFailure) as failure:
        rebooting("new").reboot(PlayedConnection())

    assert failure.value.kind is FailureKind.BUSY
    assert failure.value.text == "0009-other in /srv/second/runs, a run of anna live there"
    assert "the inventory and user that started it" in failure.value.advice
    assert "reboot" not in board.asked


def test_force_takes_the_machine_from_its_run(board: type[PlayedBoard]) -> None:
    board.living = [{"run": "0007-iridium10"}]

    done = rebooting("new", is_forced=True).reboot(PlayedConnection())

    assert done.boot_id == "new"
    assert board.asked == ["boot", "reboot"]


def test_machine_at_which_another_command_works_is_left_to_it(board: type[PlayedBoard]) -> None:
    board.failures["lock"] = MachineFailure(FailureKind.BUSY, "another command works there")

    with pytest.raises(MachineFailure, match="another command works there"):
        rebooting("new").reboot(PlayedConnection())


def test_disk_that_takes_no_lock_is_no_reason_against_it(board: type[PlayedBoard]) -> None:
    board.failures["lock"] = MachineFailure(FailureKind.READ_ONLY, "Read-only file system")

    assert rebooting("new").reboot(PlayedConnection()).boot_id == "new"


@pytest.mark.parametrize(
    ("tries", "words"),
    [
        ([UNREACHABLE], "not back in 60 s: no answer"),
        (["old"], "not back in 60 s: it answers, and has not gone down"),
    ],
)
def test_machine_that_is_not_back_in_time_failed(
    board: type[PlayedBoard], tries: list[str | MachineFailure], words: str
) -> None:
    with pytest.raises(MachineFailure) as failure:
        rebooting(*tries).reboot(PlayedConnection())

    assert failure.value.kind is FailureKind.TIMEOUT
    assert failure.value.text == words
    assert "console" in failure.value.advice


def test_login_that_is_refused_while_it_starts_is_tried_again_later(
    board: type[PlayedBoard],
) -> None:
    refused = MachineFailure(FailureKind.AUTHENTICATION, "not yet")

    done = rebooting(refused, refused, "new").reboot(PlayedConnection())

    assert done.back_s == 11.0


def test_another_host_key_after_the_reboot_is_not_waited_out(board: type[PlayedBoard]) -> None:
    changed = MachineFailure(FailureKind.HOST_KEY_CHANGED, "another key")

    with pytest.raises(MachineFailure, match="another key"):
        rebooting(changed, "new").reboot(PlayedConnection())


@pytest.mark.process
def test_this_computer_is_known_under_any_name(tmp_path: Path) -> None:
    target = Target(name="pi01", address="127.0.0.1", connection="local", root=str(tmp_path))

    done = rebooting("new", own_boot_id=read_boot_id()).reboot(LocalConnection(target))

    assert (done.back_s, done.why_not) == (None, "it is this computer")


# The command


@pytest.fixture
def inventory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    def connect(target: Target, options: ConnectOptions) -> LocalConnection:
        if target.name == "pi02":
            raise UNREACHABLE
        return LocalConnection(target)

    monkeypatch.setattr("cosmos_cli.fleet.fleet.connect", connect)
    path = tmp_path / "inventory.yaml"
    path.write_text(
        f"all:\n  vars: {{cosmos_root: {tmp_path / 'cosmos'}}}\n"
        "  hosts: {pi01: {}, pi02: {}, here: {ansible_connection: local}}\n"
    )
    return path


def test_nobody_to_ask_is_refused(inventory: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code = cosmos(["reboot", "-i", str(inventory)])

    error = capsys.readouterr().err
    assert code == 2
    assert "reboot 2 machines (pi01, pi02): nobody is there to ask; give --yes" in error


@pytest.mark.process
def test_this_computer_is_left_alone_and_failures_are_told(
    inventory: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code = cosmos(["reboot", "-i", str(inventory), "--yes"])

    captured = capsys.readouterr()
    assert code == 3
    assert "here: left alone, it is this computer" in captured.err
    assert "pi01  left alone: it is this computer\n" in captured.out
    assert "pi02  failed  no answer; switch it on\n" in captured.out
    assert "2 machines: 0 back, 1 left alone, 1 failed in " in captured.out


def test_second_name_of_one_address_is_left_alone(
    board: type[PlayedBoard],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def connect(target: Target, options: ConnectOptions) -> PlayedConnection:
        connection = PlayedConnection("new")
        connection.target = target
        return connection

    monkeypatch.setattr("cosmos_cli.fleet.fleet.connect", connect)
    monkeypatch.setattr("cosmos_cli.commands.reboot.connect", connect)
    path = tmp_path / "inventory.yaml"
    path.write_text(
        "all: {hosts: {imu: {ansible_host: pi01}, pi01: {}, same: {ansible_host: pi01}}}\n"
    )

    code = cosmos(["reboot", "-i", str(path), "--yes"])

    captured = capsys.readouterr()
    assert code == 0
    assert board.asked == ["boot", "lock", "reboot"]
    assert "pi01  left alone: it is imu, under another name\n" in captured.out
    assert "3 machines: 1 back, 2 left alone in " in captured.out


@pytest.mark.process
def test_json_tells_each_machine(inventory: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cosmos(["reboot", "-i", str(inventory), "--yes", "--json", "--limit", "pi01:here"])

    answer = json.loads(capsys.readouterr().out)
    (machine,) = answer["machines"]
    assert (answer["exit_code"], answer["left_alone"]) == (0, ["here"])
    assert (machine["machine"], machine["status"], machine["back_s"]) == (
        "pi01",
        "left_alone",
        None,
    )
