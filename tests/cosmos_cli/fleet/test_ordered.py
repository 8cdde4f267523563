"""Outcomes in the order of the inventory."""

from __future__ import annotations

from cosmos_cli.fleet.outcome import HOLD_S, InOrder, Outcome
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


def test_nobody_waits_for_long_for_one_that_takes_its_time() -> None:
    told: list[str] = []
    now_s = [0.0]
    targets = [Target(name=name, address=name) for name in ("slow", "a", "b", "slower", "c")]
    take = InOrder[int](
        targets, lambda outcome: told.append(outcome.machine), now_s=lambda: now_s[0]
    )
    seen = []

    for name, at_s in (("b", 1.0), ("a", 1.1), (None, 1.1 + HOLD_S), ("slow", 9.0), ("c", 9.0)):
        now_s[0] = at_s
        take(Outcome(machine=name, value=1)) if name else take.wait()
        seen.append(list(told))
    now_s[0] = 9.0 + 2 * HOLD_S
    take(Outcome(machine="slower", value=1))

    assert seen == [[], [], ["a", "b"], ["a", "b", "slow"], ["a", "b", "slow"]]
    assert told == ["a", "b", "slow", "slower", "c"]
