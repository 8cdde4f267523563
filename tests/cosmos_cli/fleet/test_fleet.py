"""A fleet connects, works and closes: also when a task fails, and when the operator interrupts it."""

import _thread
import threading
from typing import get_args

import pytest
from harness.waiting import wait_until

from cosmos_cli.commands.fleet_command import warn_of_same
from cosmos_cli.fleet import fleet as module
from cosmos_cli.fleet.connection import ConnectOptions
from cosmos_cli.fleet.failure import FailureKind, MachineFailure
from cosmos_cli.fleet.fleet import Fleet, fleet_of
from cosmos_cli.fleet.open_connection import OPENERS, connect
from cosmos_cli.fleet.target import Target
from cosmos_cli.models.connection_kind import (
    CONNECTION_OF_WORD,
    AnsibleConnection,
    ConnectionKind,
)
from cosmos_cli.ui.console import Console

WAIT_S = 20.0
TARGETS = tuple(Target(name=f"pi{n}", address=f"10.0.0.{n}") for n in range(3))


class Pretended:
    """A connection that notes whether it was closed."""

    def __init__(self, target):
        self.target = target
        self.closed = threading.Event()

    def close(self):
        self.closed.set()


@pytest.fixture
def connections(monkeypatch):
    made = {}

    def connect(target, options):
        if target.name == "pi2":
            raise MachineFailure(FailureKind.REFUSED, "refused")
        made[target.name] = Pretended(target)
        return made[target.name]

    monkeypatch.setattr(module, "connect", connect)
    return made


def test_every_connection_is_closed_whatever_its_task_did(connections):
    def task(connection):
        if connection.target.name == "pi1":
            raise MachineFailure(FailureKind.STEP, "failed")
        return connection.target.address

    outcomes = Fleet(targets=TARGETS).each_target(task)

    assert [outcome.value for outcome in outcomes] == ["10.0.0.0", None, None]
    kinds = [outcome.failure.kind for outcome in outcomes if outcome.failure]
    assert kinds == [FailureKind.STEP, FailureKind.REFUSED]
    assert all(connection.closed.is_set() for connection in connections.values())


def test_interrupt_closes_what_is_open_so_that_what_runs_there_ends(connections):
    both = threading.Barrier(2)

    def task(connection):
        both.wait(WAIT_S)
        if connection.target.name == "pi1":
            _thread.interrupt_main()
        assert connection.closed.wait(WAIT_S)

    with pytest.raises(KeyboardInterrupt):
        Fleet(targets=TARGETS[:2]).each_target(task)

    assert all(connection.closed.is_set() for connection in connections.values())


def test_connection_that_opens_after_an_interrupt_is_closed_and_nothing_is_done_there(
    connections, monkeypatch
):
    connect, is_interrupted, late = module.connect, threading.Event(), []

    def connect_late(target, options):
        if target.name == "pi0":
            assert is_interrupted.wait(WAIT_S)
            late.append(connect(target, options))
            return late[0]
        return connect(target, options)

    def task(connection):
        done.append(connection.target.name)
        if connection.target.name == "pi1":
            _thread.interrupt_main()
        assert connection.closed.wait(WAIT_S)

    done = []
    monkeypatch.setattr(module, "connect", connect_late)
    with pytest.raises(KeyboardInterrupt):
        Fleet(targets=TARGETS[:2]).each_target(task)
    is_interrupted.set()

    wait_until(lambda: late and late[0].closed.is_set(), "end of the connection")
    assert done == ["pi1"]


def test_task_is_given_what_the_inventory_says_of_its_machine(connections, tmp_path):
    inventory = tmp_path / "tower.yaml"
    inventory.write_text("all:\n  hosts:\n    pi0: {cosmos_devices: [sense_hat]}\n    pi1:\n")

    outcomes = fleet_of(inventory, forks=2).each(
        lambda _, machine: machine.variables.cosmos_devices
    )

    assert [outcome.value for outcome in outcomes] == [("sense_hat",), None]


def test_every_kind_of_connection_has_its_way_to_be_opened_and_every_word_of_ansible_a_kind():
    assert set(OPENERS) == set(get_args(ConnectionKind)) == set(CONNECTION_OF_WORD.values())
    assert set(CONNECTION_OF_WORD) == set(get_args(AnsibleConnection))


@pytest.fixture
def network(monkeypatch):
    """The addresses that answer."""
    answering = set()

    def open_(target, _options):
        if target.address not in answering:
            text = f"{target.address} port 22: no route"
            raise MachineFailure(FailureKind.UNREACHABLE, text, "is it switched on?")
        return Pretended(target)

    monkeypatch.setitem(OPENERS, "ssh", open_)
    return answering


MOVED = Target(name="pi1", address="10.0.9.1", user="pi", root="~/other")
LISTED = ConnectOptions(listed={"pi1": MOVED})


def test_machine_that_has_another_address_by_now_is_reached_where_the_inventory_has_it(network):
    network.add("10.0.9.1")

    found = connect(TARGETS[1], LISTED).target

    assert (found.address, found.user, found.root) == ("10.0.9.1", "pi", TARGETS[1].root)


def test_machine_that_answers_where_it_was_is_not_looked_for_elsewhere(network):
    network |= {"10.0.0.1", "10.0.9.1"}

    assert connect(TARGETS[1], LISTED).target == TARGETS[1]


def test_machine_that_answers_nowhere_is_told_with_both_addresses(network):
    with pytest.raises(MachineFailure) as caught:
        connect(TARGETS[1], LISTED)
    assert "10.0.0.1 port 22: no route; and where the inventory has it, 10.0.9.1" in str(
        caught.value
    )
    with pytest.raises(MachineFailure) as caught:
        connect(TARGETS[2], LISTED)
    assert "inventory" not in str(caught.value)


def test_two_names_of_one_machine_are_warned_of(capsys):
    places = {"a": ("10.0.0.1", None), "b": ("10.0.0.1", None), "c": ("10.0.0.1", 2222)}
    targets = [Target(name=name, address=at, port=port) for name, (at, port) in places.items()]
    local = [Target(name=name, address="here", connection="local") for name in ("d", "e")]

    warn_of_same(Console(), Fleet(targets=(*targets, *local)))

    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(
        "warning: a and b are one machine, 10.0.0.1, which is worked on for each"
    )
