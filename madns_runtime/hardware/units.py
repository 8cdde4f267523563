"""
Units in which devices measure, and their factors to those of the International System. Pure.

Standard library alone: `cosmos validate` asks here as well as whoever reads a channel.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Final

from madns_runtime.units import conversion

G0_M_S2: Final = 9.80665
"""Standard gravity."""

FACTORS: Final[Mapping[str, Mapping[str, float]]] = {
    "rad/s": {
        "rad/s": 1.0,
        "mrad/s": 1e-3,
        "deg/s": math.radians(1.0),
        "dps": math.radians(1.0),
        "mdps": math.radians(1e-3),
        "deg/h": math.radians(1.0) / 3600.0,
        "rpm": math.tau / 60.0,
    },
    "m/s^2": {
        "m/s^2": 1.0,
        "mm/s^2": 1e-3,
        "g": G0_M_S2,
        "mg": G0_M_S2 * 1e-3,
        "ug": G0_M_S2 * 1e-6,
    },
    "T": {
        "T": 1.0,
        "mT": 1e-3,
        "uT": 1e-6,
        "nT": 1e-9,
        "G": 1e-4,
        "gauss": 1e-4,
        "mG": 1e-7,
    },
    "m": {"m": 1.0, "km": 1e3, "cm": 1e-2, "mm": 1e-3},
    "m/s": {"m/s": 1.0, "km/s": 1e3, "cm/s": 1e-2, "mm/s": 1e-3},
    "s": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9},
    "1": {"1": 1.0, "": 1.0},
}
"""By the unit of the International System: the factors of values in other units of the same quantity."""

_SPELLINGS: Final = {"µ": "u", "μ": "u", "²": "^2", "°": "deg", "**": "^", " ": ""}


def plain_unit(unit: str) -> str:
    """Return a unit as the table spells it: m/s2 and m/s² become m/s^2, µT becomes uT."""
    for other, ours in _SPELLINGS.items():
        unit = unit.replace(other, ours)
    return unit[:-1] + "^2" if unit.endswith("/s2") else unit


def factor_of(unit: str, wanted: str) -> float | None:
    """
    Return the factor of values in a unit to one of the International System.

    Args:
        unit: As a channel declares it.
        wanted: A key of `FACTORS`, or any other unit of `madns_runtime.units`.

    Returns:
        The factor; None if it is no unit of that quantity.
    """
    known = FACTORS.get(wanted)
    return conversion(unit, wanted) if known is None else known.get(plain_unit(unit))


def unit_fault(unit: str, wanted: str) -> str | None:
    """Return what is wrong with a channel's unit where values in another are wanted; None if it converts."""
    if factor_of(unit, wanted) is not None:
        return None
    known = ", ".join(name for name in FACTORS.get(wanted, {wanted: 1.0}) if name)
    if not unit.strip():
        return f"expected a unit of {wanted}, and the channel declares none: declare one of {known}"
    return f"expected a unit that converts to {wanted} ({known}), got {unit!r:.40}"
