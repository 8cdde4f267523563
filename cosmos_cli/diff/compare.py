"""The comparison of two runs: settings, versions, timing, and every stream of their simulation."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from typing import Any

from cosmos_cli.diff.constellation import Constellation, ConstellationDifference
from cosmos_cli.diff.recorded import Key, Recorded
from cosmos_cli.diff.settings import OF_THE_RUN, KeyDifference, differing_keys
from cosmos_cli.diff.side import Side, check_comparable
from cosmos_cli.diff.stream import (
    Pairing,
    StreamDifference,
    choose_pairing,
    diff_stream,
    identical_stream,
)
from cosmos_cli.expectation import mapping_at
from madns_runtime.recording.records import CLOCK, EVENTS, HEALTH, LOG, PROCESS, TICKS

FRAMEWORK_STREAMS = tuple(s.name for s in (TICKS, CLOCK, EVENTS, LOG, HEALTH, PROCESS))
"""What the framework records measures the computers: it is compared when it is named."""
Progress = Callable[[str, float], None]
TIMING = (
    ("exit code", ("exit_code",)),
    ("simulated time, s", ("duration_s",)),
    ("real-time factor", ("rtf",)),
    ("ticks", ("timing", "ticks")),
    ("ticks missed", ("timing", "missed")),
    ("lateness p50, ms", ("timing", "lateness_ms", "p50")),
    ("lateness p99, ms", ("timing", "lateness_ms", "p99")),
    ("lateness max, ms", ("timing", "lateness_ms", "max")),
    ("round trip p50, ms", ("round_trip_ms", "p50")),
    ("reliable messages", ("messages", "reliable", "sent")),
    ("sync messages", ("messages", "sync", "sent")),
    ("sync deadlines broken", ("messages", "sync", "deadlines_broken")),
    ("records", ("records", "written")),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Timed:
    """One figure of both summaries, side by side."""

    title: str
    key: str
    """Dotted, in run.json."""
    a: Any
    b: Any


@dataclass(frozen=True, slots=True, kw_only=True)
class Selection:
    """Which records are compared."""

    agents: tuple[str, ...] = ()
    """Globs of agents' names; empty for all."""
    streams: tuple[str, ...] = ()
    """Globs of streams or tables; empty for all that the simulation records."""

    def takes(self, recorded: Recorded) -> bool:
        """Tell whether a stream is compared."""
        if recorded.role == "agent" and not _fits(recorded.source, self.agents, default=True):
            return False
        if self.streams:
            names = (recorded.stream, recorded.table)
            return any(_fits(name, self.streams, default=True) for name in names)
        return recorded.stream not in FRAMEWORK_STREAMS


@dataclass(slots=True, kw_only=True)
class Comparison:
    """What differs between two runs."""

    a: Side
    b: Side
    settings: list[KeyDifference] = field(default_factory=list)
    versions: list[KeyDifference] = field(default_factory=list)
    summaries: list[KeyDifference] = field(default_factory=list)
    """Of what the simulation summed up at its end."""
    timing: list[Timed] = field(default_factory=list)
    streams: list[StreamDifference] = field(default_factory=list)
    """One a stream and source."""
    only_a: list[Key] = field(default_factory=list)
    """Streams that only the first run recorded."""
    only_b: list[Key] = field(default_factory=list)
    constellation: ConstellationDifference | None = None
    missing: list[str] = field(default_factory=list)
    """Data of either run that are missing or cut, each with the run's name first."""
    remarks: list[str] = field(default_factory=list)

    def totals(self) -> list[StreamDifference]:
        """Return the streams over all their sources."""
        totals: dict[str, StreamDifference] = {}
        for one in self.streams:
            empty = StreamDifference(table=one.table, source="*", by=one.by, is_identical=True)
            totals.setdefault(one.table, empty).merge(one)
        return list(totals.values())

    @property
    def has_records(self) -> bool:
        """Whether either run has a record that was to be compared."""
        return bool(self.only_a or self.only_b) or any(o.rows_a or o.rows_b for o in self.streams)

    @property
    def is_same(self) -> bool:
        """Whether the compared records of both runs are all there and the same; no records are never the same."""
        whole = not self.only_a and not self.only_b and not self.missing
        return (
            whole
            and self.has_records
            and all(one.is_identical or one.has_same_values for one in self.streams)
        )

    @property
    def is_identical(self) -> bool:
        """Whether they are the same bit by bit."""
        return self.is_same and all(one.is_identical for one in self.streams)


def compare(
    a: Side, b: Side, selection: Selection, progress: Progress = lambda _what, _share: None
) -> Comparison:
    """
    Compare two runs.

    Args:
        a: The first run; differences are those of the second from it.
        b: The second.
        selection: Which records are compared.
        progress: Told what is being done and how far it is.

    Raises:
        InputError: They are of different simulations.
        MachineError: A file of theirs cannot be read.
    """
    check_comparable(a, b)
    result = Comparison(a=a, b=b)
    result.settings = differing_keys(a.settings, b.settings, without=OF_THE_RUN)
    result.versions = _differing(a, b, "versions")
    result.summaries = _differing(a, b, "simulation")
    result.timing = [
        Timed(title=title, key=".".join(path), a=_at(a, path), b=_at(b, path))
        for title, path in TIMING
    ]
    result.missing = [f"{side.run.name}: {line}" for side in (a, b) for line in side.missing]
    result.remarks = _remarks(a, b)
    of_a = {key: one for key, one in a.streams.items() if selection.takes(one)}
    of_b = {key: one for key, one in b.streams.items() if selection.takes(one)}
    result.only_a = [key for key in of_a if key not in of_b]
    result.only_b = [key for key in of_b if key not in of_a]
    _compare_streams(result, of_a, of_b, selection, progress)
    return result


def _compare_streams(
    result: Comparison,
    of_a: Mapping[Key, Recorded],
    of_b: Mapping[Key, Recorded],
    selection: Selection,
    progress: Progress,
) -> None:
    a, b = result.a, result.b
    constellation = Constellation.of(a, b)
    common = [key for key in of_a if key in of_b]
    sizes = [_size(of_a[key]) + _size(of_b[key]) for key in common]
    done, total = 0, max(sum(sizes), 1)
    for key, size in zip(common, sizes, strict=True):
        progress(f"comparing {key[1]}/{key[0]}", done / total)
        pairing = choose_pairing(of_a[key].fields, of_b[key].fields, (a.tick_hz, b.tick_hz))
        found = _compare_one(of_a[key], of_b[key], pairing, selection, constellation)
        result.streams.append(found)
        done += size
    if constellation is not None:
        result.constellation = constellation.finish(of_a, of_b)


def _compare_one(
    recorded: Recorded,
    other: Recorded,
    pairing: Pairing,
    selection: Selection,
    constellation: Constellation | None,
) -> StreamDifference:
    lines = recorded.lines()
    if lines is not None and lines == other.lines():
        same = identical_stream(recorded, pairing.by, lines.records)
        if constellation is not None:
            constellation.take_identical(recorded, same)
        return same
    observe = None if constellation is None else constellation.observer(recorded, pairing)
    return diff_stream(recorded, other, pairing, agents=selection.agents, observe=observe)


def _remarks(a: Side, b: Side) -> list[str]:
    remarks = []
    if a.tick_hz != b.tick_hz:
        remarks.append(
            f"ticks are matched by time: {a.tick_hz:g} Hz against {b.tick_hz:g} Hz,"
            " so only the instants that both have are compared"
        )
    if a.duration_s != b.duration_s:
        remarks.append(
            f"simulated times differ: {a.duration_s:g} s against {b.duration_s:g} s;"
            " what only the longer run has is alone"
        )
    return remarks


def _differing(a: Side, b: Side, name: str) -> list[KeyDifference]:
    return differing_keys(mapping_at(a.document, name), mapping_at(b.document, name))


def _at(side: Side, path: Sequence[str]) -> Any:
    return mapping_at(side.document, *path[:-1]).get(path[-1])


def _fits(name: str, globs: Sequence[str], *, default: bool) -> bool:
    return any(fnmatchcase(name, glob) for glob in globs) if globs else default


def _size(recorded: Recorded) -> int:
    """Return the bytes of a stream's lines; a stream without lines counts little."""
    size = 1
    for file in recorded.files:
        try:
            size += file.path.stat().st_size
        except OSError:
            continue
    return size
