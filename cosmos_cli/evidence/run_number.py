"""
The numbers of runs in a folder: each is given once, also when several runs begin at the same moment.

There is no lock: in a folder that many users share, whoever may open one could hold up everybody. A
directory is made, and given up again for a later number if another of its number is there: of two that
are made at once, at least one sees the other.
"""

from __future__ import annotations

import random
import time
from collections.abc import Callable, Iterable
from pathlib import Path

TRIES_MAX = 200
NUMBER_MAX = 999_999_999
"""A name with a larger one is no run's: whoever may write in a shared folder could make it end there."""
PAUSE_S_MAX = 0.02
Taken = Callable[[], Iterable[tuple[int, str]]]
"""Returns number and name of every run that there is."""


class NoNumber(Exception):
    """Others take every number first, or there is none left."""


def make_numbered(root: Path, slug: str, taken: Taken, *, mode: int) -> Path:
    """
    Make the next directory and return it.

    Args:
        root: Of all runs.
        slug: What follows the number.
        taken: What there is; asked anew for each try.
        mode: Of the directory, whatever the umask.

    Raises:
        OSError: It cannot be made.
        NoNumber: Others were always quicker, or the last number is taken.
    """
    for _ in range(TRIES_MAX):
        number = max((0, *(number for number, _ in taken()))) + 1
        if number > NUMBER_MAX:
            raise NoNumber(f"number {NUMBER_MAX} is taken, and is the last; move that run away")
        path = root / f"{number:04d}-{slug}"
        try:
            path.mkdir(mode=mode)
        except FileExistsError:
            continue
        others = [name for found, name in taken() if found == number and name != path.name]
        if not others:
            path.chmod(mode)
            return path
        path.rmdir()
        time.sleep(random.uniform(0.0, PAUSE_S_MAX))  # noqa: S311 - no secret
    raise NoNumber(f"{root}: others took every number first, {TRIES_MAX} times")
