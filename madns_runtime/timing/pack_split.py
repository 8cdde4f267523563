"""How the agents of a process are split into packs that tick together (`realtime.packs`). Pure."""

from __future__ import annotations

import math
from collections.abc import Sequence

PACK_AGENTS_MAX = 8
"""Agents of a process that share a deadline, and so a wake-up."""


def split_into_packs(names: Sequence[str]) -> list[Sequence[str]]:
    """Return the agents of a process in as few packs of PACK_AGENTS_MAX at most as hold them, as even as can be."""
    count = math.ceil(len(names) / PACK_AGENTS_MAX)
    bounds = [round(number * len(names) / count) for number in range(count + 1)]
    return [names[start:end] for start, end in zip(bounds, bounds[1:], strict=False)]


def packs_on_machine(names: Sequence[str], per_process: int) -> list[Sequence[str]]:
    """Return the packs of all processes of a machine that runs the agents *names*."""
    starts = range(0, len(names), per_process)
    return [
        pack for start in starts for pack in split_into_packs(names[start : start + per_process])
    ]
