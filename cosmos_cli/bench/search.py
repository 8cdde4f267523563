"""
Search of the largest number of agents that keeps a budget: doubling until it breaks, then bisection.

Pure: it says which number is to be tried next and is told what came of it.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(slots=True, kw_only=True)
class CapacitySearch:
    """One search; `following` and `tell` take turns."""

    first: int
    """Number of agents of the first trial."""
    largest: int
    """Beyond it nothing is tried."""
    resolution: float = 0.05
    """The search ends when the smallest number that broke is within this share above the largest that held, or next to it."""
    held: int = 0
    """Largest number that kept the budget; 0 for none."""
    broken: int | None = None
    """Smallest number that broke it; None for none."""

    def __post_init__(self) -> None:
        if not 1 <= self.first <= self.largest:
            raise ValueError(f"expected 1 <= first <= largest, got {self.first}, {self.largest}")

    def following(self) -> int | None:
        """Return the number of agents to try next; None when the search has ended."""
        if self.broken is None:
            if self.held >= self.largest:
                return None
            return min(self.held * 2, self.largest) if self.held else self.first
        if self.broken - self.held <= max(1, int(self.resolution * self.held)):
            return None
        return (self.held + self.broken) // 2

    def tell(self, count: int, *, holds: bool) -> None:
        """
        Take the outcome of a trial.

        Raises:
            ValueError: It is not between what held and what broke, so it was not asked for.
        """
        if count <= self.held or (self.broken is not None and count >= self.broken):
            raise ValueError(f"expected {self.held} < count < {self.broken}, got {count}")
        if holds:
            self.held = count
        else:
            self.broken = count
