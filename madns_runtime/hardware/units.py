"""
Units in which devices measure, and their factors to those of the International System. Pure.

Standard library alone: `cosmos validate` asks here as well as whoever reads a channel.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from madns_runtime.units import conversion

G0_M_S2: Final = 9.80665
"""Standard gravity."""

EXAMPLES: Final[Mapping[str, tuple[str, ...]]] = {
    "rad/s": ("rad/s", "mrad/s", "deg/s", "dps", "mdps", "deg/h", "rpm"),
    "m/s^2": ("m/s^2", "mm/s^2", "g", "mg", "ug"),
    "T": ("T", "mT", "uT", "nT", "G", "gauss", "mG"),
    "m": ("m", "km", "cm", "mm"),
    "m/s": ("m/s", "km/s", "cm/s", "mm/s"),
    "s": ("s", "ms", "us", "ns"),
    "1": ("1", "%"),
}
"""By the unit of the International System: what is named to somebody whose unit does not convert to it."""

_OF_DEVICES: Final[Mapping[str, Mapping[str, float]]] = {
    "m/s^2": {"g": G0_M_S2, "mg": G0_M_S2 * 1e-3, "ug": G0_M_S2 * 1e-6},
    "1": {"": 1.0},
}
"""Units that devices mean otherwise than records do: the g of an accelerometer is no gram."""


def factor_of(unit: str, wanted: str) -> float | None:
    """
    Return the factor of values in a unit to one of the International System.

    Args:
        unit: As a channel declares it.
        wanted: Any unit of `madns_runtime.units`.

    Returns:
        The factor; None if it is no unit of that quantity.
    """
    own = _OF_DEVICES.get(wanted, {}).get(unit.strip().replace("µ", "u").replace("μ", "u"))
    return conversion(unit, wanted) if own is None else own


def unit_fault(unit: str, wanted: str) -> str | None:
    """Return what is wrong with a channel's unit where values in another are wanted; None if it converts."""
    if factor_of(unit, wanted) is not None:
        return None
    known = ", ".join(EXAMPLES.get(wanted, (wanted,)))
    if not unit.strip():
        return f"expected a unit of {wanted}, and the channel declares none: declare one of {known}"
    return f"expected a unit that converts to {wanted} ({known}), got {unit!r:.40}"
