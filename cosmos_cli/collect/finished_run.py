"""Whether a run is over and collected, for commands that read or change a finished one."""

from __future__ import annotations

import os
import re
import shlex
import stat
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from cosmos_cli.errors import InputError
from cosmos_cli.evidence.manifest import file_entry
from cosmos_cli.evidence.run_directory import RunDirectory
from cosmos_cli.onboard.processes import words_of
from cosmos_cli.ui.name_ranges import compact
from cosmos_cli.ui.plural import counted
from madns_runtime.plain_values import mapping_at
from madns_runtime.processes import ProcessEntry, list_processes

PROCESSES_SHOWN_MAX = 3
_SEVERAL_NAMES = re.compile(r"([^\s,]+),(?:\S+,)?([^\s,]+)(?= \(pid )")


def collected_document(run: RunDirectory, given: str) -> dict[str, Any]:
    """
    Return run.json of a run that is over and collected.

    Args:
        run: The run.
        given: What a person called it, for advice.

    Raises:
        InputError: Its processes still live here, and collecting would be refused, too; or it is not collected yet.
    """
    document = run.read_json(run.run_json)
    if document is None or document.get("status") == "running":
        refuse_living(run, list_processes())
        raise InputError(
            f"{run.name} is not collected yet; do that with: cosmos collect {shlex.quote(given)}"
        )
    return document


def refuse_foreign_tables(run: RunDirectory) -> None:
    """
    See that the manifest lists every table that would be read; without a manifest nobody knows.

    Raises:
        InputError: It does not list one.
    """
    listed = mapping_at(run.read_json(run.manifest_json), "files")
    for path in sorted(run.tables.glob("*.parquet")) if listed else ():
        is_read = os.path.isfile(path) and not path.is_symlink()
        if is_read and f"{run.tables.name}/{path.name}" not in listed:
            raise InputError(
                f"{path}: no collection made it, and its values would pass for the run's; remove it, or have it noted"
                f" with: cosmos collect {run.shell_path}"
            )


def listed_files(run: RunDirectory) -> dict[str, Mapping[str, Any]]:
    """Return the entries of the manifest by the names of files below the run's directory."""
    files = mapping_at(run.read_json(run.manifest_json), "files")
    return {name: entry for name, entry in files.items() if isinstance(entry, Mapping)}


def is_as_listed(entry: Mapping[str, Any], path: Path) -> bool:
    """Tell whether a file is what its entry says: a value that was damaged is no value to judge by."""
    try:
        status = path.lstat()
        is_whole = stat.S_ISREG(status.st_mode) and status.st_size == entry.get("bytes")
        return is_whole and file_entry(path)["sha256"] == entry.get("sha256")
    except OSError:
        return False


def changed_tables(run: RunDirectory) -> tuple[str, ...]:
    """Return a remark per table that is there and is not as it was collected; those that are gone are told elsewhere."""
    return tuple(
        f"{name} is not as it was collected: what is told of it need not be of the run; make it anew with:"
        f" cosmos collect {run.shell_path}"
        for name, entry in listed_files(run).items()
        if name.startswith(f"{run.tables.name}/")
        and os.path.isfile(run.path / name)
        and not is_as_listed(entry, run.path / name)
    )


def refuse_living(run: RunDirectory, processes: Sequence[ProcessEntry]) -> None:
    """
    See that nothing of a run lives on this computer.

    Raises:
        InputError: It does; the message names who.
    """
    living = [
        words_of(entry)
        for entry in processes
        if Path(entry.run_directory).resolve().is_relative_to(run.path)
    ]
    if living:
        raise still_running(run.name, {"": living})


def still_running(run: str, living: Mapping[str, Sequence[str]]) -> InputError:
    """
    Return the refusal to touch a run that still lives: where, how many processes, and what to do.

    Args:
        run: The run's name.
        living: In words, the processes on each machine; this computer's name is empty.
    """
    machines = compact(name for name in living if name)
    where = f" on {machines}" if machines else ""
    processes = [words for there in living.values() for words in there]
    shown = ", ".join(
        _SEVERAL_NAMES.sub(r"\1 ... \2", text) for text in processes[:PROCESSES_SHOWN_MAX]
    )
    if len(processes) > PROCESSES_SHOWN_MAX:
        shown = f"{counted(len(processes), 'process')}, such as {shown}"
    return InputError(
        f"{run} is still running{where}: {shown}; wait for its end, or end it with: cosmos down {run}"
    )
