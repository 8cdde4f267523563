"""Machines of a run as they are reached: two names of one machine are seen before anything is started."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from types import SimpleNamespace

import pytest

from cosmos_cli.errors import InputError
from cosmos_cli.fleet.connection import Completed, Connection, ConnectOptions
from cosmos_cli.fleet.helper import Helper
from cosmos_cli.fleet.local import LocalConnection
from cosmos_cli.fleet.target import Target
from cosmos_cli.launch.machines import RemoteMachine, close_machines, reach_machines

pytestmark = pytest.mark.process


@pytest.fixture
def opened() -> Iterator[list[LocalConnection]]:
    """Connections that were made."""
    made: list[LocalConnection] = []
    yield made
    for connection in made:
        connection.close()


def reached(opened: list[LocalConnection], roots: Mapping[str, Path]) -> dict[str, RemoteMachine]:
    """Reach this computer by several names, each with a folder."""

    def connect(target: Target, options: ConnectOptions) -> Connection:
        opened.append(LocalConnection(target))
        return opened[-1]

    def prepare(target: Target, board: Helper) -> SimpleNamespace:
        return SimpleNamespace(
            python="python3", base_directory="", driver_directory="", variables=dict
        )

    targets = [
        Target(name=name, address=f"{name}.example", root=str(root)) for name, root in roots.items()
    ]
    return reach_machines(
        targets, prepare, parts=(), options=ConnectOptions(), connect=connect, forks=2
    )


def test_one_machine_that_was_reached_by_two_addresses_is_refused(opened, tmp_path):
    with pytest.raises(
        InputError, match=r"a \(a.example\) and b \(b.example\) are one machine.*--limit"
    ):
        reached(opened, {"a": tmp_path, "b": tmp_path})


def test_two_folders_on_one_machine_are_two_machines(opened, tmp_path):
    machines = reached(opened, {"a": tmp_path / "a", "b": tmp_path / "b"})
    close_machines(tuple(machines.values()))

    assert list(machines) == ["a", "b"]


@pytest.mark.parametrize(
    ("said", "status", "is_anew"),
    [("another\n", 0, True), ("", 1, False), ("no room\n", 254, False)],
)
def test_only_another_boot_is_a_new_start(opened, tmp_path, said, status, is_anew):
    machines = reached(opened, {"a": tmp_path})
    (machine,) = machines.values()
    assert not machine.has_started_anew()

    told = Completed(exit_status=status, stdout=said.encode(), stderr=b"")
    machine.connection.run = lambda command, timeout_s: told

    assert machine.has_started_anew() is is_anew
    close_machines(tuple(machines.values()))
