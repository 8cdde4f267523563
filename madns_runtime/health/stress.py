"""Work beside a run: processes that factorise primes, to see what load costs (thesis A.2.7)."""

from __future__ import annotations

import random
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from madns_runtime.health.lifeline import ChildProcess, Lifeline, fork_child

NUMBER_BITS = 36
"""Size of the numbers: trial division of the worst takes some 10 ms on a board."""


@dataclass(frozen=True, slots=True, kw_only=True)
class StressReport:
    """Work done by the workers."""

    factored: tuple[int, ...]
    """Numbers factorised, one entry per worker."""
    errors: tuple[str, ...] = ()


def start_stress(workers: int) -> tuple[ChildProcess, ...]:
    """
    Start the processes; each uses what it gets of a processor, at ordinary niceness.

    Args:
        workers: How many; 0 for none.
    """
    return tuple(fork_child(_worker(seed)) for seed in range(workers))


def stop_stress(workers: Sequence[ChildProcess], timeout_s: float) -> StressReport:
    """
    End the workers and return what they have done.

    Args:
        workers: What `start_stress` returned.
        timeout_s: For all of them; who takes longer is killed, and "errors" says so.
    """
    end_s = time.monotonic() + timeout_s
    for worker in workers:
        worker.stop()
    reports = [worker.wait(max(0.0, end_s - time.monotonic())) for worker in workers]
    return StressReport(
        factored=tuple(int(report.get("factored", 0)) for report in reports),
        errors=tuple(error for report in reports for error in report.get("errors", ())),
    )


def factorise(number: int) -> list[int]:
    """
    Return the prime factors of *number* in ascending order, by trial division.

    Raises:
        ValueError: *number* is below 1.
    """
    if number < 1:
        raise ValueError(f"expected a positive number, got {number}")
    factors, divisor = [], 2
    while divisor * divisor <= number:
        while number % divisor == 0:
            factors.append(divisor)
            number //= divisor
        divisor += 1 if divisor == 2 else 2
    return [*factors, number] if number > 1 else factors


def _worker(seed: int) -> Any:
    def main(lifeline: Lifeline) -> Mapping[str, Any]:
        numbers = random.Random(seed)
        factored = 0
        while not lifeline.has_ended():
            factorise(numbers.getrandbits(NUMBER_BITS) | 1)
            factored += 1
        return {"factored": factored}

    return main
