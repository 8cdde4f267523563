"""Thrusters and wheels: what a command costs and gives, errors that repeat, and what is refused."""

import math

import numpy as np
import pytest

from madns_runtime.simulations.constellation.equipment import ReactionWheels, Thruster, Vehicle
from madns_runtime.simulations.constellation.truth.maneuvers.actuators import (
    ActuatorRefusal,
    Burn,
    chance_of,
    fire,
    turn,
)
from madns_runtime.simulations.constellation.truth.maneuvers.effects import Effect
from madns_runtime.simulations.constellation.truth.maneuvers.tank import Tank

EXACT = Thruster(isp_s=220.0, propellant_kg=20.0)


def tank(thruster=EXACT, mass_kg=100.0):
    return Tank(Vehicle(mass_kg=mass_kg, thruster=thruster))


def chance(number=0, agent="a", seed=1):
    return chance_of(seed, agent, number)


def book(full, burn):
    effect = Effect(
        number=0,
        kind="impulse",
        at_s=10.0,
        start_s=10.0,
        end_s=10.0,
        vector=burn.vector,
        burnt=burn.burnt,
    )
    full.book(effect, burn.propellant_kg, now_s=5.0)


def test_an_exact_thruster_gives_what_is_commanded_for_what_tsiolkovsky_says():
    full = tank()

    burn = fire(EXACT, full, (3.0, 0.0, 4.0), chance())
    book(full, burn)

    assert burn.vector == (3.0, 0.0, 4.0)
    assert burn.duration_s == 0.0
    # 100 kg (1 - exp(-5 / (9.80665 * 220)))
    assert burn.propellant_kg == pytest.approx(0.2314853, abs=1e-6)
    assert full.propellant_kg == pytest.approx(20.0 - burn.propellant_kg)
    assert full.mass_kg == pytest.approx(100.0 - burn.propellant_kg)


def test_the_order_of_burns_changes_nothing_of_what_is_left():
    left = []
    for order in ((50.0, 200.0), (200.0, 50.0), (250.0,)):
        full = tank()
        for delta_v in order:
            burn = fire(EXACT, full, (delta_v, 0.0, 0.0), chance())
            book(full, burn)
        left.append(full.propellant_kg)

    assert left == pytest.approx([left[0]] * 3, abs=1e-12)


def test_a_finite_burn_takes_propellant_times_exhaust_velocity_over_thrust():
    thruster = Thruster(isp_s=220.0, propellant_kg=20.0, thrust_n=10.0)

    burn = fire(thruster, tank(thruster), (5.0, 0.0, 0.0), chance())

    assert burn.duration_s == pytest.approx(0.2314853 * 9.80665 * 220.0 / 10.0, rel=1e-6)


def test_what_cannot_be_burnt_is_refused_with_figures():
    assert fire(EXACT, tank(), (0.0, 0.0, 0.0), chance()) == ActuatorRefusal(
        reason="a change of velocity of 0 m/s"
    )
    needs = fire(EXACT, tank(), (1000.0, 0.0, 0.0), chance())
    assert needs.reason == "needs 37.09 kg of propellant, 20 kg are left"
    coarse = Thruster(isp_s=220.0, propellant_kg=20.0, minimum_impulse_n_s=2.0)
    small = fire(coarse, tank(coarse), (0.019, 0.0, 0.0), chance())
    assert small.reason == "an impulse of 1.9 N s, the least is 2 N s"
    assert isinstance(fire(coarse, tank(coarse), (0.021, 0.0, 0.0), chance()), Burn)


@pytest.mark.slow
def test_all_that_is_left_can_be_asked_for():
    for propellant_kg in range(1, 90):
        thruster = Thruster(isp_s=220.0, propellant_kg=propellant_kg)
        full = tank(thruster)
        all_m_s = -220.0 * 9.80665 * math.log1p(-propellant_kg / 100.0)

        burn = fire(thruster, full, (all_m_s, 0.0, 0.0), chance())

        assert isinstance(burn, Burn), propellant_kg
        assert burn.propellant_kg <= propellant_kg
        assert burn.magnitude_m_s == pytest.approx(all_m_s, rel=1e-10)
        more = fire(thruster, full, (all_m_s + 1e-6, 0.0, 0.0), chance())
        assert isinstance(more, ActuatorRefusal), propellant_kg


def test_errors_have_the_deviations_that_the_scenario_says():
    thruster = Thruster(
        isp_s=220.0, propellant_kg=20.0, magnitude_error=0.02, direction_error_deg=1.5
    )
    commanded = np.array((0.0, 2.0, 1.0))
    unit = commanded / np.linalg.norm(commanded)

    given = np.array(
        [fire(thruster, tank(thruster), tuple(commanded), chance(n)).vector for n in range(3000)]
    )

    magnitudes = np.linalg.norm(given, axis=1) / np.linalg.norm(commanded)
    assert magnitudes.mean() == pytest.approx(1.0, abs=2e-3)
    assert magnitudes.std() == pytest.approx(0.02, rel=0.05)
    across = np.degrees(np.arccos(np.clip(given @ unit / np.linalg.norm(given, axis=1), -1, 1)))
    # Two independent axes: the mean square of the angle is twice that of each.
    assert math.sqrt((across**2).mean() / 2) == pytest.approx(1.5, rel=0.05)
    assert np.linalg.norm((given / magnitudes[:, None]).mean(axis=0) - commanded) < 0.02


def test_an_error_depends_on_seed_agent_and_number_alone():
    thruster = Thruster(isp_s=220.0, propellant_kg=20.0, magnitude_error=0.02)

    def magnitude(**of):
        return fire(thruster, tank(thruster), (1.0, 0.0, 0.0), chance(**of)).magnitude_m_s

    assert magnitude(number=3) == magnitude(number=3)
    assert (
        len({magnitude(number=n, agent=a, seed=s) for n in (0, 1) for a in "ab" for s in (1, 2)})
        == 8
    )


def test_an_error_cannot_burn_what_is_not_there():
    thruster = Thruster(isp_s=220.0, propellant_kg=1.0, magnitude_error=0.5)
    last_m_s = 220.0 * 9.80665 * -math.log(0.99)
    burns = [
        fire(thruster, tank(thruster), (last_m_s * 0.999, 0.0, 0.0), chance(n)) for n in range(20)
    ]

    assert max(burn.propellant_kg for burn in burns) == 1.0
    assert max(burn.magnitude_m_s for burn in burns) == pytest.approx(last_m_s)


WHEELS = ReactionWheels(torque_n_m_max=0.1, momentum_n_m_s_max=1.0)


def test_torques_are_limited_on_each_axis():
    given = turn(WHEELS, ((0.0, 0.0, 0.0),) * 2, (0.05, -0.3, 0.0), 2.0, chance())

    assert given.torque_n_m == (0.05, -0.1, 0.0)
    assert given.limits == ("y: 0.1 N m at most",)


def test_wheels_saturate_by_the_opposite_of_what_they_give():
    nearly = turn(WHEELS, ((-0.9, 0.0, 0.0),) * 2, (0.1, 0.0, 0.0), 10.0, chance())
    back = turn(WHEELS, ((-0.9, 0.0, 0.0),) * 2, (-0.1, 0.0, 0.0), 10.0, chance())

    assert nearly.torque_n_m[0] == pytest.approx(0.01)
    assert nearly.limits == ("x: wheels saturate",)
    assert back.torque_n_m[0] == -0.1
    full = turn(WHEELS, ((-1.0, 0.0, 0.0),) * 2, (0.1, 0.0, 0.0), 10.0, chance())
    assert full == ActuatorRefusal(reason="the wheels are saturated")


def test_a_vehicle_without_wheels_turns_exactly_as_commanded():
    held, torque = ((9.0, 0.0, 0.0),) * 2, (5.0, 0.0, 0.0)

    assert turn(None, held, torque, 1.0, chance()).torque_n_m == torque
    assert isinstance(turn(None, held, (0.0, 0.0, 0.0), 1.0, chance()), ActuatorRefusal)
