"""Which entry of a scenario describes a vehicle, and who flies what."""

import pytest
from constellation_fakes import parameters

from madns_runtime.simulations.constellation.equipment import Vehicle
from madns_runtime.simulations.constellation.flight_settings import FlightClass
from madns_runtime.simulations.constellation.vehicles import flight_of, flight_rules, vehicle_of

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


def test_the_first_rule_of_flight_software_that_fits_holds():
    rules = [
        {"software": "a.py:A", "agents": ["SAT-1"]},
        {"command": ["b"], "agents": ["agent-0[12]"]},
        "c.py:C",
    ]
    params = parameters(flight=rules)

    assert flight_of(params, "agent-01", "SAT-1").software == "a.py:A"
    assert flight_of(params, "agent-02", "SAT-2").command == ("b",)
    assert flight_of(params, "agent-03", "SAT-3").software == "c.py:C"
    assert flight_of(parameters(flight=rules[:2]), "agent-03", "SAT-3") is None
    assert flight_rules(parameters(flight=[])) == ()
