"""Many machines at once: every outcome is kept, and nobody's failure or slowness hides another's."""

import _thread
import threading
import time

import pytest

from cosmos_cli.errors import InputError, MachinesError
from cosmos_cli.fleet.failure import FailureKind, MachineFailure
from cosmos_cli.fleet.outcome import raise_if_failed
from cosmos_cli.fleet.pool import for_each
from cosmos_cli.fleet.target import Target

TARGETS = [Target(name=f"pi{n}", address=f"10.0.0.{n}") for n in range(8)]
WAIT_S = 20.0


def test_outcomes_come_in_the_order_of_the_machines_whoever_is_done_first():
    gates = {target.name: threading.Event() for target in TARGETS}
    done = []

    def work(target):
        assert gates[target.name].wait(WAIT_S)
        return target.name.upper()

    def open_next(outcome):
        done.append(outcome.machine)
        for name in reversed(gates):
            if not gates[name].is_set():
                gates[name].set()
                return

    gates["pi7"].set()
    outcomes = for_each(TARGETS, work, forks=8, on_done=open_next)

    assert [outcome.value for outcome in outcomes] == [t.name.upper() for t in TARGETS]
    assert done == [target.name for target in reversed(TARGETS)]


def test_failure_of_one_machine_hides_nobody():
    def work(target):
        if target.name == "pi3":
            raise MachineFailure(FailureKind.REFUSED, "refused", "do this")
        return 1

    outcomes = for_each(TARGETS, work)

    assert [outcome.machine for outcome in outcomes if not outcome.is_ok] == ["pi3"]
    assert sum(outcome.value or 0 for outcome in outcomes) == 7
    with pytest.raises(
        MachinesError, match=r"ping: 1 of 8 machines failed:\n  pi3: refused; do this"
    ):
        raise_if_failed(outcomes, "ping")


def test_surprise_is_one_machines_defect():
    outcomes = for_each(TARGETS[:2], lambda target: 1 / (target.name == "pi1"))

    assert outcomes[0].failure is not None
    assert outcomes[0].failure.kind is FailureKind.DEFECT
    assert "ZeroDivisionError" in outcomes[0].failure.text
    assert outcomes[1].value == 1.0


def test_fault_in_the_operators_own_files_ends_all():
    def work(target):
        raise InputError("ssh configuration: wrong")

    with pytest.raises(InputError, match="wrong"):
        for_each(TARGETS, work)


def test_no_more_than_forks_machines_at_a_time():
    lock = threading.Lock()
    now, most = 0, 0

    def work(target):
        nonlocal now, most
        with lock:
            now += 1
            most = max(most, now)
        time.sleep(0.01)
        with lock:
            now -= 1

    for_each(TARGETS, work, forks=3)

    assert most <= 3


def test_no_machine_is_no_work():
    assert for_each([], lambda target: 1) == []


def test_interrupt_leaves_alone_who_has_not_begun_and_does_not_wait():
    begun = []
    release = threading.Event()

    def work(target):
        begun.append(target.name)
        _thread.interrupt_main()
        release.wait(WAIT_S)

    start_s = time.monotonic()
    try:
        with pytest.raises(KeyboardInterrupt):
            for_each(TARGETS, work, forks=1)
        assert time.monotonic() - start_s < WAIT_S / 2
    finally:
        release.set()
    time.sleep(0.05)

    assert begun == ["pi0"]
