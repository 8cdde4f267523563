"""Fits a vehicle out before the run: its sensors and its flight software, from what the scenario says."""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any

from madns_runtime.plugin.api import AgentContext
from madns_runtime.simulations.constellation.equipment import Vehicle
from madns_runtime.simulations.constellation.flight.loading import load_flight_class
from madns_runtime.simulations.constellation.flight.pilot import Pilot
from madns_runtime.simulations.constellation.flight.process import ExternalFlight
from madns_runtime.simulations.constellation.messages import Initial
from madns_runtime.simulations.constellation.orbit.constants import GRAVITY_MODELS
from madns_runtime.simulations.constellation.parameters import FlightProcess, FlightSoftware
from madns_runtime.simulations.constellation.vehicle.board import Board
from madns_runtime.simulations.constellation.vehicle.cockpit import Cockpit
from madns_runtime.simulations.constellation.vehicle.sensors.errors import generator_of
from madns_runtime.simulations.constellation.vehicle.sensors.scene import Scene
from madns_runtime.simulations.constellation.vehicle.sensors.suite import SensorSuite
from madns_runtime.simulations.constellation.vehicle.truth_buffer import TruthBuffer
from madns_runtime.simulations.constellation.vehicles import flight_of

CHANCE_BYTES = 32


def fit_out(
    context: AgentContext, initial: Initial, *, vehicle: Vehicle, buffer: TruthBuffer
) -> tuple[SensorSuite | None, Cockpit | None]:
    """
    Mount sensors and flight software, and let the latter prepare; None for what the vehicle has not.

    Raises:
        BlamedError: Flight software does not load, or raised.
        MissingExtraError: A sensor, or flight software, needs what is not installed.
    """
    flight = flight_of(context.parameters, context.name, initial.satellite)
    wanted = vehicle.sensors
    has_sensors = any(getattr(wanted, field.name) for field in dataclasses.fields(wanted))
    if flight is None and not has_sensors:
        return None, None
    # All that is left to chance on board hangs on these bytes and on a name, not on an order.
    chance = context.random.bytes(CHANCE_BYTES)
    suite = cockpit = None
    if has_sensors:
        radius_m = GRAVITY_MODELS[context.parameters.gravity].radius_m
        scene = Scene(initial.epoch_utc, buffer, radius_m)
        suite = SensorSuite(wanted, scene, context=context, chance=chance)
    if flight is not None:
        board = Board(
            context,
            initial,
            vehicle=vehicle,
            settings=copy.deepcopy(flight.settings),  # its own: vehicles may share a process
            random=generator_of(chance, "flight"),
        )
        pilot = Pilot(_software(flight, context))
        is_truth_fed = flight.input == "truth"
        cockpit = Cockpit(pilot, board, vehicle=vehicle, is_truth_fed=is_truth_fed)
    return suite, cockpit


def _software(flight: FlightSoftware | FlightProcess, context: AgentContext) -> Callable[[], Any]:
    folder = context.base_directory
    if isinstance(flight, FlightProcess):
        return partial(ExternalFlight, flight, folder, is_lockstep=context.is_lockstep)
    return load_flight_class(flight.software, folder)
