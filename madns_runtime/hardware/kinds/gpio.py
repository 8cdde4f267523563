"""`gpio`: digital lines of a chip: levels in and out, edges with the kernel's time stamps, a pulse per second."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from annotated_types import Ge, Le, MinLen

from madns_runtime.errors import PluginError
from madns_runtime.hardware.contract import Channel, DeviceKind, Needs


@dataclass(frozen=True, slots=True, kw_only=True)
class GpioLine:
    """One line."""

    name: Annotated[str, MinLen(1)]
    offset: Annotated[int, Ge(0), Le(1023)]
    """Number of the line on its chip: on a Raspberry Pi the number after GPIO."""
    mode: Literal["level", "edges", "output"] = "level"
    """level: its state at each read; edges: each change of it, with the kernel's time stamp (PPS); output."""
    edge: Literal["rising", "falling", "both"] = "rising"
    """edges: which of them."""
    bias: Literal["as_is", "pull_up", "pull_down", "disabled"] = "as_is"
    active_low: bool = False
    debounce_s: Annotated[float, Ge(0), Le(1)] = 0.0
    """level and edges: a change that does not last so long is none."""
    safe: Literal[0, 1] = 0
    """output: the state in which it harms nobody."""


@dataclass(frozen=True, slots=True, kw_only=True)
class GpioParameters:
    """Settings of a `gpio` device."""

    lines: Annotated[tuple[GpioLine, ...], MinLen(1)]
    chip: Annotated[str, MinLen(1)] = "/dev/gpiochip0"
    """Its file, or its label, such as pinctrl-rp1 for a Raspberry Pi 5's header: files are counted in the order in which
    chips are found, and one that is plugged in anew may get another."""


def channels_of(parameters: GpioParameters) -> tuple[Channel, ...]:
    """
    Return a channel per line; an edge is 1 for a rising, 0 for a falling one.

    Raises:
        PluginError: Levels and edges are asked for together, or a line twice, or an output is to be debounced.
    """
    modes = {line.mode for line in parameters.lines}
    if {"level", "edges"} <= modes:
        raise PluginError(
            "lines: levels are asked for and edges are waited for; give those with mode edges a device of their own"
        )
    offsets = [line.offset for line in parameters.lines]
    if len(set(offsets)) < len(offsets):
        raise PluginError(f"lines: expected each offset once, got {offsets}")
    if bounced := [
        each.name for each in parameters.lines if each.mode == "output" and each.debounce_s
    ]:
        # The kernel refuses it, and does not say why.
        raise PluginError(
            f"lines: {', '.join(bounced)}: debounce_s is of inputs; leave it out of an output"
        )
    found = []
    for line in parameters.lines:
        if line.mode == "output":
            output = Channel(
                name=line.name,
                direction="out",
                limits=(0.0, 1.0),
                safe=float(line.safe),
                passing="queue",
            )
            found.append(output)
        else:
            passing: Literal["queue", "newest"] = "queue" if line.mode == "edges" else "newest"
            found.append(Channel(name=line.name, limits=(0.0, 1.0), passing=passing))
    return tuple(found)


def needs_of(parameters: GpioParameters) -> Needs:
    """Return what the chip needs."""
    file = parameters.chip if "/" in parameters.chip else "/dev/gpiochip*"
    return Needs(
        groups=("gpio",),
        files=(file,),
        requirements=("gpiod>=2.1",),
        exclusive=tuple(f"{parameters.chip} line {line.offset}" for line in parameters.lines),
    )


kind = DeviceKind(
    name="gpio",
    summary="digital lines: levels, edges with time stamps (PPS), outputs",
    device="madns_runtime.hardware.drivers.gpio:GpioDevice",
    parameters=GpioParameters,
    channels=channels_of,
    needs=needs_of,
)
