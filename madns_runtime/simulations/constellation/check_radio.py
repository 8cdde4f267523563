"""Faults in names by which messages go: of ground stations, of the receivers of uplinks, and of vehicles that no message reaches."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from madns_runtime.plain_values import LINE_CHARACTERS_MAX, is_line, shown
from madns_runtime.simulations.constellation.messages import GROUND, is_for_ground
from madns_runtime.simulations.constellation.parameters import ConstellationParameters


def radio_faults(
    parameters: ConstellationParameters, names: Sequence[tuple[str, str]]
) -> list[str]:
    """
    Return the faults.

    Args:
        parameters: Of the scenario, within their bounds.
        names: Names of each agent and of its satellite; empty if they are not known.
    """
    return [
        *_station_faults(parameters),
        *_uplink_faults(parameters, names),
        *_unreachable_faults(parameters, names),
    ]


def _station_faults(parameters: ConstellationParameters) -> list[str]:
    faults = []
    known: set[str] = set()
    for number, station in enumerate(parameters.stations):
        field = f"parameters.stations[{number}].name"
        if not is_line(station.name):
            faults.append(
                f"{field}: expected a name of at most {LINE_CHARACTERS_MAX} printable characters, got {shown(station.name)}"
            )
        elif station.name in known:
            faults.append(f"{field}: expected every name once, got {station.name!r} again")
        known.add(station.name)
    return faults


def _uplink_faults(
    parameters: ConstellationParameters, names: Sequence[tuple[str, str]]
) -> list[str]:
    faults = []
    if parameters.uplinks and not parameters.stations:
        faults.append("parameters.uplinks: need parameters.stations to leave from")
    agents = {agent for agent, _ in names}
    satellites = Counter(satellite for _, satellite in names)
    for number, uplink in enumerate(parameters.uplinks):
        field = f"parameters.uplinks[{number}].to"
        if not names or uplink.to in agents:
            continue
        if uplink.to not in satellites:
            faults.append(f"{field}: no agent and no satellite is called {uplink.to!r}")
        elif satellites[uplink.to] > 1:
            faults.append(
                f"{field}: {satellites[uplink.to]} satellites are called {uplink.to!r}: name the agent"
            )
    return faults


def _unreachable_faults(
    parameters: ConstellationParameters, names: Sequence[tuple[str, str]]
) -> list[str]:
    """Return a fault if agents, and one if satellites, have names that mean ground stations to whoever sends."""
    if parameters.crosslinks is None and not parameters.stations:
        return []
    faults = []
    radio = "stations" if parameters.crosslinks is None else "crosslinks"
    for field, what, place in ((radio, "agent", 0), ("satellites", "satellite", 1)):
        taken = [pair[place] for pair in names if is_for_ground(pair[place])]
        if taken:
            more = f" (nor {len(taken) - 1} more)" if len(taken) > 1 else ""
            faults.append(
                f"parameters.{field}: no message reaches the {what} named {taken[0]!r}{more}: {GROUND} and "
                f"{GROUND}:NAME mean ground stations; give it another name"
            )
    return faults
