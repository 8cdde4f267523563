"""All that is recorded: one place for names, fields and units. What is recorded beside it is a remark in run.json."""

from __future__ import annotations

from madns_runtime.plugin.api import DeclaredStream
from madns_runtime.recording.records import Field

from @MODULE@.parameters import RoverParameters

TRUTH = (Field("t_s", "s"), Field("agent", "", "str"), Field("position_m", "m"))
"""Where each rover is, as the host knows it."""
DRIVE = (Field("tick", "", "int"), Field("measured_m", "m"), Field("speed_m_s", "m/s"))
"""Measurements and commands of a rover."""


def declared_streams(
    parameters: RoverParameters, agents: tuple[str, ...]
) -> list[DeclaredStream]:
    """Return every stream that either half may open."""
    return [
        DeclaredStream(role="host", name="truth", fields=TRUTH),
        DeclaredStream(role="agent", name="drive", fields=DRIVE),
    ]
