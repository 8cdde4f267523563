"""
Which figures a stream gets: the one place to add a new one.

A builder takes the stream's table and the run, and returns the blocks of its section. A stream that
is not named here, such as one of a plug-in of your own, gets a time series for each of its numbers.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from cosmos_cli.report.figures.constellation import elements_blocks, invariants_blocks, state_blocks
from cosmos_cli.report.figures.generic import generic_blocks
from cosmos_cli.report.figures.health import health_blocks, process_blocks
from cosmos_cli.report.figures.links import (
    contact_blocks,
    link_blocks,
    message_blocks,
    refusal_blocks,
)
from cosmos_cli.report.figures.maneuvers import (
    command_blocks,
    estimate_blocks,
    maneuver_blocks,
    truth_change_blocks,
)
from cosmos_cli.report.figures.round_trips import round_trip_blocks
from cosmos_cli.report.figures.sensors import sensor_blocks
from cosmos_cli.report.figures.timing import clock_blocks, tick_blocks
from cosmos_cli.report.model import Block
from cosmos_cli.report.source import Source
from cosmos_cli.tables import TableReader

Builder = Callable[[TableReader, Source], list[Block]]


@dataclass(frozen=True, slots=True)
class Chapter:
    """A section's title and what fills it. Streams of one title share a section."""

    title: str
    build: Builder


FIGURES: dict[str, Chapter] = {
    "ticks": Chapter("Real time", tick_blocks),
    "round_trips": Chapter("Round trips", round_trip_blocks),
    "state": Chapter("Orbits", state_blocks),
    "elements": Chapter("Orbits", elements_blocks),
    "estimates": Chapter("Control", estimate_blocks),
    "host_maneuvers": Chapter("Control", maneuver_blocks),
    "commands": Chapter("Control", command_blocks),
    "command_results": Chapter("Control", command_blocks),
    "truth_changes": Chapter("Control", truth_change_blocks),
    "host_links": Chapter("Links", link_blocks),
    "messages": Chapter("Links", message_blocks),
    "refusals": Chapter("Links", refusal_blocks),
    "host_contacts": Chapter("Links", contact_blocks),
    **{
        name: Chapter("Sensors", sensor_blocks)
        for name in (
            "gnss",
            "gyro",
            "accelerometer",
            "magnetometer",
            "star_tracker",
            "sun_sensor",
        )
    },
    "host_invariants": Chapter("Health of the model", invariants_blocks),
    "machine_health": Chapter("State of health", health_blocks),
    "host_health": Chapter("State of health of the host", health_blocks),
    "process": Chapter("Processes", process_blocks),
    "clock": Chapter("Clock", clock_blocks),
}
"""By table name, in the order of the report; tables of the host are host_..., of machines machine_..."""

TEXT_STREAMS = ("events", "log", "host_events", "host_log")
"""Told in words, not drawn."""


def chapter_of(table: TableReader) -> Chapter:
    """Return the chapter of a table; an unknown stream gets one of its own."""
    known = FIGURES.get(table.name)
    return known or Chapter(f"Stream {table.name}", generic_blocks)
