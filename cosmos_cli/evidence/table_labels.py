"""
Columns that tables bear beside what was recorded: UTC of simulated time, and the second names of agents.

Simulated time zero is the `epoch_utc` of the host's summary, or else of the parameters; of a simulation that knows none
it is the moment at which the run began, as its host recorded it. In lockstep, where records tell no wall time, that is 1970-01-01T00:00:00Z.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cosmos_cli.evidence.run_directory import RunDirectory
from cosmos_cli.models.agent_labels import NO_LABELS as AGENTS_UNLABELLED
from cosmos_cli.models.agent_labels import AgentLabels
from madns_runtime.config import RunConfig, from_mapping
from madns_runtime.errors import ConfigurationError
from madns_runtime.plain_values import mapping_at

EPOCH = "epoch_utc"
LOCKSTEP_ZERO_UTC = "1970-01-01T00:00:00Z"
ZERO_OFF_H_MAX = 1.0
"""Time between a run's start and its simulated time zero that no remark is made of: to load and to set up takes less."""
US_PER_S = 1e6
NEVER_US = np.iinfo(np.int64).min
YEARS_US = 1e17
"""Simulated times beyond 3000 years have no UTC."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TableLabels:
    """Labels of one run's tables; without any nothing is added."""

    zero_utc: datetime | None = None
    """UTC of simulated time zero."""
    agents: AgentLabels = AGENTS_UNLABELLED
    """Second names of agents."""

    @classmethod
    def of(
        cls,
        config: RunConfig | None,
        result: Mapping[str, Any] | None,
        plan: Mapping[str, Any] | None = None,
    ) -> TableLabels:
        """
        Return the labels of a run.

        Args:
            config: Its settings.
            result: What the host reported at its end; None if it could not.
            plan: Its plan.json.
        """
        zero_utc = _parse_utc(_told_zero(config, result or {}))
        return cls(zero_utc=zero_utc, agents=agent_labels(plan, result))

    def utc_us(self, t_s: NDArray[np.float64]) -> NDArray[np.int64]:
        """Return microseconds since 1970 UTC at simulated times, shape (N,), s; NEVER_US where there is no time."""
        assert self.zero_utc is not None
        zero_us = round(self.zero_utc.timestamp() * US_PER_S)
        with np.errstate(over="ignore"):  # of what diverged
            after_us = t_s * US_PER_S
        is_time = np.abs(after_us) < YEARS_US  # false for NaN
        whole = np.where(is_time, np.rint(np.where(is_time, after_us, 0.0)), 0.0).astype(np.int64)
        return np.where(is_time, zero_us + whole, NEVER_US)


def agent_labels(plan: Mapping[str, Any] | None, result: Mapping[str, Any] | None) -> AgentLabels:
    """
    Return the second names of a run's agents.

    Args:
        plan: Its plan.json.
        result: What its host reported: earlier runs, whose plan tells no names, have those of satellites there.
    """
    listed = (plan or {}).get("labels")
    if isinstance(listed, Mapping):
        try:
            return from_mapping(AgentLabels, listed)
        except ConfigurationError:
            return AGENTS_UNLABELLED
    told = mapping_at(result, "simulation", "satellites")
    agents = mapping_at(result, "agents")
    names = {agent: str(name) for agent, name in told.items() if agent in agents}
    return AgentLabels(column="satellite", names=names) if names else AGENTS_UNLABELLED


def run_labels(run: RunDirectory) -> AgentLabels:
    """Return the second names of a run's agents, whatever its simulation is now."""
    return agent_labels(run.read_json(run.plan_json), run.read_json(run.result_json))


def time_zero_remarks(
    config: RunConfig | None, result: Mapping[str, Any], started_utc: object = None
) -> tuple[str, ...]:
    """
    Return a remark where simulated time zero is told, and is no time that tables could tell, or far from the run's start.

    Args:
        config: The run's; None where it is lost.
        result: What its host reported.
        started_utc: When the run was started, by the clock of the computer that did; ISO 8601.
    """
    told = _told_zero(config, result)
    if told is None:
        return ()
    if (zero := _parse_utc(told)) is not None:
        start = _parse_utc(started_utc)
        if start is None or not _is_by_a_clock(config, result):
            return ()
        ahead_h = (zero - start).total_seconds() / 3600
        if abs(ahead_h) <= ZERO_OFF_H_MAX:
            return ()
        side = "after" if ahead_h > 0 else "before"
        return (
            f"simulated_utc in tables, and utc of what the host recorded, are by the clock of the host's machine: to it the run began"
            f" {abs(ahead_h):.0f} h {side} it was started here; let a time service set the one that is wrong",
        )
    expected = f"expected an {EPOCH} such as 2017-03-07T12:00:00Z, got {told!r:.80}"
    return (f"tables have no simulated_utc: {expected}",)


def _is_by_a_clock(config: RunConfig | None, result: Mapping[str, Any]) -> bool:
    """Tell whether simulated time zero is what the clock of the host's machine showed."""
    return not _epochs(config, result) and not (config is not None and config.time.is_lockstep)


def _epochs(config: RunConfig | None, result: Mapping[str, Any]) -> list[object]:
    places = (mapping_at(result, "simulation"), config.parameters if config else {})
    return [place[EPOCH] for place in places if EPOCH in place]


def _told_zero(config: RunConfig | None, result: Mapping[str, Any]) -> object:
    if epochs := _epochs(config, result):
        return next(filter(None, epochs), None)
    if config is not None and config.time.is_lockstep:
        return LOCKSTEP_ZERO_UTC
    return result.get("t0_utc")


def _parse_utc(text: object) -> datetime | None:
    if not isinstance(text, str):
        return None
    try:
        told = datetime.fromisoformat(text)
        return told.replace(tzinfo=UTC) if told.tzinfo is None else told.astimezone(UTC)
    except (
        ValueError,
        OverflowError,
    ):  # the latter of a zone that leads out of the years 1 to 9999
        return None
