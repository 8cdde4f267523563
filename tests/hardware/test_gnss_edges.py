"""Messages of a GNSS receiver where numbers turn over: seconds, weeks, minutes, courses, the date line, the poles."""

import io
import itertools
import math
import random
from datetime import UTC, datetime, timedelta

import pytest
from pyubx2 import NMEA_PROTOCOL, UBX_PROTOCOL, UBXReader

from madns_runtime.hardware.gnss_messages import GnssMessage, ToldQuality, encode
from madns_runtime.hardware.gnss_solution import GnssSolution, geodetic

QUALITY = ToldQuality(
    position_m=2.5, velocity_m_s=0.05, time_ns=30, satellites=12, dilution=1.2, geoid_m=0.0
)
LEO = (-6_123_456.78914, 1_234_567.89126, -3_210_987.65432)
SPEED = (1234.5678, 5678.9123, -4321.0987)
RADIUS_M, E2 = 6_378_137.0, 6.694_379_990_141_316e-3
GPS_EPOCH = datetime(1980, 1, 6, tzinfo=UTC)


def told(name, solution, quality=QUALITY):
    """Return a message as pyubx2 or pynmeagps reads it, checksum and all."""
    data = io.BytesIO(encode(name, solution, quality))
    [(raw, message)] = UBXReader(data, protfilter=NMEA_PROTOCOL | UBX_PROTOCOL, quitonerror=2)
    return message, raw.decode("ascii", "replace").split(",")


def at(text, leap_s=18, position=LEO, velocity=SPEED):
    when = datetime.fromisoformat(text).timestamp()
    return GnssSolution.of((when, *position, *velocity), leap_s)


def over(latitude_deg, longitude_deg, *, height_m=0.0, north=0.0, east=0.0):
    """Return the solution of a place and a velocity over ground."""
    latitude, longitude = math.radians(latitude_deg), math.radians(longitude_deg)
    sine, cosine = math.sin(latitude), math.cos(latitude)
    normal_m = RADIUS_M / math.sqrt(1.0 - E2 * sine * sine)
    flat_m = (normal_m + height_m) * cosine
    x, y = flat_m * math.cos(longitude), flat_m * math.sin(longitude)
    z = (normal_m * (1.0 - E2) + height_m) * sine
    vx = -sine * math.cos(longitude) * north - math.sin(longitude) * east
    vy = -sine * math.sin(longitude) * north + math.cos(longitude) * east
    return GnssSolution.of((1_773_835_200.0, x, y, z, vx, vy, cosine * north), 18)


# Time ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("utc", "leap_s", "week", "time_of_week_ms"),
    [
        ("2026-03-14T23:59:41.999Z", 18, 2409, 604_799_999),
        ("2026-03-14T23:59:42.000Z", 18, 2410, 0),
        ("2026-03-14T23:59:59.999Z", 18, 2410, 17_999),
        ("2026-03-15T00:00:00.000Z", 18, 2410, 18_000),
        ("1980-01-06T00:00:00.000Z", 0, 0, 0),
        ("1999-08-21T23:59:46.999Z", 13, 1023, 604_799_999),  # the first roll-over of ten bits
        ("1999-08-21T23:59:47.000Z", 13, 1024, 0),
        ("2019-04-06T23:59:42.000Z", 18, 2048, 0),  # and the second
        ("2038-11-20T23:59:42.000Z", 18, 3072, 0),
        ("2016-12-31T23:59:59.999Z", 17, 1930, 16_999),  # before and after a leap second
        ("2017-01-01T00:00:00.000Z", 18, 1930, 18_000),
        ("2099-12-31T23:59:59.999Z", 18, 6260, 432_017_999),
    ],
)
def test_weeks_turn_over_in_gps_time_and_days_in_utc(utc, leap_s, week, time_of_week_ms):
    solution = at(utc, leap_s)
    timegps, _ = told("NAV-TIMEGPS", solution)

    assert (timegps.week, timegps.iTOW, timegps.leapS) == (week, time_of_week_ms, leap_s)
    gps = GPS_EPOCH + timedelta(weeks=week, milliseconds=time_of_week_ms)
    assert gps - timedelta(seconds=leap_s) == datetime.fromisoformat(utc)
    for name in GnssMessage.__args__:
        message, fields = told(name, solution)
        if hasattr(message, "iTOW"):
            assert message.iTOW == time_of_week_ms, name
        else:
            assert fields[1] == f"{utc[11:13]}{utc[14:16]}{utc[17:23]}", name
    pvt, _ = told("NAV-PVT", solution)
    timeutc, _ = told("NAV-TIMEUTC", solution)
    for one, second in ((pvt, pvt.second), (timeutc, timeutc.sec)):
        when = datetime(one.year, one.month, one.day, one.hour, one.min, second, tzinfo=UTC)
        assert when + timedelta(microseconds=one.nano / 1000) == datetime.fromisoformat(utc)
    assert told("RMC", solution)[1][9] == utc[8:10] + utc[5:7] + utc[2:4]


@pytest.mark.parametrize("turn", ["minute", "hour", "day", "month", "year", "leap day"])
def test_no_second_is_sixty_however_near_to_its_end(turn):
    ends = {
        "minute": "2026-03-20T12:35:00Z",
        "hour": "2026-03-20T13:00:00Z",
        "day": "2026-03-21T00:00:00Z",
        "month": "2026-04-01T00:00:00Z",
        "year": "2027-01-01T00:00:00Z",
        "leap day": "2028-02-29T00:00:00Z",
    }
    end = datetime.fromisoformat(ends[turn])
    for before_s in (0.0, 1e-7, 4e-4, 6e-4, 0.4, 0.9996, 1.0):
        values = (end.timestamp() - before_s, *LEO, *SPEED)
        solution = GnssSolution.of(values, 18)
        whole_ms = round(before_s * 1e3)
        expected = end - timedelta(milliseconds=whole_ms)
        _, fields = told("RMC", solution)
        assert fields[1] == f"{expected:%H%M%S}.{expected.microsecond // 1000:03d}"
        assert fields[9] == f"{expected:%d%m%y}"
        pvt, _ = told("NAV-PVT", solution)
        assert (pvt.day, pvt.hour, pvt.min, pvt.second) == (
            expected.day, expected.hour, expected.minute, expected.second,
        )  # fmt: skip
        assert 0 <= pvt.nano < 1_000_000_000


# Courses ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("north", "east", "course"),
    [
        (7500.0, 0.0, "0.000"),
        (7500.0, -0.0, "0.000"),
        (7500.0, -1e-4, "0.000"),  # 359.9999992
        (7500.0, -0.06, "0.000"),  # 359.99954
        (7500.0, -0.07, "359.999"),
        (7500.0, 0.07, "0.001"),
        (0.0, 7500.0, "90.000"),
        (-7500.0, 0.0, "180.000"),
        (0.0, -7500.0, "270.000"),
        (0.0, 0.0, "0.000"),
    ],
)
def test_a_course_lies_below_360_degrees(north, east, course):
    solution = over(0.0, 0.0, height_m=500e3, north=north, east=east)

    assert told("RMC", solution)[1][8] == course
    assert told("NAV-PVT", solution)[0].headMot < 360.0


def test_no_course_of_many_is_360_degrees():
    chance = random.Random(11)
    for _ in range(3000):
        east = -(10.0 ** chance.uniform(-18, 1))
        solution = over(chance.uniform(-80, 80), chance.uniform(-180, 180), north=7500, east=east)
        assert 0.0 <= float(told("RMC", solution)[1][8]) < 360.0
        assert 0.0 <= told("NAV-PVT", solution)[0].headMot < 360.0


# Places -----------------------------------------------------------------------------------------------

LATITUDES = (
    -90.0,
    -89.999_999_999,
    -45.0,
    -1e-12,
    0.0,
    1e-12,
    59.999_999_999_9,
    89.999_999_999,
    90.0,
)
LONGITUDES = (
    -180.0,
    -179.999_999_999_9,
    -90.0,
    -1e-12,
    0.0,
    9.999_999_999_99,
    179.999_999_999_9,
    180.0,
)


@pytest.mark.parametrize("height_m", [-420.0, -0.0004, 0.0, 0.0004, 500e3])
def test_places_at_all_edges_are_read_back(height_m):
    for latitude, longitude in itertools.product(LATITUDES, LONGITUDES):
        solution = over(latitude, longitude, height_m=height_m)
        pvt, _ = told("NAV-PVT", solution)
        assert -90.0 <= pvt.lat <= 90.0 and -180.0 <= pvt.lon <= 180.0
        assert pvt.lat == pytest.approx(latitude, abs=1e-7)
        for name in ("GGA", "RMC"):
            message, fields = told(name, solution)
            first = 2 if name == "GGA" else 3
            north, north_side, east, east_side = fields[first : first + 4]
            assert len(north) == 12 and len(east) == 13, fields
            assert float(north[2:]) < 60.0 and float(east[3:]) < 60.0, fields
            assert int(north[:2]) <= 90 and int(east[:3]) <= 180
            assert (north_side, east_side) in itertools.product("NS", "EW")
            if not float(north):
                assert north_side == "N"
            if not float(east):
                assert east_side == "E"
            assert message.lat == pytest.approx(latitude, abs=2e-9)
            if abs(latitude) < 89.0:
                assert math.remainder(message.lon - longitude, 360.0) == pytest.approx(0, abs=2e-9)
                assert math.remainder(pvt.lon - longitude, 360.0) == pytest.approx(0, abs=1e-7)


@pytest.mark.parametrize(
    ("height_m", "geoid_m", "altitude", "separation"),
    [
        (0.0, 0.0, "0.000", "0.000"),
        (-0.0004, -0.0, "0.000", "0.000"),
        (-0.0006, 0.0, "-0.001", "0.000"),
        (10.0, 10.0002, "0.000", "10.000"),
        (-420.0, -17.25, "-402.750", "-17.250"),
        (999_999.999_6, 0.0, "1000000.000", "0.000"),
    ],
)
def test_a_height_of_nothing_has_no_sign(height_m, geoid_m, altitude, separation):
    quality = ToldQuality(
        position_m=2.5, velocity_m_s=0.05, time_ns=30, satellites=12, dilution=1.2, geoid_m=geoid_m
    )
    _, fields = told("GGA", over(0.0, 0.0, height_m=height_m), quality)

    assert (fields[9], fields[11]) == (altitude, separation)


@pytest.mark.parametrize("z", [6_356_752.314, -6_356_752.314, 7e6, -7e6, 0.0])
def test_on_the_axis_and_at_the_centre_every_message_is_whole(z):
    solution = at("2026-03-20T12:00:00Z", position=(0.0, -0.0, z), velocity=(7500.0, 0.0, 0.0))

    for name in GnssMessage.__args__:
        told(name, solution)
    latitude, longitude, height_m = geodetic((0.0, -0.0, z))
    assert math.degrees(latitude) == pytest.approx(math.copysign(90.0, z) if z else 0.0)
    assert math.isfinite(longitude) and math.isfinite(height_m)


def test_a_way_over_the_pole_and_the_date_line_is_read_back_point_by_point():
    for number in range(-50, 51):
        share = number / 50 * 1e-6
        solution = over(90.0 - abs(share), 10.0 if share < 0 else -170.0, height_m=500e3)
        assert told("NAV-PVT", solution)[0].lat == pytest.approx(90.0 - abs(share), abs=1e-7)
        solution = over(12.0, math.remainder(180.0 + share, 360.0), height_m=500e3)
        lon = told("RMC", solution)[0].lon
        assert math.remainder(lon - 180.0 - share, 360.0) == pytest.approx(0.0, abs=2e-9)


def test_a_position_of_tenths_of_millimetres_is_split_without_a_remainder_too_large():
    chance = random.Random(3)
    edges = [0.00995, -0.00995, 0.009949, 1e-5, -1e-5, 0.01, -0.01, 0.0]
    for _ in range(500):
        position = tuple(chance.uniform(-7e6, 7e6) // 1 + chance.choice(edges) for _ in range(3))
        solution = at("2026-03-20T12:00:00Z", position=position)
        message, _ = told("NAV-HPPOSECEF", solution)
        for axis, expected in zip("XYZ", position, strict=True):
            assert getattr(message, f"ecef{axis}") * 1e-2 == pytest.approx(expected, abs=5.1e-5)
