"""`playback`: the recorded samples of another device, at their own times and with their own ages."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from annotated_types import Ge

from madns_runtime.errors import PluginError
from madns_runtime.hardware.contract import Channel, DeviceKind
from madns_runtime.recording.reader import read_stream

HEAD = ("t_s", "number", "age_us")
"""First fields of an input's stream."""


FRAME = ("bytes", "data")
"""Its further fields, if its values are frames."""


CHANNELS_MAX = 64


@dataclass(frozen=True, slots=True, kw_only=True)
class PlaybackParameters:
    """Settings of a `playback` device."""

    directory: Path
    """Folder of a device's records, such as runs/0007-hwil/devices/pi22/imu, or what `cosmos devices record` wrote."""
    start_s: Annotated[float, Ge(0)] = 0.0
    """Time in the recording that is simulated time zero, s."""


def channels_of(parameters: PlaybackParameters) -> tuple[Channel, ...]:
    """
    Return the inputs that were recorded.

    Raises:
        PluginError: The folder holds no stream of an input.
    """
    found = tuple(channel for channel, _ in _streams(parameters.directory))
    if not found:
        raise PluginError(
            f"{parameters.directory}: expected records of a device's inputs, found none"
        )
    return found


def _streams(directory: Path) -> list[tuple[Channel, Path]]:
    """Return the inputs that a folder holds, with their files."""
    found = []
    for path in sorted(directory.glob("*.jsonl"))[:CHANNELS_MAX]:
        fields = read_stream(path).schema.get("fields", ())
        names = tuple(field["name"] for field in fields)
        if names[: len(HEAD)] == HEAD and path.stem.isidentifier():
            found.append((_channel(path.stem, fields[len(HEAD) :]), path))
    return found


def _channel(name: str, fields: Any) -> Channel:
    columns = [field["name"] for field in fields]
    if tuple(columns) == FRAME:
        return Channel(name=name, is_frame=True, frame_bytes_max=8192)
    if columns == [name]:
        return Channel(name=name, unit=fields[0]["unit"])
    components = tuple(column.removeprefix(f"{name}_") for column in columns)
    return Channel(name=name, unit=fields[0]["unit"], shape=(len(columns),), components=components)


kind = DeviceKind(
    name="playback",
    summary="the recorded samples of another device, at their own times and with their own ages",
    device="madns_runtime.hardware.drivers.playback:PlaybackDevice",
    parameters=PlaybackParameters,
    channels=channels_of,
    can_block=False,
    needs_hardware=False,
    follows_simulated_time=True,
)
