"""Fits a vehicle out before the run: its flight software and its sensors, from what the scenario says."""

from __future__ import annotations

import numpy as np

from madns_runtime.plugin.api import AgentContext
from madns_runtime.simulations.constellation.flight.loading import load_flight_class
from madns_runtime.simulations.constellation.flight.pilot import Pilot
from madns_runtime.simulations.constellation.messages import Initial
from madns_runtime.simulations.constellation.parameters import FlightProcess, Vehicle
from madns_runtime.simulations.constellation.vehicle.board import Board
from madns_runtime.simulations.constellation.vehicle.cockpit import Cockpit
from madns_runtime.simulations.constellation.vehicles import flight_of


def fit_out(context: AgentContext, initial: Initial, vehicle: Vehicle) -> Cockpit | None:
    """
    Load an agent's flight software and let it prepare; None for a vehicle that only coasts.

    Raises:
        PluginError: It does not load.
        BlamedError: It raised.
    """
    flight = flight_of(context.parameters, context.name, initial.satellite)
    if flight is None:
        return None
    if isinstance(flight, FlightProcess):
        raise NotImplementedError
    software = load_flight_class(flight.software, context.base_directory)()
    board = Board(
        context,
        initial,
        vehicle=vehicle,
        settings=flight.settings,
        random=np.random.Generator(np.random.Philox(context.random.integers(2**63))),
    )
    is_truth_fed = flight.input == "truth"
    return Cockpit(Pilot(software), board, vehicle=vehicle, is_truth_fed=is_truth_fed)
