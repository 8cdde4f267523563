"""Outcome of each machine: a value or a failure, never neither, and nobody's result hides another's."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from cosmos_cli.errors import MachinesError
from cosmos_cli.fleet.failure import MachineFailure
from cosmos_cli.fleet.target import Target

T = TypeVar("T")
HOLD_S = 0.5
"""Time that an outcome waits for those before it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Outcome(Generic[T]):
    """One machine's."""

    machine: str
    value: T | None = None
    failure: MachineFailure | None = None
    duration_s: float = 0.0

    @property
    def is_ok(self) -> bool:
        """Whether it did what it was asked to."""
        return self.failure is None

    def to_mapping(self, value: Any = None) -> dict[str, Any]:
        """Return plain values for --json; *value* stands for the outcome's own."""
        return {
            "machine": self.machine,
            "ok": self.is_ok,
            "failure": self.failure.to_mapping() if self.failure else None,
            "duration_s": round(self.duration_s, 3),
            **(value or {}),
        }


def failed(outcomes: Iterable[Outcome[T]]) -> list[Outcome[T]]:
    """Return those that failed."""
    return [outcome for outcome in outcomes if not outcome.is_ok]


def raise_if_failed(outcomes: Sequence[Outcome[T]], what: str) -> None:
    """
    Raise when any machine failed, naming each and why.

    Raises:
        MachinesError: Its text has one line per failed machine.
    """
    bad = failed(outcomes)
    if bad:
        lines = "".join(f"\n  {outcome.machine}: {outcome.failure}" for outcome in bad)
        raise MachinesError(f"{what}: {len(bad)} of {len(outcomes)} machines failed:{lines}")


def failure_teller(say: Callable[[str], object]) -> Callable[[Outcome[Any]], None]:
    """Return what tells each machine's failure by *say* when it happens; call it as `on_done`."""

    def tell(outcome: Outcome[Any]) -> None:
        if outcome.failure is not None:
            say(f"{outcome.machine}: failed: {outcome.failure}")

    return tell


class InOrder(Generic[T]):
    """
    Passes outcomes on in the order of the inventory, unless a machine keeps the others waiting.

    Call it as `on_done`, and its `wait` as `on_wait`.

    Args:
        targets: All machines that will be done.
        tell: Called with each outcome, in the order of *targets* as far as nobody waits for long.
        now_s: A monotonic clock.
    """

    def __init__(
        self,
        targets: Sequence[Target],
        tell: Callable[[Outcome[T]], None],
        *,
        now_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self._waiting = [target.name for target in targets]
        self._done: dict[str, Outcome[T]] = {}
        self._tell = tell
        self._now_s = now_s
        self._held_since_s: float | None = None

    def __call__(self, outcome: Outcome[T]) -> None:
        """Take one outcome, and pass on what has its turn."""
        self._done[outcome.machine] = outcome
        while self._waiting and self._waiting[0] in self._done:
            self._tell(self._done.pop(self._waiting.pop(0)))
        if not self._done:
            self._held_since_s = None
        elif self._held_since_s is None:
            self._held_since_s = self._now_s()
        self.wait()

    def wait(self) -> None:
        """Pass on what has waited for long enough; called again and again while machines are at work."""
        if self._held_since_s is None or self._now_s() - self._held_since_s < HOLD_S:
            return
        self._held_since_s = None
        ready = [name for name in self._waiting if name in self._done]
        self._waiting = [name for name in self._waiting if name not in self._done]
        for name in ready:
            self._tell(self._done.pop(name))
