"""Who is checked in full: the first of a kind; all of them when it fails."""

import dataclasses
import threading

import pytest

from cosmos_cli.fleet.layout import Layout
from cosmos_cli.models.machine_facts import Computer, Disk, Interpreter, MachineFacts
from cosmos_cli.provision.desired import DesiredState
from cosmos_cli.provision.full_checks import FullChecks, machine_kind

BOARD = Computer(model="Raspberry Pi 4", machine="aarch64", processor_kind="a72")
FACTS = MachineFacts(
    user="pi",
    uid=1000,
    home="/home/pi",
    board=BOARD,
    python=Interpreter(version=(3, 11, 2), executable="/usr/bin/python3", libc="glibc 2.36"),
    disk=Disk(path="/", total_bytes=1, free_bytes=1),
)
DESIRED = DesiredState(layout=Layout("/home/pi/cosmos"))
DEADLINE_S = 60.0


def turn(checks, kind):
    with checks.turn(kind) as is_full:
        return is_full


def test_first_of_a_kind_is_checked_in_full_and_the_others_are_not():
    checks = FullChecks()

    assert [turn(checks, kind) for kind in ("a", "a", "b", "a", "b")] == [
        True, False, True, False, False,
    ]  # fmt: skip


def test_machine_of_no_known_kind_is_always_checked_in_full():
    checks = FullChecks()

    assert [turn(checks, None) for _ in range(3)] == [True] * 3


def test_others_wait_for_the_first():
    checks, entered, may_end = FullChecks(), threading.Event(), threading.Event()
    told = []

    def first():
        with checks.turn("a") as is_full:
            told.append(is_full)
            entered.set()
            may_end.wait(DEADLINE_S)
            told.append("passed")

    threads = [threading.Thread(target=first)]
    threads[0].start()
    entered.wait(DEADLINE_S)
    threads += [threading.Thread(target=lambda: told.append(turn(checks, "a"))) for _ in range(3)]
    for thread in threads[1:]:
        thread.start()
    may_end.set()
    for thread in threads:
        thread.join(DEADLINE_S)

    assert told == [True, "passed", False, False, False]


def test_after_a_failure_each_is_checked_in_full_until_one_passes():
    checks = FullChecks()
    with pytest.raises(ValueError, match="no numpy"), checks.turn("a"):
        raise ValueError("no numpy")
    with checks.turn("a") as second, checks.turn("a") as third:  # nobody waits for it
        told = [second, third]

    assert [*told, turn(checks, "a")] == [True, True, False]


@pytest.mark.parametrize(
    "change", [{"processor_kind": "a76"}, {"kernel": "6.12"}, {"machine": "armv7l"}]
)
def test_machines_that_differ_in_what_imports_stand_on_are_of_two_kinds(change):
    other = dataclasses.replace(FACTS, board=dataclasses.replace(BOARD, **change))
    same = dataclasses.replace(FACTS, uid=1001, board=dataclasses.replace(BOARD, node="pi02"))

    assert machine_kind(other, DESIRED) != machine_kind(FACTS, DESIRED)
    assert machine_kind(same, DESIRED) == machine_kind(FACTS, DESIRED)


def test_machine_whose_processor_is_not_known_is_of_no_kind():
    unknown = dataclasses.replace(FACTS, board=dataclasses.replace(BOARD, processor_kind=None))

    assert machine_kind(unknown, DESIRED) is None
