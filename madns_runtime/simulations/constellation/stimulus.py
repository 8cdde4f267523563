"""
Stimuli of a vehicle, as a person writes them in a scenario: which truth goes to which channel of a device, and how.

Frozen dataclasses with bounds, the standard library and annotated_types alone; on neither side of the wall, for
`cosmos validate` asks here as well as the vehicle.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, Final, Literal, NamedTuple, get_args

from annotated_types import Ge, Gt, Le, MinLen

from madns_runtime.simulations.constellation.alignment import alignment_fault

StimulusSource = Literal[
    "magnetic_field",
    "sun_direction",
    "body_rates",
    "quaternion",
    "position",
    "velocity",
    "earth_fixed_state",
    "gnss_epoch",
]
Row = tuple[float, float, float]


class SourceForm(NamedTuple):
    """Description of a source's values."""

    unit: str
    size: int
    is_body_vector: bool
    """Whether they are three components in body axes."""
    needs_attitude: bool


SOURCES: Final[dict[StimulusSource, SourceForm]] = {
    "magnetic_field": SourceForm("T", 3, True, True),
    "sun_direction": SourceForm("1", 3, True, True),
    "body_rates": SourceForm("rad/s", 3, True, True),
    "quaternion": SourceForm("1", 4, False, True),
    "position": SourceForm("m", 3, False, False),
    "velocity": SourceForm("m/s", 3, False, False),
    "earth_fixed_state": SourceForm("m, m/s", 6, False, False),
    "gnss_epoch": SourceForm("s, m, m/s", 7, False, False),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Stimulus:
    """Truth of a vehicle that a device is given: scale (alignment truth) + bias, held to the limits."""

    source: StimulusSource
    """magnetic_field (T), sun_direction (unit vector, zeros in the umbra) and body_rates (rad/s) in body axes; quaternion
    (scalar last, inertial to body); position (m) and velocity (m/s) in the run's frame; earth_fixed_state: WGS-84
    position (m) and velocity (m/s), from TEME by sidereal time alone; gnss_epoch: the same behind UTC (s since 1970), for a
    gnss_receiver."""
    channel: Annotated[str, MinLen(3)]
    """Device and its output, such as mcu.magnetometer."""
    alignment: tuple[Row, Row, Row] | tuple[float, float, float, float] | None = None
    """From body axes to the device's: a matrix by its rows, or a quaternion, scalar last; none where they are one."""
    scale: float | tuple[float, ...] = 1.0
    """Factor of all values, or one for each, such as A/T of a coil."""
    bias: float | tuple[float, ...] = 0.0
    """Added afterwards, one number or one for each, in the channel's unit."""
    limits: tuple[float, float] | None = None
    """Least and largest value that it is held to; those beyond are counted. None for the channel's own limits alone."""
    rate_hz: Annotated[float, Gt(0), Le(1000)] = 10.0
    """Points per second."""
    lead_s: Annotated[float, Gt(0), Le(10)] = 1.0
    """How long before their time points are handed to the device's process, s."""
    field: Literal["dipole", "igrf"] = "dipole"
    """magnetic_field: tilted dipole, or the IGRF (extra `igrf`)."""
    start_s: Annotated[float, Ge(0)] = 0.0
    """Simulated time of the first point, s."""

    @property
    def device(self) -> str:
        """Name of the device."""
        return self.channel.rpartition(".")[0]

    @property
    def output(self) -> str:
        """Name of the device's output."""
        return self.channel.rpartition(".")[2]


def stimulus_faults(
    stimulus: Stimulus, *, has_attitude: bool, lead_s_max: float
) -> Iterator[tuple[str, str]]:
    """
    Yield what is wrong beyond bounds: a field's name, and what.

    Args:
        stimulus: As it was written.
        has_attitude: Whether the vehicle has one.
        lead_s_max: How long ahead truth is there, s.
    """
    form = SOURCES[stimulus.source]
    if not stimulus.device or not stimulus.output:
        yield "channel", f"expected DEVICE.CHANNEL, got {stimulus.channel!r:.80}"
    if form.needs_attitude and not has_attitude:
        yield "source", f"{stimulus.source} needs a vehicle with attitude"
    for name, numbers in (("scale", stimulus.scale), ("bias", stimulus.bias)):
        if isinstance(numbers, tuple) and len(numbers) != form.size:
            text = f"expected one number, or {form.size} for {stimulus.source}, got {len(numbers)}"
            yield name, text
    if stimulus.limits is not None and not stimulus.limits[0] <= stimulus.limits[1]:
        yield (
            "limits",
            f"expected least and largest, got {stimulus.limits[0]:g} to {stimulus.limits[1]:g}",
        )
    if stimulus.lead_s > lead_s_max:
        yield (
            "lead_s",
            f"expected at most half of segments.buffer_s, {lead_s_max:g} s: no more truth is sure to be there",
        )
    if stimulus.alignment is not None:
        yield from _alignment_faults(stimulus, form)


def _alignment_faults(stimulus: Stimulus, form: SourceForm) -> Iterator[tuple[str, str]]:
    alignment = stimulus.alignment
    assert alignment is not None
    is_quaternion = len(alignment) == 4
    if not (form.is_body_vector or stimulus.source == "quaternion"):
        aligned = [s for s in get_args(StimulusSource) if SOURCES[s].needs_attitude]
        yield (
            "alignment",
            f"{stimulus.source} is in no body axes; only {', '.join(aligned)} are turned",
        )
    elif stimulus.source == "quaternion" and not is_quaternion:
        yield "alignment", "expected a quaternion for the source quaternion, got a matrix"
    elif (fault := alignment_fault(alignment, must_turn=False)) is not None:
        yield "alignment", fault
