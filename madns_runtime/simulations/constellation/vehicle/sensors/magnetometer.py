"""Magnetometer: the Earth's field, of a tilted dipole or of the IGRF."""

from __future__ import annotations

import importlib.util
import math
from collections.abc import Callable
from pathlib import Path

from madns_runtime.errors import MissingExtraError, PluginError
from madns_runtime.recording.records import Field
from madns_runtime.simulations.constellation.equipment import Magnetometer
from madns_runtime.simulations.constellation.orbit.magnetic import (
    NT,
    Coefficients,
    Harmonics,
    decimal_year,
    dipole_at,
    dipole_field_t,
)
from madns_runtime.simulations.constellation.vehicle.sensors.scene import Scene

Vector = tuple[float, float, float]


class FluxGate:
    """
    Three axes along the body's; along the frame's without attitude.

    Args:
        settings: Which field.
        scene: Where: the model is taken at the run's epoch, since it changes by 1e-3 in a year.

    Raises:
        MissingExtraError: The IGRF is wanted and its coefficients are not installed.
    """

    name = "magnetometer"
    stream = "magnetometer"
    fields = (Field("bx_t", "T"), Field("by_t", "T"), Field("bz_t", "T"))
    digits = 15
    channels = 3

    def __init__(self, settings: Magnetometer, scene: Scene) -> None:
        year = decimal_year(scene.days)
        self._field_t: Callable[[Vector], Vector]
        if settings.field == "igrf":
            self._field_t = Harmonics(igrf_coefficients(year)).field_t
        else:
            dipole = dipole_at(year)
            self._field_t = lambda r_m: dipole_field_t(dipole, r_m)

    def measure(self, scene: Scene, error: list[float]) -> tuple[float, ...]:
        """Return the field, T."""
        x, y, z = scene.state[:3]
        gmst = scene.gmst_rad
        cosine, sine = math.cos(gmst), math.sin(gmst)
        fx, fy, fz = self._field_t((cosine * x + sine * y, cosine * y - sine * x, z))
        bx, by, bz = scene.to_body((cosine * fx - sine * fy, sine * fx + cosine * fy, fz))
        a, b, c = error
        return bx + a, by + b, bz + c


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
    lines = [line.split() for line in path.read_text(encoding="utf-8").splitlines()]
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
