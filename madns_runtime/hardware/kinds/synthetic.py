"""`synthetic`: waveforms with noise under a seed, as functions of simulated time."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Literal

from annotated_types import Ge, MinLen

from madns_runtime.hardware.contract import Channel, DeviceKind

Shape = Literal["constant", "sine", "square", "triangle", "sawtooth", "ramp"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Waveform:
    """One element of a channel: offset + amplitude x shape(frequency x t + phase) + noise."""

    shape: Shape = "constant"
    """constant; sine, square, triangle, sawtooth of one period per 1 / frequency_hz; ramp: amplitude per second."""
    amplitude: float = 0.0
    offset: float = 0.0
    frequency_hz: Annotated[float, Ge(0)] = 1.0
    phase: float = 0.0
    """Share of a period by which it runs ahead."""
    noise: Annotated[float, Ge(0)] = 0.0
    """Standard deviation of white noise."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SyntheticChannel:
    """One channel of numbers."""

    name: str
    unit: str = ""
    elements: Annotated[tuple[Waveform, ...], MinLen(1)] = (Waveform(),)
    """One for a number, several for a vector."""
    components: tuple[str, ...] = ()
    """Names of a vector's elements, such as x, y, z."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SyntheticParameters:
    """Settings of a `synthetic` device."""

    channels: Annotated[tuple[SyntheticChannel, ...], MinLen(1)] = field(
        default_factory=lambda: (
            SyntheticChannel(name="value", elements=(Waveform(shape="sine", amplitude=1.0),)),
        )
    )
    seed: Annotated[int, Ge(0)] = 0
    """Of the noise; each agent's own device, and each machine's, has another one under it."""


def channels_of(parameters: SyntheticParameters) -> tuple[Channel, ...]:
    """Return the inputs that the parameters describe."""
    return tuple(
        Channel(
            name=each.name,
            unit=each.unit,
            shape=(len(each.elements),) if len(each.elements) > 1 else (),
            components=each.components,
        )
        for each in parameters.channels
    )


kind = DeviceKind(
    name="synthetic",
    summary="waveforms with noise under a seed",
    device="madns_runtime.hardware.drivers.synthetic:SyntheticDevice",
    parameters=SyntheticParameters,
    channels=channels_of,
    can_block=False,
    needs_hardware=False,
    follows_simulated_time=True,
)
