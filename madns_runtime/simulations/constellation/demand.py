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
from numpy.typing import NDArray

from madns_runtime.plugin.api import Demand, Flow
from madns_runtime.protocol.codec import pack
from madns_runtime.protocol.datagram import FRAGMENT_BYTES_MAX
from madns_runtime.simulations.constellation.host_side.truth_distribution import URGENT_KNOTS_MAX
from madns_runtime.simulations.constellation.host_side.truth_remainders import URGENT_S, split
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

Array = NDArray[np.float64]

TIMINGS = 5
"""Timed propagations; the median is taken, after one that pays for imports."""
COMMANDS_HZ = 1.0
"""Commands of one vehicle that are planned for: flight software does not say how many it will give."""
MESSAGES_HZ, MESSAGE_BYTES = 1.0, 256
"""Messages of one vehicle that are planned for, where there is radio: it does not say that either."""
REPORT_BYTES = 160
"""A command's result, of which there are two."""
STEP_S = 50e-6
"""Of an agent's half without flight software: 41 us with all on record, measured on a 2-core x86-64 virtual machine."""


def estimate_demand(
    parameters: ConstellationParameters, agents: int, tick_hz: float, base_directory: Path
) -> Demand:
    """
    Return the terms of the inequalities, with truth propagated here to time it.

    A maneuver's truth is timed as far as it is propagated before its time (`truth_remainders`); what follows is a flow.
    T_bi is half a buffer: an agent that is refilled at half has no more, and each batch brings no
    more. Truth goes to the agents, and nothing comes back but commands, radio and acknowledgements, so the
    tick rate costs no traffic.

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
        flows=(
            Flow(name="segment", message_bytes=segment_bytes, rate_hz=1.0 / window_s),
            *_acknowledged("segments", segment_bytes, 1.0 / window_s),
            *_radio(parameters, fleet.states),
        ),
        buffer_s=window_s,
        batch_bytes=segment_bytes,
        batch_compute_s=batch_s / agents,
        sync_bytes=0,
        sync_compute_s=0.0,
        sync_rate_hz=0.0,
        lead_s=math.inf,
        measured=True,
        state_bytes=segment.states[0].nbytes,
        buffer_bytes=2 * intervals * segment.states[0].nbytes,
        step_s=STEP_S,
    )
    if not _is_commanded(parameters) or not parameters.propagator.can_maneuver:
        return demand
    sync_bytes, sync_s, rest_bytes = _maneuver(fleet.states[0], knot_s, 3 * intervals, propagation)
    return replace(
        demand,
        flows=(*demand.flows, *_maneuvers(sync_bytes, rest_bytes)),
        sync_bytes=sync_bytes,
        sync_compute_s=sync_s,
        sync_rate_hz=COMMANDS_HZ,
        lead_s=shortest_lead_s(parameters.maneuvers, tick_hz),
    )


def _is_commanded(parameters: ConstellationParameters) -> bool:
    """Tell whether anything gives commands that may change truth."""
    has_actuators = any(vehicle.actuation for vehicle in parameters.vehicles)
    return has_actuators or bool(flight_rules(parameters))


def _maneuvers(sync_bytes: int, rest_bytes: int) -> list[Flow]:
    """Return what commands cost beside what is sent before their time: *rest_bytes* of truth follow each."""
    flows = [
        Flow(name="results of commands", message_bytes=REPORT_BYTES, rate_hz=2.0 * COMMANDS_HZ),
        *_acknowledged("maneuvers", sync_bytes + rest_bytes, COMMANDS_HZ),
    ]
    if rest_bytes:
        rest = Flow(
            name="rest of a maneuver's truth",
            message_bytes=rest_bytes,
            rate_hz=COMMANDS_HZ,
            within_s=URGENT_S,
        )
        flows.append(rest)
    return flows


def _acknowledged(what: str, message_bytes: int, rate_hz: float) -> list[Flow]:
    """Return the datagrams that acknowledge reliable ones, one each at worst, and hold nothing else."""
    datagrams = math.ceil(message_bytes / FRAGMENT_BYTES_MAX)
    name = f"acknowledgements of {what}"
    return [Flow(name=name, message_bytes=1, rate_hz=rate_hz * datagrams)] if datagrams else []


def _radio(parameters: ConstellationParameters, states: Array) -> list[Flow]:
    """
    Return the messages of vehicles to each other, which go by way of the host.

    Each that is sent is delivered to as many as are in range at the epoch on average, whatever the Earth hides.
    """
    flows = []
    if parameters.crosslinks is not None:
        r_km = states[:, :3] / 1e3
        reach_km = parameters.crosslinks.range_km_max
        near = sum(
            int((np.linalg.norm(r_km - each, axis=1) <= reach_km).sum()) - 1 for each in r_km
        )
        flows = [
            Flow(name="crosslinks, sent", message_bytes=MESSAGE_BYTES, rate_hz=MESSAGES_HZ),
            Flow(
                name="crosslinks, delivered",
                message_bytes=MESSAGE_BYTES,
                rate_hz=MESSAGES_HZ * near / len(states),
            ),
        ]
    if parameters.stations:
        flows += [
            Flow(name=f"ground, {way}", message_bytes=MESSAGE_BYTES, rate_hz=MESSAGES_HZ)
            for way in ("telemetry", "uplink")
        ]
    return [flow for flow in flows if flow.rate_hz]


def shortest_lead_s(settings: Maneuvers, tick_hz: float) -> float:
    """Return the shortest T_m - T_s, in whole ticks, at which a command is carried out at its time."""
    needed_s = settings.propagation_s + 2.0 * settings.network_s
    return max(1, math.ceil(needed_s * tick_hz - 1e-9)) / tick_hz


def _maneuver(
    state: Array, knot_s: float, end_knot: int, propagation: PropagationParameters
) -> tuple[int, float, int]:
    """Return bytes and seconds that one maneuver costs before its time, command and new truth; bytes of what follows."""
    at_s = 0.3 * knot_s
    impulse = Effect(
        number=0, kind="impulse", at_s=at_s, start_s=at_s, end_s=at_s, vector=(0.0, 0.0, 1.0)
    )
    whole = VehicleRequest(
        start_s=0.0,
        state=state,
        change_s=at_s,
        end_knot=end_knot,
        knot_s=knot_s,
        effects=(impulse,),
    )
    request = split(whole) or whole
    truth, took_s = _timed(propagate_vehicle, request, replace(propagation, element_sets=()))
    urgent = truth.states[:URGENT_KNOTS_MAX]
    messages = [part for piece in truth.pieces for part in piece.to_segments(1)]
    if len(urgent) > 1:  # of long knots the piece up to the first one may be all that is urgent
        messages.append(Segment(revision=1, t0_s=knot_s, knot_s=knot_s, states=urgent))
    command = Command(
        number=0, kind="delta_v", commanded_s=0.0, at_s=at_s, frame="rtn", vector=(0.0, 0.0, 1.0)
    )
    sync_bytes = sum(len(pack(message.to_message())) for message in (command, *messages))
    left = end_knot - len(urgent)
    return sync_bytes, took_s, max(0, left) * state.nbytes


def _timed(function: Callable[..., Any], *arguments: Any) -> tuple[Any, float]:
    """Return a function's value and the median of what it takes, s."""
    value = function(*arguments)
    timings_s = []
    for _ in range(TIMINGS):
        started_s = time.perf_counter()
        function(*arguments)
        timings_s.append(time.perf_counter() - started_s)
    return value, statistics.median(timings_s)
