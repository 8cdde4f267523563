"""Parameters of the counting benchmark."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from annotated_types import Ge, Le

from madns_runtime.plugin.api import DeclaredStream
from madns_runtime.recording.records import Field

ROUND_TRIPS = (
    Field("packet", "", "int"),
    Field("value", "", "int"),
    Field("round_trip_us", "us", "int"),
)
"""One record per packet that came back."""
DEVICE_SAMPLES = (
    Field("t_s", "s"),
    Field("device", "", "str"),
    Field("channel", "", "str"),
    Field("number", "", "int"),
    Field("delay_us", "us", "int"),
    Field("values", "", "json"),
)
"""One record per sample of a device that reached the host; delay: from its being taken until the host has it."""
SAMPLE_BYTES = 256
"""What a device's samples take in a packet, about: those of a Sense HAT with all its sensors."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CounterParameters:
    """Way of the counting packets."""

    service: Literal["best", "reliable", "sync"] = "best"
    """Class of service: best as a bare datagram, reliable and sync with delivery guaranteed."""
    payload_bytes: Annotated[int, Ge(0), Le(1000)] = 0
    """Further bytes in every packet."""
    send_device: str = ""
    """A device whose newest samples agents that use it send to the host in each tick, as bare datagrams; empty for none."""


def declared_streams(
    parameters: CounterParameters, agents: tuple[str, ...]
) -> tuple[DeclaredStream, ...]:
    """Return the streams of both halves; see `plugin.api.Simulation`."""
    round_trips = DeclaredStream(role="agent", name="round_trips", fields=ROUND_TRIPS)
    if not parameters.send_device:
        return (round_trips,)
    return (round_trips, DeclaredStream(role="host", name="device_samples", fields=DEVICE_SAMPLES))
