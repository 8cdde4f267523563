"""Samples of a channel from a folder of a device's records, as `cosmos devices record` and runs write them."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np

from madns_runtime.errors import ConfigurationError
from madns_runtime.hardware.calibration.result import SI_UNITS, ChannelSamples, SensorName
from madns_runtime.hardware.contract import Channel
from madns_runtime.hardware.kinds.playback import streams_of
from madns_runtime.hardware.units import factor_of, unit_fault
from madns_runtime.recording.reader import read_columns

VECTOR: Final = 3


def read_samples(
    folder: Path,
    sensor: SensorName,
    channel: str | None,
    *,
    limits: tuple[float, float] | None,
) -> ChannelSamples:
    """
    Return what a sensor's channel gave, to all processes that its device had, without samples that hold no numbers.

    Args:
        folder: Of one device's records.
        sensor: Which quantity is meant.
        channel: Its name; None for the only one of three numbers in a unit of that quantity.
        limits: Least and largest value of the channel, where they are known.

    Raises:
        ConfigurationError: The folder holds no such channel, or several.
        MachineError: A file cannot be read.
        PluginError: The files of a channel are of different recordings.
    """
    found, files = _stream(folder, sensor, channel)
    parts = [columns for path in files if (columns := read_columns(path))]
    t_s, _, _, *values = (
        np.concatenate([np.asarray(columns[name], dtype=np.float64) for columns in parts])
        for name in parts[0]
    )
    vectors = np.column_stack(values)
    is_whole = np.isfinite(vectors).all(axis=1) & np.isfinite(t_s)
    return ChannelSamples(
        name=found.name,
        unit=found.unit,
        t_s=t_s[is_whole],
        values=vectors[is_whole],
        limits=limits,
    )


def _stream(
    folder: Path, sensor: SensorName, channel: str | None
) -> tuple[Channel, tuple[Path, ...]]:
    """Return a sensor's channel, with its files in their order."""
    if not folder.is_dir():
        raise ConfigurationError(f"{folder}: expected a folder of a device's records")
    vectors = [
        (each, files)
        for each, files in streams_of(folder)
        if each.direction == "in" and each.size == VECTOR
    ]
    known = ", ".join(f"{each.name} ({each.unit or 'no unit'})" for each, _ in vectors)
    wanted = SI_UNITS[sensor]
    if channel is None:
        fitting = [each for each in vectors if factor_of(each[0].unit, wanted) is not None]
        if len(fitting) != 1:
            count = "several channels" if fitting else "no channel"
            raise ConfigurationError(
                f"{folder}: {count} of three numbers in a unit of {wanted}, for {sensor}; it has {known or 'none'};"
                " --channel names one"
            )
        return fitting[0]
    found = [each for each in vectors if each[0].name == channel]
    if not found:
        raise ConfigurationError(
            f"{folder}: no input {channel!r} of three numbers; it has {known or 'none'}"
        )
    if fault := unit_fault(found[0][0].unit, wanted):
        raise ConfigurationError(f"{folder}: {channel}: {fault}")
    return found[0]
