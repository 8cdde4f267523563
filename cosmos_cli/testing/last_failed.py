"""Tests that failed when they were last run, remembered beside the register of processes."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterable
from pathlib import Path

from cosmos_cli.system.file_lock import LockHeld, locked
from cosmos_cli.system.ownership import read_own_file
from cosmos_cli.testing.outcome import CaseOutcome
from madns_runtime.partial_file import write_whole
from madns_runtime.processes import state_directory

FILE_BYTES_MAX = 16 * 1024 * 1024
REMEMBERED_MAX = 20_000
LOCK_TIMEOUT_S = 5.0
"""For other suites that end at the same time, each of which reads and writes once."""

FailedTest = tuple[str, int | None]
"""Absolute path of the scenario, and the seed that was given; None for its own."""


def memory_file() -> Path:
    """Return where they are remembered."""
    return state_directory().parent / "failed-tests.json"


def read_failed() -> tuple[FailedTest, ...]:
    """Return what failed; nothing if it is not known."""
    try:
        listed = json.loads(read_own_file(memory_file(), bytes_max=FILE_BYTES_MAX))
        return tuple((str(path), None if seed is None else int(seed)) for path, seed in listed)
    except (OSError, ValueError, TypeError, OverflowError, RecursionError):
        return ()


def remember_failed(outcomes: Iterable[CaseOutcome]) -> None:
    """Enter those that failed, and take out those that passed; a folder that cannot be written is no reason to fail."""
    file = memory_file()
    with contextlib.suppress(OSError, LockHeld):
        file.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
        with locked(file.with_suffix(".lock"), timeout_s=LOCK_TIMEOUT_S):
            kept = [[path, seed] for path, seed in _with(outcomes)[-REMEMBERED_MAX:]]
            write_whole(file, json.dumps(kept).encode(), mode=0o600, is_durable=False)


def _with(outcomes: Iterable[CaseOutcome]) -> list[FailedTest]:
    failed = dict.fromkeys(read_failed())
    for each in outcomes:
        if each.outcome == "failed":
            failed[each.case.key] = None
        elif each.outcome == "passed":
            failed.pop(each.case.key, None)
    return list(failed)
