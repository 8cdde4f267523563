"""
Element sets from files: TLE, and OMM as CSV, JSON and XML.

Reading needs only the standard library, so that a scenario is validated quickly; sgp4 comes in when
a set is propagated (`sgp4_sets`). Every fault of a file is reported at once with its line.
"""

from __future__ import annotations

import csv
import io
import json
import math
import re
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import MAXYEAR, UTC, datetime, timedelta
from pathlib import Path

from madns_runtime.errors import ConfigurationError

FILE_BYTES_MAX = 64 * 1024 * 1024
"""The whole public catalogue as XML takes half of this."""
TLE_NAME_COLUMNS = 24
FIRST_YEAR = 1957
"""Of the first satellite: no epoch lies before it, and two-digit years turn over there."""
FAULTS_MAX = 20
"""Faults that one message lists; a file of another kind would give one a line."""

BOOKKEEPING = {
    "CLASSIFICATION_TYPE": "U",
    "OBJECT_ID": "",
    "EPHEMERIS_TYPE": "0",
    "ELEMENT_SET_NO": "999",
    "REV_AT_EPOCH": "0",
    "NORAD_CAT_ID": "0",
}
"""OMM fields that change no orbit, and what stands for them where they are missing."""
NUMBERS = {
    "MEAN_MOTION": (1e-3, 20.0),
    "ECCENTRICITY": (0.0, 0.9999),
    "INCLINATION": (0.0, 180.0),
    "RA_OF_ASC_NODE": (-360.0, 360.0),
    "ARG_OF_PERICENTER": (-360.0, 360.0),
    "MEAN_ANOMALY": (-360.0, 360.0),
    "BSTAR": (-math.inf, math.inf),
    "MEAN_MOTION_DOT": (-math.inf, math.inf),
    "MEAN_MOTION_DDOT": (-math.inf, math.inf),
}
"""OMM fields that SGP4 needs, with the range each must lie in."""
FIXED_FIELDS = {
    "CENTER_NAME": "EARTH",
    "REF_FRAME": "TEME",
    "TIME_SYSTEM": "UTC",
    "MEAN_ELEMENT_THEORY": "SGP4",
}
"""OMM metadata that must have this value where it is given: SGP4 knows no other."""

_TLE_LINE_1 = re.compile(
    r"1 [ 0-9A-Z][ 0-9]{4}[UCS ] .{8} [ 0-9]{2}[ 0-9]{3}\.[0-9]{8} .{10} .{8} .{8} [0-9 ] [ 0-9]{4}[0-9]"
)
_TLE_LINE_2 = re.compile(
    r"2 [ 0-9A-Z][ 0-9]{4} [ 0-9]{3}\.[0-9]{4} [ 0-9]{3}\.[0-9]{4} [0-9]{7}"
    r" [ 0-9]{3}\.[0-9]{4} [ 0-9]{3}\.[0-9]{4} [ 0-9]{2}\.[0-9]{8}[ 0-9]{5}[0-9]"
)


@dataclass(frozen=True, slots=True, kw_only=True)
class ElementSet:
    """One satellite's mean elements, as its file gave them; exactly one of lines and omm is filled."""

    name: str
    epoch_utc: datetime
    lines: tuple[str, str] | None = None
    """The two lines of a TLE."""
    omm: tuple[tuple[str, str], ...] = ()
    """Keys and values of an OMM."""


def read_element_sets(path: Path) -> tuple[ElementSet, ...]:
    """
    Read a file of element sets; OMM or TLE is told by suffix, else by content.

    Raises:
        ConfigurationError: The file is missing, too large, of no known kind, empty or faulty; one
            line a fault, each with file and line number.
    """
    text = _read_text(path)
    reader = {"csv": _read_csv, "json": _read_json, "xml": _read_xml, "tle": _read_tle}[
        _kind(path, text)
    ]
    faults: list[str] = []
    sets = tuple(reader(text, str(path), faults))
    if faults:
        more = [f"{path}: and {len(faults) - FAULTS_MAX} more"] if len(faults) > FAULTS_MAX else []
        raise ConfigurationError("\n".join(faults[:FAULTS_MAX] + more))
    if not sets:
        raise ConfigurationError(f"{path}: expected TLE or OMM element sets, found none")
    return sets


def _read_text(path: Path) -> str:
    try:
        size = path.stat().st_size
        if size > FILE_BYTES_MAX:
            raise ConfigurationError(f"{path}: expected <= {FILE_BYTES_MAX} bytes, got {size}")
        return path.read_text(encoding="utf-8-sig")
    except FileNotFoundError as error:
        raise ConfigurationError(f"{path}: no such file") from error
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigurationError(f"{path}: cannot be read: {error}") from error


def _kind(path: Path, text: str) -> str:
    suffix = path.suffix.lower()
    if suffix in (".csv", ".json", ".xml", ".tle"):
        return suffix[1:]
    head = text.lstrip()[:1]
    if head in ("[", "{"):
        return "json"
    if head == "<":
        return "xml"
    return "csv" if "MEAN_MOTION" in text.partition("\n")[0] else "tle"


# --- TLE ---------------------------------------------------------------------------------------


def _read_tle(text: str, where: str, faults: list[str]) -> Iterator[ElementSet]:
    name = ""
    first: tuple[int, str] | None = None
    number = 0
    for number, raw in enumerate(text.splitlines(), start=1):
        line = raw.rstrip()
        if not line or line.startswith("#"):
            continue
        if first is not None:
            found = _tle_set(name, first, (number, line), where, faults)
            if found is not None:
                yield found
            first, name = None, ""
        elif line.startswith("1 ") and len(line) > TLE_NAME_COLUMNS:
            first = (number, line)
        elif name or len(line.removeprefix("0 ")) > TLE_NAME_COLUMNS:
            faults.append(f"{where}:{number}: expected line 1 of a TLE, got {line[:24]!r}")
            name = ""
        else:
            name = line.removeprefix("0 ").strip()
    if first is not None or name:
        which = 2 if first is not None else 1
        faults.append(f"{where}:{number}: expected line {which} of a TLE to follow, the file ends")


def _tle_set(
    name: str, first: tuple[int, str], second: tuple[int, str], where: str, faults: list[str]
) -> ElementSet | None:
    before = len(faults)
    for which, (number, line) in ((1, first), (2, second)):
        fault = _tle_line_fault(line, which)
        if fault:
            faults.append(f"{where}:{number}: {fault}")
    line1, line2 = first[1], second[1]
    if len(faults) == before and line1[2:7] != line2[2:7]:
        faults.append(
            f"{where}:{second[0]}: expected catalogue number {line1[2:7]}, got {line2[2:7]}"
        )
    if len(faults) > before:
        return None
    year, day = int(line1[18:20]), float(line1[20:32])
    if not 1.0 <= day < 367.0:
        faults.append(f"{where}:{first[0]}: expected a day of the year, got {line1[20:32]}")
        return None
    start = datetime(year + (2000 if year < FIRST_YEAR - 1900 else 1900), 1, 1, tzinfo=UTC)
    return ElementSet(
        name=name or line1[2:7].strip(),
        epoch_utc=start + timedelta(days=day - 1.0),
        lines=(line1[:69], line2[:69]),
    )


def _tle_line_fault(line: str, which: int) -> str | None:
    if not line.startswith(f"{which} "):
        return f"expected line {which} of a TLE, got {line[:24]!r}"
    if len(line) < 69:
        return f"expected 69 columns, got {len(line)}"
    expected, got = tle_checksum(line), line[68]
    if got != str(expected):
        return f"checksum: expected {expected}, got {got!r}; the line is damaged"
    pattern = _TLE_LINE_1 if which == 1 else _TLE_LINE_2
    if not pattern.fullmatch(line[:69]):
        return f"expected the columns of line {which} of a TLE, got {line[:69]!r}"
    return None


def tle_checksum(line: str) -> int:
    """Return the checksum of a TLE line: its digits' sum, a minus counting one, modulo ten."""
    return sum(int(c) if c.isdigit() else c == "-" for c in line[:68]) % 10


# --- OMM ---------------------------------------------------------------------------------------


def _read_csv(text: str, where: str, faults: list[str]) -> Iterator[ElementSet]:
    reader = csv.DictReader(io.StringIO(text))
    try:
        missing = sorted({"EPOCH", *NUMBERS} - set(reader.fieldnames or ()))
        if missing:
            columns = ", ".join(missing)
            faults.append(f"{where}:1: expected the columns of an OMM, missing {columns}")
            return
        for row in reader:
            fields = {key: value for key, value in row.items() if key and value is not None}
            yield from _omm_set(fields, f"{where}:{reader.line_num}", faults)
    except csv.Error as error:
        faults.append(f"{where}:{reader.line_num}: {error}")


def _read_json(text: str, where: str, faults: list[str]) -> Iterator[ElementSet]:
    try:
        document = json.loads(text)
    except json.JSONDecodeError as error:
        faults.append(f"{where}:{error.lineno}:{error.colno}: {error.msg}")
        return
    except (
        ValueError,
        RecursionError,
    ) as error:  # a number of thousands of digits, brackets without end
        faults.append(f"{where}: {error}")
        return
    entries = document if isinstance(document, list) else [document]
    lines = _lines_of('"EPOCH"', text)
    for index, entry in enumerate(entries):
        line = lines[index] if len(lines) == len(entries) else 1
        at = f"{where}:{line}"
        if not isinstance(entry, dict):
            faults.append(f"{at}: set {index + 1}: expected an object of OMM fields, got {entry!r}")
            continue
        fields = {key: str(value) for key, value in entry.items() if value is not None}
        yield from _omm_set(fields, at, faults)


def _read_xml(text: str, where: str, faults: list[str]) -> Iterator[ElementSet]:
    try:
        root = ET.fromstring(text)
    except ET.ParseError as error:
        line, column = error.position
        faults.append(f"{where}:{line}:{column + 1}: {error.msg}")
        return
    segments = list(root.iter("segment"))
    lines = _lines_of("<segment", text)
    for index, segment in enumerate(segments):
        line = lines[index] if len(lines) == len(segments) else 1
        fields = {leaf.tag: (leaf.text or "").strip() for leaf in segment.iter() if len(leaf) == 0}
        yield from _omm_set(fields, f"{where}:{line}", faults)


def _lines_of(needle: str, text: str) -> list[int]:
    """Return the numbers of the lines that hold *needle*: where each set of a document stands."""
    return [n for n, line in enumerate(text.splitlines(), start=1) if needle in line]


def _omm_set(fields: dict[str, str], at: str, faults: list[str]) -> Iterator[ElementSet]:
    before = len(faults)
    name = fields.get("OBJECT_NAME", "").strip() or fields.get("NORAD_CAT_ID", "").strip()
    for key, expected in FIXED_FIELDS.items():
        if fields.get(key, expected).strip().upper() != expected:
            faults.append(f"{at}: {key}: expected {expected}, got {fields[key]!r}")
    for key, (low, high) in NUMBERS.items():
        value = _number(fields.get(key))
        if value is None or not low <= value <= high:
            bounds = "" if math.isinf(high) else f" within [{low:g}, {high:g}]"
            faults.append(f"{at}: {key}: expected a number{bounds}, got {fields.get(key)!r}")
    epoch = _omm_epoch(fields.get("EPOCH", ""))
    if epoch is None:
        faults.append(
            f"{at}: EPOCH: expected such as 2017-03-07T07:18:55.000000, got {fields.get('EPOCH')!r}"
        )
    if len(faults) > before or epoch is None:
        return
    kept = {key: fields[key].strip() for key in NUMBERS}
    kept |= {key: fields.get(key, "").strip() or value for key, value in BOOKKEEPING.items()}
    kept["EPOCH"] = epoch.strftime("%Y-%m-%dT%H:%M:%S.%f")
    yield ElementSet(name=name, epoch_utc=epoch, omm=tuple(sorted(kept.items())))


def _number(text: str | None) -> float | None:
    try:
        value = float(text) if text is not None else math.nan
    except ValueError:
        return None
    return value if math.isfinite(value) else None


def _omm_epoch(text: str) -> datetime | None:
    try:
        epoch = datetime.fromisoformat(text.strip().removesuffix("Z"))
    except ValueError:
        return None
    if epoch.tzinfo is not None or not FIRST_YEAR <= epoch.year < MAXYEAR:
        return None
    return epoch.replace(tzinfo=UTC)
