"""A run's end on a machine that brings its records and cannot delete them: green, and told."""

from __future__ import annotations

import contextlib
from types import SimpleNamespace

from cosmos_cli.collect import retrieve
from cosmos_cli.collect.machine_retrieval import Retrieved
from cosmos_cli.fleet.connection import ConnectOptions
from cosmos_cli.fleet.outcome import Outcome
from cosmos_cli.launch import execute

REMARK = "it could not be deleted there: /home/pi/cosmos/runs/0001-c: Read-only file system"


class Fetched(contextlib.nullcontext):
    """A retrieval that is done."""

    def __init__(self, outcomes: list[Outcome[Retrieved]]) -> None:
        super().__init__(self)
        self.fetch = lambda: outcomes


def test_copy_that_stays_on_a_machine_is_a_warning_of_the_run(monkeypatch):
    kept = Retrieved(files=7, bytes=100, is_released=False, remark=REMARK)
    gone = Retrieved(files=7, bytes=100)
    outcomes = [Outcome(machine="pi01", value=gone), Outcome(machine="pi02", value=kept)]
    monkeypatch.setattr(retrieve, "Retrieval", lambda *_, **__: Fetched(outcomes))
    said: list[tuple[str, str]] = []
    view = SimpleNamespace(say=lambda text, level: said.append((text, level)), work=None)
    machine = SimpleNamespace(connection=None)
    prepared = SimpleNamespace(remote={"pi01": machine, "pi02": machine}, run=None)
    options = SimpleNamespace(connecting=ConnectOptions(), forks=2)

    problems = execute._retrieve(prepared, options, view, is_wanted=True)

    assert problems == ()
    assert said == [(f"pi02: its records are here, but the copy stays: {REMARK}", "warning")]
