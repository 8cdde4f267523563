"""The shipped scenarios of control as whole runs in lockstep, shortened: what truth says became of the wishes."""

import json

import pytest
from harness.cosmos_command import CosmosCommand

pytestmark = pytest.mark.process


def run(folder, scenario, *settings):
    cosmos = CosmosCommand(folder)
    code, result = cosmos.run(scenario, "time.mode=lockstep", *settings)
    assert code == 0, result["verdict"]
    done = cosmos("report", "last", "--json", "--quiet")
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def flights(document):
    return [agent.get("flight") for agent in document["simulation"]["agents"].values()]


def test_ten_satellites_are_injected_at_once_by_commands_of_one_ticks_lead(tmp_path):
    settings = ("time.duration_s=64", "parameters.flight.settings.lead_s=0")

    document = run(tmp_path, "hohmann10.yaml", *settings)

    maneuvers = document["simulation"]["host"]["maneuvers"]
    assert (maneuvers["commanded"], maneuvers["executed"]) == (10, 10)
    assert (maneuvers["inequality_broken"], maneuvers["refused"]) == (0, 0)
    for flight in flights(document):
        assert flight["delta_v_m_s"] == pytest.approx(2295.0, abs=25.0)
        assert flight["delta_v_m_s"] == pytest.approx(flight["delta_v_asked_m_s"], rel=1e-9)
        assert flight["apogee_km"] == pytest.approx(42_164.0, abs=3.0)


@pytest.mark.nightly
def test_ring_of_93_finds_its_slots_over_crosslinks(tmp_path):
    # A quarter of the day, hastened: coarse ticks, and a shorter time constant at the price of delta-v.
    settings = ("agents.tick_hz=0.05", "parameters.flight.settings.time_constant_h=1.5")

    document = run(tmp_path, "ring93.yaml", "time.duration_s=21700", *settings)

    first, last = document["control"]["rows"][0], document["control"]["rows"][-1]
    assert first["slot_error_deg_rms"] == pytest.approx(0.2, abs=1e-3)
    assert last["slot_error_deg_rms"] < 0.06
    # Measured at most one exchange ago.
    believed = last["slot_error_estimated_deg_rms"]
    assert believed == pytest.approx(last["slot_error_deg_rms"], abs=0.01)
    assert 0.5 < last["delta_v_m_s_mean"] < 3.0
    assert last["messages"] == 93 * 2 * 72 + 186
    assert all(flight["neighbours"] == 2 for flight in flights(document))
