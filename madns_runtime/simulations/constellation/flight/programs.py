"""Finds the program that a scenario names; also for `cosmos validate`, which must answer at once."""

from __future__ import annotations

import os
import shutil
from collections.abc import Sequence
from pathlib import Path


def find_program(command: Sequence[str], base_directory: Path) -> list[str] | None:
    """
    Return a command with its program's path, or None if there is no such program.

    Args:
        command: Program and arguments; the program from the scenario's folder, else from PATH.
        base_directory: Folder of the scenario.
    """
    own = base_directory / command[0]
    if os.path.isfile(own) and os.access(own, os.X_OK):
        return [str(own.resolve()), *command[1:]]
    found = shutil.which(command[0]) if "/" not in command[0] else None
    return [found, *command[1:]] if found else None
