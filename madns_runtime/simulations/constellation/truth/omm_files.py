"""Orbit mean-elements messages (OMM) from CSV, JSON and XML; every fault is noted with its line."""

from __future__ import annotations

import csv
import io
import json
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from datetime import UTC, date, datetime, timedelta

from madns_runtime.plain_values import shown
from madns_runtime.simulations.constellation.truth.element_set import (
    FIRST_YEAR,
    LAST_YEAR,
    NUMBERS,
    ElementSet,
    range_fault,
    theory_fault,
)

BOOKKEEPING = {
    "CLASSIFICATION_TYPE": "U",
    "OBJECT_ID": "",
    "EPHEMERIS_TYPE": "0",
    "ELEMENT_SET_NO": "999",
    "REV_AT_EPOCH": "0",
    "NORAD_CAT_ID": "0",
}
"""OMM fields that change no orbit, and what stands for them where they are missing."""
TAKEN = ("EPHEMERIS_TYPE", "NORAD_CAT_ID")
"""Of these what a file says counts; whatever the others say, sgp4 is given what stands for them: it takes few forms."""
FIXED_FIELDS = {
    "CENTER_NAME": "EARTH",
    "REF_FRAME": "TEME",
    "TIME_SYSTEM": "UTC",
    "MEAN_ELEMENT_THEORY": "SGP4",
}
"""OMM metadata that must have this value where it is given: SGP4 knows no other."""

OTHER_WORDS = {("MEAN_ELEMENT_THEORY", "SGP/SGP4"): "SGP4"}
"""Other words for them. Source: CCSDS 502.0-B-3, whose own examples write the theory so."""
_DATE = re.compile(r"([0-9]{4})-([0-9]{3}|[0-9]{2}-[0-9]{2})([T ].*)?", re.ASCII)
"""By month and day or by day of the year. Source: CCSDS 502.0-B-3, 7.5.10; ISO 8601 alone has weeks, too, others a blank for T."""


def read_csv(text: str, where: str, faults: list[str]) -> Iterator[ElementSet]:
    """Yield the sets of an OMM as CSV, one per row; what is wrong goes into *faults*."""
    rows = text.lstrip()
    above = text[: len(text) - len(rows)].count("\n")
    reader = csv.DictReader(io.StringIO(rows), skipinitialspace=True)
    try:
        missing = sorted({"EPOCH", *NUMBERS} - set(reader.fieldnames or ()))
        if missing:
            columns = ", ".join(missing)
            faults.append(f"{where}:{above + 1}: expected the columns of an OMM, missing {columns}")
            return
        twice = sorted(_twice(reader.fieldnames or ()))
        if twice:
            faults.append(
                f"{where}:{above + 1}: expected every column once, got {', '.join(twice)[:200]} again"
            )
            return
        for row in reader:
            at = f"{where}:{above + reader.line_num}"
            if None in row:  # what has no column
                width = len(reader.fieldnames or ())
                faults.append(f"{at}: expected {width} values, got more")
                continue
            fields = {key: value for key, value in row.items() if key and value is not None}
            yield from _omm_set(fields, at, faults)
    except csv.Error as error:
        faults.append(f"{where}:{above + reader.line_num}: {error}")


def read_json(text: str, where: str, faults: list[str]) -> Iterator[ElementSet]:
    """Yield the sets of an OMM as JSON, an object or a list of them; what is wrong goes into *faults*."""
    try:
        document = json.loads(text, object_pairs_hook=_fields_once)
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
            faults.append(
                f"{at}: set {index + 1}: expected an object of OMM fields, got {shown(entry)}"
            )
            continue
        fields = {key: str(value) for key, value in entry.items() if value is not None}
        yield from _omm_set(fields, at, faults)


def _fields_once(pairs: list[tuple[str, object]]) -> dict[str, object]:
    """Return an object of JSON whose keys are different."""
    twice = _twice([key for key, _ in pairs])
    if twice:
        raise ValueError(f"expected every field once, got {', '.join(sorted(twice))[:200]} again")
    return dict(pairs)


def _twice(names: Sequence[str]) -> set[str]:
    return {name for name, count in Counter(names).items() if count > 1}


def read_xml(text: str, where: str, faults: list[str]) -> Iterator[ElementSet]:
    """Yield the sets of an OMM as XML, one per segment; what is wrong goes into *faults*."""
    # Imported late: `cosmos validate` of a scenario with TLEs has no use for it.
    import xml.etree.ElementTree as ET

    try:
        root = ET.fromstring(text)
    except ET.ParseError as error:
        line, column = error.position
        faults.append(f"{where}:{line}:{column + 1}: {error.msg}")
        return
    for element in root.iter():
        element.tag = element.tag.rpartition("}")[2]  # without its namespace
    segments = list(root.iter("segment"))
    lines = _lines_of(r"<([\w.-]+:)?segment\b", text)
    for index, segment in enumerate(segments):
        line = lines[index] if len(lines) == len(segments) else 1
        leaves = [leaf for leaf in segment.iter() if len(leaf) == 0]
        twice = _twice([leaf.tag for leaf in leaves if leaf.tag in ("EPOCH", *NUMBERS)])
        if twice:
            faults.append(f"{where}:{line}: expected {', '.join(sorted(twice))} once in a segment")
            continue
        fields = {leaf.tag: (leaf.text or "").strip() for leaf in leaves}
        yield from _omm_set(fields, f"{where}:{line}", faults)


def _lines_of(pattern: str, text: str) -> list[int]:
    """Return the numbers of the lines that hold a pattern: where each set of a document stands."""
    return [n for n, line in enumerate(text.splitlines(), start=1) if re.search(pattern, line)]


def _omm_set(fields: dict[str, str], at: str, faults: list[str]) -> Iterator[ElementSet]:
    before = len(faults)
    name = fields.get("OBJECT_NAME", "").strip() or fields.get("NORAD_CAT_ID", "").strip()
    for key, expected in FIXED_FIELDS.items():
        given = fields.get(key, expected).strip().upper()
        if OTHER_WORDS.get((key, given), given) != expected:
            faults.append(f"{at}: {key}: expected {expected}, got {shown(fields[key])}")
    if fault := theory_fault(fields.get("EPHEMERIS_TYPE", "")):
        faults.append(f"{at}: {fault}")
    for key in NUMBERS:
        if fault := range_fault(key, fields.get(key)):
            faults.append(f"{at}: {fault}")
    epoch = _omm_epoch(fields.get("EPOCH", ""))
    if epoch is None:
        faults.append(
            f"{at}: EPOCH: expected such as 2017-03-07T07:18:55.000000 or 2017-066T07:18:55, "
            f"of a year from {FIRST_YEAR} to {LAST_YEAR - 1}, got {shown(fields.get('EPOCH'))}"
        )
    if len(faults) > before or epoch is None:
        return
    kept = {key: fields[key].strip() for key in NUMBERS}
    taken = {key: fields.get(key, "").strip() for key in TAKEN}
    kept |= {key: taken.get(key) or value for key, value in BOOKKEEPING.items()}
    kept["EPOCH"] = epoch.strftime("%Y-%m-%dT%H:%M:%S.%f")
    yield ElementSet(name=name, epoch_utc=epoch, omm=tuple(sorted(kept.items())), place=at)


def _omm_epoch(text: str) -> datetime | None:
    """Return an epoch of CCSDS ASCII time code A or B; None if it is none, has a zone or an impossible year."""
    form = _DATE.fullmatch(text.strip().removesuffix("Z"))
    if form is None:
        return None
    year, day, time = form.groups(default="")
    try:
        if len(day) == 3:
            of_year = date(int(year), 1, 1) + timedelta(days=int(day) - 1)
            if of_year.year != int(year):
                return None
            day = f"{of_year:%m-%d}"
        epoch = datetime.fromisoformat(f"{year}-{day}{time}")
    except (ValueError, OverflowError):  # no such date or time; before or behind all years
        return None
    if epoch.tzinfo is not None or not FIRST_YEAR <= epoch.year < LAST_YEAR:
        return None
    return epoch.replace(tzinfo=UTC)
