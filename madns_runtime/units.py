"""
Units of recorded values and factors between them. Pure; standard library alone.

A unit is written as in records: `m/s^2`, `N m`, `deg`, `1e-6`. Angles are a quantity of their own, so that `deg`
converts to `rad` and neither to a bare number. Temperatures in degC have no factor to any other unit.
"""

from __future__ import annotations

import functools
import math
import re
from collections.abc import Mapping
from decimal import Decimal
from typing import Final

_BASE: Final = ("m", "kg", "s", "A", "K", "mol", "cd", "rad", "B", "degC")
Dimensions = tuple[int, ...]
"""Powers of the base units, in their order."""


def _powers(**powers: int) -> Dimensions:
    return tuple(powers.get(name, 0) for name in _BASE)


_PREFIXES: Final[Mapping[str, float]] = {
    "T": 1e12, "G": 1e9, "M": 1e6, "k": 1e3, "h": 1e2, "d": 1e-1, "c": 1e-2, "m": 1e-3, "u": 1e-6, "n": 1e-9,
    "p": 1e-12,
}  # fmt: skip
_PREFIXED: Final[Mapping[str, tuple[float, Dimensions]]] = {
    "m": (1.0, _powers(m=1)),
    "g": (1e-3, _powers(kg=1)),
    "s": (1.0, _powers(s=1)),
    "A": (1.0, _powers(A=1)),
    "K": (1.0, _powers(K=1)),
    "mol": (1.0, _powers(mol=1)),
    "cd": (1.0, _powers(cd=1)),
    "rad": (1.0, _powers(rad=1)),
    "Hz": (1.0, _powers(s=-1)),
    "N": (1.0, _powers(kg=1, m=1, s=-2)),
    "Pa": (1.0, _powers(kg=1, m=-1, s=-2)),
    "bar": (1e5, _powers(kg=1, m=-1, s=-2)),
    "J": (1.0, _powers(kg=1, m=2, s=-2)),
    "W": (1.0, _powers(kg=1, m=2, s=-3)),
    "C": (1.0, _powers(A=1, s=1)),
    "V": (1.0, _powers(kg=1, m=2, s=-3, A=-1)),
    "ohm": (1.0, _powers(kg=1, m=2, s=-3, A=-2)),
    "T": (1.0, _powers(kg=1, s=-2, A=-1)),
    "G": (1e-4, _powers(kg=1, s=-2, A=-1)),
    "B": (1.0, _powers(B=1)),
    "bit": (0.125, _powers(B=1)),
    "eV": (1.602176634e-19, _powers(kg=1, m=2, s=-2)),
}
"""Units that take prefixes."""
_PLAIN: Final[Mapping[str, tuple[float, Dimensions]]] = {
    "1": (1.0, _powers()),
    "%": (1e-2, _powers()),
    "ppm": (1e-6, _powers()),
    "min": (60.0, _powers(s=1)),
    "h": (3600.0, _powers(s=1)),
    "d": (86_400.0, _powers(s=1)),
    "deg": (math.radians(1.0), _powers(rad=1)),
    "arcmin": (math.radians(1.0 / 60.0), _powers(rad=1)),
    "arcsec": (math.radians(1.0 / 3600.0), _powers(rad=1)),
    "rev": (math.tau, _powers(rad=1)),
    "dps": (math.radians(1.0), _powers(rad=1, s=-1)),
    "mdps": (math.radians(1e-3), _powers(rad=1, s=-1)),
    "rpm": (math.tau / 60.0, _powers(rad=1, s=-1)),
    "degC": (1.0, _powers(degC=1)),
    "gauss": (1e-4, _powers(kg=1, s=-2, A=-1)),
    "KiB": (1024.0, _powers(B=1)),
    "MiB": (1024.0**2, _powers(B=1)),
    "GiB": (1024.0**3, _powers(B=1)),
    "g0": (9.80665, _powers(m=1, s=-2)),
}
_SPELLINGS: Final = {
    "µ": "u",
    "μ": "u",
    "²": "^2",
    "³": "^3",
    "°": "deg",
    "**": "^",
    "·": " ",
    "*": " ",
}
_TERM: Final = re.compile(r"(?P<divided>/?)\s*(?P<symbol>[A-Za-z%][A-Za-z0-9]*?|[0-9.]+(?:e-?[0-9]+)?)"
                          r"(?:\^?(?P<power>-?[1-9]))?(?=[\s/]|$)\s*")  # fmt: skip
UNIT_CHARACTERS_MAX: Final = 40


@functools.lru_cache(maxsize=256)
def parse_unit(unit: str) -> tuple[float, Dimensions] | None:
    """Return a unit's factor to base units and the powers of these; None if it is no unit that is known."""
    for other, ours in _SPELLINGS.items():
        unit = unit.replace(other, ours)
    text, place, factor = unit.strip(), 0, 1.0
    powers = [0] * len(_BASE)
    if not text or len(text) > UNIT_CHARACTERS_MAX:
        return None
    while place < len(text):
        term = _TERM.match(text, place)
        known = None if term is None else _symbol(term["symbol"])
        if term is None or known is None:
            return None
        place = term.end()
        power = int(term["power"] or 1) * (-1 if term["divided"] else 1)
        try:
            factor *= known[0] ** power
        except OverflowError:
            return None
        powers = [have + power * own for have, own in zip(powers, known[1], strict=True)]
    return (factor, tuple(powers)) if 0.0 < factor < math.inf else None


def conversion(unit: str, wanted: str) -> float | None:
    """Return the factor of values in *unit* to values in *wanted*; None if they measure different quantities."""
    if unit == wanted:
        return 1.0
    ours, theirs = parse_unit(unit), parse_unit(wanted)
    if ours is None or theirs is None or ours[1] != theirs[1]:
        return None
    exact = ours[0] / theirs[0]
    if not 0.0 < exact < math.inf:
        return None
    # 5 ms are 5000 us, not 5000.000000000001; a degree is what it is.
    rounded = float(f"{exact:.12g}")
    return rounded if math.isclose(rounded, exact, rel_tol=1e-15) else exact


def converted(value: float, factor: float) -> float:
    """
    Return a number in another unit, *factor* of which make one of its own.

    Both are taken for the decimal numbers that they are read from where the factor, or what it divides by, is one of
    few digits: 1.005 ms are 1005 us and 5 us are 0.000005 s, which in binary numbers they miss by their last digit.
    """
    if factor == 1.0 or not math.isfinite(value):
        return value * factor
    if _is_short(factor):
        return float(Decimal(repr(float(value))) * Decimal(repr(factor)))
    divisor = 1.0 / factor
    if math.isfinite(divisor) and _is_short(divisor):
        return float(Decimal(repr(float(value))) / Decimal(repr(divisor)))
    return value * factor


def _is_short(number: float) -> bool:
    return float(f"{number:.12g}") == number


def _symbol(symbol: str) -> tuple[float, Dimensions] | None:
    if symbol in _PLAIN:
        return _PLAIN[symbol]
    if symbol in _PREFIXED:
        return _PREFIXED[symbol]
    prefix, rest = symbol[:1], symbol[1:]
    if prefix in _PREFIXES and rest in _PREFIXED:
        factor, powers = _PREFIXED[rest]
        return factor * _PREFIXES[prefix], powers
    try:
        number = float(symbol)
    except ValueError:
        return None
    return (number, _powers()) if math.isfinite(number) and number > 0.0 else None
