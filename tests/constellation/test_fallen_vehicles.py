"""A vehicle that meets the Earth is lost by name and time; the truth of the others goes on."""

import pytest
from constellation_fakes import Star, parameters, state_rows

from madns_runtime.errors import BlamedError
from madns_runtime.simulations.constellation.orbit.constants import EARTH_POLAR_RADIUS_M

TWO = {
    "keplerian": [
        {"name": "HIGH", "altitude_km": 780, "i_deg": 86},
        {"name": "FALLER", "a_km": 6420, "e": 0.006, "i_deg": 60, "mean_anomaly_deg": 90},
    ]
}
DIVE = """
class Dive:
    def setup(self, context):
        self.context = context

    def step(self, t_s, readings):
        if t_s == 1.0:
            self.context.delta_v((-2000.0, 0.0, 0.0), at_s=4.0)
"""
WAITING = """
        if t_s == 2.0:
            self.context.delta_v((0.0, 1000.0, 0.0), at_s=45.0)
"""
THRUSTER = {"thruster": {"isp_s": 1e5, "propellant_kg": 50}}


@pytest.fixture
def star(tmp_path):
    (tmp_path / "dive.py").write_text(DIVE)
    flight = {"software": "dive.py:Dive", "input": "truth", "agents": ["FALLER"]}
    settings = parameters(TWO, flight=flight, vehicles=[THRUSTER])
    return Star(settings, count=2, duration_s=60.0, base_directory=tmp_path)


def test_who_meets_the_earth_ends_with_that_as_its_reason(star):
    with pytest.raises(BlamedError, match=r"^FALLER has met the Earth at 36\.7 s$"):
        star.run(60.0)

    x, y, z = state_rows(star, "agent-02")[-1, 1:4]
    assert 0.0 < (x * x + y * y + z * z) ** 0.5 - EARTH_POLAR_RADIUS_M < 1000.0


def go_on_without_it(star):
    """Fly the others to the end of a minute."""
    from_s = star.context.clock_s + 0.1
    del star.agents["agent-02"]
    star.host.agent_lost("agent-02", "it fell")
    star.run(60.0, from_s=from_s)
    assert state_rows(star, "agent-01")[-1, 0] == 599


def test_the_others_go_on_and_what_fell_is_not_judged(star):
    with pytest.raises(BlamedError):
        star.run(60.0)

    go_on_without_it(star)

    assert star.agents["agent-01"].finish()["underruns"] == 0
    summary = star.host.finish()
    assert summary["energy_drift_max"] < 1e-12
    assert all(check["passed"] for check in summary["checks"])


@pytest.mark.parametrize("thrust_n", [None, 1e6], ids=["impulse", "arc"])
def test_a_burn_that_waits_as_a_vehicle_falls_does_not_end_the_others(tmp_path, thrust_n):
    (tmp_path / "dive.py").write_text(DIVE + WAITING)
    flight = {"software": "dive.py:Dive", "input": "truth", "agents": ["FALLER"]}
    vehicles = [{"thruster": THRUSTER["thruster"] | {"thrust_n": thrust_n}}]
    settings = parameters(TWO, flight=flight, vehicles=vehicles)
    star = Star(settings, count=2, duration_s=60.0, base_directory=tmp_path)

    with pytest.raises(BlamedError, match="FALLER has met the Earth"):
        star.run(60.0)

    go_on_without_it(star)
    assert star.host.finish()["maneuvers"]["executed"] == 2
