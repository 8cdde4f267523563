"""Partition of the agents among the workers."""

from __future__ import annotations

import os

from madns_runtime.config import Agents


def share_out(agents: Agents, processors: int) -> list[range]:
    """
    Return the indices of each worker's agents: neighbours, in order, at most one more here than there.

    Args:
        agents: How many agents; with per_process above 1, how many at most share a worker.
        processors: As many workers as these otherwise, but never more than agents.
    """
    wanted = processors if agents.per_process == 1 else -(-agents.count // agents.per_process)
    workers = max(1, min(wanted, agents.count))
    bounds = [agents.count * number // workers for number in range(workers + 1)]
    return [range(first, last) for first, last in zip(bounds, bounds[1:], strict=False)]


def processors_here() -> int:
    """Return how many processors this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
