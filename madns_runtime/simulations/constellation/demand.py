"""What a constellation asks of host and network, for the inequalities 2.7-2.10: encoded and timed, not guessed."""

from __future__ import annotations

import math
import statistics
import time
from pathlib import Path

from madns_runtime.plugin.api import Demand, Flow
from madns_runtime.protocol.codec import pack
from madns_runtime.simulations.constellation.messages import Segment
from madns_runtime.simulations.constellation.orbit.constants import GRAVITY_MODELS
from madns_runtime.simulations.constellation.parameters import ConstellationParameters
from madns_runtime.simulations.constellation.truth.fleet import load_fleet
from madns_runtime.simulations.constellation.truth.propagation import (
    PropagationParameters,
    StretchRequest,
    propagate_stretch,
)

TIMINGS = 5
"""Timed propagations; the median is taken, after one that pays for imports."""


def estimate_demand(
    parameters: ConstellationParameters, agents: int, tick_hz: float, base_directory: Path
) -> Demand:
    """
    Return the terms of the inequalities, with one window of truth propagated here to time it.

    T_bi is half a buffer: an agent that is refilled at half has no more, and each batch brings no
    more. Truth goes to the agents and nothing comes back, so the tick rate costs no traffic.

    Raises:
        ConfigurationError: The satellites cannot be loaded.
        MissingExtraError: scipy or sgp4 is not installed.
    """
    fleet = load_fleet(parameters, agents, Path(base_directory))
    knot_s = parameters.segments.knot_s
    intervals = max(1, round(parameters.segments.buffer_s / 2.0 / knot_s))
    request = StretchRequest(first_knot=0, knots=intervals + 1, knot_s=knot_s, states=fleet.states)
    propagation = PropagationParameters(
        settings=parameters.propagator,
        gravity=GRAVITY_MODELS[parameters.gravity],
        epoch_utc=fleet.epoch_utc,
        element_sets=fleet.element_sets,
    )
    stretch = propagate_stretch(request, propagation)
    timings_s = []
    for _ in range(TIMINGS):
        started_s = time.perf_counter()
        propagate_stretch(request, propagation)
        timings_s.append(time.perf_counter() - started_s)
    segment = Segment(revision=0, t0_s=0.0, knot_s=knot_s, states=stretch.states[0])
    segment_bytes = len(pack(segment.to_message()))
    window_s = intervals * knot_s
    return Demand(
        flows=(Flow(name="segment", message_bytes=segment_bytes, rate_hz=1.0 / window_s),),
        buffer_s=window_s,
        batch_bytes=segment_bytes,
        batch_compute_s=statistics.median(timings_s) / agents,
        sync_bytes=0,
        sync_compute_s=0.0,
        sync_rate_hz=0.0,
        lead_s=math.inf,
        measured=True,
    )
