"""What each run of a constellation commanded, spent, and believed of its slots."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from cosmos_cli.diff.recorded import Key, Recorded
from cosmos_cli.report.style import as_array
from cosmos_cli.spread import Spread, Stretch

ESTIMATES, COMMANDS, MANEUVERS = "estimates", "commands", "host_maneuvers"
SLOT_ERROR = "slot_error_deg"
SETTLED_SHARE = 0.1
"""The last part of a run, in which a controller has settled."""
GIVEN_FIELDS = ("delta_v_given_m_s", "dv_given_m_s", "given_m_s")


@dataclass(frozen=True, slots=True, kw_only=True)
class Effort:
    """What one run commanded and spent for one agent, or for all."""

    commanded_m_s: float = 0.0
    given_m_s: float | None = None
    """What the actuators really gave, as the host knows; None where it did not record it."""
    commands: int = 0


@dataclass(frozen=True, slots=True, kw_only=True)
class SlotError:
    """How far flight software of one run believed to be from its slot, deg."""

    rms_deg: float
    settled_rms_deg: float
    """Over the last tenth of the run."""
    last_deg: float
    count: int
    squares: float
    settled_count: int
    settled_squares: float


def efforts_of(streams: Mapping[Key, Recorded]) -> dict[str, Effort]:
    """Return what each agent commanded and what its actuators gave."""
    commanded: dict[str, list[float]] = {}
    given: dict[str, float] = {}
    for (table, source), recorded in streams.items():
        if table == COMMANDS and {"kind", "x", "y", "z"} <= set(recorded.names()):
            commanded[source] = _commanded(recorded)
        elif table == MANEUVERS:
            _add_given(recorded, given)
    agents = dict.fromkeys((*commanded, *given))
    return {
        agent: Effort(
            commanded_m_s=math.fsum(commanded.get(agent, ())),
            commands=len(commanded.get(agent, ())),
            given_m_s=given.get(agent, 0.0) if given else None,
        )
        for agent in agents
    }


def total_effort(efforts: Mapping[str, Effort]) -> Effort:
    """Return what all agents commanded and spent."""
    given = [one.given_m_s for one in efforts.values() if one.given_m_s is not None]
    return Effort(
        commanded_m_s=math.fsum(one.commanded_m_s for one in efforts.values()),
        commands=sum(one.commands for one in efforts.values()),
        given_m_s=math.fsum(given) if given else None,
    )


def total_slot_error(errors: Mapping[str, SlotError]) -> SlotError | None:
    """Return the slot error over all agents; None if nobody estimated one."""
    if not errors:
        return None
    every = errors.values()
    return _made_slot_error(
        sum(e.squares for e in every),
        sum(e.count for e in every),
        (sum(e.settled_squares for e in every), sum(e.settled_count for e in every)),
        math.sqrt(sum(e.last_deg**2 for e in every) / len(errors)),
    )


def slot_errors_of(
    streams: Mapping[Key, Recorded], tick_hz: float, duration_s: float, spread: Spread
) -> tuple[dict[str, SlotError], list[Stretch]]:
    """Return the slot error that each agent's flight software estimated, and that of all over time."""
    found = {}
    for (table, agent), recorded in streams.items():
        if table == ESTIMATES and SLOT_ERROR in recorded.names():
            error = _slot_error(recorded, tick_hz, (1.0 - SETTLED_SHARE) * duration_s, spread)
            if error is not None:
                found[agent] = error
    return found, spread.rows()


def _commanded(recorded: Recorded) -> list[float]:
    sizes: list[float] = []
    for columns in recorded.batches(("kind", "x", "y", "z")):
        vectors = np.column_stack([as_array(columns[axis]) for axis in "xyz"])
        is_delta_v = columns["kind"].astype(str) == "delta_v"
        sizes.extend(np.linalg.norm(vectors[is_delta_v], axis=1).tolist())
    return sizes


def _add_given(recorded: Recorded, given: dict[str, float]) -> None:
    """Add what the host's account of maneuvers says was given."""
    name = next((n for n in GIVEN_FIELDS if n in recorded.names()), None)
    if name is None or "agent" not in recorded.names():
        return
    for columns in recorded.batches(("agent", name)):
        values = np.nan_to_num(as_array(columns[name]))
        for agent, value in zip(columns["agent"].tolist(), values.tolist(), strict=True):
            given[str(agent)] = given.get(str(agent), 0.0) + value


def _slot_error(
    recorded: Recorded, tick_hz: float, settled_from_s: float, spread: Spread
) -> SlotError | None:
    count, squares, settled_count, settled_squares, last_deg = 0, 0.0, 0, 0.0, 0.0
    key = "tick" if "tick" in recorded.names() else "t_s"
    scale = 1.0 / tick_hz if key == "tick" else 1.0
    for columns in recorded.batches((key, SLOT_ERROR)):
        error_deg = as_array(columns[SLOT_ERROR])
        t_s = as_array(columns[key]) * scale
        is_there = np.isfinite(error_deg) & np.isfinite(t_s)
        error_deg, t_s = error_deg[is_there], t_s[is_there]
        if not len(error_deg):
            continue
        spread.add(t_s, error_deg)
        settled = error_deg[t_s >= settled_from_s]
        count += len(error_deg)
        squares += float(np.dot(error_deg, error_deg))
        settled_count += len(settled)
        settled_squares += float(np.dot(settled, settled))
        last_deg = float(error_deg[-1])
    if not count:
        return None
    return _made_slot_error(squares, count, (settled_squares, settled_count), last_deg)


def _made_slot_error(
    squares: float, count: int, settled: tuple[float, int], last_deg: float
) -> SlotError:
    return SlotError(
        rms_deg=math.sqrt(squares / count),
        settled_rms_deg=math.sqrt(settled[0] / settled[1]) if settled[1] else math.nan,
        last_deg=last_deg,
        count=count,
        squares=squares,
        settled_count=settled[1],
        settled_squares=settled[0],
    )
