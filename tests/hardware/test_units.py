"""Units of channels: which convert, to what, and what is said of those that do not."""

import math

import pytest

from madns_runtime.hardware.units import EXAMPLES, factor_of, unit_fault


@pytest.mark.parametrize(
    ("unit", "wanted", "factor"),
    [
        ("deg/s", "rad/s", math.pi / 180),
        ("°/s", "rad/s", math.pi / 180),
        ("rad/s", "rad/s", 1.0),
        ("g", "m/s^2", 9.80665),
        ("m/s2", "m/s^2", 1.0),
        ("m/s²", "m/s^2", 1.0),
        ("uT", "T", 1e-6),
        ("µT", "T", 1e-6),
        ("nT", "T", 1e-9),
        ("gauss", "T", 1e-4),
        ("", "1", 1.0),
        ("ug", "m/s^2", 9.80665e-6),
        ("g0", "m/s^2", 9.80665),
        ("um", "m", 1e-6),
        ("pT", "T", 1e-12),
        ("min", "s", 60.0),
        ("km/h", "m/s", 1 / 3.6),
        ("ppm", "1", 1e-6),
        ("deg s^-1", "rad/s", math.pi / 180),
    ],
)
def test_a_unit_converts(unit, wanted, factor):
    assert factor_of(unit, wanted) == pytest.approx(factor, rel=1e-15)
    assert unit_fault(unit, wanted) is None


def test_a_unit_of_something_else_is_refused_in_words():
    assert factor_of("V", "T") is None
    assert unit_fault("V", "T") == (
        "expected a unit that converts to T (T, mT, uT, nT, G, gauss, mG), got 'V'"
    )


def test_a_channel_without_a_unit_is_told_what_to_declare():
    assert "declares none: declare one of rad/s" in unit_fault(" ", "rad/s")


@pytest.mark.parametrize(
    ("unit", "wanted"), [(unit, wanted) for wanted, units in EXAMPLES.items() for unit in units]
)
def test_each_unit_that_is_named_converts(unit, wanted):
    assert factor_of(unit, wanted) is not None
    assert factor_of(wanted, wanted) == 1.0


def test_a_quantity_beyond_the_table_converts_as_recorded_values_do():
    assert factor_of("kHz", "Hz") == 1000.0
    assert factor_of("V", "Hz") is None
    assert unit_fault("kHz", "Hz") is None
    assert unit_fault("V", "Hz") == "expected a unit that converts to Hz (Hz), got 'V'"
    assert "declare one of furlong" in unit_fault("", "furlong")
