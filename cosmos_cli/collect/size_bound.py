"""Bounds on a machine's records of a run, and on the time to read them there. Pure."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

from cosmos_cli.fleet.failure import FailureKind, MachineFailure
from cosmos_cli.ui.sizes import size_words
from madns_runtime.config import RunConfig
from madns_runtime.timing.rate import count_ticks

TICK_BYTES = 64 * 1024
"""Bytes that an agent may have recorded per tick: some hundred times what the shipped simulations do."""
BASE_BYTES = 1024**3
"""Bytes that any machine may have: logs, output of flight programs, and runs of which no plan is left."""
HASH_BASE_S = 60.0
HASH_BYTES_S_MIN = 2_000_000
"""A board with a slow card and a busy processor reads and hashes several times as much."""
FILE_S_MAX = 0.02
UNITS = {"": 1, "k": 10**3, "m": 10**6, "g": 10**9, "t": 10**12}
SIZE = re.compile(r"(\d{1,15}(?:\.\d{1,6})?)\s*([kmgt]?)b?", re.IGNORECASE)


@dataclass(frozen=True, slots=True)
class SizedFile:
    """One file that a machine has of a run."""

    path: str
    size_bytes: int


def recordable_bytes(config: RunConfig | None, agents: int, *, is_host: bool) -> int:
    """
    Return a generous bound of what a machine can have recorded.

    Args:
        config: Of the run; None if it is lost.
        agents: How many the machine had.
        is_host: Whether it had the host, which records of all agents.
    """
    if config is None:
        return BASE_BYTES
    ticks = count_ticks(config.time.duration_s, config.agents.tick_hz)
    incarnations = 1 + config.agents.restarts_max
    recorders = agents * incarnations + (config.agents.count if is_host else 0)
    return BASE_BYTES + ticks * recorders * TICK_BYTES


def check_sizes(files: Sequence[SizedFile], bytes_max: int, directory: str, *, run: str) -> None:
    """
    See that a machine has no more of a run than it can have recorded.

    Args:
        files: Those that it has.
        bytes_max: What it can have recorded.
        directory: Where they are there.
        run: What `cosmos collect` is told, for a shell.

    Raises:
        MachineFailure: It has.
    """
    total = sum(file.size_bytes for file in files)
    if total <= bytes_max:
        return
    largest = max(files, key=lambda file: file.size_bytes)
    raise MachineFailure(
        FailureKind.DATA,
        f"{directory} holds {size_words(total)}, of which {largest.path} is"
        f" {size_words(largest.size_bytes)}; by its plan the run can have recorded at most"
        f" {size_words(bytes_max)} there",
        f"look at it there; if it is right, repeat with: cosmos collect --size-max SIZE {run}",
    )


def hash_deadline_s(files: int, size_bytes: int) -> float:
    """Return how long a machine may take to read and hash so much."""
    return HASH_BASE_S + files * FILE_S_MAX + size_bytes / HASH_BYTES_S_MIN


def parse_size(text: str) -> int:
    """
    Return a size in bytes, such as 20GB, 1.5 TB or 1000000.

    Raises:
        ValueError: It is none.
    """
    match = SIZE.fullmatch(text.strip())
    if match is None or float(match[1]) <= 0:
        raise ValueError(f"expected a size such as 20GB or 1500000, got {text!r}")
    return int(float(match[1]) * UNITS[match[2].lower()])
