"""One pass over all records of a run: counted, hashed, and written to tables."""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pyarrow as pa

from cosmos_cli.rundir import RunDirectory
from cosmos_cli.streams import Columns, StreamFile, StreamScan, find_streams, scan_stream
from cosmos_cli.tables import TableWriter, plan_table

Progress = Callable[[str, float], None]
"""Takes what is being done and how far it is, 0 to 1."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Gathered:
    """What the records of a run hold."""

    scans: tuple[StreamScan, ...]
    faults: tuple[str, ...] = ()
    """Tables that could not be written or hold less than was recorded, each starting with its name."""

    was: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """Earlier manifest entries of files that are no longer what they were."""

    def by_path(self) -> dict[Path, StreamScan]:
        """Return the scans by file."""
        return {scan.file.path: scan for scan in self.scans}


def gather(run: RunDirectory, tick_hz: float | None, progress: Progress) -> Gathered:
    """
    Read every stream of a run once and write its table.

    A table that cannot be written, as on a full disk, is reported; counting goes on.

    Raises:
        MachineError: A stream cannot be read.
    """
    files = sorted(find_streams(run.path), key=lambda file: file.table)
    done = _Done(files, progress)
    scans: list[StreamScan] = []
    faults: list[str] = []
    for name, group in itertools.groupby(files, key=lambda file: file.table):
        found, fault = _gather_table(run, list(group), tick_hz, done)
        scans.extend(found)
        if fault:
            faults.append(f"tables/{name}.parquet: {fault}")
    return Gathered(scans=tuple(scans), faults=tuple(faults))


class _Done:
    """Turns files read into progress, weighed by their size."""

    def __init__(self, files: Sequence[StreamFile], progress: Progress) -> None:
        self._total = max(sum(_size(file.path) for file in files), 1)
        self._read = 0
        self._progress = progress

    def add(self, file: StreamFile) -> None:
        self._read += _size(file.path)
        self._progress(f"reading {file.label}", min(self._read / self._total, 1.0))


def _gather_table(
    run: RunDirectory, files: list[StreamFile], tick_hz: float | None, done: _Done
) -> tuple[list[StreamScan], str | None]:
    writer, fault = _open_writer(run, files, tick_hz)
    scans: list[StreamScan] = []
    for file in files:

        def consume(columns: Columns, count: int, file: StreamFile = file) -> None:
            nonlocal writer, fault
            if writer is not None:
                try:
                    writer.add(file, columns, count)
                except (OSError, pa.ArrowException) as error:
                    writer, fault = _give_up(writer, error)

        scans.append(scan_stream(file, consume))
        if writer is not None:
            try:
                writer.end_file(file)
            except (OSError, pa.ArrowException) as error:
                writer, fault = _give_up(writer, error)
        done.add(file)
    return scans, fault or _close(writer)


def _open_writer(
    run: RunDirectory, files: list[StreamFile], tick_hz: float | None
) -> tuple[TableWriter | None, str | None]:
    readable = [file for file in files if file.fields]
    if not readable:
        return None, None
    try:
        path = run.tables / f"{readable[0].table}.parquet"
        return TableWriter(path, plan_table(readable, tick_hz)), None
    except (OSError, pa.ArrowException) as error:
        return None, _not_written(error)


def _give_up(writer: TableWriter, error: Exception) -> tuple[None, str]:
    writer.abandon()
    return None, _not_written(error)


def _not_written(error: Exception) -> str:
    number = getattr(error, "errno", None)
    return f"not written: {os.strerror(number) if number else error}"


def _close(writer: TableWriter | None) -> str | None:
    if writer is None:
        return None
    try:
        writer.close()
    except (OSError, pa.ArrowException) as error:
        return _give_up(writer, error)[1]
    if writer.unfit:
        return f"{writer.unfit} recorded values are not of their field's kind and are null"
    return None


def _size(path: Path) -> int:
    try:
        return path.stat().st_size
    except OSError:
        return 0
