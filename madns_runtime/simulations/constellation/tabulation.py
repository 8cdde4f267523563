"""Tables of truth at any times from the host's own record; asked for by the operator's side through the descriptor."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from madns_runtime.errors import ConfigurationError, MachineError
from madns_runtime.plugin.api import Tabulated
from madns_runtime.recording.reader import StreamReading
from madns_runtime.recording.records import Field
from madns_runtime.simulations.constellation.streams import ATTITUDE, STATE, TRUTH
from madns_runtime.simulations.constellation.truth.segment_records import TruthHistory

FILE = "truth.jsonl"
HELD_BYTES_MAX = 256 << 20
"""Of records held at a time: a larger file is read in several passes, each for some of the agents."""
ROWS_MAX = 1 << 17
"""Rows made at a time."""
_AGENT, _ATTITUDE = ([field.name for field in TRUTH].index(name) for name in ("agent", "attitude"))


def tabulate_truth(
    host_directory: Path, agents: tuple[str, ...], times_s: NDArray[np.float64]
) -> Iterator[Tabulated]:
    """
    Yield the truth of agents' vehicles at ascending times.

    Args:
        host_directory: Where the host's streams are.
        agents: Whose.
        times_s: Simulated times, s.

    Raises:
        ConfigurationError: There is none.
        MachineError: The record cannot be read, or one in it is none of truth.
    """
    path = host_directory / FILE
    if not path.exists():
        raise ConfigurationError(
            f"{path}: this run recorded no truth, or its record was deleted; truth is recorded unless the"
            " scenario's parameters say otherwise: run it again with --set parameters.record.truth=true"
        )
    reading = StreamReading(path)
    size = reading.path.stat().st_size
    share = max(1, math.floor(len(agents) / max(1, math.ceil(size / HELD_BYTES_MAX))))
    attitude = ATTITUDE[1:] if _has_attitude(reading) else ()
    fields = (*STATE[1:], *attitude)
    for first in range(0, len(agents), share):
        histories = read_histories(reading, agents[first : first + share])
        for agent in agents[first : first + share]:
            yield from _rows(agent, histories.pop(agent), times_s, fields)


def read_histories(reading: StreamReading, agents: tuple[str, ...]) -> dict[str, TruthHistory]:
    """
    Return what is on record of agents' vehicles.

    Raises:
        MachineError: The record cannot be read, or one in it is none of truth.
    """
    names = [field.name for field in TRUTH]
    if list(reading.field_names[: len(names)]) != names:
        raise MachineError(f"{reading.path}: expected a record of truth, with {', '.join(names)}")
    histories = {agent: TruthHistory() for agent in agents}
    for record in reading.records():
        history = histories.get(record[_AGENT]) if isinstance(record[_AGENT], str) else None
        if history is None:
            continue
        try:
            history.add(record[: len(names)])
        except (TypeError, ValueError) as error:
            raise MachineError(f"{reading.path}: {record[_AGENT]}: {error}") from error
    return histories


def _has_attitude(reading: StreamReading) -> bool:
    """Tell whether any vehicle on record is a rigid body."""
    return any(
        record[_ATTITUDE] is not None for record in reading.records() if len(record) > _ATTITUDE
    )


def _rows(
    agent: str,
    history: TruthHistory,
    times_s: NDArray[np.float64],
    fields: tuple[Field, ...],
) -> Iterator[Tabulated]:
    for first in range(0, len(times_s), ROWS_MAX):
        part_s = times_s[first : first + ROWS_MAX]
        table = history.tabulate(part_s)
        # A point mass among rigid bodies has no attitude.
        absent = np.full(len(part_s), np.nan)
        columns = {
            field.name: table[:, column] if column < table.shape[1] else absent
            for column, field in enumerate(fields)
        }
        yield Tabulated(agent=agent, fields=fields, times_s=part_s, columns=columns)
