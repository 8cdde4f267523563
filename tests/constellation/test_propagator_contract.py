"""What every propagator keeps, whoever computes."""

import dataclasses
import math
import pickle  # noqa: TID251 - as executors do with arguments
import subprocess
import sys
from dataclasses import replace
from typing import get_type_hints

import numpy as np
import pytest
from propagator_kinds import EXTRAS, OWN, distance_m, make_kind, orbits

from madns_runtime.errors import ConfigurationError, MissingExtraError
from madns_runtime.simulations.constellation.orbit.constants import EARTH_POLAR_RADIUS_M
from madns_runtime.simulations.constellation.orbit.invariants import ENERGY
from madns_runtime.simulations.constellation.parameters import PROPAGATORS, CustomPropagator
from madns_runtime.simulations.constellation.truth import propagators
from madns_runtime.simulations.constellation.truth.propagation import (
    conserved_by,
    load_propagator,
    propagate,
)


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "own.py").write_text(OWN)
    return tmp_path


@pytest.fixture(params=sorted(PROPAGATORS))
def kind(request, folder):
    return make_kind(request.param, folder)


@pytest.fixture(params=sorted(set(PROPAGATORS) - {"sgp4"}))
def numerical(request, folder):
    return make_kind(request.param, folder)


@pytest.fixture(params=["scipy", "numba", "custom"])
def dragged(request, folder):
    return make_kind(request.param, folder, forces=("two_body", "drag"))


def test_states_come_by_vehicle_knot_and_component(kind):
    found = propagate(orbits(), 0.0, np.array([0.0, 1.0, 2.5, 30.0, 61.0]), kind.parameters())

    assert found.shape == (4, 5, 6)
    assert found.dtype == np.float64
    assert np.isfinite(found).all()


def test_a_knot_at_the_start_is_the_state_itself(numerical):
    states = orbits()

    found = propagate(states, 7.0, np.array([7.0, 7.0, 8.0]), numerical.parameters())

    assert np.array_equal(found[:, 0], states)
    assert np.array_equal(found[:, 1], states)


def test_no_knot_and_no_vehicle_give_nothing(kind):
    assert propagate(orbits(), 0.0, np.array([]), kind.parameters()).shape == (4, 0, 6)
    no_sets = replace(kind.parameters(), element_sets=())
    assert propagate(np.empty((0, 6)), 0.0, np.array([1.0]), no_sets).shape == (0, 1, 6)


def test_one_knot_alone_is_the_same_as_among_others(kind):
    many = propagate(orbits(), 0.0, np.arange(0.0, 60.5, 0.5), kind.parameters())

    one = propagate(orbits(), 0.0, np.array([60.0]), kind.parameters())

    assert distance_m(one[:, 0], many[:, 120]) < 1e-7


def test_velocities_are_the_derivatives_of_positions(kind):
    knots_s = np.array([9.0, 9.5, 10.0, 10.5, 11.0])

    found = propagate(orbits(), 0.0, knots_s, kind.parameters())

    r = found[..., :3]
    slope = (8.0 * (r[:, 3] - r[:, 1]) - (r[:, 4] - r[:, 0])) / 6.0
    # SGP4's positions carry noise of 1e-5 m.
    assert np.abs(slope - found[:, 2, 3:]).max() < (1e-7 if kind.is_numerical else 1e-4)


def test_a_vehicle_moves_alone_as_it_does_among_others(kind):
    knots_s = np.arange(0.0, 301.0, 10.0)
    among = propagate(orbits(), 0.0, knots_s, kind.parameters())

    for n in range(4):
        parameters = kind.parameters()
        parameters = replace(parameters, element_sets=parameters.element_sets[n : n + 1])
        alone = propagate(orbits()[n : n + 1], 0.0, knots_s, parameters)
        # scipy has one step for all; the others give the same digits.
        assert distance_m(alone[0], among[n]) < 1e-7


def test_two_calls_make_one(kind):
    knots_s = np.arange(0.0, 601.0, 10.0)
    whole = propagate(orbits(), 0.0, knots_s, kind.parameters())

    first = propagate(orbits(), 0.0, knots_s[:24], kind.parameters())
    second = propagate(first[:, -1], 230.0, knots_s[24:], kind.parameters())

    assert distance_m(np.concatenate((first, second), axis=1), whole) < 1e-6


def test_a_start_off_the_grid_of_knots_costs_nothing(numerical):
    odd_s = 3.123456789
    at_odd = propagate(orbits(), 0.0, np.array([odd_s]), numerical.parameters())[:, 0]

    found = propagate(at_odd, odd_s, np.arange(4.0, 20.0), numerical.parameters())

    expected = propagate(orbits(), 0.0, np.arange(4.0, 20.0), numerical.parameters())
    assert distance_m(found, expected) < 1e-6


def test_energy_stays(numerical):
    parameters = numerical.parameters()
    found = propagate(orbits(), 0.0, np.arange(0.0, 601.0, 20.0), parameters)

    energy = conserved_by(found, parameters)[..., ENERGY]

    assert np.abs(energy / energy[:, :1] - 1.0).max() < 1e-12
    assert parameters.conserves_energy == (not isinstance(numerical.settings, CustomPropagator))


@pytest.mark.parametrize("forces", [("two_body",), ("two_body", "j2")], ids="+".join)
@pytest.mark.parametrize("name", ["numba", "basilisk", "custom"])
def test_all_agree_with_scipy(name, forces, folder):
    knots_s = np.arange(0.0, 901.0, 60.0)
    expected = propagate(
        orbits(), 0.0, knots_s, make_kind("scipy", folder, forces=forces).parameters()
    )

    found = propagate(orbits(), 0.0, knots_s, make_kind(name, folder, forces=forces).parameters())

    assert distance_m(found, expected) < 1e-6


def test_the_same_call_gives_the_same_digits(kind):
    knots_s = np.arange(0.0, 120.0, 7.0)
    first = propagate(orbits(), 0.0, knots_s, kind.parameters())
    propagate(orbits(radius_m=8.0e6), 0.0, knots_s, kind.parameters())

    again = propagate(orbits(), 0.0, knots_s, kind.parameters())

    assert np.array_equal(first, again)


def test_states_given_are_not_changed(kind):
    states = orbits()

    propagate(states, 0.0, np.array([0.0, 10.0]), kind.parameters())

    assert np.array_equal(states, orbits())


def test_the_ballistic_coefficient_is_each_vehicles_own(dragged):
    states = np.repeat(orbits(1, radius_m=6.7e6), 3, axis=0)
    ballistic = np.array([0.0, 0.01, 0.02])
    parameters = dragged.parameters(ballistic_m2_kg=ballistic)

    found = propagate(states, 0.0, np.array([600.0]), parameters)
    free = propagate(states, 0.0, np.array([600.0]), dragged.parameters())

    behind = np.linalg.norm((found - free)[:, 0, :3], axis=1)
    assert behind[0] < 1e-6
    # Small enough to be linear.
    assert behind[2] / behind[1] == pytest.approx(2.0, rel=1e-3)
    assert behind[1] > 0.5
    drifts = dragged.parameters(ballistic_m2_kg=ballistic).conserves_energy
    assert not drifts


def test_a_thrust_arc_far_from_the_earth_is_analytic(numerical):
    states = np.zeros((2, 6))
    states[:, 0] = 1e11
    states[:, 3:] = (1.0, 2.0, 3.0)
    thrust = np.array([[1e-3, -2e-3, 5e-4], [0.0, 0.0, 1e-2]])

    found = propagate(
        states, 0.0, np.array([50.0, 100.0]), numerical.parameters(thrust_m_s2=thrust)
    )

    # Gravity is 4e-8 m/s^2 there.
    given = found[:, :, 3:] - states[:, None, 3:]
    assert given[:, 0] == pytest.approx(50.0 * thrust, abs=5e-6)
    assert given[:, 1] == pytest.approx(100.0 * thrust, abs=5e-6)
    # Steps of a float64 of 1e11 m are 1.5e-5 m.
    moved = found[:, 1, 1:3] - 100.0 * states[:, 4:]
    assert moved == pytest.approx(5000.0 * thrust[:, 1:], abs=1e-6)


def test_a_thrust_arc_in_orbit_adds_to_gravity(numerical):
    thrust = np.full((4, 3), 2e-3)
    burnt = propagate(orbits(), 0.0, np.array([10.0]), numerical.parameters(thrust_m_s2=thrust))
    free = propagate(orbits(), 0.0, np.array([10.0]), numerical.parameters())

    gained = (burnt - free)[:, 0, 3:]

    # The gravity gradient bends it by (n t)^2.
    assert gained == pytest.approx(10.0 * thrust, rel=1.5e-4)


def test_who_cannot_maneuver_says_so(kind, folder):
    own = replace(make_kind("custom", folder).settings, can_maneuver=False)

    assert kind.settings.can_maneuver == kind.is_numerical
    assert not own.can_maneuver


def test_a_thrust_is_refused_by_who_cannot_maneuver(folder):
    sgp4 = make_kind("sgp4", folder).parameters(thrust_m_s2=np.zeros((4, 3)))

    with pytest.raises(ConfigurationError, match="sgp4 cannot follow a thrust"):
        propagate(orbits(), 0.0, np.array([1.0]), sgp4)


@pytest.mark.parametrize(
    ("change", "what"),
    [
        (lambda s: s.__setitem__((2, 4), math.nan), "C: expected a finite state, got .*nan"),
        (lambda s: s.__setitem__((2, 0), math.inf), "C: expected a finite state, got .*inf"),
    ],
)
def test_bad_states_are_named(kind, change, what):
    states = orbits()
    change(states)

    with pytest.raises(ConfigurationError, match=f"^{what}.* at 5 s$"):
        propagate(states, 5.0, np.array([6.0]), kind.parameters(names=("A", "B", "C", "D")))


def test_a_vehicle_that_meets_the_earth_stands_still_there_and_the_others_fly_on(numerical):
    states, knots_s = orbits(), np.arange(0.0, 700.0, 20.0)
    states[1, 3:] *= 0.5

    found = propagate(states, 0.0, knots_s, numerical.parameters())

    expected = propagate(orbits(), 0.0, knots_s, numerical.parameters())
    assert distance_m(found[[0, 2, 3]], expected[[0, 2, 3]]) < 1e-7
    heights_m = np.linalg.norm(found[1, :, :3], axis=1) - EARTH_POLAR_RADIUS_M
    met = int(np.argmax(heights_m < 0.0))
    assert 10 < met < 30
    assert np.linalg.norm(found[1, met, 3:]) > 4e3
    assert (found[1, met:, :3] == found[1, met, :3]).all()
    assert not found[1, met + 1 :, 3:].any()


@pytest.mark.parametrize("along_m_s", [0.0, 50.0])
def test_a_steep_fall_through_a_long_call_ends_nobody_else(numerical, along_m_s):
    states, knots_s = orbits(), np.arange(0.0, 2000.0, 100.0)
    states[1, 3:] *= along_m_s / np.linalg.norm(states[1, 3:])

    found = propagate(states, 0.0, knots_s, numerical.parameters())

    expected = propagate(orbits(), 0.0, knots_s, numerical.parameters())
    assert distance_m(found[[0, 2, 3]], expected[[0, 2, 3]]) < 1e-6
    assert not found[1, -1, 3:].any()


@pytest.mark.slow
def test_a_call_that_begins_inside_the_earth_stays_where_it_began(kind):
    states = orbits()
    states[2, :3] = 3e6, 3e6, 3e6
    knots_s = np.array([5.0, 6.0, 2000.0])

    found = propagate(states, 5.0, knots_s, kind.parameters())

    assert (found[2, :, :3] == 3e6).all()
    assert found[2, :, 3:].any(axis=1).tolist() == [True, False, False]
    others = propagate(orbits(), 5.0, knots_s, kind.parameters())
    assert distance_m(found[[0, 1, 3]], others[[0, 1, 3]]) < 1e-6


def test_a_fleet_of_wrecks_stays_where_it_is(kind):
    states = np.zeros((4, 6))

    found = propagate(states, 5.0, np.array([6.0]), kind.parameters())

    assert not found.any()


@pytest.mark.parametrize("name", ["scipy", "numba"])
def test_a_tolerance_out_of_reach_is_said(name, folder):
    kind = make_kind(name, folder)
    states = orbits()
    states[:, 3:] = 1e200  # Errors squared are past all numbers: no step passes.

    with (
        np.errstate(all="ignore"),
        pytest.raises(ConfigurationError, match=f"{name} DOP853 from 5e\\+06 s"),
    ):
        propagate(states, 5e6, np.array([5e6 + 1.0]), kind.parameters())


def test_what_does_not_fit_is_said_all_at_once(kind):
    parameters = kind.parameters(ballistic_m2_kg=np.zeros(3), thrust_m_s2=np.zeros((4, 2)))

    with pytest.raises(ConfigurationError) as error:
        propagate(orbits(), 5.0, np.array([6.0, 5.5]), parameters)

    text = str(error.value)
    assert "expected ballistic_m2_kg of shape (4,), got (3,)" in text
    assert "expected thrust_m_s2 of shape (4, 3), got (4, 2)" in text
    assert "expected knots that ascend from 5 s on" in text


def test_knots_before_the_start_are_refused(kind):
    with pytest.raises(ConfigurationError, match="ascend from 5 s on"):
        propagate(orbits(), 5.0, np.array([4.0]), kind.parameters())


@pytest.mark.parametrize("name", ["scipy", "numba", "basilisk"])
def test_forces_without_the_earth_are_refused(name, folder):
    kind = make_kind(name, folder, forces=("j2",))

    with pytest.raises(ConfigurationError, match="expected two_body among them, got \\['j2'\\]"):
        propagate(orbits(), 0.0, np.array([1.0]), kind.parameters())


def test_parameters_travel_to_another_process(kind):
    parameters = kind.parameters(ballistic_m2_kg=np.full(4, 0.01))

    there = pickle.loads(pickle.dumps(parameters))

    knots_s = np.array([0.0, 30.0])
    expected = propagate(orbits(), 0.0, knots_s, parameters)
    assert np.array_equal(propagate(orbits(), 0.0, knots_s, there), expected)


@pytest.mark.process
def test_properties_are_known_without_any_library():
    code = (
        "import sys; from madns_runtime.simulations.constellation.parameters import AnyPropagator;"
        "from typing import get_args;"
        "print(*(p.PROPERTIES.engine for p in get_args(AnyPropagator)));"
        "print({'scipy', 'numba', 'sgp4', 'Basilisk'} & set(sys.modules))"
    )

    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)

    engines, imported = done.stdout.splitlines()
    assert len(engines.split()) == len(PROPAGATORS)
    assert imported == "set()"


def test_properties_are_those_of_the_engine(kind):
    properties = kind.settings.PROPERTIES
    engine = load_propagator(kind.settings.kind)
    states, knots_s, given = orbits(), np.array([10.0, 400.0]), kind.parameters()
    alone = replace(given, element_sets=given.element_sets[1:2])
    together = propagate(states, 0.0, knots_s, given)

    by_itself = propagate(states[1:2], 0.0, knots_s, alone)

    assert hasattr(engine, "propagate_bodies") == properties.turns_bodies
    assert np.array_equal(by_itself[0], together[1]) == properties.is_independent
    elsewhere = propagate(states + 1.0, 0.0, knots_s, given)
    assert np.array_equal(elsewhere, together) == properties.needs_element_sets


@pytest.mark.parametrize("settings", PROPAGATORS.values(), ids=PROPAGATORS)
def test_drag_is_known_to_those_of_whom_it_may_be_asked(settings):
    fields = {field.name: field.type for field in dataclasses.fields(settings)}
    may_be_asked = "forces" in fields and "drag" in str(get_type_hints(settings)["forces"])

    assert settings.PROPERTIES.knows_drag == may_be_asked


@pytest.mark.parametrize(("name", "extra"), [("numba", "fast"), ("basilisk", "basilisk")])
def test_a_missing_extra_is_named(name, extra, monkeypatch):
    monkeypatch.setitem(sys.modules, EXTRAS[name], None)
    for module in [m for m in sys.modules if m.startswith(f"{EXTRAS[name]}.")]:
        monkeypatch.delitem(sys.modules, module)
    for module in (
        "numba_propagator",
        "numba_dop853",
        "basilisk_propagator",
        "basilisk_simulation",
    ):
        monkeypatch.delitem(sys.modules, f"{propagators.__name__}.{module}", raising=False)
        monkeypatch.delattr(propagators, module, raising=False)
    load_propagator.cache_clear()

    with pytest.raises(MissingExtraError, match=rf"cosmos-madns\[{extra}\]"):
        load_propagator(name)
