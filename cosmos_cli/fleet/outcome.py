"""What became of each machine: a value or a failure, never neither, and nobody's result hides another's."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from cosmos_cli.errors import MachinesError
from cosmos_cli.fleet.failure import MachineFailure

T = TypeVar("T")
NAMES_SHOWN_MAX = 8


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
        MachinesError: Its text has a line a failed machine.
    """
    bad = failed(outcomes)
    if bad:
        lines = "".join(f"\n  {outcome.machine}: {outcome.failure}" for outcome in bad)
        raise MachinesError(f"{what}: {len(bad)} of {len(outcomes)} machines failed:{lines}")
