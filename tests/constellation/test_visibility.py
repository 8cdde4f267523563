"""Line of sight, light time, sidereal time and places on the ellipsoid."""

import math
from dataclasses import replace
from datetime import UTC, datetime

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from sgp4.propagation import gstime

from madns_runtime.simulations.constellation.orbit.constants import (
    EARTH_POLAR_RADIUS_M,
    EARTH_RADIUS_M,
    EGM_96,
)
from madns_runtime.simulations.constellation.orbit.earth import (
    days_since_j2000,
    fixed_to_teme,
    geodetic_to_fixed,
    gmst_rad,
    gmst_rate_rad_s,
)
from madns_runtime.simulations.constellation.orbit.elements import (
    Elements,
    elements_from_state,
    state_from_elements,
)
from madns_runtime.simulations.constellation.orbit.visibility import (
    LIGHT_SPEED_M_S,
    coast,
    has_line_of_sight,
    have_line_of_sight,
    signal_way,
    signal_ways,
    sines_of_elevation,
)

HEIGHT_M = 100e3
RADIUS_M = EARTH_RADIUS_M + 780e3
COORDINATES = st.floats(-2e7, 2e7)
POSITIONS = st.tuples(COORDINATES, COORDINATES, COORDINATES)


def on_equator(angle_deg, radius_m=RADIUS_M):
    angle = math.radians(angle_deg)
    return (radius_m * math.cos(angle), radius_m * math.sin(angle), 0.0)


@pytest.mark.parametrize(
    ("apart_deg", "is_clear"),
    # By hand: 2 acos((6378.137 + 100) / (6378.137 + 780)) = 50.357 deg.
    [(0.0, True), (30.0, True), (50.35, True), (50.36, False), (90.0, False), (180.0, False)],
)
def test_line_of_sight_ends_where_it_grazes_the_atmosphere(apart_deg, is_clear):
    assert has_line_of_sight(on_equator(0.0), on_equator(apart_deg), HEIGHT_M) is is_clear


def test_line_of_sight_reaches_further_without_atmosphere():
    # 2 acos(6378.137 / 7158.137) = 53.995 deg.
    assert has_line_of_sight(on_equator(0.0), on_equator(53.99), 0.0)
    assert not has_line_of_sight(on_equator(0.0), on_equator(54.0), 0.0)


@pytest.mark.parametrize(("above_m", "is_clear"), [(1.0, True), (-1.0, False)])
def test_earth_is_flat_at_its_poles(above_m, is_clear):
    z = EARTH_POLAR_RADIUS_M + HEIGHT_M + above_m

    assert has_line_of_sight((-3e6, 0.0, z), (3e6, 0.0, z), HEIGHT_M) is is_clear


def test_who_is_inside_the_atmosphere_sees_nobody():
    inside = on_equator(0.0, EARTH_RADIUS_M + 99e3)

    assert not has_line_of_sight(inside, on_equator(1.0), HEIGHT_M)
    assert not has_line_of_sight(on_equator(1.0), inside, HEIGHT_M)


@given(first=POSITIONS, second=POSITIONS)
def test_line_of_sight_is_the_same_both_ways_and_for_many(first, second):
    one_way = has_line_of_sight(first, second, HEIGHT_M)
    many = have_line_of_sight(np.array(first), np.array([second, second]), HEIGHT_M)

    nearest_m = abs(nearest_scaled(first, second) - 1.0) * EARTH_RADIUS_M
    if nearest_m > 1e-3:  # closer than that, rounding may decide
        assert has_line_of_sight(second, first, HEIGHT_M) == one_way
        assert many.tolist() == [one_way, one_way]


def nearest_scaled(first, second):
    """Return the least distance from the centre, of 1001 points and the ends, by trial."""
    equator, pole = EARTH_RADIUS_M + HEIGHT_M, EARTH_POLAR_RADIUS_M + HEIGHT_M
    scale = np.array((equator, equator, pole))
    start, end = np.array(first) / scale, np.array(second) / scale
    way = end - start
    square = float(way @ way)
    share = min(1.0, max(0.0, -float(start @ way) / square)) if square > 0 else 0.0
    return float(np.linalg.norm(start + share * way))


def test_signal_meets_its_receiver_where_that_has_moved_to():
    receiver = (3e6, 0.0, 0.0, 7500.0, 0.0, 0.0)

    distance_m, meets_m = signal_way((0.0, 0.0, 0.0), receiver)

    # Exactly: d = 3e6 + v d / c.
    exact_m = 3e6 / (1.0 - 7500.0 / LIGHT_SPEED_M_S)
    assert distance_m == pytest.approx(exact_m, abs=2.1e-3)
    assert distance_m > 3e6 + 75.0
    assert meets_m == pytest.approx((distance_m, 0.0, 0.0), abs=1e-6)


@given(sender=POSITIONS, receiver=POSITIONS, v=st.tuples(*[st.floats(-8e3, 8e3)] * 3))
def test_signal_ways_of_many_are_those_of_one(sender, receiver, v):
    distance_m, meets_m = signal_way(sender, (*receiver, *v))
    distances_m, meet_m = signal_ways(np.array(sender), np.array([(*receiver, *v)]))

    assert distances_m[0] == pytest.approx(distance_m, rel=1e-14, abs=1e-9)
    assert meet_m[0] == pytest.approx(meets_m, rel=1e-14, abs=1e-8)


@pytest.mark.parametrize(
    ("dt_s", "tolerance_m"), [(0.1, 1e-8), (10.0, 5e-3), (11.0, 1e-6), (86_400.0, 1e-6)]
)
def test_coasting_follows_the_ellipse(dt_s, tolerance_m):
    orbit = Elements(a_m=7.0e6, e=0.01, i_rad=1.0, raan_rad=0.2, argp_rad=0.3, mean_anomaly_rad=0.4)
    rate = math.sqrt(EGM_96.mu_m3_s2 / orbit.a_m**3)
    start = np.array(sum(state_from_elements(orbit, EGM_96.mu_m3_s2), ()))
    later = replace(orbit, mean_anomaly_rad=0.4 + rate * dt_s)
    expected = np.array(sum(state_from_elements(later, EGM_96.mu_m3_s2), ()))

    got = coast(start, dt_s)

    assert np.linalg.norm(got[:3] - expected[:3]) < tolerance_m
    assert np.linalg.norm(got[3:] - expected[3:]) < 0.5 * tolerance_m


def test_sidereal_time_is_vallados():
    # Vallado, Fundamentals, 4th ed., example 3-15: UT1 = UTC - 0.4399619 s, GMST 312.8098943 deg.
    days = days_since_j2000(datetime(2004, 4, 6, 7, 51, 28, 386009, tzinfo=UTC), -0.4399619)

    assert math.degrees(gmst_rad(days)) == pytest.approx(312.8098943, abs=1e-7)


@given(days=st.floats(-18_000.0, 36_000.0))
def test_sidereal_time_is_that_of_the_sgp4_library(days):
    # The library's day number resolves 40 us, 3e-9 rad.
    difference = gmst_rad(days) - gstime(2_451_545.0 + days)

    assert abs(math.remainder(difference, math.tau)) < 1e-8


def test_sidereal_rate_is_that_of_sidereal_time():
    advance = math.remainder(gmst_rad(9000.5 + 0.01) - gmst_rad(9000.5), math.tau)

    assert gmst_rate_rad_s(9000.5) == pytest.approx(advance / 864.0, rel=1e-9)
    assert gmst_rate_rad_s(9000.5) == pytest.approx(7.292115855e-5, rel=1e-9)


@given(
    latitude=st.floats(-math.pi / 2, math.pi / 2),
    longitude=st.floats(-math.pi, math.tau),
    altitude_m=st.floats(-500.0, 9000.0),
)
def test_places_stand_on_the_ellipsoid_and_look_along_its_normal(latitude, longitude, altitude_m):
    arrays = np.array([latitude]), np.array([longitude])
    ground, up = geodetic_to_fixed(*arrays, np.zeros(1))
    raised, _ = geodetic_to_fixed(*arrays, np.array([altitude_m]))

    radii = np.array((EARTH_RADIUS_M, EARTH_RADIUS_M, EARTH_POLAR_RADIUS_M))
    normal = ground[0] / radii**2
    assert np.sum((ground[0] / radii) ** 2) == pytest.approx(1.0, abs=1e-14)
    assert up[0] == pytest.approx(normal / np.linalg.norm(normal), abs=1e-14)
    assert raised[0] == pytest.approx(ground[0] + altitude_m * up[0], abs=1e-7)


def test_geodetic_latitude_is_vallados():
    # Example 3-3: 34.352496 deg, 46.4464 deg, 5085.22 km; its angles are rounded to 10 m.
    place, _ = geodetic_to_fixed(
        np.radians([34.352496]), np.radians([46.4464]), np.array([5_085_220.0])
    )

    assert place[0] == pytest.approx((6_524_834.0, 6_862_875.0, 6_448_296.0), abs=15.0)


def test_elevation_and_its_rate_are_those_of_a_turning_earth():
    turn = 7.292115e-5
    fixed, up = geodetic_to_fixed(np.array([0.6]), np.array([0.4]), np.array([300.0]))
    state = np.array([[5.5e6, 3.1e6, 4.0e6, -3000.0, 6500.0, 2000.0]])

    def sine(t_s):
        moved = state + np.array([[*state[0, 3:] * t_s, 0, 0, 0]])
        place, zenith = fixed_to_teme(np.stack((fixed, up)), turn * t_s)
        return sines_of_elevation(place, zenith, moved, turn)

    by_hand = (state[0, :3] - fixed[0]) @ up[0] / np.linalg.norm(state[0, :3] - fixed[0])
    slope = (sine(0.5)[0] - sine(-0.5)[0])[0, 0]
    assert sine(0.0)[0][0, 0] == pytest.approx(by_hand, abs=1e-14)
    assert sine(0.0)[1][0, 0] == pytest.approx(slope, rel=1e-5)


def test_who_falls_in_a_line_but_for_the_last_digits_is_carried_on_by_the_series():
    # Sideways some micrometres per second: its ellipse is a line to double precision.
    falling = np.array([[4e8, 0.0, 0.0, -1000.0, 1e-6, 0.0]])

    later = coast(falling, 20.0)

    assert later[0, :3] == pytest.approx((4e8 - 20_000.0 - 0.5, 2e-5, 0.0), abs=1e-2)
    with pytest.raises(ValueError, match="expected a bound orbit"):
        elements_from_state((4e8, 0.0, 0.0), (-1000.0, 1e-6, 0.0), EGM_96.mu_m3_s2)
