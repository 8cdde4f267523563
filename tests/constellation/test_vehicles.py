"""Which entry of a scenario describes a vehicle, and who flies what."""

import pytest
from constellation_fakes import parameters

from madns_runtime.simulations.constellation.equipment import Vehicle
from madns_runtime.simulations.constellation.parameters import FlightClass
from madns_runtime.simulations.constellation.vehicles import flight_of, vehicle_of

VEHICLES = [
    {"agents": ["agent-01", "IRIDIUM 9*"], "mass_kg": 1.0},
    {"agents": ["agent-0*"], "mass_kg": 2.0},
]


@pytest.mark.parametrize(
    ("agent", "satellite", "mass_kg"),
    [
        ("agent-01", "IRIDIUM 8", 1.0),
        ("agent-02", "IRIDIUM 914", 1.0),
        ("agent-02", "IRIDIUM 8", 2.0),
        ("agent-12", "iridium 914", Vehicle().mass_kg),
    ],
)
def test_the_first_entry_that_fits_agent_or_satellite_describes_a_vehicle(
    agent, satellite, mass_kg
):
    vehicle = vehicle_of(parameters(vehicles=VEHICLES), agent, satellite)

    assert vehicle.mass_kg == mass_kg


def test_a_name_with_brackets_fits_itself():
    params = parameters(vehicles=[{"agents": ["OBJECT [A]"], "mass_kg": 3.0}])

    assert vehicle_of(params, "agent-01", "OBJECT [A]").mass_kg == 3.0


def test_the_short_form_flies_on_every_agent():
    assert flight_of(parameters(flight="guidance.py:G"), "a", "b") == FlightClass(
        software="guidance.py:G"
    )


def test_agents_that_no_glob_names_only_coast():
    params = parameters(flight={"command": ["hold"], "agents": ["agent-02"]})

    assert flight_of(params, "agent-01", "X") is None
    assert flight_of(params, "agent-02", "X").command == ("hold",)
    assert flight_of(parameters(), "agent-02", "X") is None
