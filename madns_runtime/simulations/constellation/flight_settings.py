"""
Rules of flight software, as a person writes them in a scenario.

As in `parameters`: frozen dataclasses with bounds, the standard library and annotated_types alone.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Literal

from annotated_types import Gt, Le, MinLen

from madns_runtime.simulations.constellation.interface_settings import FlightInterface

Setting = bool | int | float | str | list[int] | list[float] | list[str]
"""A value of one's own that a scenario hands to code of one's own."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FlightClass:
    """Flight software in Python: one class in one file."""

    software: Annotated[str, MinLen(3)]
    """guidance.py:Guidance beside the scenario, or module:Class."""
    agents: Annotated[tuple[str, ...], MinLen(1)] = ("*",)
    """Globs of agents' or satellites' names that fly it; the others are not commanded."""
    input: Literal["measurements", "truth"] = "measurements"
    """Input at every tick."""
    rate_hz: Annotated[float, Gt(0), Le(100_000)] | None = None
    """Its own rate, Hz: one that divides agents.tick_hz or is a whole multiple of it; none for a step at every tick."""
    settings: dict[str, Setting] = field(default_factory=dict)
    """For the class to read: context.settings."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FlightProcess:
    """Flight software in any language: a program that speaks JSON lines on stdin and stdout, or as `interface` says."""

    command: Annotated[tuple[str, ...], MinLen(1)]
    """The program and its arguments; a relative path is found from the scenario's folder."""
    agents: Annotated[tuple[str, ...], MinLen(1)] = ("*",)
    """Globs of agents' or satellites' names that fly it."""
    input: Literal["measurements", "truth"] = "measurements"
    """Input at every tick."""
    rate_hz: Annotated[float, Gt(0), Le(100_000)] | None = None
    """Its own rate, Hz: one that divides agents.tick_hz or is a whole multiple of it; none for a step at every tick."""
    settings: dict[str, Setting] = field(default_factory=dict)
    """In the first line that it reads."""
    answer_s: Annotated[float, Gt(0)] = 1.0
    """Time for the answer to a tick; in real time a later one is counted as late and taken when it comes."""
    environment: dict[str, str] = field(default_factory=dict)
    """Variables of the program's environment beside the agent's own."""
    interface: FlightInterface | None = None
    """Way to the program; none for JSON lines on its standard input and output."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FlightAttached:
    """Flight software that runs already: on a board, in an emulator, started by hand."""

    interface: FlightInterface
    """Way to it."""
    agents: Annotated[tuple[str, ...], MinLen(1)] = ("*",)
    """Globs of agents' or satellites' names that fly it."""
    input: Literal["measurements", "truth"] = "measurements"
    """Input at every tick."""
    rate_hz: Annotated[float, Gt(0), Le(100_000)] | None = None
    """Its own rate, Hz: one that divides agents.tick_hz or is a whole multiple of it; none for a step at every tick."""
    settings: dict[str, Setting] = field(default_factory=dict)
    """Told with its setup."""
    answer_s: Annotated[float, Gt(0)] = 1.0
    """Time for the answer to a tick; in real time a later one is counted as late and taken when it comes."""


FlightRule = FlightClass | FlightProcess | FlightAttached
"""Flight software of some of the vehicles."""
