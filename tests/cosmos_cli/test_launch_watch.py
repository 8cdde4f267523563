"""Signs of life of a run's machines on a clock of the test's own."""

from __future__ import annotations

from functools import partial
from types import SimpleNamespace

import pytest

from cosmos_cli.launch import watch
from cosmos_cli.launch.pulse import SILENCE_S
from cosmos_cli.launch.watch import CHECK_INTERVAL_S, MachineWatch


class Stage:
    """A machine, its supervisor, the operator's loop and whoever is told, with one clock for all."""

    def __init__(self, monkeypatch) -> None:
        self.now_s = 100.0
        monkeypatch.setattr(watch, "time", SimpleNamespace(monotonic=lambda: self.now_s))
        self.does_supervisor_answer = True
        self.is_connected = True
        self.lost: list[tuple[str, str]] = []
        self.asked = 0
        self.deadlines: dict[str, tuple[float, object]] = {}
        loop = SimpleNamespace(
            deadlines=SimpleNamespace(set=self._set, cancel=lambda name: None),
            background=SimpleNamespace(submit=self._submit),
        )
        self.child = SimpleNamespace(name="agents@pi01", send=self._ping)
        machine = SimpleNamespace(is_alive=self._is_alive, return_to=lambda *a, **k: None)
        self.watch = MachineWatch({"pi01": machine}, {"pi01": "/runs"}, loop, self)
        self.watch.add("pi01", self.child, is_host=False)

    def run_for(self, seconds: float) -> None:
        end_s = self.now_s + seconds
        while self.now_s < end_s:
            self.now_s += CHECK_INTERVAL_S
            at_s, check = self.deadlines["pulse"]
            if self.now_s >= at_s:
                check()

    def machine_lost(self, machine, why):
        self.lost.append((machine, why))

    def machine_back(self, machine):
        raise AssertionError(machine)

    def is_wanted(self, machine):
        return False

    def _set(self, name, at_s, act):
        self.deadlines[name] = (at_s, act)

    def _ping(self, question):
        if self.does_supervisor_answer:
            self.watch.pong("pi01", self.child.name, question["n"])

    def _is_alive(self):
        self.asked += 1
        return self.is_connected

    def _submit(self, work, done):
        if isinstance(work, partial):
            return  # the way back of a lost machine is no matter here
        done(work(), None)


@pytest.fixture
def stage(monkeypatch):
    return Stage(monkeypatch)


def test_silent_supervisor_of_a_running_run_is_a_lost_machine(stage):
    stage.run_for(5.0)
    assert stage.lost == []
    assert stage.asked <= 1  # until its first answer

    stage.does_supervisor_answer = False
    stage.run_for(SILENCE_S + 2.0)

    assert stage.lost == [("pi01", f"no sign of life for {SILENCE_S:g} s")]


def test_silent_supervisor_of_an_ending_run_is_asked_for_through_its_connection(stage):
    stage.run_for(5.0)
    stage.watch.expect_ends()
    stage.does_supervisor_answer = False  # it closes its records

    stage.run_for(30.0)

    assert stage.lost == []
    assert stage.asked >= 25


def test_machine_that_goes_while_its_run_ends_is_lost_all_the_same(stage):
    stage.run_for(5.0)
    stage.watch.expect_ends()
    stage.does_supervisor_answer = stage.is_connected = False

    stage.run_for(3.0)

    assert stage.lost == [("pi01", "it does not answer")]
