"""One stream of one source in one run: read in bounded batches, from its table or from its lines."""

from __future__ import annotations

import contextlib
import functools
import hashlib
import re
import shlex
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cosmos_cli.collect.previous_manifest import Earlier
from cosmos_cli.collect.unread_files import find_unread
from cosmos_cli.errors import InputError
from cosmos_cli.evidence.manifest import file_entry
from cosmos_cli.evidence.run_directory import RunDirectory
from cosmos_cli.evidence.streams import (
    DETAILS,
    Columns,
    RecordFile,
    Role,
    find_streams,
    read_batches,
)
from cosmos_cli.evidence.table_layout import in_unit
from cosmos_cli.evidence.tables import TableReader, open_tables
from madns_runtime.errors import MachineError
from madns_runtime.plain_values import mapping_at
from madns_runtime.recording.reader import StreamReading
from madns_runtime.recording.records import Field

ROWS_READ_MAX = 16_384
"""Records of one stream that are read at a time."""
BLOCK_BYTES = 1 << 20
CONTROL_KEYS = (b'{"t0_utc":', b'{"end":')
CONTROL_LINE = re.compile(
    rb'^\{"(?:t0_utc": ?"[^"\n]*"|end": ?\{[^{}\n]*\})\}(?:\n|\Z)', re.MULTILINE
)
"""Lines that are no records: they tell when a run was, not what was recorded. A record may begin like one, and goes on."""
Key = tuple[str, str]
"""Table and source, such as ("state", "agent-03")."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Lines:
    """Figures of a stream's lines without decoding them."""

    sha256: str
    """Of all records, without the lines that name the run and its time."""
    records: int
    changed: tuple[Path, ...] = ()
    """Files that are no longer what they were when the run was collected."""

    def is_same(self, other: Lines) -> bool:
        """Tell whether others hold the same records."""
        return (self.sha256, self.records) == (other.sha256, other.records)


@dataclass(frozen=True, slots=True, kw_only=True)
class Recorded:
    """One stream of one source."""

    table: str
    role: Role
    source: str
    fields: tuple[Field, ...]
    files: tuple[RecordFile, ...]
    """In the order of incarnations; empty if only the table is left."""
    reader: TableReader | None
    """None if there is no table, or one that is older than the lines."""
    collected: Mapping[Path, str]
    """Hashes of the run's files when it was collected, as far as they are known."""

    @property
    def stream(self) -> str:
        """The stream's name as it was recorded, without the role that its table's name begins with."""
        return self.table if self.role == "agent" else self.table.removeprefix(f"{self.role}_")

    def names(self) -> tuple[str, ...]:
        """Return the names of the fields."""
        return tuple(field.name for field in self.fields)

    def batches(self, names: Iterable[str]) -> Iterator[Columns]:
        """
        Give columns of all records in the order of recording.

        Raises:
            MachineError: A file cannot be read.
        """
        wanted = list(names)
        reader = self.reader
        if reader is not None and self._is_held_by(reader, wanted) and self._is_sound(reader):
            yield from reader.batches(self.source, wanted, ROWS_READ_MAX, is_exact=True)
            return
        own = {field.name: field for field in self.fields}
        for file in self.files:
            units = {field.name: field.unit for field in file.fields}
            for columns, count in read_batches(file, StreamReading(file.path)):
                nothing = np.empty(count, dtype=object)  # of what another incarnation alone has
                columns = {name: columns.get(name, nothing) for name in wanted}
                yield {
                    name: in_unit(values, units[name], own[name], self.role)[0]
                    if name in units and name in own
                    else values
                    for name, values in columns.items()
                }

    def lines(self) -> Lines | None:
        """
        Hash the records as they were written; None if the lines are gone.

        Raises:
            MachineError: A file cannot be read.
        """
        if not self.files:
            return None
        digest, records, changed = hashlib.sha256(), 0, []
        for file in self.files:
            whole = hashlib.sha256()
            for block in _record_blocks(file.path, whole):
                has_control = any(key in block for key in CONTROL_KEYS)
                told = CONTROL_LINE.sub(b"", block) if has_control else block
                digest.update(told)
                records += told.count(b"\n")
            if self.collected.get(file.path, whole.hexdigest()) != whole.hexdigest():
                changed.append(file.path)
        return Lines(sha256=digest.hexdigest(), records=records, changed=tuple(changed))

    def _is_held_by(self, reader: TableReader, names: Sequence[str]) -> bool:
        """Tell whether a table has columns of all these fields in their own units, not in those of other sources."""
        if not reader.has(*names):
            return False
        units = {field.name: field.unit for field in reader.recorded_fields}
        own = {field.name: field.unit for field in self.fields}
        return not self.files or all(
            own.get(name, unit) == unit for name, unit in units.items() if name in names
        )

    def _is_sound(self, reader: TableReader) -> bool:
        """
        Tell whether a table is what was collected: one of other records would be taken for these.

        Raises:
            InputError: It is not, and there are no lines to read instead.
        """
        expected = self.collected.get(reader.path)
        with contextlib.suppress(OSError):  # it is gone meanwhile
            mtime_ns = reader.path.stat().st_mtime_ns
            if expected is None or expected == _hash_of(reader.path, mtime_ns):
                return True
        if self.files:
            return False
        run = shlex.quote(str(reader.path.parent.parent))
        raise InputError(
            f"{reader.path}: not as it was collected, and the lines that it was made of are gone; put it back,"
            f" or have it noted with: cosmos collect {run}"
        )


def recorded_streams(run: RunDirectory) -> dict[Key, Recorded]:
    """Return every stream of a run that has a schema, by table and source."""
    files: dict[Key, list[RecordFile]] = {}
    unread, collected = find_unread(run), _collected(run)
    for file in find_streams(run.path):
        if file.fields and file.path not in unread:
            files.setdefault((file.table, file.source), []).append(file)
    tables = open_tables(run.tables)
    found = {
        key: _from_lines(key, group, _fresh(tables.get(key[0]), group), collected)
        for key, group in files.items()
    }
    for reader in tables.values():
        for source in reader.sources:
            found.setdefault((reader.name, source), _from_table(reader, source, collected))
    return found


def _collected(run: RunDirectory) -> dict[Path, str]:
    """Return the hashes of a run's streams when it was collected first, and of its tables when they were made."""
    made = mapping_at(run.read_json(run.manifest_json), "files")
    tables = {name: made[name] for name in made if name.startswith(f"{run.tables.name}/")}
    hashes = {
        run.path / name: entry.get("sha256")
        for name, entry in {**tables, **Earlier.read(run).entries}.items()
        if isinstance(entry, Mapping)
    }
    return {path: each for path, each in hashes.items() if isinstance(each, str)}


@functools.lru_cache(maxsize=256)
def _hash_of(path: Path, _mtime_ns: int) -> str:
    """Return the hash of a table, which several streams are read from."""
    return str(file_entry(path)["sha256"])


def _from_lines(
    key: Key,
    files: Sequence[RecordFile],
    reader: TableReader | None,
    collected: Mapping[Path, str],
) -> Recorded:
    fields: dict[str, Field] = {}
    for file in files:
        for field in (*file.fields, *(() if file.is_array else (DETAILS,))):
            fields.setdefault(field.name, field)
    names = [tuple(field.name for field in file.fields) for file in files]
    if len(set(names)) > 1 and reader is None:
        # Incarnations of different builds: what all of them have.
        common = set.intersection(*map(set, names))
        fields = {name: field for name, field in fields.items() if name in common}
    return Recorded(
        table=key[0],
        role=files[0].role,
        source=key[1],
        fields=tuple(fields.values()),
        files=tuple(files),
        reader=reader if reader is not None and key[1] in reader.sources else None,
        collected=collected,
    )


def _from_table(reader: TableReader, source: str, collected: Mapping[Path, str]) -> Recorded:
    role: Mapping[str, Role] = {"host": "host", "machine": "machine", "device": "device"}
    return Recorded(
        table=reader.name,
        role=role.get(reader.role, "agent"),
        source=source,
        fields=reader.recorded_fields,
        files=(),
        reader=reader,
        collected=collected,
    )


def _fresh(reader: TableReader | None, files: Sequence[RecordFile]) -> TableReader | None:
    """Return the table unless a line was written after it: then the lines tell more."""
    if reader is None:
        return None
    try:
        newest = max(file.path.stat().st_mtime_ns for file in files)
        return reader if reader.path.stat().st_mtime_ns >= newest else None
    except OSError:
        return None


def _record_blocks(path: Path, whole: hashlib._Hash) -> Iterator[bytes]:
    """Give all lines but the schema's, in blocks that end with a line; *whole* takes all of the file."""
    try:
        with path.open("rb") as file:
            whole.update(file.readline())
            held = b""
            while block := file.read(BLOCK_BYTES):
                whole.update(block)
                end = block.rfind(b"\n") + 1
                if end:
                    yield held + block[:end]
                    held = block[end:]
                else:
                    held += block
            if held:
                yield held
    except OSError as error:
        raise MachineError(f"{path}: cannot be read: {error.strerror}") from error
