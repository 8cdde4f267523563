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
ANSWER_ROUND_TRIPS = (
    Field("t_s", "s"),
    Field("agent", "", "str"),
    Field("packet", "", "int"),
    Field("round_trip_us", "us", "int"),
)
"""One record per answer that an agent's later packet showed to have arrived: from the answer to that packet."""
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
"""Bytes that a device's samples take in a packet, about: those of a Sense HAT with all its sensors."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CounterParameters:
    """Way of the counting packets."""

    service: Literal["best", "reliable", "sync"] = "best"
    """Class of service: best as a bare datagram, reliable and sync with delivery guaranteed."""
    payload_bytes: Annotated[int, Ge(0), Le(1000)] = 0
    """Further bytes in every packet."""
    send_device: str = ""
    """A device whose newest samples agents that use it send to the host in each tick, as bare datagrams; empty for none."""
    answer_hz: Annotated[float, Ge(0), Le(10_000)] = 0.0
    """Rate of the host's own tick, on which it answers all that has come since the last one, Hz; 0: it answers at once."""
    read_on_tick: bool = False
    """Agents read answers at their next tick, as in the thesis, instead of when they come."""
    host_round_trips: bool = False
    """The host times its answers as well: until the first packet that the agent sent after it had the answer."""


def declared_streams(
    parameters: CounterParameters, agents: tuple[str, ...]
) -> tuple[DeclaredStream, ...]:
    """Return the streams of both halves; see `plugin.api.Simulation`."""
    streams = [DeclaredStream(role="agent", name="round_trips", fields=ROUND_TRIPS)]
    if parameters.send_device:
        streams.append(DeclaredStream(role="host", name="device_samples", fields=DEVICE_SAMPLES))
    if parameters.host_round_trips:
        streams.append(
            DeclaredStream(role="host", name="answer_round_trips", fields=ANSWER_ROUND_TRIPS)
        )
    return tuple(streams)
