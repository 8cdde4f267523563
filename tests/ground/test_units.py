"""Factors between units: as exact as binary numbers are."""

import math

import pytest

from madns_runtime import units
from madns_runtime.units import conversion, converted, parse_unit


@pytest.mark.parametrize(
    ("value", "unit", "wanted", "expected"),
    [
        (5, "ms", "us", 5000.0),
        (1, "km", "m", 1000.0),
        (3.6, "km/h", "m/s", 1.0),
        (50, "%", "1", 0.5),
        (1, "min", "s", 60.0),
        (90, "deg", "rad", math.pi / 2),
        (-180, "deg", "rad", -math.pi),
        (math.pi, "rad", "deg", 180.0),
        (1, "rpm", "deg/s", 6.0),
    ],
)
def test_a_value_at_a_limit_is_the_limit_in_another_unit_too(value, unit, wanted, expected):
    factor = conversion(unit, wanted)

    assert factor is not None
    assert value * factor == expected
    assert converted(value, factor) == expected


@pytest.mark.parametrize(
    ("unit", "wanted", "per_one"), [("ms", "us", 1000), ("s", "ms", 1000), ("km/h", "m/h", 1000)]
)
def test_every_number_of_three_places_is_a_whole_one_of_the_unit_a_thousand_times_smaller(
    unit, wanted, per_one
):
    there, back = conversion(unit, wanted), conversion(wanted, unit)

    assert [n for n in range(5000) if converted(n / per_one, there) != n] == []
    assert [n for n in range(5000) if converted(n, back) != n / per_one] == []


def test_what_no_decimal_number_is_stays_the_product():
    assert converted(45.0, conversion("deg", "rad")) == math.radians(45.0)
    assert converted(math.inf, 1000.0) == math.inf
    assert converted(1.7e308, 1000.0) == math.inf


@pytest.mark.parametrize(
    ("unit", "wanted"),
    [
        ("deg", "1"),
        ("degC", "K"),
        ("m", "s"),
        ("ells", "m"),
        ("0 m", "m"),
        ("1e308 1e308 m", "m"),
        ("1e-308 1e-308 m", "m"),
        ("1e-308^-9 m", "m"),
        ("1e200 m", "1e-200 m"),
    ],
)
def test_what_does_not_convert_has_no_factor(unit, wanted):
    assert conversion(unit, wanted) is None


def test_each_unit_of_the_tables_is_read_as_itself_and_no_prefix_makes_another_of_it():
    named = units._PREFIXED | units._PLAIN

    assert {name: parse_unit(name) for name in named} == named
    assert [
        p + name for p in units._PREFIXES for name in units._PREFIXED if p + name in named
    ] == []
    assert len(named) == len(units._PREFIXED) + len(units._PLAIN)


@pytest.mark.parametrize("unit", ["m0", "m^0", "mg0"])
def test_a_power_of_nought_is_no_unit(unit):
    assert parse_unit(unit) is None
