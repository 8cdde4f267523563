"""Samples of a channel from a folder of a device's records, as `cosmos devices record` and runs write them."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from madns_runtime.errors import ConfigurationError
from madns_runtime.hardware.calibration.result import SI_UNITS, ChannelSamples, SensorName
from madns_runtime.hardware.kinds.playback import HEAD
from madns_runtime.hardware.units import factor_of, unit_fault
from madns_runtime.recording.reader import StreamReading, read_columns, read_stream

FILES_MAX = 64


def read_samples(
    folder: Path,
    sensor: SensorName,
    channel: str | None,
    *,
    limits: tuple[float, float] | None,
) -> ChannelSamples:
    """
    Return what a sensor's channel gave, without samples that hold no numbers.

    Args:
        folder: Of one device's records.
        sensor: Which quantity is meant.
        channel: Its name; None for the only one of three numbers in a unit of that quantity.
        limits: Least and largest value of the channel, where they are known.

    Raises:
        ConfigurationError: The folder holds no such channel, or several.
        MachineError: A file cannot be read.
    """
    stream = _stream(folder, sensor, channel)
    names = stream.field_names
    columns = read_columns(stream.path)
    values = np.column_stack([np.asarray(columns[name], dtype=np.float64) for name in names[3:]])
    t_s = np.asarray(columns["t_s"], dtype=np.float64)
    is_whole = np.isfinite(values).all(axis=1) & np.isfinite(t_s)
    return ChannelSamples(
        name=stream.path.stem,
        unit=_unit(stream),
        t_s=t_s[is_whole],
        values=values[is_whole],
        limits=limits,
    )


def _stream(folder: Path, sensor: SensorName, channel: str | None) -> StreamReading:
    if not folder.is_dir():
        raise ConfigurationError(f"{folder}: expected a folder of a device's records")
    vectors = [
        stream
        for path in sorted(folder.glob("*.jsonl"))[:FILES_MAX]
        if (stream := read_stream(path)).field_names[:3] == HEAD and len(stream.field_names) == 6
    ]
    known = ", ".join(f"{each.path.stem} ({_unit(each) or 'no unit'})" for each in vectors)
    wanted = SI_UNITS[sensor]
    if channel is None:
        fitting = [each for each in vectors if factor_of(_unit(each), wanted) is not None]
        if len(fitting) != 1:
            count = "several channels" if fitting else "no channel"
            raise ConfigurationError(
                f"{folder}: {count} of three numbers in a unit of {wanted}, for {sensor}; it has {known or 'none'};"
                " --channel names one"
            )
        return fitting[0]
    found = [each for each in vectors if each.path.stem == channel]
    if not found:
        raise ConfigurationError(
            f"{folder}: no input {channel!r} of three numbers; it has {known or 'none'}"
        )
    if fault := unit_fault(_unit(found[0]), wanted):
        raise ConfigurationError(f"{folder}: {channel}: {fault}")
    return found[0]


def _unit(stream: StreamReading) -> str:
    return str(stream.schema["fields"][3]["unit"])
