"""Two-line element sets (TLE) from text; every fault is noted with its line."""

from __future__ import annotations

import re
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta

from madns_runtime.simulations.constellation.truth.element_set import (
    FIRST_YEAR,
    ElementSet,
    range_fault,
    theory_fault,
)

TLE_NAME_COLUMNS = 24
_TLE_LINE_1 = re.compile(
    r"1 [ 0-9A-HJ-NP-Z][ 0-9]{4}[UCS ] .{8} [ 0-9]{2}[ 0-9]{3}\.[0-9]{8} [ +-]\.[0-9]{8}"
    r" [ +-][0-9 ]{5}[ +-][0-9] [ +-][0-9 ]{5}[ +-][0-9] [0-9 ] [ 0-9]{4}[0-9]"
)
_TLE_LINE_2 = re.compile(
    r"2 [ 0-9A-HJ-NP-Z][ 0-9]{4} [ 0-9]{3}\.[0-9]{4} [ 0-9]{3}\.[0-9]{4} [0-9]{7}"
    r" [ 0-9]{3}\.[0-9]{4} [ 0-9]{3}\.[0-9]{4} [ 0-9]{2}\.[0-9]{8}[ 0-9]{5}[0-9]"
)


def read_tle(text: str, where: str, faults: list[str]) -> Iterator[ElementSet]:
    """
    Yield the sets of a file of TLEs; what is wrong goes into *faults*.

    Lines that begin with # are comments, except one such as "#1 SAT" directly above a line 1 without a name: it is the name.
    """
    name = marked = ""
    first: tuple[int, str] | None = None
    number = 0
    for number, raw in enumerate(text.splitlines(), start=1):
        line = raw.rstrip()
        if not line or line.startswith("#"):
            marked = line
            continue
        if first is not None:
            found = _tle_set(name, first, (number, line), where, faults)
            if found is not None:
                yield found
            first, name, marked = None, "", ""
        elif line.startswith("1 ") and len(line) > TLE_NAME_COLUMNS:
            first = (number, line)
            if marked[1:2].isdigit() and len(marked) <= TLE_NAME_COLUMNS:
                name = name or marked
        elif name or len(line.removeprefix("0 ")) > TLE_NAME_COLUMNS:
            faults.append(f"{where}:{number}: expected line 1 of a TLE, got {line[:24]!r}")
            name = marked = ""
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
    epoch: datetime | None = None
    try:
        epoch = _tle_epoch(line1)
    except ValueError:  # blanks instead of a year's digits, or between those of the day
        got = repr(line1[18:32])
        faults.append(f"{where}:{first[0]}: expected a year and a day of it as 17066.0, got {got}")
    else:
        if epoch is None:
            faults.append(f"{where}:{first[0]}: expected a day of its year, got {line1[18:32]}")
    if fault := theory_fault(line1[62]):
        faults.append(f"{where}:{first[0]}: {fault}")
    faults += _tle_number_faults(where, first, second)
    if len(faults) > before or epoch is None:
        return None
    return ElementSet(
        name=name or line1[2:7].strip(),
        epoch_utc=epoch,
        lines=(_without_blanks(line1), line2[:69]),
        place=f"{where}:{first[0]}",
    )


def _tle_epoch(line1: str) -> datetime | None:
    """
    Return the epoch in the columns of line 1; None if its year has no such day.

    Raises:
        ValueError: There are blanks where digits belong.
    """
    year, day = int(line1[18:20]), float(line1[20:32])
    start = datetime(year + (2000 if year < FIRST_YEAR - 1900 else 1900), 1, 1, tzinfo=UTC)
    if not day >= 1.0:
        return None
    epoch = start + timedelta(days=day - 1.0)
    return epoch if epoch.year == start.year else None


def _without_blanks(line1: str) -> str:
    """Return line 1 with zeros for blanks within a number: SGP4's reader would read on into the columns behind them."""
    year = f"{int(line1[18:20]):02d}"
    ddot, bstar = (line1[start:end].replace(" ", "0") for start, end in ((45, 50), (54, 59)))
    return f"{line1[:18]}{year}{line1[20:45]}{ddot}{line1[50:54]}{bstar}{line1[59:69]}"


def _tle_number_faults(where: str, first: tuple[int, str], second: tuple[int, str]) -> list[str]:
    """Return the numbers of a TLE, whose columns are right, that lie outside what an orbit can have."""
    (number1, line1), (number2, line2) = first, second
    columns = (
        ("BSTAR", number1, _tle_exponential(line1[53:61])),
        ("MEAN_MOTION_DDOT", number1, _tle_exponential(line1[44:52])),
        ("INCLINATION", number2, line2[8:16]),
        ("RA_OF_ASC_NODE", number2, line2[17:25]),
        ("ECCENTRICITY", number2, f".{line2[26:33]}"),
        ("ARG_OF_PERICENTER", number2, line2[34:42]),
        ("MEAN_ANOMALY", number2, line2[43:51]),
        ("MEAN_MOTION", number2, line2[52:63]),
    )
    faults = ((number, range_fault(key, text)) for key, number, text in columns)
    return [f"{where}:{number}: {fault}" for number, fault in faults if fault]


def _tle_exponential(text: str) -> str:
    """Return a TLE's number with an assumed point, such as -11606-4, as others write it: -.11606e-4."""
    return f"{text[0].strip()}.{text[1:6].replace(' ', '0')}e{text[6:].replace(' ', '+')}"


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
    return sum(int(c) if c in "0123456789" else c == "-" for c in line[:68]) % 10
