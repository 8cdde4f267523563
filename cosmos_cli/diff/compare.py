"""The comparison of two runs: settings, versions, timing, and every stream of their simulation."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from fnmatch import fnmatchcase
from typing import Any

from cosmos_cli.collect.finished_run import changed_tables
from cosmos_cli.collect.unread_files import find_unread, told_unread
from cosmos_cli.diff.recorded import Key, Lines, Recorded
from cosmos_cli.diff.side import Side, check_comparable
from cosmos_cli.diff.stream import (
    StreamDifference,
    choose_pairing,
    diff_stream,
    identical_stream,
)
from cosmos_cli.evidence.simulation_calls import call_simulation, check_blocks, json_document
from cosmos_cli.evidence.streams import file_size_bytes
from cosmos_cli.evidence.tables import no_tables, open_recorded_run
from cosmos_cli.evidence.verdict import is_number
from cosmos_cli.models.expectation import owner_of
from madns_runtime.analysis.tables import ComparedRun
from madns_runtime.analysis.values import SimulationDifference
from madns_runtime.errors import PluginError
from madns_runtime.plain_values import mapping_at
from madns_runtime.recording.records import FRAMEWORK_STREAMS

Progress = Callable[[str, float], None]
OF_THE_RUN = ("run", "base_directory", "network.port")
"""Keys that differ between any two runs and say nothing of them."""
TIMING = (
    ("exit code", ("exit_code",)),
    ("duration, s", ("duration_s",)),
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
class KeyDifference:
    """One key whose values differ; None where a run does not have it."""

    key: str
    a: Any
    b: Any


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
    """Selection of the records that are compared."""

    agents: tuple[str, ...] = ()
    """Globs of agents' names; empty for all."""
    streams: tuple[str, ...] = ()
    """Globs of streams or tables; empty for all that the simulation records."""

    def takes(self, recorded: Recorded, agents: Collection[str]) -> bool:
        """Tell whether a stream is compared; *agents* are all of the runs, who have their own devices' records, too."""
        owner = owner_of(recorded.source) if recorded.role == "device" else recorded.source
        is_of_agent = recorded.role == "agent" or (recorded.role == "device" and owner in agents)
        if is_of_agent and self.agents and not _fits(owner, self.agents):
            return False
        if self.streams:
            return any(_fits(name, self.streams) for name in (recorded.stream, recorded.table))
        # What the framework records measures the computers: it is compared when it is named.
        return recorded.stream not in FRAMEWORK_STREAMS

    def parts(self, recorded: Recorded) -> bool:
        """Tell whether of a stream that is compared some records are not: a host's are of all agents."""
        return bool(self.agents) and recorded.role == "host"


@dataclass(slots=True, kw_only=True)
class Comparison:
    """Differences between two runs."""

    a: Side
    b: Side
    settings: list[KeyDifference] = field(default_factory=list)
    versions: list[KeyDifference] = field(default_factory=list)
    summaries: list[KeyDifference] = field(default_factory=list)
    """Of what the simulation summed up at its end."""
    timing: list[Timed] = field(default_factory=list)
    streams: list[StreamDifference] = field(default_factory=list)
    """One per stream and source."""
    only_a: list[Key] = field(default_factory=list)
    """Streams that only the first run recorded."""
    only_b: list[Key] = field(default_factory=list)
    simulation: str = ""
    """Name of what was simulated, as its descriptor tells it."""
    by_simulation: SimulationDifference | None = None
    """Differences that the simulation itself tells."""
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
        return (
            self.has_records
            and not (self.only_a or self.only_b or self.missing)
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
    agents = {*a.agents, *b.agents}
    of_a = {key: one for key, one in a.streams.items() if selection.takes(one, agents)}
    of_b = {key: one for key, one in b.streams.items() if selection.takes(one, agents)}
    result = Comparison(
        a=a,
        b=b,
        settings=differing_keys(a.settings, b.settings, without=OF_THE_RUN),
        versions=_differing(a, b, "versions"),
        summaries=_differing(a, b, "simulation"),
        timing=[
            Timed(title=title, key=".".join(path), a=_at(a, path), b=_at(b, path))
            for title, path in TIMING
        ],
        only_a=[key for key in of_a if key not in of_b],
        only_b=[key for key in of_b if key not in of_a],
        missing=[f"{side.run.name}: {line}" for side in (a, b) for line in side.missing],
        remarks=_remarks(a, b),
    )
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
    common = [key for key in of_a if key in of_b]
    sizes = [_size(of_a[key]) + _size(of_b[key]) for key in common]
    done, total = 0, max(sum(sizes), 1)
    identical: dict[Key, int] = {}
    for key, size in zip(common, sizes, strict=True):
        progress(f"comparing {key[1]}/{key[0]}", done / total)
        pairing = choose_pairing(of_a[key].fields, of_b[key].fields, (a.tick_hz, b.tick_hz))
        # The same numbers under other names, or in another unit, are others.
        is_alike = of_a[key].fields == of_b[key].fields
        lines, other = of_a[key].lines(), of_b[key].lines()
        _note_changes(result, a, lines)
        _note_changes(result, b, other)
        # The same ticks at different rates are other instants.
        is_same_time = pairing.scales[0] == pairing.scales[1]
        is_identical = bool(lines and other and is_alike and is_same_time and lines.is_same(other))
        if lines is not None and is_identical:
            identical[key] = lines.records
        if lines is not None and is_identical and not selection.parts(of_a[key]):
            found = identical_stream(of_a[key], pairing.by, lines.records)
        else:
            found = diff_stream(of_a[key], of_b[key], pairing, agents=selection.agents)
            # Of what is the same bit by bit any part is.
            found.is_identical = found.is_identical or is_identical
        result.streams.append(found)
        done += size
    if selection == Selection():
        progress("looking for changes in what is not compared", 1.0)
        for side in (a, b):
            for key, stream in side.streams.items():
                if key not in common:
                    _note_changes(result, side, stream.lines())
    changed = [f"{side.run.name}: {line}" for side in (a, b) for line in changed_tables(side.run)]
    result.missing += changed
    progress("comparing by the simulation", 1.0)
    try:
        if changed:
            raise PluginError("tables are not as they were collected")
        _compare_by_simulation(result, of_a, of_b, identical)
    except PluginError as error:
        result.remarks.append(f"{a.simulation} compared nothing itself: {error}")


def _note_changes(result: Comparison, side: Side, lines: Lines | None) -> None:
    """Enter files whose hash is not what it was: their length may be, which was looked at before."""
    for path in lines.changed if lines is not None else ():
        name = f"{side.run.name}: {path.relative_to(side.run.path).as_posix()}: "
        if not any(line.startswith(name) for line in result.missing):
            result.missing.append(f"{name}changed since the run was collected")


def _compare_by_simulation(
    result: Comparison,
    of_a: Mapping[Key, Recorded],
    of_b: Mapping[Key, Recorded],
    identical: Mapping[Key, int],
) -> None:
    """
    Ask the simulation itself, by its descriptor's `compare`; nothing comes of it if it has none.

    Raises:
        PluginError: It could not be asked, or returned something else.
    """
    sides = tuple(
        ComparedRun(
            run=open_recorded_run(side.run, side.document), streams=streams, identical=identical
        )
        for side, streams in ((result.a, of_a), (result.b, of_b))
    )
    config = sides[1].run.config
    if config is None:
        return
    result.simulation, found = call_simulation(config, "compare", *sides)
    if found is not None and not isinstance(found, SimulationDifference):
        raise PluginError(
            f"compare() must return a madns_runtime.analysis.values.SimulationDifference,"
            f" got {type(found).__name__}"
        )
    if found is not None:
        check_blocks(found.blocks, "compare()")
        told = json_document(found.document, "compare()'s document")
        found = replace(found, document=told)
    result.by_simulation = found


def _remarks(a: Side, b: Side) -> list[str]:
    remarks = []
    if a.tick_hz != b.tick_hz:
        remarks.append(
            f"ticks are matched by time: {a.tick_hz:g} Hz against {b.tick_hz:g} Hz,"
            " so only the instants that both have are compared"
        )
    cut = [side for side in (a, b) if not side.is_complete]
    for side in cut:
        remarks.append(
            f"{side.run.name}: {side.status} before the end of the {side.duration_s:g} s that were planned; what the"
            " other run has beyond that is alone"
        )
    if not cut and a.duration_s != b.duration_s:
        remarks.append(
            f"simulated times differ: {a.duration_s:g} s against {b.duration_s:g} s;"
            " what only the longer run has is alone"
        )
    for side in (a, b):
        unread = told_unread(side.run, find_unread(side.run))
        remarks += [f"{side.run.name}: {name}: {why}" for name, why in unread.items()]
        if names := no_tables(side.run.tables):
            remarks.append(
                f"{side.run.name}: not read, as they are links or no files: tables/{', '.join(names)}"
            )
    return remarks


def _differing(a: Side, b: Side, name: str) -> list[KeyDifference]:
    return differing_keys(mapping_at(a.document, name), mapping_at(b.document, name))


def _at(side: Side, path: Sequence[str]) -> Any:
    return mapping_at(side.document, *path[:-1]).get(path[-1])


def _fits(name: str, globs: Sequence[str]) -> bool:
    return any(fnmatchcase(name, glob) for glob in globs)


def _size(recorded: Recorded) -> int:
    """Return the bytes of a stream's lines; a stream without lines counts little."""
    return 1 + sum(file_size_bytes(file.path) for file in recorded.files)


def differing_keys(
    a: Mapping[str, Any], b: Mapping[str, Any], *, without: Sequence[str] = ()
) -> list[KeyDifference]:
    """
    Return the keys at which two trees differ, in the order of the first.

    Args:
        a: Mappings of mappings, lists and scalars.
        b: The same.
        without: Dotted keys that are not compared, nor what is below them.
    """
    of_a, of_b = dict(flat(a)), dict(flat(b))
    return [
        KeyDifference(key=key, a=of_a.get(key), b=of_b.get(key))
        for key in dict.fromkeys((*of_a, *of_b))
        if not _is_same(of_a, of_b, key)
        and not any(key == other or key.startswith(f"{other}.") for other in without)
    ]


def flat(value: Any, key: str = "") -> Iterator[tuple[str, Any]]:
    """Give every leaf with its dotted key; a list of scalars is one leaf."""
    if isinstance(value, Mapping):
        for name, item in value.items():
            yield from flat(item, f"{key}.{name}" if key else str(name))
    elif isinstance(value, list | tuple) and any(isinstance(item, Mapping) for item in value):
        for number, item in enumerate(value):
            yield from flat(item, f"{key}[{number}]")
    else:
        yield key, list(value) if isinstance(value, tuple) else value


def _is_same(a: Mapping[str, Any], b: Mapping[str, Any], key: str) -> bool:
    if (key in a) != (key in b):
        # Null here and a mapping there: the keys of the mapping tell, and this one would tell nothing.
        return a.get(key) is None and b.get(key) is None
    left, right = a[key], b[key]
    return bool(left == right) and is_number(left) == is_number(right)
