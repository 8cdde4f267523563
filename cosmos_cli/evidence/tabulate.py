"""One pass over all records of a run: counted, hashed, and written to tables."""

from __future__ import annotations

import contextlib
import itertools
import os
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import pyarrow as pa

from cosmos_cli.evidence.run_directory import RunDirectory
from cosmos_cli.evidence.streams import (
    Columns,
    RecordFile,
    StreamScan,
    file_size_bytes,
    find_streams,
    scan_stream,
)
from cosmos_cli.evidence.table_labels import TableLabels
from cosmos_cli.evidence.table_layout import NO_LABELS, TableLayout, plan_table
from cosmos_cli.evidence.tables import TableWriter
from madns_runtime.errors import MachineError

Progress = Callable[[str, float], None]
"""Takes what is being done and how far it is, 0 to 1."""
Layout = Callable[[Sequence[RecordFile]], TableLayout]
"""Lays out the table of some streams."""
LOST_TOLD_MAX = 3
"""Fields of a table with values that are not of their kind, and fields of agents in units that do not convert, each told."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Gathered:
    """Contents of a run's records."""

    scans: tuple[StreamScan, ...]
    faults: tuple[str, ...] = ()
    """Tables that could not be written or hold less than was recorded, each starting with its name."""

    was: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """Earlier manifest entries of files that are no longer what they were."""
    unread: frozenset[Path] = frozenset()
    """Files that were left out, and are in neither manifest nor package."""

    def by_path(self) -> dict[Path, StreamScan]:
        """Return the scans by file."""
        return {scan.file.path: scan for scan in self.scans}


def gather(
    run: RunDirectory,
    tick_hz: float | None,
    progress: Progress,
    *,
    labels: TableLabels = NO_LABELS,
    without: Collection[Path] = (),
) -> Gathered:
    """
    Read every stream of a run but those *without*, once, and write its table, with *labels* beside each record.

    A table that cannot be written, as on a full disk, is reported, as is a stream that cannot be read, as on a bad one;
    counting goes on.
    """
    config = run.read_config()
    # In lockstep schema lines name the scenario: two runs of it are the same to the byte.
    runs = () if config is None else (config.run, config.scenario)
    found = (file for file in find_streams(run.path, runs) if file.path not in without)
    files = sorted(found, key=lambda file: file.table)
    done = _Done(files, progress)
    layout = partial(plan_table, tick_hz=tick_hz, labels=labels)
    scans: list[StreamScan] = []
    faults: list[str] = []
    unread = set(without)
    for name, group in itertools.groupby(files, key=lambda file: file.table):
        together = list(group)
        table = _Table(run.tables / f"{name}.parquet", together, layout)
        for file in together:
            try:
                scans.append(scan_stream(file, partial(table.add, file)))
            except MachineError as error:
                unread.add(file.path)
                faults.append(str(error).removeprefix(f"{run.path}/"))
            table.end_file(file)
            done.add(file)
        table.close()
        if table.fault:
            faults.append(f"tables/{name}.parquet: {table.fault}")
    return Gathered(scans=tuple(scans), faults=tuple(faults), unread=frozenset(unread))


class _Done:
    """Turns files read into progress, weighed by their size."""

    def __init__(self, files: Sequence[RecordFile], progress: Progress) -> None:
        self._total = max(sum(file_size_bytes(file.path) for file in files), 1)
        self._read = 0
        self._progress = progress

    def add(self, file: RecordFile) -> None:
        self._read += file_size_bytes(file.path)
        self._progress(f"reading {file.label}", min(self._read / self._total, 1.0))


class _Table:
    """
    The table of some streams, as far as it can be written; `fault` tells why it cannot, or holds less than was recorded.

    Args:
        path: Where.
        files: The streams; those without a schema line have no place in it.
        layout: Lays it out.
    """

    def __init__(self, path: Path, files: Sequence[RecordFile], layout: Layout) -> None:
        self.fault: str | None = None
        self._writer: TableWriter | None = None
        readable = [file for file in files if file.fields]
        with self._guarded():
            if readable and path.parent.is_symlink():
                raise OSError("the folder tables is a link; delete it")
            if readable:
                self._writer = TableWriter(path, layout(readable))

    def add(self, file: RecordFile, columns: Columns, count: int, size_bytes: int) -> None:
        with self._guarded():
            if self._writer is not None:
                self._writer.add(file, columns, count, size_bytes)

    def end_file(self, file: RecordFile) -> None:
        with self._guarded():
            if self._writer is not None:
                self._writer.end_file(file)

    def close(self) -> None:
        with self._guarded():
            if self._writer is not None:
                self._writer.close()
        if self._writer is not None:
            self.fault = _lost(self._writer)

    @contextlib.contextmanager
    def _guarded(self) -> Iterator[None]:
        """Give the table up where the disk does not take it."""
        try:
            yield
        except (OSError, pa.ArrowException) as error:
            number = getattr(error, "errno", None)
            self.fault = f"not written: {os.strerror(number) if number else error}"
            if self._writer is not None:
                self._writer.abandon()
            self._writer = None


def _lost(writer: TableWriter) -> str | None:
    """Return which recorded values a table does not hold; None if it holds all."""
    unfit = [
        f"{number} values of {field} are null: not of their kind, first {first}"
        for field, (number, first) in writer.unfit.items()
    ]
    foreign = [f"{place}: {number} values are null" for place, number in writer.foreign.items()]
    return "; ".join([*_first_lost(unfit), *_first_lost(foreign)]) or None


def _first_lost(told: list[str]) -> list[str]:
    more = len(told) - LOST_TOLD_MAX
    return [*told[:LOST_TOLD_MAX], f"so are those of {more} more"] if more > 0 else told
