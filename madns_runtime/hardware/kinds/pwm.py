"""`pwm`: pulse-width modulation by the kernel's files."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from annotated_types import Ge, Le

from madns_runtime.hardware.contract import Channel, DeviceKind, Needs

PWM = Path("/sys/class/pwm")


@dataclass(frozen=True, slots=True, kw_only=True)
class PwmParameters:
    """Settings of a `pwm` device."""

    chip: Annotated[int, Ge(0), Le(255)] = 0
    line: Annotated[int, Ge(0), Le(255)] = 0
    period_s: Annotated[float, Ge(1e-9), Le(10)] = 0.02
    """0.02 s is what servos want; the kernel counts it in whole nanoseconds."""
    low: Annotated[float, Ge(0), Le(1)] = 0.0
    high: Annotated[float, Ge(0), Le(1)] = 1.0
    """Limits of the share of the period in which the line is on."""
    safe: Annotated[float, Ge(0), Le(1)] = 0.0
    polarity: Literal["normal", "inversed"] = "normal"
    """normal: the line is high while it is on; inversed: it is low."""
    root: str = str(PWM)
    """Folder of all chips."""


def channels_of(parameters: PwmParameters) -> tuple[Channel, ...]:
    """Return the duty to set, and the one that is set."""
    limits = (parameters.low, parameters.high)
    return (
        Channel(name="duty", direction="out", limits=limits, safe=parameters.safe),
        Channel(name="duty_set", limits=(0.0, 1.0)),
    )


def needs_of(parameters: PwmParameters) -> Needs:
    """Return the folder that must be there."""
    return Needs(
        groups=("gpio",),
        boot_lines=("dtoverlay=pwm-2chan",),
        files=(f"{parameters.root}/pwmchip{parameters.chip}",),
        exclusive=(f"{parameters.root}/pwmchip{parameters.chip}/pwm{parameters.line}",),
    )


kind = DeviceKind(
    name="pwm",
    summary="pulse-width modulation (servos, heaters, coils) by the kernel's files",
    device="madns_runtime.hardware.drivers.pwm:PwmDevice",
    parameters=PwmParameters,
    channels=channels_of,
    needs=needs_of,
)
