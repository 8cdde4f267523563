"""Truth after commands: pieces between the knots, revisions, and what several effects make together."""

import numpy as np
import pytest
from constellation_fakes import parameters

from madns_runtime.simulations.constellation.orbit.constants import GRAVITY_MODELS
from madns_runtime.simulations.constellation.parameters import KNOTS_MAX
from madns_runtime.simulations.constellation.truth.initial_states import load_fleet
from madns_runtime.simulations.constellation.truth.maneuvers.effects import (
    Effect,
    Timeline,
    lay_out,
    snap,
)
from madns_runtime.simulations.constellation.truth.maneuvers.rules import WAITING_MAX
from madns_runtime.simulations.constellation.truth.propagation import (
    PropagationParameters,
    StretchRequest,
    TruthStretch,
    propagate,
    propagate_stretch,
)
from madns_runtime.simulations.constellation.truth.propagators.rigid_body import (
    RigidBody,
    initial_attitude,
)
from madns_runtime.simulations.constellation.truth.segments import TruthStore
from madns_runtime.simulations.constellation.truth.vehicle_propagation import (
    VehicleRequest,
    propagate_vehicle,
)
from madns_runtime.simulations.constellation.vehicle.future_truth import FutureTruth
from madns_runtime.simulations.constellation.vehicle.truth_buffer import TruthBuffer

PARAMETERS = parameters()
FLEET = load_fleet(PARAMETERS, 3, None)
PROPAGATION = PropagationParameters(
    settings=PARAMETERS.propagator, gravity=GRAVITY_MODELS["EGM-96"], epoch_utc=FLEET.epoch_utc
)
HERMITE_M = 1e-7
"""Interpolation between knots a second apart errs 2e-8 m; pieces are as dense or denser."""


def impulse(at_s, vector=(0.0, 10.0, 0.0), *, number=0, frame="rtn"):
    return Effect(
        number=number,
        kind="impulse",
        at_s=at_s,
        start_s=at_s,
        end_s=at_s,
        vector=vector,
        frame=frame,
    )


def burn(start_s, end_s, vector=(0.0, 10.0, 0.0), *, number=0, frame="inertial", burnt=0.0):
    return Effect(
        number=number,
        kind="thrust",
        at_s=(start_s + end_s) / 2,
        start_s=start_s,
        end_s=end_s,
        vector=vector,
        frame=frame,
        burnt=burnt,
    )


class Truth:
    """A store of three vehicles over 30 s, the second of which is commanded."""

    def __init__(self, windows=3):
        self.store = TruthStore(3, knots_per_window=10, knot_s=1.0)
        self.timeline = Timeline(0.0)
        self.extend(windows)

    def extend(self, windows):
        first = self.store.end * 10
        states = self.store.last_states() if first else FLEET.states
        request = StretchRequest(
            first_knot=first, knots=windows * 10 + 1, knot_s=1.0, states=states
        )
        self.store.add(propagate_stretch(request, PROPAGATION))

    def command(self, effect, vehicle=1):
        self.timeline.add(effect)
        start_s, state = self.store.restart(vehicle, effect.start_s)
        truth = propagate_vehicle(
            VehicleRequest(
                start_s=start_s,
                state=state,
                change_s=effect.start_s,
                end_knot=self.store.end * 10,
                knot_s=1.0,
                effects=self.timeline.from_time(start_s),
                thrusts=self.timeline.thrusts,
            ),
            PROPAGATION,
        )
        self.timeline.thrusts |= truth.thrusts
        self.store.replace(vehicle, truth)
        return truth


def flown(effects, t_s, vehicle=1):
    """The same by plain propagation from change to change, inertial effects only."""
    state, at_s = FLEET.states[vehicle], 0.0
    times = sorted({t_s, *(t for e in effects for t in (e.start_s, e.end_s) if t < t_s)})
    for stop_s in times:
        thrust = sum(
            (
                np.array(e.vector) / (e.end_s - e.start_s)
                for e in effects
                if e.kind == "thrust" and e.start_s <= at_s < e.end_s
            ),
            np.zeros(3),
        )
        parameters = PropagationParameters(
            settings=PARAMETERS.propagator,
            gravity=PROPAGATION.gravity,
            epoch_utc=FLEET.epoch_utc,
            thrust_m_s2=thrust[None],
        )
        if stop_s > at_s:
            state = propagate(state[None], at_s, np.array([stop_s]), parameters)[0, -1]
        at_s = stop_s
        for effect in effects:
            if effect.kind == "impulse" and effect.start_s == at_s and at_s < t_s:
                state = state + np.array((0, 0, 0, *effect.vector))
    return state


def test_truth_of_as_many_commands_as_may_wait_finds_room_on_the_vehicle():
    truth = Truth(windows=18)
    for n in range(1, WAITING_MAX):
        truth.timeline.add(burn(2.55 + 2.7 * n, 2.95 + 2.7 * n, number=n))
    truth.command(burn(2.55, 2.95))  # brings truth of all of them

    segments = truth.store.segments(1, 0, 17)
    buffer, future = TruthBuffer(), FutureTruth()
    taken = [held.add(segment) for held in (buffer, future) for segment in segments]

    assert len(segments) > 3 * WAITING_MAX
    assert all(taken)
    assert all(buffer.lookup(t_s) is not None for t_s in np.arange(0.0, 180.01, 0.1))


@pytest.mark.slow
@pytest.mark.parametrize("at_s", [12.3, 12.0, 12.95, 20.0, 29.5, 30.0])
def test_a_maneuver_at_any_time_changes_truth_from_then_on_and_nothing_before(at_s):
    before, after = Truth(), Truth()
    effect = impulse(at_s, (1.0, 10.0, -2.0), frame="inertial")

    after.command(effect)

    for t_s in np.arange(0.0, 30.0, 0.05).round(3).tolist():
        if t_s < at_s:
            assert after.store.state(1, t_s) == pytest.approx(before.store.state(1, t_s), abs=1e-6)
        elif t_s > at_s:
            error = np.array(after.store.state(1, t_s)) - flown([effect], t_s)
            assert np.abs(error[:3]).max() < HERMITE_M
            assert np.abs(error[3:]).max() < 1e-5
    assert after.store.revisions == [0, 1, 0]
    others = [after.store.states(t)[[0, 2]] - before.store.states(t)[[0, 2]] for t in (5.0, 25.5)]
    assert np.abs(others).max() == 0.0


def test_states_of_all_vehicles_are_those_of_each():
    truth = Truth()
    truth.command(impulse(12.3))

    for t_s in (3.3, 12.0, 12.2999, 12.3, 12.7, 13.0, 29.99, 30.0):
        each = np.array([truth.store.state(v, t_s) for v in range(3)])
        assert np.abs(truth.store.states(t_s) - each).max() < 1e-8
    assert truth.store.states(30.1) is None
    assert truth.store.state(0, -0.1) is None


def test_a_radial_impulse_is_along_the_radius_of_its_own_time():
    truth = Truth()
    r = np.array(truth.store.state(1, 12.3)[:3])

    truth.command(impulse(12.3, (5.0, 0.0, 0.0)))

    given = np.array(truth.store.state(1, 12.3)[3:]) - np.array(Truth().store.state(1, 12.3)[3:])
    assert given == pytest.approx(5.0 * r / np.linalg.norm(r), abs=2e-6)


@pytest.mark.parametrize(
    "times", [(12.3, 12.7), (12.7, 12.3), (12.0, 11.5), (11.5, 12.0), (12.3, 12.3), (8.0, 22.25)]
)
def test_effects_compose_whatever_the_order_they_were_taken_in(times):
    truth = Truth()
    effects = [
        impulse(t, (3.0, 4.0 * n + 1, 0.0), number=n, frame="inertial") for n, t in enumerate(times)
    ]

    for effect in effects:
        truth.command(effect)

    for t_s in (11.75, 12.31, 12.5, 12.75, 13.0, 22.5, 29.9):
        error = np.array(truth.store.state(1, t_s)) - flown(effects, t_s)
        assert np.abs(error[:3]).max() < HERMITE_M
    assert truth.store.revisions[1] == 2


@pytest.mark.parametrize(
    ("start_s", "end_s"), [(12.3, 14.7), (12.0, 14.0), (9.5, 10.0), (12.2, 12.5), (12.93, 15.02)]
)
def test_a_burn_is_an_arc_with_its_thrust_and_no_interval_spans_its_ends(start_s, end_s):
    truth = Truth()
    effect = burn(start_s, end_s)

    truth.command(effect)

    for t_s in np.arange(start_s - 1.0, end_s + 2.0, 0.04).tolist():
        error = np.array(truth.store.state(1, t_s)) - flown([effect], t_s)
        assert np.abs(error[:3]).max() < HERMITE_M
    arcs = [s for s in truth.store.segments(1, 0, 2) if s.thrust is not None]
    assert [(s.t0_s, s.end_s) for s in arcs] == [(start_s, pytest.approx(end_s))]
    felt = np.array(arcs[0].thrust.at(start_s + 0.1))
    assert felt * (end_s - start_s) == pytest.approx(effect.vector)


def test_a_burn_goes_on_in_the_same_direction_when_an_impulse_comes_in_its_middle():
    truth = Truth()
    arc = burn(12.3, 16.3, frame="rtn")
    first = truth.command(arc)
    thrust = truth.timeline.thrusts[0]

    second = truth.command(impulse(14.1, (50.0, 0.0, 0.0), number=1))

    assert first.thrusts == {0: thrust}
    assert second.thrusts == {0: thrust}
    assert second.pieces[0].thrust == thrust


def test_a_burn_beyond_what_is_known_goes_on_in_the_next_stretch():
    truth = Truth()
    arc = burn(27.5, 33.5)
    truth.command(arc)
    start_s = truth.store.end_s
    state = truth.store.last_states()[1]

    truth.extend(1)
    more = propagate_vehicle(
        VehicleRequest(
            start_s=start_s,
            state=state,
            change_s=start_s,
            end_knot=40,
            knot_s=1.0,
            effects=truth.timeline.between(start_s, 40.0),
            thrusts=truth.timeline.thrusts,
        ),
        PROPAGATION,
    )
    truth.store.put(1, more)

    for t_s in (28.0, 30.0, 31.5, 33.4, 33.7, 36.5):
        error = np.array(truth.store.state(1, t_s)) - flown([arc], t_s)
        assert np.abs(error[:3]).max() < 2 * HERMITE_M
    assert truth.store.last_states()[1][:3] == pytest.approx(flown([arc], 40.0)[:3], abs=1e-6)


@pytest.mark.parametrize("at_s", [12.3, 12.0, 12.95])
def test_an_agent_that_is_sent_the_change_flies_what_the_host_knows(at_s):
    truth, buffer = Truth(), TruthBuffer()
    for segment in truth.store.segments(1, 0, 2):
        buffer.add(segment)
    rejoined = TruthBuffer()

    truth.command(impulse(at_s))
    truth.command(burn(15.2, 18.4, number=1))
    for segment in truth.store.segments_from(1, at_s, 3):
        assert buffer.add(segment)
    for segment in truth.store.segments(1, 1, 2):
        assert rejoined.add(segment)

    for t_s in np.arange(10.0, 30.0, 0.1).round(3).tolist():
        expected = truth.store.state(1, t_s)
        assert buffer.lookup(t_s) == pytest.approx(expected, abs=1e-6)
        assert rejoined.lookup(t_s) == pytest.approx(expected, abs=1e-6)
    assert (buffer.underruns, rejoined.underruns) == (0, 0)
    assert {s.revision for s in truth.store.segments(1, 0, 2)} == {2}


def still(n, knot_s):
    """A store of three windows of *n* intervals each, of a vehicle that does not move."""
    store = TruthStore(1, knots_per_window=n, knot_s=knot_s)
    states, invariants = np.full((1, 3 * n + 1, 6), 7e6), np.ones((1, 3 * n + 1, 3))
    store.add(TruthStretch(first_knot=0, states=states, invariants=invariants))
    return store


@pytest.mark.parametrize("n", [36_000, (KNOTS_MAX - 2) // 2])
def test_windows_of_more_knots_than_a_segment_has_travel_in_several(n):
    store, buffer = still(n, 0.05), TruthBuffer()

    segments = store.segments(0, 0, 2)

    assert segments[-1].end_s == pytest.approx(store.end_s)
    assert [s.t0_s for s in segments[1:]] == pytest.approx([s.end_s for s in segments[:-1]])
    assert all(len(segment.states) <= KNOTS_MAX for segment in segments)
    assert all(buffer.add(segment) for segment in segments)
    for change_s in (0.6 * store.window_s, 0.7 * store.window_s):
        # What a vehicle holds must leave room for the two windows and a half that a change brings.
        store.revisions[0] += 1
        assert all(buffer.add(segment) for segment in store.segments_from(0, change_s, 3))
    assert all(buffer.lookup(part * store.end_s / 9) for part in range(10))


def test_pieces_are_dropped_with_their_windows():
    truth = Truth()
    truth.command(impulse(4.3))
    truth.command(impulse(15.5, number=1))

    truth.store.drop_before(1)
    assert truth.store.segments(1, 0, 2)[0].t0_s == 10.0
    assert len(truth.store._pieces[1]) == 2
    truth.store.drop_before(2)

    assert truth.store._pieces == {}
    assert truth.store.state(1, 15.0) is None
    assert truth.store.restart(1, 15.5) is None


def test_a_rigid_body_turns_under_a_torque_and_its_wheels_take_it_up():
    attitude = parameters(vehicles=[{"attitude": {"inertia_kg_m2": [10, 10, 10]}}]).vehicles[0]
    r, v = FLEET.states[0][:3].tolist(), FLEET.states[0][3:].tolist()
    state = np.concatenate((FLEET.states[0], initial_attitude(attitude.attitude, r, v)))
    torque = Effect(
        number=0, kind="torque", at_s=2.5, start_s=2.5, end_s=4.5, vector=(0.0, 0.0, 0.1)
    )

    truth = propagate_vehicle(
        VehicleRequest(
            start_s=0.0,
            state=state,
            change_s=2.5,
            end_knot=10,
            knot_s=1.0,
            effects=(torque,),
            body=RigidBody.of(attitude.attitude, (0.0, 0.0, 0.0)),
        ),
        PROPAGATION,
    )

    assert truth.first_knot == 3
    assert [(p.t0_s, p.end_s) for p in truth.pieces] == [(2.5, 4.5), (4.5, 5.0)]
    assert truth.attitude.shape == (8, 7)
    # 0.1 N m for 2 s over 10 kg m^2; the rest is the orbit's own turn and its gyration.
    assert truth.attitude[-1, 6] == pytest.approx(0.02, abs=1e-4)
    timeline = Timeline(0.0)
    timeline.add(torque)
    assert timeline.wheels_at(3.5) == pytest.approx((0.0, 0.0, -0.1))
    timeline.forget_before(9.0)
    assert timeline.wheels_at(9.0) == pytest.approx((0.0, 0.0, -0.2))


def test_a_ballistic_coefficient_holds_from_its_time_on():
    timeline = Timeline(0.01)
    timeline.add(
        Effect(
            number=0, kind="ballistic", at_s=5.0, start_s=5.0, end_s=5.0, vector=(0.04, 0.0, 0.0)
        )
    )

    assert (timeline.ballistic_at(4.9), timeline.ballistic_at(5.0)) == (0.01, 0.04)
    timeline.forget_before(6.0)
    assert timeline.effects == ()
    assert timeline.ballistic_at(6.0) == 0.04


@pytest.mark.parametrize("start_s", [0.0, 0.3, 0.97, 1.0])
@pytest.mark.parametrize("end_s", [1.3, 2.0, 2.04, 5.0])
@pytest.mark.parametrize("jumps", [False, True])
def test_pieces_and_grid_cover_an_interval_without_gap_or_overlap(start_s, end_s, jumps):
    spans = lay_out(start_s, end_s, 1.0, jumps=jumps, is_arc=False)

    at_s = start_s
    for span in spans:
        assert span.start_s == at_s or (span.start_s > at_s and at_s == round(at_s))
        assert span.knot_s <= 1.1
        at_s = span.end_s
    assert at_s == end_s or (at_s == round(at_s) and end_s == round(end_s) and not jumps)


def test_times_that_mean_a_knot_are_the_knots():
    assert snap(0.1 * 3, 0.1) == 3 * 0.1
    assert snap(12.00000005, 1.0) == 12.0
    assert snap(12.3, 1.0) == 12.3
