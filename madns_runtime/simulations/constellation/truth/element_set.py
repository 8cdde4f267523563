"""One satellite's mean elements, and the range that each number of them must lie in."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, field
from datetime import datetime

FIRST_YEAR = 1957
"""Of the first satellite: no epoch lies before it, and two-digit years turn over there."""
LAST_YEAR = 2200
"""No epoch lies so far ahead: sidereal time and the Sun's place are series about J2000."""
NUMBERS = {
    "MEAN_MOTION": (1e-3, 20.0),
    "ECCENTRICITY": (0.0, 0.9999),
    "INCLINATION": (0.0, 180.0),
    "RA_OF_ASC_NODE": (-360.0, 360.0),
    "ARG_OF_PERICENTER": (-360.0, 360.0),
    "MEAN_ANOMALY": (-360.0, 360.0),
    "BSTAR": (-10.0, 10.0),
    "MEAN_MOTION_DOT": (-10.0, 10.0),
    "MEAN_MOTION_DDOT": (-10.0, 10.0),
}
"""OMM fields that SGP4 needs, with the range each must lie in; a TLE's columns of the same meaning, too. The last
three of real objects are a thousand times smaller at least: what is beyond is garbage."""
OTHER_THEORIES = {"4": "SGP4-XP or SGP8", "5": "SDP8", "6": "special perturbations"}
"""Ephemeris types of sets that are no mean elements of SGP4, which would give states of them all the same.
Source: CCSDS 502.0-B-3, EPHEMERIS_TYPE; Spacetrack Report No. 3. A TLE has the number in its column 63."""
_MU_KM3_S2, _EQUATOR_KM = 398_600.8, 6378.135
"""WGS-72, which element sets are fitted with."""
_NUMBER = re.compile(r"\s*[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]{1,3})?\s*", re.ASCII)


@dataclass(frozen=True, slots=True, kw_only=True)
class ElementSet:
    """One satellite's mean elements, as its file gave them; exactly one of lines and omm is filled."""

    name: str
    epoch_utc: datetime
    lines: tuple[str, str] | None = None
    """The two lines of a TLE."""
    omm: tuple[tuple[str, str], ...] = ()
    """Keys and values of an OMM."""
    place: str = field(default="", compare=False)
    """File and line that it stands in, for messages."""

    @property
    def catalogue_number(self) -> str:
        """The number that the object has in a catalogue; empty or 0 where its file gives none."""
        text = self.lines[0][2:7] if self.lines else dict(self.omm).get("NORAD_CAT_ID", "")
        return text.strip().lstrip("0")

    @property
    def inclination_deg(self) -> float:
        """Of the mean orbit, deg."""
        return float(self.lines[1][8:16] if self.lines else dict(self.omm)["INCLINATION"])

    @property
    def perigee_km(self) -> float:
        """Height of the mean orbit's perigee above the equator's radius."""
        if self.lines:
            revolutions_day, e = float(self.lines[1][52:63]), float(f".{self.lines[1][26:33]}")
        else:
            fields = dict(self.omm)
            revolutions_day, e = float(fields["MEAN_MOTION"]), float(fields["ECCENTRICITY"])
        rate_rad_s = revolutions_day * math.tau / 86_400.0
        return math.cbrt(_MU_KM3_S2 / rate_rad_s**2) * (1.0 - e) - _EQUATOR_KM


def _number(text: str | None) -> float | None:
    """Return a number as files of element sets write it; None for anything else, such as nan, 1_000 or 0x1p3."""
    if text is None or not _NUMBER.fullmatch(text):
        return None
    value = float(text)
    return value if math.isfinite(value) else None


def theory_fault(ephemeris_type: str) -> str | None:
    """Return why SGP4 must not propagate sets of an ephemeris type; None if it may."""
    theory = OTHER_THEORIES.get(ephemeris_type.strip())
    if theory is None:
        return None
    return f"EPHEMERIS_TYPE: expected 0, a set of SGP4, got {ephemeris_type.strip()}: {theory}; take sets of type 0"


def range_fault(key: str, text: str | None) -> str | None:
    """Return what is wrong with a number; None if it is one, within its range."""
    low, high = NUMBERS[key]
    value = _number(text)
    if value is not None and low <= value <= high:
        return None
    got = "nothing" if text is None else repr(text[:40])
    return f"{key}: expected a number within [{low:g}, {high:g}], got {got}"
