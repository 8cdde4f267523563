"""`cosmos packages` over machines whose apt is played."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from cosmos_cli.app import run as cosmos
from cosmos_cli.commands.packages import Action, check_names
from cosmos_cli.errors import InputError
from cosmos_cli.fleet.connection import Connection, ConnectOptions
from cosmos_cli.fleet.failure import FailureKind, MachineFailure
from cosmos_cli.fleet.local import LocalConnection
from cosmos_cli.fleet.target import Target

TOLD: dict[str, Any] = {
    "pi01": [{"doing": "..."}, {"changes": [], "notes": []}],
    "pi02": [
        {
            "changes": [
                {"name": "bar", "old": None, "new": "1.0"},
                {"name": "baz", "old": "2.0", "new": None},
                {"name": "foo", "old": "1.0", "new": "1.1"},
            ],
            "notes": ["wants a reboot: `cosmos reboot`"],
        }
    ],
    "pi03": MachineFailure(FailureKind.BUSY, "locked", "wait"),
}
TOLD |= dict.fromkeys(("pi04", "pi05"), TOLD["pi02"])


@pytest.mark.parametrize("name", ["i2c-tools", "libfoo2++", "foo:armhf", "foo=1.2-3~deb12u1+b1"])
def test_names_of_packages_are_taken(name: str) -> None:
    assert check_names(Action.INSTALL, [name, name]) == [name]


@pytest.mark.parametrize(
    "name", ["numpy>=1.24", "PyYAML", "a[b]", "./x.whl", "-oDebug=1", "foo-", "pkg==1", "x_y"]
)
def test_what_is_no_name_of_a_package_is_told_with_where_it_belongs(name: str) -> None:
    with pytest.raises(InputError, match="`requirements` of the scenario"):
        check_names(Action.INSTALL, ["fine", name])


def test_name_is_needed_but_for_upgrade() -> None:
    with pytest.raises(InputError, match="name the packages to remove"):
        check_names(Action.REMOVE, [])

    assert check_names(Action.UPGRADE, []) == []


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, dict[str, Any], bool]]:
    asked: list[tuple[str, dict[str, Any], bool]] = []

    class PlayedBoard:
        def __init__(self, name: str) -> None:
            self.name = name
            self.greeting = {"uid": 1000}

        @classmethod
        def start(cls, connection: Connection, parts: object) -> PlayedBoard:
            return cls(connection.target.name)

        def call(
            self, verb: str, arguments: dict[str, Any] | None = None, *, as_root: bool = False
        ) -> None:
            self.refuse(as_root)
            asked.append((verb, arguments or {}, as_root))

        def refuse(self, as_root: bool) -> None:
            if as_root and self.name == "pi05":
                raise MachineFailure(FailureKind.NO_SUDO, "a password is required", "allow it")

        def pieces(
            self, verb: str, arguments: dict[str, Any], *, as_root: bool, **deadlines: float
        ) -> Any:
            assert set(deadlines) == {"timeout_s", "whole_s"}
            self.refuse(as_root)
            asked.append((verb, arguments, as_root))
            told = TOLD[self.name]
            if isinstance(told, MachineFailure):
                raise told
            for value in told:
                yield type("Answer", (), {"value": value})()

        def __enter__(self) -> PlayedBoard:
            return self

        def __exit__(self, *error: object) -> None:
            pass

    monkeypatch.setattr("cosmos_cli.commands.packages.Helper", PlayedBoard)
    return asked


@pytest.fixture
def inventory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    def connect(target: Target, options: ConnectOptions) -> LocalConnection:
        return LocalConnection(target)

    monkeypatch.setattr("cosmos_cli.fleet.fleet.connect", connect)
    path = tmp_path / "inventory.yaml"
    path.write_text(
        'all: {hosts: {"pi[01:03]": {}, pi04: {ansible_become: false},'
        " here: {ansible_connection: local}}}\n"
    )
    return path


def test_each_machine_tells_what_changed(
    asked: list[Any], inventory: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code = cosmos(["packages", "install", "foo", "bar", "-i", str(inventory)])

    captured = capsys.readouterr()
    assert code == 3
    assert captured.out.splitlines()[:4] == [
        "pi01  ok",
        "pi02  changed  bar 1.0 (new), baz 2.0 (removed), foo 1.0 -> 1.1"
        "  (wants a reboot: `cosmos reboot`)",
        "pi03  failed   locked; wait",
        "pi04  failed   the inventory forbids to become root there (ansible_become: false);"
        " leave that machine out with --limit",
    ]
    assert captured.out.splitlines()[4].startswith("4 machines: 1 changed, 1 ok, 2 failed in ")
    assert captured.err.startswith(
        "here: left alone, it is this computer\n2 machines of 4 failed (pi03, pi04);"
    )
    assert sorted(verb for verb, _, _ in asked) == ["lock"] * 3 + ["packages"] * 3
    assert {is_root for verb, _, is_root in asked if verb == "packages"} == {True}


@pytest.mark.parametrize("name", ["pi04", "pi05"])
def test_check_fails_where_nobody_may_become_root_for_the_change(
    asked: list[Any], inventory: Path, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    inventory.write_text("all: {hosts: {pi04: {ansible_become: false}, pi05: {}}}\n")
    told = []
    for words in ([], ["--check"]):
        code = cosmos(["packages", "upgrade", "-i", str(inventory), "-l", name, *words])
        told.append((code, capsys.readouterr().out.splitlines()[0]))

    assert told[0] == told[1]
    assert told[0][0] == 3


def test_check_takes_no_lock_and_changes_nothing_as_root(
    asked: list[Any], inventory: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code = cosmos(["packages", "upgrade", "--check", "-i", str(inventory), "-l", "pi02", "--json"])

    answer = json.loads(capsys.readouterr().out)
    (verb, arguments, is_root), *after = asked
    assert (code, verb, arguments["is_check"], is_root) == (0, "packages", True, False)
    assert after == [("look", {}, True)]
    assert (answer["changed"], answer["failed"], answer["is_check"]) == (1, 0, True)
    assert answer["machines"][0]["changes"][0] == {"name": "bar", "old": None, "new": "1.0"}
