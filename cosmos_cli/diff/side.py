"""One of the two runs that are compared: its summary, its settings, and the streams it recorded."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from cosmos_cli.diff.recorded import Key, Recorded, recorded_streams
from cosmos_cli.errors import InputError
from cosmos_cli.expectation import mapping_at
from cosmos_cli.rundir import RunDirectory
from cosmos_cli.verdict import is_number


@dataclass(frozen=True, slots=True, kw_only=True)
class Side:
    """One run."""

    run: RunDirectory
    document: Mapping[str, Any]
    """run.json."""
    settings: Mapping[str, Any]
    """What every process of the run was told: the scenario with its defaults."""
    streams: Mapping[Key, Recorded]

    @property
    def simulation(self) -> str:
        """Name of what was simulated."""
        return str(self.settings.get("simulation"))

    @property
    def tick_hz(self) -> float:
        """Ticks a second of every agent."""
        value = mapping_at(self.settings, "agents").get("tick_hz")
        return float(value) if is_number(value) and value else 1.0

    @property
    def duration_s(self) -> float:
        """Simulated time that the run was to have, s."""
        value = mapping_at(self.settings, "time").get("duration_s")
        return float(value) if is_number(value) else 0.0

    @property
    def missing(self) -> tuple[str, ...]:
        """What of its data is missing or cut, as its verdict names it."""
        lines = mapping_at(self.document, "data").get("missing", ())
        return tuple(str(line) for line in lines)


def open_side(run: RunDirectory, given: str) -> Side:
    """
    Open a run for comparison.

    Args:
        run: The run.
        given: What a person called it, for advice.

    Raises:
        InputError: It is not collected yet, or what it ran is not known any more.
    """
    document = run.read_json(run.run_json)
    if document is None or document.get("status") == "running":
        raise InputError(f"{run.name} is not collected yet; do that with: cosmos collect {given}")
    settings = (run.read_json(run.plan_json) or {}).get("config")
    if not isinstance(settings, Mapping) or "simulation" not in settings:
        raise InputError(
            f"{run.plan_json}: expected the run's settings under config, found none;"
            f" without them {run.name} cannot be compared"
        )
    return Side(run=run, document=document, settings=settings, streams=recorded_streams(run))


def check_comparable(a: Side, b: Side) -> None:
    """
    Refuse runs that have nothing to compare.

    Raises:
        InputError: They are of different simulations.
    """
    if a.simulation != b.simulation:
        raise InputError(
            f"expected two runs of one simulation, got {a.run.name} of {a.simulation}"
            f" and {b.run.name} of {b.simulation}"
        )
