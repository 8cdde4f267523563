"""Outcomes in the order of the inventory."""

from __future__ import annotations

from cosmos_cli.fleet.ordered import InOrder
from cosmos_cli.fleet.outcome import Outcome
from cosmos_cli.fleet.target import Target


def test_outcomes_wait_for_those_before_them() -> None:
    told: list[str] = []
    targets = [Target(name=name, address=name) for name in ("a", "b", "c")]
    take = InOrder[int](targets, lambda outcome: told.append(outcome.machine))
    seen = []

    for name in ("b", "a", "c"):
        take(Outcome(machine=name, value=1))
        seen.append(list(told))

    assert seen == [[], ["a", "b"], ["a", "b", "c"]]
