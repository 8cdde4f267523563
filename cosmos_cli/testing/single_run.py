"""
One run from a test of one's own: its verdict, and what it recorded as arrays.

    from cosmos_cli.testing import run

    def test_nobody_burns(tmp_path):
        found = run("ring.yaml", runs=tmp_path, time__duration_s=600)
        assert found.passed, found.verdict
        assert found.table("state")["agent-03"]["z_teme_m"].max() < 7.2e6
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cosmos_cli.errors import InputError, RunFailedError
from cosmos_cli.evidence.run_directory import RunDirectory, runs_root
from cosmos_cli.evidence.tables import TableReader, open_tables
from cosmos_cli.models.loading import load_scenario
from cosmos_cli.models.scenario_test import override_of
from cosmos_cli.system.bounded_process import path_word
from cosmos_cli.testing.case import deadline_of
from cosmos_cli.testing.check_lines import broken_checks, check_line
from cosmos_cli.testing.suite import FOLDER, POLL_S
from cosmos_cli.testing.suite_process import ProcessResult, SuiteProcess

SEPARATOR = "__"
"""In the name of an argument, for the dot of a key."""


@dataclass(frozen=True, kw_only=True)
class FinishedRun:
    """A run that has ended with a verdict."""

    directory: RunDirectory
    exit_code: int
    document: Mapping[str, Any]
    """run.json."""

    @property
    def passed(self) -> bool:
        """Whether it passed."""
        return self.exit_code == 0

    @property
    def verdict(self) -> str:
        """The verdict in a line."""
        return str(self.document.get("verdict") or "")

    @property
    def broken(self) -> list[str]:
        """One line per broken check."""
        return [check_line(check) for check in broken_checks(self.document)]

    @cached_property
    def tables(self) -> Mapping[str, TableReader]:
        """The recorded streams by name, read from the disk when they are asked; of the host host_..."""
        return open_tables(self.directory.tables)

    def table(self, stream: str, *fields: str) -> dict[str, dict[str, NDArray[Any]]]:
        """
        Return all records of a stream, by agent and field.

        Args:
            stream: Its name, such as state.
            fields: Those that are wanted; all if none is named.

        Returns:
            Arrays of shape (N,), in the order of recording; numbers as float64 with null as NaN, whole ones
            without null as int64, the rest as objects.

        Raises:
            KeyError: There is no such stream or field; the message lists what there is.
        """
        table = self.tables.get(stream)
        if table is None:
            raise KeyError(f"no stream {stream}; there are {', '.join(self.tables)}")
        known = [each.name for each in table.fields]
        if unknown := [name for name in fields if name not in known]:
            raise KeyError(f"no {', '.join(unknown)} in {stream}; there are {', '.join(known)}")
        return {
            source: {name: np.asarray(values) for name, values in columns.items()}
            for source, columns in table.each(fields or known)
        }


def run(
    path: str | Path,
    settings: Mapping[str, Any] | None = None,
    *,
    runs: str | Path | None = None,
    deadline_s: float | None = None,
    **values: Any,
) -> FinishedRun:
    """
    Run a scenario to its end in a process of its own, as `cosmos run` does.

    Args:
        path: The scenario's file; its section `test` does not count.
        settings: Values by dotted key, as --set takes them: {"time.duration_s": 20}; numpy's and paths, too.
        runs: Folder of the run; tests in the folder of all runs if none.
        deadline_s: Longest time that it may take, s; from its length if none.
        values: More settings; two underscores stand for a dot: time__duration_s=20.

    Raises:
        InputError: The scenario, a setting or the folder is wrong; with every fault.
        RunFailedError: It was not done in time, or came to no verdict.
    """
    path = Path(path)
    chosen = {**(settings or {})} | {
        key.replace(SEPARATOR, "."): value for key, value in values.items()
    }
    overrides = [override_of(key, value) for key, value in chosen.items()]
    limit_s = deadline_of(load_scenario(path, overrides)) if deadline_s is None else deadline_s
    words = [path_word(path), *(word for item in overrides for word in ("--set", item))]
    folder = runs_root() / FOLDER if runs is None else Path(runs)
    result = _finished(words, folder, limit_s)
    if result.is_too_long:
        raise RunFailedError(f"{path}: not done after {limit_s:g} s, and ended")
    if not result.document:
        if result.exit_code == InputError.exit_code:
            raise InputError(result.words.removeprefix("error: "))
        raise RunFailedError(f"{path}: ended without a verdict: {result.words}")
    return FinishedRun(
        directory=RunDirectory((folder / str(result.document["run"])).resolve()),
        exit_code=result.exit_code,
        document=result.document,
    )


def _finished(words: list[str], folder: Path, limit_s: float) -> ProcessResult:
    process = SuiteProcess(words, folder, deadline_s=limit_s, now_s=time.monotonic())
    try:
        while (result := process.poll(time.monotonic())) is None:
            time.sleep(POLL_S)
    except BaseException:
        process.kill()
        raise
    return result
