"""How a recorded benchmark is flown again: as it is. What it measured was the network, which lockstep has none of."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from madns_runtime.plugin.api import Rerun
from madns_runtime.simulations.counter.parameters import CounterParameters

UNLIKE: Final = ("round_trips.round_trip_us", "answer_round_trips", "device_samples")
"""Times of messages, and the host's streams, whose records stand in the order in which messages came."""


def for_rerun(parameters: CounterParameters, agents: tuple[str, ...], run_directory: Path) -> Rerun:
    """Return the same parameters, and what depends on the network."""
    return Rerun(parameters=parameters, unlike=UNLIKE)
