"""Outcome of a rerun, in words and as JSON. Pure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from fnmatch import fnmatchcase
from typing import Any, Final

from cosmos_cli.diff.compare import Comparison
from cosmos_cli.diff.document import to_document
from cosmos_cli.diff.fields import FieldDifference
from cosmos_cli.diff.stream import StreamDifference
from cosmos_cli.models.known_streams import OF_DEVICES_OWN
from cosmos_cli.rerun.device_comparison import ChannelComparison
from cosmos_cli.rerun.expectations import ExpectationComparison
from cosmos_cli.rerun.rounding import is_rounding
from cosmos_cli.ui.console import Column, Console
from cosmos_cli.ui.plural import counted

SCHEMA: Final = 1
NOTHING_COMPARED: Final = "neither run has a record that is judged"
STREAMS_SHOWN_MAX: Final = 20


@dataclass(frozen=True, slots=True, kw_only=True)
class RerunOutcome:
    """A rerun and its comparison with the recorded run."""

    devices: Sequence[ChannelComparison]
    streams: Comparison
    remarks: Sequence[str]
    unlike: Sequence[str]
    """Streams of the simulation that are not compared."""
    expectations: Sequence[ExpectationComparison] = ()
    """Checks that were judged in both runs."""
    is_exact: bool = False
    """Whether nothing of the recorded run was rounded and played back: then no difference is small."""

    @property
    def differing_expectations(self) -> list[ExpectationComparison]:
        """Checks that hold in one run alone, but for those on what is not compared."""
        return [
            each
            for each in self.expectations
            if not each.is_same
            and not self._is_unlike(each.stream)
            and not _is_of_devices_own(each.stream)
            and not self._is_unlike(f"{each.stream}.{each.field}")
            and not any(fnmatchcase(f"device.{each.stream}", glob) for glob in self.unlike)
        ]

    @property
    def differing(self) -> list[StreamDifference]:
        """Streams of the simulation that differ by more than the rounding of recorded times."""
        return [one for one in self.streams.totals() if self.differences_of(one)]

    @property
    def differing_channels(self) -> list[ChannelComparison]:
        """Channels of devices that differ, but for outputs that are only told."""
        return [each for each in self.devices if not each.is_same and self.is_judged(each)]

    def is_judged(self, channel: ChannelComparison) -> bool:
        """Tell whether a channel counts."""
        name = f"device.{channel.name.rpartition('/')[2]}"
        return channel.direction == "in" or not any(fnmatchcase(name, glob) for glob in self.unlike)

    @property
    def alone(self) -> list[str]:
        """Streams of the simulation that only one run has."""
        pairs = ((self.streams.only_a, "on record"), (self.streams.only_b, "in the rerun"))
        return [
            f"{source}/{table}: only {where}"
            for keys, where in pairs
            for table, source in keys
            if not self._is_unlike(table) and self._holds_records(table, source)
        ]

    @property
    def has_compared(self) -> bool:
        """Whether there was anything to be compared: records of the simulation or of devices, or checks."""
        judged = (one for one in self.streams.streams if not self._is_unlike(one.table))
        return (
            any(one.rows_a or one.rows_b for one in judged)
            or any(each.compared for each in self.devices if self.is_judged(each))
            or bool(self.expectations or self.alone)
        )

    @property
    def is_same(self) -> bool:
        """Whether all that is compared is the same; nothing is never the same."""
        return (
            self.has_compared
            and not self.differing_channels
            and not self.differing
            and not self.differing_expectations
            and not self.alone
            and not self.streams.missing
        )

    def differences_of(self, one: StreamDifference) -> list[str]:
        """Say what differs in a stream; nothing if all of it is the same."""
        if one.is_identical or one.has_same_values or self._is_unlike(one.table):
            return []
        told = [
            _told(field)
            for name, field in one.fields.items()
            if field.different
            and not self._is_unlike(f"{one.table}.{name}")
            and not self._is_rounding(one.table, name)
        ]
        for alone, where in ((one.only_a, "on record"), (one.only_b, "in the rerun")):
            if alone.count:
                told.append(f"{counted(alone.count, 'record')} only {where}")
        for fields, where in (
            (one.fields_only_a, "on record"),
            (one.fields_only_b, "in the rerun"),
        ):
            # Software of today may record a field in another unit, or no more: its values were compared with none.
            names = [name for name in fields if not self._is_unlike(_place_of(one.table, name))]
            if names:
                told.append(f"{', '.join(names)} only {where}")
        return told

    def _is_rounding(self, table: str, name: str) -> bool:
        """Tell whether values differ by no more than what was rounded explains, in the records of each source."""
        if self.is_exact:
            return False
        found = [
            (one.fields[name], self.streams.a.streams[table, one.source])
            for one in self.streams.streams
            if one.table == table and name in one.fields and one.fields[name].different
        ]
        return all(is_rounding(field, recorded) for field, recorded in found)

    def _is_unlike(self, name: str) -> bool:
        is_device = name.startswith("device_")  # compared by their own rules
        return is_device or name in self.unlike or name.removeprefix("host_") in self.unlike

    def _holds_records(self, table: str, source: str) -> bool:
        key = (table, source)
        for side in (self.streams.a, self.streams.b):
            found = side.streams.get(key)
            lines = found.lines() if found is not None else None
            if found is not None and (lines is None or lines.records):
                return True
        return False

    def to_mapping(self) -> dict[str, Any]:
        """Return what --json prints."""
        return {
            "schema": SCHEMA,
            "run": self.streams.a.run.name,
            "rerun": self.streams.b.run.name,
            "directory": str(self.streams.b.run.path),
            "same": self.is_same,
            "remarks": [*self.remarks, *([] if self.has_compared else [NOTHING_COMPARED])],
            "devices": [
                {**asdict(each), "same": each.is_same, "judged": self.is_judged(each)}
                for each in self.devices
            ],
            "checks": [{**asdict(each), "same": each.is_same} for each in self.expectations],
            "not_compared": list(self.unlike),
            "diff": to_document(self.streams),
        }


def _place_of(table: str, field: str) -> str:
    """Return what a rerun calls a field that stands in one run alone, perhaps with its unit in parentheses."""
    return f"{table}.{field.partition(' (')[0]}"


def _is_of_devices_own(stream: str) -> bool:
    """Tell whether a check's stream tells how a device fares: another one plays it back."""
    _, dot, name = stream.rpartition(".")
    return bool(dot) and any(name == schema.name for schema in OF_DEVICES_OWN)


def print_outcome(console: Console, found: RerunOutcome) -> None:
    """Print a rerun's outcome on stdout; its last line says whether it is the same."""
    for remark in (*found.remarks, *found.streams.remarks):
        console.data(f"remark: {remark}")
    for line in found.streams.missing:
        console.data(f"missing: {line}")
    if found.devices:
        columns = [Column("channel"), Column("agent"), Column("")]
        columns += [
            Column(name, True) for name in ("records", "compared", "differ", "in ticks", "not seen")
        ]
        columns.append(Column("first difference"))
        console.table(columns, [_channel_row(found, each) for each in found.devices])
    for one in found.differing[:STREAMS_SHOWN_MAX]:
        console.data(f"{one.table}: {'; '.join(found.differences_of(one))}")
    for text in found.alone[:STREAMS_SHOWN_MAX]:
        console.data(text)
    for check in found.expectations:
        if not check.is_same:
            console.data(check.words)
    console.data(verdict_of(found))


def verdict_of(found: RerunOutcome) -> str:
    """Return in one line whether the rerun is the same."""
    records = sum(each.compared for each in found.devices)
    matched = sum(one.matched for one in found.streams.streams)
    both = (
        f"{counted(records, 'record')} of {counted(len(found.devices), 'channel')} of devices,"
        f" {counted(matched, 'record')} of the simulation"
    )
    if found.is_same:
        return f"SAME: {both}"
    if not found.has_compared:
        return f"NOTHING COMPARED: {NOTHING_COMPARED}"
    names = [each.name for each in found.differing_channels]
    names += [one.table for one in found.differing] + found.alone
    names += [f"check {each.name}" for each in found.differing_expectations]
    names += ["missing data"] * bool(found.streams.missing)
    return f"DIFFERENT: in {', '.join(names[:STREAMS_SHOWN_MAX])} ({both})"


def _channel_row(found: RerunOutcome, channel: ChannelComparison) -> list[str]:
    first = f"{channel.first.t_s:.6f} s: {channel.first.text}" if channel.first else ""
    way = "played" if channel.direction == "in" else "given"
    way += "" if found.is_judged(channel) else ", only told"
    counts = (
        channel.records,
        channel.compared,
        channel.different,
        channel.in_ticks,
        channel.left_out,
    )
    return [channel.name, channel.agent, way, *map(str, counts), first]


def _told(field: FieldDifference) -> str:
    """Return how a field differs, and where first."""
    largest = f", at most {field.max:g} {field.field.unit}".rstrip() if field.is_number else ""
    place = field.first
    where = f", first at {place.key:.12g} {place.who}".rstrip() if place is not None else ""
    return f"{field.field.name} differs in {counted(field.different, 'record')}{largest}{where}"
