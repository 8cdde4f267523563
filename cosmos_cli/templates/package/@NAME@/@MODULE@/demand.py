"""Demands of the simulation on host and network: `cosmos plan` holds them against the machines."""

from __future__ import annotations

import math
from pathlib import Path

from madns_runtime.plugin.api import Demand, Flow

from @MODULE@.host import TRUTH_STEP_S
from @MODULE@.parameters import RoverParameters

MESSAGE_BYTES = 32


def demand(
    parameters: RoverParameters, agents: int, tick_hz: float, base_directory: Path
) -> Demand:
    """Return the flows of one rover; it needs no data ahead of time."""
    return Demand(
        flows=(
            Flow(name="measurements", message_bytes=MESSAGE_BYTES, rate_hz=1.0 / TRUTH_STEP_S),
            Flow(name="commands", message_bytes=MESSAGE_BYTES, rate_hz=tick_hz),
        ),
        buffer_s=math.inf,
        batch_bytes=0,
        batch_compute_s=0.0,
        sync_bytes=0,
        sync_compute_s=0.0,
        sync_rate_hz=0.0,
        lead_s=0.0,
        measured=False,
    )
