"""
The Earth's field by the name that a scenario gives its model: for truth, and for what measures it.

On neither side of the wall. Only the IGRF reads a file, once.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from pathlib import Path

from madns_runtime.bounded_files import read_regular_file
from madns_runtime.errors import MissingExtraError, PluginError
from madns_runtime.simulations.constellation.equipment import FieldName
from madns_runtime.simulations.constellation.orbit.magnetic import (
    NT,
    Coefficients,
    Harmonics,
    Vector,
    dipole_at,
    dipole_field_t,
)

FILE_BYTES_MAX = 16 * 1024 * 1024


def field_model(name: FieldName, year: float) -> Callable[[Vector], Vector]:
    """
    Return the function from an Earth-fixed position, m, to the field there, T.

    Args:
        name: dipole for the tilted dipole, igrf for all of the IGRF.
        year: Decimal year.

    Raises:
        MissingExtraError: The IGRF is wanted and not installed.
        PluginError: Its data are not where, or what, they were.
    """
    if name == "igrf":
        return Harmonics(igrf_coefficients(year)).field_t
    dipole = dipole_at(year)
    return lambda r_m: dipole_field_t(dipole, r_m)


def igrf_coefficients(year: float) -> Coefficients:
    """
    Return the newest IGRF's coefficients at a decimal year, linear between its epochs.

    Only the data file of ppigrf is read: its code takes 15 ms for a point, and pandas to import.

    Raises:
        MissingExtraError: ppigrf is not installed.
        PluginError: Its data are not where, or what, they were.
    """
    found = importlib.util.find_spec("ppigrf")
    if found is None or not found.submodule_search_locations:
        raise MissingExtraError("ppigrf", "igrf")
    folder = Path(found.submodule_search_locations[0])
    files = sorted(folder.glob("IGRF*.shc"))
    if not files:
        raise PluginError(f"{folder}: expected a file IGRF*.shc of the package ppigrf >= 2.1")
    return read_coefficients(files[-1], year)


def read_coefficients(path: Path, year: float) -> Coefficients:
    """
    Return the coefficients of an SHC file at a decimal year, T; of its nearest epoch outside of them.

    Raises:
        PluginError: It is no SHC file.
    """
    text = read_regular_file(path, bytes_max=FILE_BYTES_MAX).decode()
    lines = [line.split() for line in text.splitlines()]
    rows = [line for line in lines if line and not line[0].startswith("#")][1:]
    try:
        years = [float(number) for number in rows[0]]
        year = min(max(year, years[0]), years[-1])
        at = next(number for number, until in enumerate(years[1:]) if year <= until)
        part = (year - years[at]) / (years[at + 1] - years[at])
        table = {(int(row[0]), int(row[1])): [float(n) for n in row[2:]] for row in rows[1:]}
        return {
            key: NT * (values[at] + part * (values[at + 1] - values[at]))
            for key, values in table.items()
        }
    except (IndexError, ValueError, StopIteration) as error:
        raise PluginError(f"{path}: expected spherical harmonics as SHC text") from error
