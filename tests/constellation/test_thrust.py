"""Burns by the rocket equation: Tsiolkovsky's gain, the way it makes, and truth against an integration with mass."""

import math

import numpy as np
import pytest
from constellation_fakes import parameters
from scipy.integrate import quad, solve_ivp

from madns_runtime.simulations.constellation.equipment import (
    Attitude,
    ReactionWheels,
    Thruster,
    Vehicle,
)
from madns_runtime.simulations.constellation.orbit.constants import GRAVITY_MODELS
from madns_runtime.simulations.constellation.orbit.quaternions import rotate_back
from madns_runtime.simulations.constellation.thrust import Thrust, velocity_gain_s, way_gain_s2
from madns_runtime.simulations.constellation.truth import vehicle_propagation
from madns_runtime.simulations.constellation.truth.initial_states import load_fleet
from madns_runtime.simulations.constellation.truth.maneuvers.actuators import (
    chance_of,
    fire,
)
from madns_runtime.simulations.constellation.truth.maneuvers.effects import Effect, Timeline
from madns_runtime.simulations.constellation.truth.maneuvers.tank import Tank
from madns_runtime.simulations.constellation.truth.propagation import PropagationParameters
from madns_runtime.simulations.constellation.truth.propagators.forces import acceleration_of
from madns_runtime.simulations.constellation.truth.propagators.rigid_body import (
    RigidBody,
    initial_attitude,
)
from madns_runtime.simulations.constellation.truth.vehicle_propagation import (
    VehicleRequest,
    propagate_vehicle,
)

PARAMETERS = parameters()
STATE = load_fleet(PARAMETERS, 1, None).states[0]
PROPAGATION = PropagationParameters(
    settings=PARAMETERS.propagator,
    gravity=GRAVITY_MODELS["EGM-96"],
    epoch_utc=load_fleet(PARAMETERS, 1, None).epoch_utc,
)
MASS_KG = 500.0
STRONG = Thruster(isp_s=220.0, propellant_kg=400.0, thrust_n=1000.0)


@pytest.mark.parametrize("tau_s", [0.3, 40.0, 900.0])
@pytest.mark.parametrize("burnt", [0.0, 1e-12, 9.9e-4, 1.01e-3, 0.05, 0.9])
def test_gains_are_the_integrals_of_the_acceleration(tau_s, burnt):
    rate = burnt / tau_s

    velocity = quad(lambda t: 1.0 / (1.0 - rate * t), 0.0, tau_s, epsabs=0.0, epsrel=1e-13)[0]
    way = quad(lambda t: velocity_gain_s(t, rate), 0.0, tau_s, epsabs=0.0, epsrel=1e-13)[0]

    assert velocity_gain_s(tau_s, rate) == pytest.approx(velocity, rel=1e-12)
    assert way_gain_s2(tau_s, rate) == pytest.approx(way, rel=1e-11)


def test_parts_of_an_arc_make_the_whole():
    thrust = Thrust.of((3.0, 0.0, -4.0), 10.0, 70.0, 0.4)
    first, second, whole = (thrust.gains(*t_s) for t_s in ((10, 25), (25, 70), (10, 70)))

    assert first[0] + second[0] == pytest.approx(whole[0])
    assert first[1] + first[0] * 45.0 + second[1] == pytest.approx(whole[1])
    assert whole[0] * np.array(thrust.acceleration_m_s2) == pytest.approx((3.0, 0.0, -4.0))
    # A tenth of the mass less: a ninth more acceleration.
    assert np.array(thrust.at(25.0)) == pytest.approx(np.array(thrust.at(10.0)) / 0.9)


def flown_with_mass(burn, start_s, end_s, until_s):
    """The same by an integration of position, velocity and mass, thrust along one inertial direction."""
    gravity = acceleration_of(PROPAGATION)
    direction = np.array(burn.vector) / burn.magnitude_m_s
    flow_kg_s = burn.propellant_kg / (end_s - start_s)
    force_n = flow_kg_s * STRONG.isp_s * 9.80665

    def derivative(_, y, is_on):
        a = gravity(y[:3, None], y[3:6, None])[:, 0]
        return [*y[3:6], *(a + is_on * force_n / y[6] * direction), -flow_kg_s * is_on]

    y, at_s = np.append(STATE, MASS_KG), 0.0
    for stop_s, is_on in ((start_s, False), (end_s, True), (until_s, False)):
        found = solve_ivp(
            derivative, (at_s, stop_s), y, "DOP853", rtol=1e-13, atol=1e-7, args=(is_on,)
        )
        y, at_s = found.y[:, -1], stop_s
    return y


@pytest.mark.parametrize("delta_v_m_s", [2.0, 500.0, 1500.0])
def test_truth_in_a_burn_is_that_of_an_integration_with_mass(delta_v_m_s):
    tank = Tank(Vehicle(mass_kg=MASS_KG, thruster=STRONG))
    burn = fire(STRONG, tank, (delta_v_m_s, 0.0, 0.0), chance_of(1, "a", 0))
    start_s = 20.3
    end_s = start_s + burn.duration_s
    until_s = math.ceil(end_s) + 10
    effect = Effect(
        number=0,
        kind="thrust",
        at_s=(start_s + end_s) / 2,
        start_s=start_s,
        end_s=end_s,
        vector=burn.vector,
        burnt=burn.burnt,
    )

    truth = propagate_vehicle(
        VehicleRequest(
            start_s=0.0,
            state=STATE,
            change_s=1.0,
            end_knot=until_s,
            knot_s=1.0,
            effects=(effect,),
        ),
        PROPAGATION,
    )
    expected = flown_with_mass(burn, start_s, end_s, until_s)

    exhaust_m_s = STRONG.isp_s * 9.80665
    left_kg = MASS_KG - burn.propellant_kg
    assert exhaust_m_s * math.log(MASS_KG / left_kg) == pytest.approx(delta_v_m_s, rel=1e-12)
    assert expected[6] == pytest.approx(left_kg, rel=1e-12)
    # Measured: 2e-5 m and 1e-7 m/s. One acceleration all through would be off by dv T q / 12 and more: 50 km.
    assert np.abs(truth.states[-1][:3] - expected[:3]).max() < 1e-4
    assert np.abs(truth.states[-1][3:] - expected[3:6]).max() < 5e-7


def test_wheels_take_up_their_torque_through_all_legs_of_a_burn(monkeypatch):
    attitude = Attitude(
        inertia_kg_m2=(10.0, 12.0, 14.0),
        rates_deg_s=(2.0, 1.0, 0.0),
        wheels=ReactionWheels(torque_n_m_max=1.0, momentum_n_m_s_max=100.0),
    )
    turned = initial_attitude(attitude, STATE[:3].tolist(), STATE[3:].tolist())
    kinds = {"thrust": (0.0, 40.0, 0.0), "torque": (0.0, 0.0, 0.1)}
    effects = tuple(
        Effect(number=n, kind=kind, at_s=25.0, start_s=5.0, end_s=45.0, vector=vector, burnt=0.1)
        for n, (kind, vector) in enumerate(kinds.items())
    )
    request = VehicleRequest(
        start_s=0.0,
        state=np.concatenate((STATE, turned)),
        change_s=5.0,
        end_knot=50,
        knot_s=1.0,
        effects=effects,
        body=RigidBody.of(attitude, (0.0, 0.0, 0.0)),
    )

    in_legs = propagate_vehicle(request, PROPAGATION)
    monkeypatch.setattr(vehicle_propagation, "THRUST_LEG_S", 100.0)
    at_once = propagate_vehicle(request, PROPAGATION)

    assert np.abs(in_legs.attitude - at_once.attitude).max() < 1e-9
    assert np.abs(in_legs.attitude[-1, 4:] - turned[4:]).max() > 0.1


def turning(number, start_s, end_s, kind="torque"):
    vector = (0.0, 0.0, 0.1) if kind == "torque" else (0.0, 300.0, 0.0)
    return Effect(
        number=number, kind=kind, at_s=start_s, start_s=start_s, end_s=end_s, vector=vector,
        frame="body",
    )  # fmt: skip


@pytest.mark.parametrize(
    "turns",
    [
        (turning(1, 19.9, 20.1),),
        (turning(1, 20.0, 20.2),),
        (turning(1, 17.0, 20.0), turning(2, 22.0, 24.0), turning(3, 24.0, 25.0)),
        (turning(1, 18.0, 22.0, "dipole"), turning(2, 29.0, 33.0)),
    ],
    ids=["begun before it", "begun with it", "several within it", "dipole"],
)
def test_a_burn_in_body_axes_is_along_those_of_its_middle_whatever_turns_the_body_meanwhile(turns):
    body = RigidBody(inertia_kg_m2=(10.0, 12.0, 14.0))
    burn = Effect(
        number=0, kind="thrust", at_s=30.0, start_s=20.0, end_s=40.0, vector=(1.0, 0.0, 0.0),
        frame="body", burnt=0.001,
    )  # fmt: skip

    def flown(*effects):
        timeline = Timeline()
        for effect in effects:
            timeline.add(effect)
        request = VehicleRequest(
            start_s=0.0,
            state=np.array((*STATE, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)),
            change_s=1.0,
            end_knot=21 if burn in effects else 30,  # the middle is no part of what is asked for
            knot_s=1.0,
            effects=timeline.between(0.0, 21.0 if burn in effects else 30.0),
            body=body,
        )
        return propagate_vehicle(request, PROPAGATION)

    thrust = flown(burn, *turns).thrusts[0].acceleration_m_s2
    axes = flown(*turns).attitude[-1, :4]

    along = np.array(rotate_back(axes, (1.0, 0.0, 0.0)))
    assert np.array(thrust) / np.linalg.norm(thrust) == pytest.approx(along, abs=1e-9)
    assert np.abs(along - (1.0, 0.0, 0.0)).max() > 1e-3
