"""Seeds of a suite: 1..20, or 1,5,9, or both."""

from __future__ import annotations

import re

from cosmos_cli.errors import InputError
from madns_runtime.config import SEED_MAX

SEEDS_MAX = 10_000
_PART = re.compile(r"([0-9]{1,20})(?:\.\.([0-9]{1,20}))?")


def parse_seeds(text: str) -> tuple[int, ...]:
    """
    Return the seeds that are meant, in order, each once.

    Raises:
        InputError: The text is malformed, or means too many or too large ones.
    """
    found: dict[int, None] = {}
    for part in text.split(","):
        match = _PART.fullmatch(part.strip())
        if match is None:
            raise InputError(f"--seeds: expected numbers or ranges such as 1..20, got {part!r}")
        first = int(match[1])
        last = int(match[2]) if match[2] else first
        if last < first:
            raise InputError(f"--seeds: expected a range that goes up, got {part.strip()}")
        if last > SEED_MAX:
            raise InputError(f"--seeds: expected seeds of at most {SEED_MAX}, got {last}")
        is_short = last - first < SEEDS_MAX
        found |= dict.fromkeys(range(first, last + 1) if is_short else ())
        if not is_short or len(found) > SEEDS_MAX:
            raise InputError(f"--seeds: expected at most {SEEDS_MAX} seeds")
    return tuple(found)
