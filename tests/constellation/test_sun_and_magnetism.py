"""Sun and magnetic field against what others have published and computed."""

import math
from datetime import UTC, datetime

import numpy as np
import pytest

from madns_runtime.errors import PluginError
from madns_runtime.simulations.constellation.geomagnetic_field import (
    igrf_coefficients,
    read_coefficients,
)
from madns_runtime.simulations.constellation.orbit.earth import days_since_j2000
from madns_runtime.simulations.constellation.orbit.magnetic import (
    REFERENCE_RADIUS_M,
    Harmonics,
    decimal_year,
    dipole_at,
    dipole_field_t,
)
from madns_runtime.simulations.constellation.orbit.sun import (
    ASTRONOMICAL_UNIT_M,
    is_in_umbra,
    sun_m,
)


def days(*date):
    return days_since_j2000(datetime(*date, tzinfo=UTC))


def test_the_sun_stands_where_vallado_computes_it():
    # Fundamentals of Astrodynamics and Applications, 4th ed., example 5-1.
    expected_m = np.array([146_186_212.0, 28_788_976.0, 12_481_064.0]) * 1e3

    error_m = np.array(sun_m(days(2006, 4, 2))) - expected_m

    assert np.linalg.norm(error_m) / ASTRONOMICAL_UNIT_M < math.radians(0.01)


@pytest.mark.parametrize(
    ("date", "longitude_deg"),
    [
        # The Astronomical Almanac: equinoxes and solstices, UTC.
        ((2025, 3, 20, 9, 1), 0.0),
        ((2025, 6, 21, 2, 42), 90.0),
        ((2025, 9, 22, 18, 19), 180.0),
        ((2025, 12, 21, 15, 3), 270.0),
    ],
)
def test_seasons_begin_on_their_minute(date, longitude_deg):
    x, y, z = sun_m(days(*date))

    longitude = math.degrees(math.atan2(math.hypot(y, z) * math.copysign(1.0, z), x))
    assert abs(math.remainder(longitude - longitude_deg, 360.0)) < 0.011


def test_the_umbra_is_a_cone_behind_the_earth():
    sun = (ASTRONOMICAL_UNIT_M, 0.0, 0.0)

    assert not is_in_umbra((7.0e6, 0.0, 0.0), sun)
    assert not is_in_umbra((0.0, 7.0e6, 0.0), sun)
    assert is_in_umbra((-7.0e6, 0.0, 0.0), sun)
    # Its tip lies 1.38 million km away; a quarter of a degree narrows it all the way.
    assert is_in_umbra((-1.37e9, 0.0, 0.0), sun)
    assert not is_in_umbra((-1.40e9, 0.0, 0.0), sun)
    edge_m = 6_378_137.0 - 3.0e6 * math.tan(math.asin((695.7e6 - 6.378e6) / ASTRONOMICAL_UNIT_M))
    assert is_in_umbra((-3.0e6, edge_m - 100.0, 0.0), sun)
    assert not is_in_umbra((-3.0e6, edge_m + 100.0, 0.0), sun)


def test_the_dipole_is_that_of_its_year():
    early, late = dipole_at(1995.0), dipole_at(2025.0)

    assert dipole_at(2010.0)[1, 0] == pytest.approx((early[1, 0] * 0 - 29496.57e-9), abs=1e-15)
    assert dipole_at(2027.5)[1, 1] == pytest.approx(-1385.3e-9)
    assert dipole_at(2100.0) == dipole_at(2030.0)
    # North pole of the dipole, 2025: 80.9 N, 72.8 W (Kyoto WDC, from the same coefficients).
    g10, g11, h11 = late[1, 0], late[1, 1], late[1, -1]
    assert math.degrees(math.atan2(-g10, math.hypot(g11, h11))) == pytest.approx(80.85, abs=0.1)
    assert math.degrees(math.atan2(-h11, -g11)) == pytest.approx(-72.8, abs=0.1)
    assert decimal_year(days(2026, 7, 2, 12)) == pytest.approx(2026.5, abs=0.003)


def test_harmonics_of_degree_one_are_the_dipole():
    dipole, harmonics = dipole_at(2026.0), Harmonics(dipole_at(2026.0))
    for place in ((7e6, 1e5, -3e6), (-1e6, 2e6, 9e6), (0.0, 0.0, 7e6), (1.0, -6.5e6, 0.0)):
        assert harmonics.field_t(place) == pytest.approx(dipole_field_t(dipole, place), rel=1e-9)


def test_near_the_pole_the_field_is_that_of_the_pole():
    harmonics = Harmonics(dipole_at(2026.0))

    for place in ((0.0, 0.0, 7e6), (1e-4, 0.0, 7e6), (0.0, -1e-5, 7e6), (0.0, 2e-3, 7e6)):
        assert harmonics.field_t(place) == pytest.approx(
            dipole_field_t(dipole_at(2026.0), place), rel=1e-6
        )


def test_the_igrf_agrees_with_its_authors_own_program():
    ppigrf = pytest.importorskip("ppigrf", reason="the extra igrf is not installed")
    harmonics = Harmonics(igrf_coefficients(2025.0))
    for r_km, colatitude_deg, longitude_deg in ((7000, 30, 40), (6800, 90, 200), (7158, 150, -70)):
        up, south, east = (
            float(np.ravel(b)[0]) * 1e-9
            for b in ppigrf.igrf_gc(
                r_km, colatitude_deg, longitude_deg, datetime.fromisoformat("2025-01-01")
            )
        )
        t, p = math.radians(colatitude_deg), math.radians(longitude_deg)
        axes = np.array(
            [
                (math.sin(t) * math.cos(p), math.sin(t) * math.sin(p), math.cos(t)),
                (math.cos(t) * math.cos(p), math.cos(t) * math.sin(p), -math.sin(t)),
                (-math.sin(p), math.cos(p), 0.0),
            ]
        )

        found = axes @ harmonics.field_t(tuple(r_km * 1e3 * axes[0]))

        assert found == pytest.approx([up, south, east], abs=1e-15)


def test_coefficients_are_linear_between_their_epochs(tmp_path):
    path = tmp_path / "X.shc"
    path.write_text(
        "# head\n1 1 3 2 1 2000.0 2010.0\n2000.0 2005.0 2010.0\n1 0 1 3 7\n1 1 0 0 4\n1 -1 2 2 2\n"
    )

    assert read_coefficients(path, 2007.5)[1, 0] == pytest.approx(5e-9)
    assert read_coefficients(path, 1999.0)[1, 0] == pytest.approx(1e-9)
    assert read_coefficients(path, 2050.0)[1, 1] == pytest.approx(4e-9)


def test_what_is_no_table_of_coefficients_is_refused(tmp_path):
    path = tmp_path / "X.shc"
    path.write_text("nothing")

    with pytest.raises(PluginError, match="spherical harmonics"):
        read_coefficients(path, 2020.0)


def test_a_field_weakens_with_the_cube_of_distance():
    dipole = dipole_at(2025.0)
    near, far = (np.array(dipole_field_t(dipole, (k * REFERENCE_RADIUS_M, 0, 0))) for k in (1, 2))

    assert near == pytest.approx(8.0 * far)
