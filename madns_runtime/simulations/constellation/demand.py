"""Demands of a constellation on host and network, for the inequalities 2.7-2.10: encoded and timed, not guessed."""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from madns_runtime.plugin.api import Demand, Flow
from madns_runtime.protocol.codec import pack
from madns_runtime.simulations.constellation.messages import Command, Segment
from madns_runtime.simulations.constellation.orbit.constants import GRAVITY_MODELS
from madns_runtime.simulations.constellation.parameters import ConstellationParameters, Maneuvers
from madns_runtime.simulations.constellation.truth.initial_states import load_fleet
from madns_runtime.simulations.constellation.truth.maneuvers.effects import Effect
from madns_runtime.simulations.constellation.truth.propagation import (
    PropagationParameters,
    StretchRequest,
    propagate_stretch,
)
from madns_runtime.simulations.constellation.truth.vehicle_propagation import (
    VehicleRequest,
    propagate_vehicle,
)
from madns_runtime.simulations.constellation.vehicles import flight_rules

TIMINGS = 5
"""Timed propagations; the median is taken, after one that pays for imports."""
COMMANDS_HZ = 1.0
"""Commands of one vehicle that are planned for: flight software does not say how many it will give."""


def estimate_demand(
    parameters: ConstellationParameters, agents: int, tick_hz: float, base_directory: Path
) -> Demand:
    """
    Return the terms of the inequalities, with truth propagated here to time it.

    T_bi is half a buffer: an agent that is refilled at half has no more, and each batch brings no
    more. Truth goes to the agents and nothing comes back but commands, so the tick rate costs no
    traffic.

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
        base_directory=str(base_directory),
    )
    stretch, batch_s = _timed(propagate_stretch, request, propagation)
    segment = Segment(revision=0, t0_s=0.0, knot_s=knot_s, states=stretch.states[0])
    segment_bytes = len(pack(segment.to_message()))
    window_s = intervals * knot_s
    demand = Demand(
        flows=(Flow(name="segment", message_bytes=segment_bytes, rate_hz=1.0 / window_s),),
        buffer_s=window_s,
        batch_bytes=segment_bytes,
        batch_compute_s=batch_s / agents,
        sync_bytes=0,
        sync_compute_s=0.0,
        sync_rate_hz=0.0,
        lead_s=math.inf,
        measured=True,
    )
    is_commanded = any(vehicle.actuation for vehicle in parameters.vehicles)
    is_commanded = is_commanded or bool(flight_rules(parameters))
    if not is_commanded or not parameters.propagator.can_maneuver:
        return demand
    sync_bytes, sync_s = _maneuver(fleet.states[0], knot_s, 3 * intervals, propagation)
    return replace(
        demand,
        sync_bytes=sync_bytes,
        sync_compute_s=sync_s,
        sync_rate_hz=COMMANDS_HZ,
        lead_s=shortest_lead_s(parameters.maneuvers, tick_hz),
    )


def shortest_lead_s(settings: Maneuvers, tick_hz: float) -> float:
    """Return the shortest T_m - T_s, in whole ticks, at which a command is carried out at its time."""
    needed_s = settings.propagation_s + 2.0 * settings.network_s
    return max(1, math.ceil(needed_s * tick_hz - 1e-9)) / tick_hz


def _maneuver(
    state: np.ndarray[Any, np.dtype[np.float64]],
    knot_s: float,
    end_knot: int,
    propagation: PropagationParameters,
) -> tuple[int, float]:
    """Return bytes and seconds that one maneuver costs: command and new truth for all that is known ahead."""
    at_s = 0.3 * knot_s
    impulse = Effect(
        number=0, kind="impulse", at_s=at_s, start_s=at_s, end_s=at_s, vector=(0.0, 0.0, 1.0)
    )
    request = VehicleRequest(
        start_s=0.0,
        state=state,
        change_s=at_s,
        end_knot=end_knot,
        knot_s=knot_s,
        effects=(impulse,),
    )
    truth, took_s = _timed(propagate_vehicle, request, replace(propagation, element_sets=()))
    grid = Segment(revision=1, t0_s=knot_s, knot_s=knot_s, states=truth.states)
    command = Command(
        number=0, kind="delta_v", commanded_s=0.0, at_s=at_s, frame="rtn", vector=(0.0, 0.0, 1.0)
    )
    messages = [grid, command, *(piece.to_segment(1) for piece in truth.pieces)]
    return sum(len(pack(message.to_message())) for message in messages), took_s


def _timed(function: Callable[..., Any], *arguments: Any) -> tuple[Any, float]:
    """Return a function's value and the median of what it takes, s."""
    value = function(*arguments)
    timings_s = []
    for _ in range(TIMINGS):
        started_s = time.perf_counter()
        function(*arguments)
        timings_s.append(time.perf_counter() - started_s)
    return value, statistics.median(timings_s)
