"""What became of records: the counts that a report, a verdict and an end line are made of."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, slots=True, kw_only=True)
class StreamCounts:
    """What became of one stream's records."""

    file: str
    written: int
    dropped: int
    not_finite: int
    bytes: int

    def to_mapping(self) -> dict[str, Any]:
        """Return the counts as a plain mapping."""
        return {
            "file": self.file,
            "written": self.written,
            "dropped": self.dropped,
            "not_finite": self.not_finite,
            "bytes": self.bytes,
        }


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordCounts:
    """What became of all records of a recorder, and what went wrong on the way."""

    streams: Mapping[str, StreamCounts]
    errors: tuple[str, ...] = ()

    @property
    def written(self) -> int:
        """Records that a write call has taken."""
        return sum(counts.written for counts in self.streams.values())

    @property
    def dropped(self) -> int:
        """Records that will never be in a file."""
        return sum(counts.dropped for counts in self.streams.values())

    @property
    def not_finite(self) -> int:
        """NaN and infinite values, which became null."""
        return sum(counts.not_finite for counts in self.streams.values())

    @property
    def bytes(self) -> int:
        """Bytes in all files."""
        return sum(counts.bytes for counts in self.streams.values())

    def to_mapping(self) -> dict[str, Any]:
        """Return totals, errors and every stream's counts as plain mappings."""
        return {
            "written": self.written,
            "dropped": self.dropped,
            "not_finite": self.not_finite,
            "bytes": self.bytes,
            "errors": list(self.errors),
            "streams": {name: counts.to_mapping() for name, counts in self.streams.items()},
        }
