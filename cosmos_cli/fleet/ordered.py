"""Outcomes in the order of the inventory, each as soon as those before it are there."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Generic, TypeVar

from cosmos_cli.fleet.outcome import Outcome
from cosmos_cli.fleet.target import Target

T = TypeVar("T")


class InOrder(Generic[T]):
    """
    Passes outcomes on; call it as `on_done`.

    Args:
        targets: All machines that will be done.
        tell: Called with each outcome, in the order of *targets*.
    """

    def __init__(self, targets: Sequence[Target], tell: Callable[[Outcome[T]], None]) -> None:
        self._waiting = [target.name for target in targets]
        self._done: dict[str, Outcome[T]] = {}
        self._tell = tell

    def __call__(self, outcome: Outcome[T]) -> None:
        """Take one outcome, and pass on what has its turn."""
        self._done[outcome.machine] = outcome
        while self._waiting and self._waiting[0] in self._done:
            self._tell(self._done.pop(self._waiting.pop(0)))
