"""
Tables: the records of a run as Parquet, one file per stream over all who recorded it.

Written stream by stream in row groups that each hold one source, so that neither writing nor reading
needs more memory than a row group of it.
"""

from __future__ import annotations

import contextlib
import json
import os
import shlex
import stat
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from cosmos_cli.errors import InputError
from cosmos_cli.evidence.arrow_values import (
    as_floats,
    floats_array,
    numbers_array,
    one_code,
    to_arrow,
    to_codes,
    to_numpy,
    to_times,
)
from cosmos_cli.evidence.run_directory import RunDirectory
from cosmos_cli.evidence.streams import Columns, RecordFile
from cosmos_cli.evidence.table_labels import NEVER_US
from cosmos_cli.evidence.table_layout import METADATA_KEY, UNITS_KEY, TableLayout, in_unit
from cosmos_cli.ui.foreign_text import clean_line
from madns_runtime.analysis.tables import AGENT, INCARNATION, RecordedRun
from madns_runtime.conditions.condition import TIME
from madns_runtime.partial_file import create_partial
from madns_runtime.plain_values import shown
from madns_runtime.recording.columns import joined_column
from madns_runtime.recording.records import Field

ROWS_PER_GROUP = 128 * 1024
BYTES_PER_GROUP = 32 << 20
"""Of the lines that a row group is made of: records of more than 256 bytes each make smaller ones. As values of Python
and of Arrow they need about four times as much memory."""


class TableWriter:
    """
    Writes one table; the file appears under its name when it is closed, complete.

    Args:
        path: The Parquet file.
        layout: Its columns.

    Raises:
        OSError: The file cannot be written; so may every call.
    """

    def __init__(self, path: Path, layout: TableLayout) -> None:
        self.path = path
        self.unfit: dict[str, tuple[int, str]] = {}
        """Values that are not of their field's kind and are null here, by its name and kind: how many, and the first."""
        self.foreign: dict[str, int] = {}
        """Values in a unit that does not convert to their column's and that are null here, by a word on whose they are."""
        self.rows = 0
        self._layout = layout
        self._schema = layout.arrow_schema()
        self._held: list[Columns] = []
        self._held_count = 0
        self._held_bytes = 0
        path.parent.mkdir(parents=True, exist_ok=True)
        # Made before pyarrow opens it by its name: a link that lies there is not followed.
        self._partial, descriptor = create_partial(path, takes_over=True)
        os.close(descriptor)
        try:
            self._writer = _open_writer(self._partial, self._schema)
        except OSError:
            self._partial.unlink(missing_ok=True)  # a full disk takes a file, but nothing in it
            raise

    def add(self, file: RecordFile, columns: Columns, count: int, size_bytes: int = 0) -> None:
        """
        Take a batch of a file's records; a file's batches come one after the other.

        Args:
            file: Of the records.
            columns: The batch.
            count: Number of its records.
            size_bytes: As lines; 0 where they are numbers alone, which take little.
        """
        self._held.append(columns)
        self._held_count += count
        self._held_bytes += size_bytes
        if self._held_count >= ROWS_PER_GROUP or self._held_bytes >= BYTES_PER_GROUP:
            self.end_file(file)

    def end_file(self, file: RecordFile) -> None:
        """Write what is held: a row group never holds two sources."""
        if self._held_count:
            self._writer.write_table(self._table(file), row_group_size=ROWS_PER_GROUP)
            self.rows += self._held_count
        self._held, self._held_count, self._held_bytes = [], 0, 0

    def close(self) -> None:
        """Finish the file and give it its name."""
        self._writer.close()
        self._partial.replace(self.path)

    def abandon(self) -> None:
        """Leave nothing behind."""
        with contextlib.suppress(OSError, pa.ArrowException):
            self._writer.close()
        with contextlib.suppress(OSError):
            self._partial.unlink()

    def _table(self, file: RecordFile) -> pa.Table:
        count, layout = self._held_count, self._layout
        incarnation = np.full(count, file.incarnation, np.int32)
        arrays: list[Any] = [one_code(file.source, count), numbers_array(incarnation)]
        joined = {field.name: self._column(file, field, count) for field in layout.fields}
        t_s = joined.get(TIME)
        if layout.tick_hz is not None:
            t_s = as_floats(joined["tick"]) / layout.tick_hz
            arrays.append(floats_array(t_s))
        if layout.has_utc and t_s is not None:
            arrays.append(to_times(layout.labels.utc_us(as_floats(t_s)), never_us=NEVER_US))
        if layout.label:
            arrays.append(self._labels(file, joined.get(AGENT), count))
        for field in layout.fields:
            values = joined[field.name]
            array, places = to_arrow(values, field.kind)
            arrays.append(array)
            if len(places):
                self._count_unfit(file, field, values[places].tolist())
        return pa.Table.from_arrays(arrays, schema=self._schema)

    def _count_unfit(self, file: RecordFile, field: Field, values: list[Any]) -> None:
        about = f"{clean_line(field.name)} ({field.kind})"
        count, first = self.unfit.get(about, (0, ""))
        first = first or f"{shown(values[0])} of {clean_line(file.source)}"
        self.unfit[about] = (count + len(values), first)

    def _column(self, file: RecordFile, field: Field, count: int) -> NDArray[Any]:
        """Return what is held of a field, in its column's unit."""
        values = _join([batch.get(field.name) for batch in self._held], count)
        unit = next((own.unit for own in file.fields if own.name == field.name), field.unit)
        values, lost = in_unit(values, unit, field, self._layout.role)
        if lost:
            whose = f"{clean_line(field.name)} of {clean_line(file.source)}"
            told = f"{whose} is in {clean_line(unit) or '1'}, the table's in {clean_line(field.unit) or '1'}"
            self.foreign[told] = self.foreign.get(told, 0) + lost
        return values

    def _labels(
        self, file: RecordFile, agents: NDArray[Any] | None, count: int
    ) -> pa.DictionaryArray:
        """Return the second name of each record's agent: of the one that it tells of, else of who recorded it."""
        names = self._layout.labels.agents.names
        if agents is None:
            return one_code(names.get(file.source), count)
        return to_codes(names.get(str(agent)) for agent in agents.tolist())


class TableReader:
    """
    Reads a table source by source.

    Args:
        path: The Parquet file. Damage of it is told where it is met, by an InputError.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._file = pq.ParquetFile(path, page_checksum_verification=True)
        self._schema = self._file.schema_arrow
        note = json.loads((self._schema.metadata or {})[METADATA_KEY])
        self.name: str = note["table"]
        self.role: str = note["role"]
        self._source_column: str = note["source_column"]
        self._labels: tuple[str, ...] = tuple(note.get("labels", ()))
        self._groups: dict[str, list[int]] = {}
        for index in range(self._file.num_row_groups):
            column = self._file.read_row_group(index, columns=[self._source_column]).column(0)
            if len(column):
                self._groups.setdefault(str(column[0].as_py()), []).append(index)

    @property
    def rows(self) -> int:
        """Number of records of all sources."""
        return int(self._file.metadata.num_rows)

    @property
    def sources(self) -> tuple[str, ...]:
        """Names of the agents or machines that have records here, in order."""
        return tuple(self._groups)

    @property
    def fields(self) -> tuple[Field, ...]:
        """The recorded fields, t_s first if it was made."""
        schema = self._schema
        skipped = (self._source_column, INCARNATION, *self._labels)
        return tuple(_field(schema.field(name)) for name in schema.names if name not in skipped)

    def unit(self, source: str, name: str) -> str:
        """Return the unit of a source's values of a field: its own one, where the column has none."""
        about = self._schema.field(name).metadata or {}
        own = about.get(UNITS_KEY)
        return str(json.loads(own).get(source, "")) if own else about.get(b"unit", b"").decode()

    @property
    def recorded_fields(self) -> tuple[Field, ...]:
        """The fields without a t_s that was made of the tick, as the stream's own schema has them."""
        made = [
            column.name
            for column in self._schema
            if column.name == TIME and b"kind" not in (column.metadata or {})
        ]
        return tuple(field for field in self.fields if field.name not in made)

    def has(self, *names: str) -> bool:
        """Tell whether the table has all these columns."""
        return set(names) <= set(self._schema.names)

    def read(self, source: str, names: Iterable[str]) -> Columns:
        """
        Return columns of one source in the order of recording.

        Numbers come as float64 with null as NaN (ints without null as int64), the rest as objects.
        """
        wanted = list(names)
        with self._damage_told():
            table = self._file.read_row_groups(self._groups.get(source, []), columns=wanted)
            return {name: table.column(name).to_numpy() for name in wanted}

    def batches(
        self, source: str, names: Iterable[str], rows_max: int, *, is_exact: bool = False
    ) -> Iterator[Columns]:
        """Yield columns of one source as `read` does, *rows_max* records at most at a time; *is_exact* as of `to_numpy`."""
        wanted = list(names)
        for group in self._groups.get(source, []):
            # One group after the other: given all at once, pyarrow reads ahead without bound.
            batches = self._file.iter_batches(rows_max, row_groups=[group], columns=wanted)
            while True:
                with self._damage_told():
                    batch = next(batches, None)
                    if batch is None:
                        break
                    columns = {
                        name: to_numpy(batch.column(name), is_exact=is_exact) for name in wanted
                    }
                yield columns

    def each(self, names: Iterable[str]) -> Iterator[tuple[str, Columns]]:
        """Yield every source with its columns."""
        wanted = list(names)
        for source in self.sources:
            yield source, self.read(source, wanted)

    @contextlib.contextmanager
    def _damage_told(self) -> Iterator[None]:
        """Turn damage that shows when values are read into a fault of the file."""
        try:
            yield
        except (OSError, pa.ArrowException) as error:
            run = shlex.quote(str(self.path.parent.parent))
            raise InputError(
                f"{self.path}: damaged ({str(error):.80}); it is made anew with: cosmos collect {run}"
            ) from error


def open_tables(folder: Path) -> dict[str, TableReader]:
    """Return the tables of a run by name; one that cannot be read is left out, as is what is no file."""
    tables: dict[str, TableReader] = {}
    for path in sorted(folder.glob("*.parquet")):
        with contextlib.suppress(OSError, pa.ArrowException, KeyError, TypeError, ValueError):
            if _is_file(path):
                tables[path.stem] = TableReader(path)
    return tables


def open_recorded_run(run: RunDirectory, document: Mapping[str, Any]) -> RecordedRun:
    """Return a gathered run as simulations see it; a table that cannot be read is left out."""
    return RecordedRun(document=document, tables=open_tables(run.tables), config=run.read_config())


def no_tables(folder: Path) -> tuple[str, ...]:
    """Return the names of what bears a table's name and is none: a link, a pipe, a folder."""
    return tuple(path.name for path in sorted(folder.glob("*.parquet")) if not _is_file(path))


def _is_file(path: Path) -> bool:
    """Tell whether it is a file of the run: a pipe is waited for without end, a link leads out of the run."""
    try:
        is_file = stat.S_ISREG(path.lstat().st_mode)
    except OSError:
        return False
    return is_file and not path.parent.is_symlink()


def _open_writer(path: Path, schema: pa.Schema) -> pq.ParquetWriter:
    """Measured: these encodings need 12.3 MB per agent-hour at 100 Hz where pyarrow's defaults need 21.2."""
    encodings: dict[str, str] = {}
    dictionary: list[str] = []
    for field in schema:
        is_time = pa.types.is_timestamp(field.type)
        if field.name == INCARNATION or is_time or pa.types.is_int64(field.type):
            encodings[field.name] = "DELTA_BINARY_PACKED"
        elif pa.types.is_floating(field.type):
            encodings[field.name] = "BYTE_STREAM_SPLIT"
        elif not pa.types.is_boolean(field.type):
            dictionary.append(field.name)
    return pq.ParquetWriter(
        path,
        schema,
        compression="zstd",
        use_dictionary=dictionary,
        column_encoding=encodings,
        write_page_checksum=True,
    )


def _field(column: pa.Field) -> Field:
    about = column.metadata or {}
    # The writer above wrote a Kind.
    return Field(
        column.name, about.get(b"unit", b"").decode(), about.get(b"kind", b"float").decode()
    )


def _join(parts: list[NDArray[Any] | None], count: int) -> NDArray[Any]:
    """Return one column of all held batches; a field that an incarnation lacks is null."""
    whole = [part for part in parts if part is not None]
    if len(whole) < len(parts):
        return np.empty(count, dtype=object)
    return joined_column(whole)
