"""`null`: takes anything and measures nothing but the time: a stand-in for a device that is not there."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from annotated_types import Ge, Le

from madns_runtime.hardware.contract import Channel, DeviceKind


@dataclass(frozen=True, slots=True, kw_only=True)
class NullParameters:
    """Settings of a `null` device."""

    outputs: tuple[str, ...] = ("output",)
    """Names of its outputs; each takes a number."""
    low: Annotated[float, Ge(-1e12), Le(1e12)] = -1e12
    high: Annotated[float, Ge(-1e12), Le(1e12)] = 1e12
    """Limits of the outputs; safe is what is nearest to 0 within them."""


def channels_of(parameters: NullParameters) -> tuple[Channel, ...]:
    """Return a clock, and the outputs that the parameters name."""
    limits = (parameters.low, parameters.high)
    safe = min(max(0.0, parameters.low), parameters.high)
    outputs = tuple(
        Channel(name=name, direction="out", limits=limits, safe=safe) for name in parameters.outputs
    )
    return (Channel(name="time", unit="s"), *outputs)


kind = DeviceKind(
    name="null",
    summary="takes any output and measures the simulated time alone",
    device="madns_runtime.hardware.drivers.null:NullDevice",
    parameters=NullParameters,
    channels=channels_of,
    can_block=False,
    needs_hardware=False,
    follows_simulated_time=True,
)
