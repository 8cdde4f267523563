"""
`playback`: the recorded samples of another device, at their own times and with their own ages.

Outputs that were recorded are there as well: they take what they are given, put out nothing, and record it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Final, Literal

from annotated_types import Ge, Gt

from madns_runtime.errors import PluginError
from madns_runtime.hardware.contract import Channel, DeviceKind
from madns_runtime.hardware.kind_declaration import CHANNELS_MAX
from madns_runtime.recording.reader import read_stream
from madns_runtime.recording.stream_file import files_of

HEAD: Final = ("t_s", "number", "age_us")
"""First fields of an input's stream."""

OUTPUT_HEAD: Final = ("t_s", "lateness_us")
"""First fields of an output's stream."""

FRAME: Final = ("bytes", "data")
"""Further fields of both, if the values are frames."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PlaybackParameters:
    """Settings of a `playback` device."""

    directory: Path
    """Folder of a device's records, such as runs/0007-hwil/devices/pi22/imu, or what `cosmos devices record` wrote."""
    start_s: Annotated[float, Ge(0)] = 0.0
    """Time in the recording that is simulated time zero, s."""
    ticks: Path | None = None
    """Stream of the ticks of the agent that used the device, such as runs/0007-hwil/agents/agent-01/ticks.jsonl: in
    lockstep each sample is then there in the tick that could first find it, however late that woke up; without it in
    the first one at or after the time at which it was handed on."""
    tick_hz: Annotated[float, Gt(0)] | None = None
    """Rate of those ticks, Hz; without `ticks` they were lockstep's, on time."""
    phase_s: float = 0.0
    """By how much they were due behind their nominal times, s."""
    limits: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    """By channel, of one number or more: least and largest value, for these are not on record."""
    queues: tuple[str, ...] = ()
    """Channels of which each value arrives once, in order; frames do, but for those under `newest`."""
    newest: tuple[str, ...] = ()
    """Outputs of frames of which the newest alone goes out, where several are due at once, as in lockstep."""


def channels_of(parameters: PlaybackParameters) -> tuple[Channel, ...]:
    """
    Return the inputs and outputs that were recorded.

    Raises:
        PluginError: The folder holds no stream of an input or an output.
    """
    found = tuple(channel for channel, _ in streams_of(parameters.directory))
    if not found:
        raise PluginError(
            f"{parameters.directory}: expected records of a device's channels, found none"
        )
    return tuple(
        replace(
            each,
            limits=parameters.limits.get(each.name),
            passing=_passing(each, parameters),
        )
        for each in found
    )


def _passing(channel: Channel, parameters: PlaybackParameters) -> Literal["newest", "queue"]:
    if channel.name in parameters.newest and channel.direction == "out":
        return "newest"
    return "queue" if channel.name in parameters.queues else channel.passing


def streams_of(directory: Path) -> list[tuple[Channel, tuple[Path, ...]]]:
    """
    Return the channels of which a folder holds streams: of too many, one more than a device has.

    With each come its files in their order: a device's process that was started anew has begun another one.

    Raises:
        MachineError: A file cannot be read.
        PluginError: The files of a stream have not the same fields, so that they are of different recordings.
    """
    found: list[tuple[Channel, tuple[Path, ...]]] = []
    for name in sorted({path.name.partition(".")[0] for path in directory.glob("*.jsonl")}):
        if len(found) > CHANNELS_MAX:
            break
        if not name.isidentifier():
            continue
        files = files_of(directory, name)
        fields = _fields_of(files)
        names = tuple(field["name"] for field in fields)
        if names[: len(HEAD)] == HEAD:
            found.append((_channel(name, fields[len(HEAD) :]), files))
        elif names[: len(OUTPUT_HEAD)] == OUTPUT_HEAD:
            channel = _channel(name, fields[len(OUTPUT_HEAD) :])
            found.append((replace(channel, direction="out"), files))
    return found


def _fields_of(files: Sequence[Path]) -> Sequence[Any]:
    """Return the fields of a stream; a process that was killed may have left a file without any."""
    first: Sequence[Any] = ()
    for path in files:
        fields = read_stream(path).schema.get("fields", ())
        first = first or fields
        if fields and fields != first:
            raise PluginError(
                f"{path}: expected the fields of {files[0].name}, found others: are they of different recordings?"
            )
    return first


def _channel(name: str, fields: Any) -> Channel:
    columns = [field["name"] for field in fields]
    if tuple(columns) == FRAME:
        return Channel(name=name, is_frame=True, frame_bytes_max=8192, passing="queue")
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
