"""One of two compared runs: its summary, its settings, and the streams it recorded."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from cosmos_cli.collect.finished_run import (
    collected_document,
    is_as_listed,
    refuse_foreign_tables,
)
from cosmos_cli.collect.previous_manifest import Earlier, is_there
from cosmos_cli.diff.recorded import Key, Recorded, recorded_streams
from cosmos_cli.errors import InputError
from cosmos_cli.evidence.run_directory import RunDirectory
from cosmos_cli.evidence.streams import SUFFIX
from cosmos_cli.evidence.verdict import is_number
from madns_runtime.config import to_mapping
from madns_runtime.plain_values import mapping_at


@dataclass(frozen=True, slots=True, kw_only=True)
class Side:
    """One run."""

    run: RunDirectory
    document: Mapping[str, Any]
    """run.json."""
    settings: Mapping[str, Any]
    """Settings of every process of the run: the scenario with its defaults."""
    streams: Mapping[Key, Recorded]
    missing: tuple[str, ...]
    """Data that are missing or cut, as its verdict names them, or since it was collected."""

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
    def agents(self) -> tuple[str, ...]:
        """Names of the run's agents, those that recorded nothing as well."""
        config = self.run.read_config()
        planned = config.agents.resolved_names() if config else ()
        recorded = [key[1] for key, one in self.streams.items() if one.role == "agent"]
        return tuple(dict.fromkeys((*planned, *recorded)))

    @property
    def stream_names(self) -> frozenset[str]:
        """Names of what it recorded, as streams and as tables."""
        return frozenset(name for one in self.streams.values() for name in (one.stream, one.table))

    @property
    def status(self) -> str:
        """How the run ended, as run.json tells it."""
        return str(self.document.get("status"))

    @property
    def is_complete(self) -> bool:
        """Whether it came to its end: of another run nobody knows how much simulated time it had."""
        return self.status == "complete"

    @property
    def duration_s(self) -> float:
        """Simulated time that the run was to have, s: a stop shortens it."""
        given = (
            mapping_at(self.settings, "time").get("duration_s"),
            self.document.get("duration_s"),
        )
        return min((float(value) for value in given if is_number(value)), default=0.0)


def open_side(run: RunDirectory, given: str) -> Side:
    """
    Open a run for comparison.

    Args:
        run: The run.
        given: What a person called it, for advice.

    Raises:
        InputError: It is not collected yet, has a table that it did not make, or what it ran is not known any more.
    """
    document = collected_document(run, given)
    refuse_foreign_tables(run)
    config = run.read_config()
    # By way of the class, which knows the old names of keys.
    settings = to_mapping(config) if config else (run.read_json(run.plan_json) or {}).get("config")
    if not isinstance(settings, Mapping) or "simulation" not in settings:
        raise InputError(
            f"{run.plan_json}: expected the run's settings under config, found none;"
            f" without them {run.name} cannot be compared"
        )
    listed = mapping_at(document, "data").get("missing")
    told = listed if isinstance(listed, list) else ()
    return Side(
        run=run,
        document=document,
        settings=settings,
        streams=recorded_streams(run),
        missing=(*map(str, told), *_changed_since(run)),
    )


def _changed_since(run: RunDirectory) -> Iterator[str]:
    """Tell of files that are gone or changed; of streams by their length alone, as they are hashed when they are read."""
    for name, entry in Earlier.read(run).entries.items():
        if name.startswith(f"{run.tables.name}/"):
            continue  # can be made anew
        path, was = run.path / name, entry.get("bytes")
        if not is_there(run, name):
            yield f"{name}: missing; it was there when the run was collected"
        elif not name.endswith(SUFFIX):
            if "sha256" in entry and not is_as_listed(entry, path):
                yield f"{name}: changed since the run was collected"
        elif (now := path.stat().st_size) != was:
            yield f"{name}: changed since the run was collected ({now} bytes, were {was})"


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
