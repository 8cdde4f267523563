"""What has come from one machine: counted while it comes, told when it has."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from typing import Any

from cosmos_cli.counted import counted
from cosmos_cli.retrieve.disk import size_words


@dataclass(frozen=True, slots=True, kw_only=True)
class Retrieved:
    """One machine's records: all of them are here, verified, on the disk."""

    files: int
    bytes: int
    fetched_files: int = 0
    """Of these, those that came this time."""
    fetched_bytes: int = 0
    packed_bytes: int = 0
    """The same, as they came over the wire."""
    resumed_bytes: int = 0
    """Of files that came this time, what an earlier attempt had brought."""
    is_released: bool = True
    remark: str = ""
    """Why all of it still lies there as well; empty if it does not."""

    def to_mapping(self) -> dict[str, Any]:
        """Return plain values for --json."""
        return asdict(self)

    @property
    def words(self) -> str:
        """What people are told."""
        if self.fetched_files:
            wire = (
                f"{size_words(self.fetched_bytes)} ({size_words(self.packed_bytes)} over the wire)"
            )
            resumed = (
                f", resumed after {size_words(self.resumed_bytes)}" if self.resumed_bytes else ""
            )
            told = f"{self.fetched_files} of {counted(self.files, 'file')}, {wire}{resumed}"
        else:
            told = f"{counted(self.files, 'file')}, {size_words(self.bytes)}, here already"
        return told + (f"; {self.remark}" if self.remark else "")


@dataclass(slots=True)
class Account:
    """What has come from one machine so far, over all its connections and rounds."""

    told: Callable[[int, int], None] = lambda here_bytes, total_bytes: None
    """Takes how many bytes are here, and how many there are."""
    files: int = 0
    total_bytes: int = 0
    here_files: int = 0
    here_bytes: int = 0
    fetched_bytes: int = 0
    packed_bytes: int = 0
    fetched: set[str] = field(default_factory=set)
    resumed: dict[str, int] = field(default_factory=dict)

    def piece(self, size_bytes: int, packed_bytes: int) -> None:
        """Count a piece that has come."""
        self.fetched_bytes += size_bytes
        self.packed_bytes += packed_bytes
        self.here_bytes += size_bytes
        self.told(self.here_bytes, self.total_bytes)

    @property
    def so_far(self) -> str:
        """How far it is, for the text of a failure; empty before anything is known."""
        if not self.files:
            return ""
        here, total = size_words(self.here_bytes), size_words(self.total_bytes)
        return f" ({self.here_files} of {self.files} files and {here} of {total} are here)"

    def retrieved(self, *, is_released: bool, remark: str = "") -> Retrieved:
        """Return the account when everything has come."""
        return Retrieved(
            files=self.files,
            bytes=self.total_bytes,
            fetched_files=len(self.fetched),
            fetched_bytes=self.fetched_bytes,
            packed_bytes=self.packed_bytes,
            resumed_bytes=sum(self.resumed.values()),
            is_released=is_released,
            remark=remark,
        )
