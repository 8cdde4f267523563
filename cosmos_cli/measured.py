"""
Measurement minus truth, where a run recorded both: which fields belong together, and the size of the error.

A sensor's field is held against the field of the same name among truth ("state", "attitude"). Pure numpy.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from cosmos_cli.report.sampling import Floats
from cosmos_cli.report.style import as_array
from madns_runtime.recording.records import Field

TRUTH_TABLES = ("state", "attitude")
NO_MEASUREMENTS = (*TRUTH_TABLES, "elements", "estimates", "commands", "command_results")
KEYS = ("tick", "t_s")
QUATERNION = ("q1", "q2", "q3", "q4")
SAME_INSTANT_S = 1e-6
"""A measurement's time of validity is that of a tick."""
TITLES = {"m": "position", "m/s": "velocity", "rad/s": "body rates", "deg": "attitude"}


@dataclass(frozen=True, slots=True, kw_only=True)
class Quantity:
    """Fields of one sensor that make one error."""

    truth: str
    """Table of the truth."""
    names: tuple[str, ...]
    unit: str

    @property
    def title(self) -> str:
        """What it is."""
        return TITLES.get(self.unit, ", ".join(self.names))

    def sizes(self, measured: Mapping[str, Any], truth: Mapping[str, Any]) -> Floats:
        """
        Return the size of the error of each measurement.

        Args:
            measured: Columns, shape (N,).
            truth: Columns of the same instants.

        Returns:
            Shape (N,): the difference's norm; of quaternions the angle between them, deg.
        """
        first = np.column_stack([as_array(measured[name]) for name in self.names])
        second = np.column_stack([as_array(truth[name]) for name in self.names])
        if self.names != QUATERNION:
            return np.asarray(np.linalg.norm(first - second, axis=1))
        # A quaternion and its negative are one attitude; small angles need the chord, not the cosine.
        first /= np.linalg.norm(first, axis=1, keepdims=True)
        second /= np.linalg.norm(second, axis=1, keepdims=True)
        chord = np.minimum(
            np.linalg.norm(first - second, axis=1), np.linalg.norm(first + second, axis=1)
        )
        return np.asarray(np.degrees(4.0 * np.arcsin(np.minimum(chord / 2.0, 1.0))))


def quantities(
    table: str, fields: Sequence[Field], truths: Mapping[str, Sequence[Field]]
) -> list[Quantity]:
    """
    Return what of a sensor's records can be held against truth; nothing for what is no sensor.

    Args:
        table: Name of the sensor's table.
        fields: Its fields.
        truths: Fields of the tables of truth that the run recorded.
    """
    if table in NO_MEASUREMENTS or "t_s" not in {field.name for field in fields}:
        return []
    found: list[Quantity] = []
    for truth in TRUTH_TABLES:
        there = {field.name for field in truths.get(truth, ())} - set(KEYS)
        units: dict[str, list[str]] = {}
        for field in fields:
            if field.name in there:
                unit = "deg" if field.name in QUATERNION else field.unit
                units.setdefault(unit, []).append(field.name)
        for unit, names in units.items():
            found.append(Quantity(truth=truth, names=tuple(names), unit=unit))
    return found
