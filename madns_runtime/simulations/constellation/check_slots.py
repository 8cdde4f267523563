"""
Faults in what a scenario says of slots: they must be there to be recorded, and have a place to be counted from.

As in `check`: neither scipy nor numpy.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from madns_runtime.simulations.constellation.parameters import ConstellationParameters
from madns_runtime.simulations.constellation.truth.satellite_selection import SatelliteSelection
from madns_runtime.simulations.constellation.vehicles import (
    SLOTS,
    flight_of,
    rules_with_even_slots,
)

INCLINATIONS_DEG = (0.1, 179.9)
"""Of satellites with slots: where planes are nearer the equator, a thousandth of a degree between two turns a node by half a degree."""


def slot_record_faults(parameters: ConstellationParameters) -> list[str]:
    """Return why slot errors cannot be recorded."""
    if parameters.record.slots_hz is None:
        return []
    rules = rules_with_even_slots(parameters)
    if not rules:
        return [
            "parameters.record.slots_hz: expected flight software with settings {slots: even}, got none; "
            "drop it, or let parameters.flight say so"
        ]
    spacings = [rule.settings.get("spacing_deg") for rule in rules]
    for spacing in spacings:
        if spacing is not None and type(spacing) not in (int, float):
            return [
                "parameters.record.slots_hz: expected a number of degrees as spacing_deg in settings with slots: even, "
                f"got {spacing!r:.80}"
            ]
    if any(spacing != spacings[0] for spacing in spacings):
        told = ", ".join(sorted({*map(str, spacings)}))
        return [
            f"parameters.record.slots_hz: expected one spacing_deg in all settings with slots: even, got {told}"
        ]
    return []


def node_faults(
    parameters: ConstellationParameters, chosen: SatelliteSelection, names: Sequence[str]
) -> list[str]:
    """
    Return why phases of satellites with slots cannot be counted, each from its own ascending node.

    Args:
        parameters: Of the scenario.
        chosen: Its satellites, one per agent.
        names: The agents' names; nothing is judged without them.
    """
    inclinations_deg = [one.inclination_deg for one in chosen.element_sets]
    inclinations_rad = [*map(math.radians, inclinations_deg)] or [o.i_rad for o in chosen.orbits]
    low_rad, high_rad = map(math.radians, INCLINATIONS_DEG)
    flat = [
        (satellite, math.degrees(i_rad))
        for agent, satellite, i_rad in zip(names, chosen.names, inclinations_rad, strict=False)
        if not low_rad <= i_rad <= high_rad
        and (rule := flight_of(parameters, agent, satellite)) is not None
        and rule.settings.get("slots") in SLOTS
    ]
    if not flat:
        return []
    satellite, inclination_deg = flat[0]
    more = f" and {len(flat) - 1} more" if len(flat) > 1 else ""
    low_deg, high_deg = INCLINATIONS_DEG
    return [
        f"parameters.satellites: expected inclinations of {low_deg:g} to {high_deg:g} deg with flight software whose "
        f"settings say slots, got {inclination_deg:g} of {satellite}{more}: phases are counted from the ascending node, "
        "which an orbit in the equator does not have; incline it, or drop the setting if this software keeps no slots"
    ]
