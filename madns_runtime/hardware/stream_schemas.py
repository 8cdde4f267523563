"""Schemas of the streams that a device records; pure, and without what writes them."""

from __future__ import annotations

from madns_runtime.hardware.contract import Channel
from madns_runtime.recording.records import Field, StreamSchema

DEVICE_CLOCK = StreamSchema(
    "device_clock", (Field("t_s", "s"), Field("offset_us", "us"), Field("drift_ppm", "1e-6"))
)
"""The machine's clock minus the device's, and how much faster the device's runs."""

DEVICE_STATE = StreamSchema(
    "device_state",
    (
        Field("t_s", "s"),
        Field("samples", "", "int"),
        Field("errors", "", "int"),
        Field("late_us_max", "us", "int"),
        Field("details", "", "json"),
    ),
)
"""Once per second: samples and errors so far, the latest start of a read since, and what the driver tells."""


def schema_of(channel: Channel) -> StreamSchema:
    """Return the stream of a channel: of an input with number and age, of an output with its lateness."""
    values: tuple[Field, ...]
    head: tuple[Field, ...]
    if channel.is_frame:
        values = (Field("bytes", "", "int"), Field("data", "", "str"))
    else:
        values = tuple(Field(name, channel.unit) for name in channel.column_names())
    if channel.direction == "in":
        head = (Field("t_s", "s"), Field("number", "", "int"), Field("age_us", "us", "int"))
    else:
        head = (Field("t_s", "s"), Field("lateness_us", "us", "int"))
    return StreamSchema(channel.name, (*head, *values))
