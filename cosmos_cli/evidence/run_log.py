"""
The log of a run: lines of its processes, read from their files wherever they lie, and put in order. Pure but for `read_here`.

A file is named by its path in the run directory, here and on machines alike, so that one offset serves both.
"""

from __future__ import annotations

import contextlib
import json
import math
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, field, replace
from datetime import datetime
from pathlib import Path
from typing import Any

from cosmos_cli.onboard.log_tail import read_tails
from madns_runtime.conditions.condition import HOST
from madns_runtime.recording.records import LOG_LEVELS

STDERR = "stderr"
"""Stands where a level would: what a process wrote to its standard error, which has no time."""
RANKS: Mapping[str, int] = {**LOG_LEVELS, STDERR: max(LOG_LEVELS.values()) + 1}
TEXT_CHARACTERS_MAX = 4000
NAME_CHARACTERS_MAX = 40
_CONTROL_LINE = re.compile(r'^\{"(?:schema|t0_utc)":[^\n]*', re.MULTILINE)


@dataclass(frozen=True, slots=True, kw_only=True)
class LogLine:
    """One sentence, or one line of a standard error."""

    utc: str | None
    t_s: float | None
    """Simulated time; None where it did not run."""
    source: str
    """host, an agent's name, or a machine's for its standard error."""
    level: str
    text: str
    zero_s: float | None = None
    """Simulated time zero by the clock that `utc` was read from, as a POSIX time, s; None where it is not known."""

    def to_mapping(self) -> dict[str, Any]:
        """Return plain values for --json."""
        mapping = asdict(self)
        del mapping["zero_s"]
        return mapping


@dataclass(slots=True)
class LogReading:
    """Positions up to which each file was read; lines that could not be read are counted."""

    source: str | None = None
    """Source of the wanted lines; None for all."""
    level: str = "debug"
    """The least loud that is wanted."""
    offsets: dict[str, int] = field(default_factory=dict)
    damaged: int = 0
    """Lines that are no record."""
    sources: set[str] = field(default_factory=set)
    """Sources that have a log at all."""
    zeros_s: dict[str, float] = field(default_factory=dict)
    """Simulated time zero, as a POSIX time by the clock of who wrote it, s; by file."""

    def read_here(self, directory: Path, *, is_ended: bool = False) -> Iterator[list[LogLine]]:
        """
        Yield what was added in a directory of this computer, in portions, until nothing is left.

        Args:
            directory: The run's.
            is_ended: Whether nothing of the run lives here; see `read_tails`.
        """
        told: Mapping[str, Any] = {"more": True}
        while told["more"]:
            told = read_tails(str(directory), self.offsets, is_ended=is_ended)
            yield self.take(told["files"])

    def take(self, files: Mapping[str, Mapping[str, Any]]) -> list[LogLine]:
        """Return the lines of what `tail` told, in order of time; what was read before elsewhere is left out."""
        lines: list[LogLine] = []
        for path, told in files.items():
            self.sources.add(_source_of(path))
            if int(told["start"]) != self.offsets.get(path, 0):
                continue
            self.offsets[path] = int(told["end"])
            text = str(told["text"])
            if (zero_s := zero_in(text)) is not None:
                self.zeros_s[path] = zero_s
            zero_s = self.zeros_s.get(path)
            lines += (replace(line, zero_s=zero_s) for line in self._wanted(path, text))
        return in_order(lines)

    def _wanted(self, path: str, text: str) -> Iterator[LogLine]:
        source = _source_of(path)
        if self.source not in (None, source):
            return
        for line in text.splitlines() if path.endswith(".txt") else text.split("\n"):
            found = _line_of(path, source, line) if line.strip() else None
            if found is _DAMAGED:
                self.damaged += 1
            elif found is not None and RANKS.get(found.level, RANKS[STDERR]) >= RANKS[self.level]:
                yield found


_DAMAGED = LogLine(utc=None, t_s=None, source="", level="", text="")


def in_order(lines: Iterable[LogLine]) -> list[LogLine]:
    """
    Return lines by their time; those without one stand behind the others, as they came.

    A board may keep a time that is years off: lines are held against simulated time zero by the clock that
    they were written by; those of a clock of which that is not known, as if they were the host's.
    """
    known = list(lines)
    zeros_s = [line.zero_s for line in known if line.zero_s is not None]
    common_s = next(
        (line.zero_s for line in known if line.source == HOST and line.zero_s is not None),
        min(zeros_s, default=0.0),
    )

    def since_zero_s(line: LogLine) -> float:
        return posix_s(line.utc) - (common_s if line.zero_s is None else line.zero_s)

    return sorted(known, key=since_zero_s)


def posix_s(utc: object) -> float:
    """Return an instant as a POSIX time, s; infinity for what is none."""
    try:
        return datetime.fromisoformat(utc).timestamp() if isinstance(utc, str) else math.inf
    except (ValueError, OverflowError):
        return math.inf


def zero_in(text: str) -> float | None:
    """Return the simulated time zero that a stream's schema, or the line after it, tells; None where none does."""
    for found in _CONTROL_LINE.finditer(text):
        with contextlib.suppress(ValueError, RecursionError, AttributeError):
            zero_s = posix_s(json.loads(found[0]).get("t0_utc"))
            if math.isfinite(zero_s):
                return zero_s
    return None


def _source_of(path: str) -> str:
    return path.split("/", 1)[0] if path.startswith("host/") else path.split("/")[1]


def _line_of(path: str, source: str, line: str) -> LogLine | None:
    """Return a line of a file; None for what is no sentence, such as a stream's schema and its end."""
    if path.endswith(".txt"):
        return LogLine(utc=None, t_s=None, source=source, level=STDERR, text=cut_text(line))
    try:
        record = json.loads(line)
        if not isinstance(record, dict):
            return _DAMAGED
        if "text" not in record:
            return None if {"schema", "end", "t0_utc"} & record.keys() else _DAMAGED
        t_s, utc = record.get("t_s"), record.get("utc")
        return LogLine(
            utc=utc if isinstance(utc, str) and len(utc) <= NAME_CHARACTERS_MAX else None,
            t_s=float(t_s) if isinstance(t_s, int | float) and math.isfinite(t_s) else None,
            source=source,
            level=str(record.get("level"))[:NAME_CHARACTERS_MAX],
            text=cut_text(str(record["text"])),
        )
    except (ValueError, OverflowError, RecursionError):
        return _DAMAGED


def cut_text(text: str) -> str:
    """Return a sentence as people are told it: of one without end the beginning, and how much follows."""
    rest = len(text) - TEXT_CHARACTERS_MAX
    return f"{text[:TEXT_CHARACTERS_MAX]}... ({rest} more characters)" if rest > 0 else text
