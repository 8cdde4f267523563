"""
Commands that a device gives, as a person writes them in a scenario: which channel, and what its values command.

As in `equipment`: frozen dataclasses with bounds, the standard library and annotated_types alone. Nobody's side.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, Literal

from annotated_types import Ge, Gt, MinLen

Row = tuple[float, float, float]
VECTOR_SIZE = 3
"""Numbers of a channel whose values are vectors."""
COMMANDS_WITH_TIME = ("torque", "dipole")
"""Those that last for a time."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Actuation:
    """A channel of a device whose values become commands, by the rules of those of flight software."""

    channel: Annotated[str, MinLen(3)]
    """Device and input, such as valve.line: of one number, or of three. Its newest sample counts, each sample once."""
    command: Literal["delta_v", "torque", "dipole"]
    """delta_v, m/s; torque, N m; dipole, A m^2."""
    vector: Row | None = None
    """Command of a value of 1, for a channel of one number."""
    matrix: tuple[Row, Row, Row] | None = None
    """Command from the values of a channel of three: its rows give x, y and z; none for the values themselves."""
    scale: float = 1.0
    """Factor on the command."""
    threshold: Annotated[float, Ge(0)] = 0.0
    """A sample whose magnitude is not above it commands nothing."""
    duration_s: Annotated[float, Gt(0)] | None = None
    """Of a torque or a dipole, s."""
    frame: Literal["inertial", "rtn", "body"] = "rtn"
    """Of a delta_v; torques and dipoles are in body axes."""
    lead_s: Annotated[float, Ge(0)] | None = None
    """From the tick that finds the sample to execution, s; none for one tick. A shorter one than the host needs is
    treated as `maneuvers.late` says."""


def actuation_faults(
    actuation: Actuation, *, has_attitude: bool, has_torquers: bool
) -> Iterator[tuple[str, str]]:
    """Yield field and what is wrong of each fault of an entry, whatever its device."""
    device, _, channel = actuation.channel.rpartition(".")
    if not device or not channel:
        yield (
            "channel",
            f"expected a device and its input such as valve.line, got {actuation.channel!r:.80}",
        )
    if actuation.vector is not None and actuation.matrix is not None:
        yield (
            "matrix",
            "is for a channel of three numbers, and vector for a channel of one: give one of them",
        )
    numbers = [actuation.scale, *(actuation.vector or ())]
    numbers += [number for row in actuation.matrix or () for number in row]
    if not all(map(math.isfinite, numbers)) or not actuation.scale:
        yield "scale", "expected finite numbers, and a scale other than 0"
    is_lasting = actuation.command in COMMANDS_WITH_TIME
    if is_lasting and actuation.duration_s is None:
        yield "duration_s", f"a {actuation.command} needs one"
    if not is_lasting and actuation.duration_s is not None:
        yield "duration_s", "a delta_v takes as long as the thruster needs: leave it out"
    needs_attitude = is_lasting or actuation.frame == "body"
    if needs_attitude and not has_attitude:
        yield "command", "needs a vehicle with attitude"
    elif actuation.command == "dipole" and not has_torquers:
        yield "command", "needs a vehicle with attitude.magnetorquers"
