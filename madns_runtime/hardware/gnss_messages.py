"""
Messages of a GNSS receiver: u-blox's UBX and NMEA 0183. Pure: a solution in, bytes out.

Source: u-blox F9 HPS 1.30 interface description (UBX-22010984), and NMEA 0183 version 4.11. Fields that cannot hold
a value, as those of a position beyond 21,474 km, are held to their ends and said to be invalid.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from struct import Struct
from typing import Final, Literal

from madns_runtime.hardware.gnss_solution import GnssSolution

GnssMessage = Literal[
    "NAV-PVT",
    "NAV-HPPOSECEF",
    "NAV-POSECEF",
    "NAV-VELECEF",
    "NAV-TIMEUTC",
    "NAV-TIMEGPS",
    "GGA",
    "RMC",
]
NAV: Final = 0x01
"""Class of UBX messages with solutions."""
I4_MAX: Final = 2**31 - 1
KNOT_M_S: Final = 1852.0 / 3600.0
FIX_3D, FIX_OK, VALID_TIME = 3, 1, 7

_HEAD: Final = Struct("<BBH")
_PVT: Final = Struct("<IH5BBIi4B4i2I3iiiIIHH4xihH")
_HPPOSECEF: Final = Struct("<4xI3i3bBI")
_ECEF: Final = Struct("<I3iI")
_TIMEUTC: Final = Struct("<IIiH5BB")
_TIMEGPS: Final = Struct("<IihbBI")


@dataclass(frozen=True, slots=True, kw_only=True)
class ToldQuality:
    """Quality of a fix as a receiver states it, which truth does not tell."""

    position_m: float
    """Accuracy of position, one standard deviation, m."""
    velocity_m_s: float
    time_ns: int
    satellites: int
    """Satellites in use."""
    dilution: float
    """Dilution of precision (PDOP, HDOP)."""
    geoid_m: float
    """Height of the geoid above the ellipsoid, m."""


def encode(name: GnssMessage, solution: GnssSolution, quality: ToldQuality) -> bytes:
    """Return one message."""
    return _ENCODERS[name](solution, quality)


def ubx(number: int, payload: bytes) -> bytes:
    """Return a UBX message of class NAV: sync, class, number, length, payload, checksum."""
    body = _HEAD.pack(NAV, number, len(payload)) + payload
    first = second = 0
    for byte in body:
        first = first + byte & 0xFF
        second = second + first & 0xFF
    return b"\xb5\x62" + body + bytes((first, second))


def nmea(fields: str) -> bytes:
    """Return a sentence: its fields between $ and their checksum."""
    checksum = 0
    for byte in fields.encode("ascii"):
        checksum ^= byte
    return f"${fields}*{checksum:02X}\r\n".encode("ascii")


def _pvt(solution: GnssSolution, quality: ToldQuality) -> bytes:
    latitude, longitude, height_m = solution.geodetic()
    north, east, down = solution.velocity_ned_m_s(latitude, longitude)
    heights = [_whole(1e3 * h) for h in (height_m, height_m - quality.geoid_m)]
    is_invalid = any(abs(height) == I4_MAX for height in heights)
    accuracy_mm = round(1e3 * quality.position_m)
    utc = solution.utc
    return ubx(
        0x07,
        _PVT.pack(
            solution.time_of_week_ms,
            utc.year,
            *(utc.month, utc.day, utc.hour, utc.minute, utc.second),
            VALID_TIME,
            quality.time_ns,
            solution.millisecond * 1_000_000,
            *(FIX_3D, FIX_OK, 0, quality.satellites),
            round(math.degrees(longitude) * 1e7),
            round(math.degrees(latitude) * 1e7),
            *heights,
            *(accuracy_mm, accuracy_mm),
            *(_whole(1e3 * speed) for speed in (north, east, down)),
            _whole(1e3 * math.hypot(north, east)),
            _course(north, east, 10**5),
            round(1e3 * quality.velocity_m_s),
            0,  # accuracy of the course
            round(100.0 * quality.dilution),
            int(is_invalid),
            *(0, 0, 0),  # heading of the vehicle, magnetic declination and its accuracy
        ),
    )


def _hpposecef(solution: GnssSolution, quality: ToldQuality) -> bytes:
    numbers = [round(1e4 * component) for component in solution.position_m]
    centimetres = [_toward_zero(number, 100) for number in numbers]
    is_invalid = any(abs(number) > I4_MAX for number in centimetres)
    rest = [n - 100 * cm for n, cm in zip(numbers, centimetres, strict=True)]
    return ubx(
        0x13,
        _HPPOSECEF.pack(
            solution.time_of_week_ms,
            *map(_whole, centimetres),
            *rest,
            int(is_invalid),
            round(1e4 * quality.position_m),
        ),
    )


def _posecef(solution: GnssSolution, quality: ToldQuality) -> bytes:
    numbers = [_whole(100.0 * component) for component in solution.position_m]
    return ubx(
        0x01, _ECEF.pack(solution.time_of_week_ms, *numbers, round(100 * quality.position_m))
    )


def _velecef(solution: GnssSolution, quality: ToldQuality) -> bytes:
    numbers = [_whole(100.0 * component) for component in solution.velocity_m_s]
    accuracy = round(100 * quality.velocity_m_s)
    return ubx(0x11, _ECEF.pack(solution.time_of_week_ms, *numbers, accuracy))


def _timeutc(solution: GnssSolution, quality: ToldQuality) -> bytes:
    utc = solution.utc
    return ubx(
        0x21,
        _TIMEUTC.pack(
            solution.time_of_week_ms,
            quality.time_ns,
            solution.millisecond * 1_000_000,
            utc.year,
            *(utc.month, utc.day, utc.hour, utc.minute, utc.second),
            VALID_TIME,
        ),
    )


def _timegps(solution: GnssSolution, quality: ToldQuality) -> bytes:
    week, tow_ms = solution.week, solution.time_of_week_ms
    values = (tow_ms, 0, week, solution.leap_s, VALID_TIME, quality.time_ns)
    return ubx(0x20, _TIMEGPS.pack(*values))


def _gga(solution: GnssSolution, quality: ToldQuality) -> bytes:
    latitude, longitude, height_m = solution.geodetic()
    return nmea(
        f"GNGGA,{_time_of_day(solution)},{_place(latitude, longitude)},1,{quality.satellites:02d},"
        f"{quality.dilution:.2f},{_metres(height_m - quality.geoid_m)},M,{_metres(quality.geoid_m)},M,,"
    )


def _rmc(solution: GnssSolution, quality: ToldQuality) -> bytes:
    latitude, longitude, _ = solution.geodetic()
    north, east, _ = solution.velocity_ned_m_s(latitude, longitude)
    speed_kn = math.hypot(north, east) / KNOT_M_S
    return nmea(
        f"GNRMC,{_time_of_day(solution)},A,{_place(latitude, longitude)},{speed_kn:.3f},"
        f"{_course(north, east, 1000) / 1000:.3f},{solution.utc:%d%m%y},,,A,V"
    )


_ENCODERS: Final[Mapping[GnssMessage, Callable[[GnssSolution, ToldQuality], bytes]]] = {
    "NAV-PVT": _pvt,
    "NAV-HPPOSECEF": _hpposecef,
    "NAV-POSECEF": _posecef,
    "NAV-VELECEF": _velecef,
    "NAV-TIMEUTC": _timeutc,
    "NAV-TIMEGPS": _timegps,
    "GGA": _gga,
    "RMC": _rmc,
}


def _time_of_day(solution: GnssSolution) -> str:
    return f"{solution.utc:%H%M%S}.{solution.millisecond:03d}"


def _place(latitude_rad: float, longitude_rad: float) -> str:
    latitude, longitude = math.degrees(latitude_rad), math.degrees(longitude_rad)
    return f"{_minutes(latitude, 2, 'NS')},{_minutes(longitude, 3, 'EW')}"


def _minutes(angle_deg: float, digits: int, sides: str) -> str:
    """Return an angle as degrees and minutes, of 2e-4 m on the ground, and its side."""
    whole = round(angle_deg * 60.0 * 10**7)
    degrees, rest = divmod(abs(whole), 60 * 10**7)
    minutes, fraction = divmod(rest, 10**7)
    return f"{degrees:0{digits}d}{minutes:02d}.{fraction:07d},{sides[whole < 0]}"


def _course(north: float, east: float, parts: int) -> int:
    """Return the course over ground in parts of a degree, from 0 to below 360 degrees: what rounds up to 360 is 0."""
    return round(math.degrees(math.atan2(east, north)) * parts) % (360 * parts)


def _metres(height_m: float) -> str:
    """Return a height to the millimetre, without the sign of what rounds to none."""
    return f"{round(height_m, 3) + 0.0:.3f}"


def _toward_zero(number: int, divisor: int) -> int:
    return int(math.copysign(abs(number) // divisor, number))


def _whole(value: float) -> int:
    """Return the nearest whole number that a field of four bytes holds."""
    return max(-I4_MAX, min(I4_MAX, round(value)))
