"""All that is recorded, and what cars are called."""

from __future__ import annotations

from pathlib import Path

from madns_runtime.plugin.api import DeclaredStream
from madns_runtime.recording.records import Field
from ring_cars.parameters import RingParameters

ROAD = (
    Field("t_s", "s"),
    Field("agent", "", "str"),
    Field("driven_m", "m"),
    Field("speed_m_s", "m/s"),
    Field("gap_m", "m"),
)
"""Truth of each car: how far it drove since the first car's start, and its gap to the car ahead."""
DRIVE = (
    Field("tick", "", "int"),
    Field("speed_m_s", "m/s"),
    Field("heard_gap_m", "m"),
    Field("acceleration_m_s2", "m/s^2"),
)
"""A car's speed as measured, what it believed of its gap, and what it commanded."""
HEARD = (Field("tick", "", "int"), Field("sender", "", "str"), Field("driven_m", "m"))
"""What each car in reach said of itself."""
REFUSED = (Field("number", "", "int"), Field("reason", "", "str"))
"""Messages that the medium refused."""


def declared_streams(parameters: RingParameters, agents: tuple[str, ...]) -> list[DeclaredStream]:
    """Return every stream that either half may open."""
    return [
        DeclaredStream(role="host", name="road", fields=ROAD),
        DeclaredStream(role="agent", name="drive", fields=DRIVE),
        DeclaredStream(role="agent", name="heard", fields=HEARD),
        DeclaredStream(role="agent", name="refused", fields=REFUSED),
    ]


def name_cars(
    parameters: RingParameters, agents: tuple[str, ...], base_directory: Path
) -> dict[str, str]:
    """Return the plate of each agent's car."""
    return {agent: f"RING {number}" for number, agent in enumerate(agents, 1)}
