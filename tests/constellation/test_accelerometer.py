"""The accelerometer: specific force of a vehicle's truth, as mean over the time between two measurements."""

import math

import numpy as np
import pytest
from constellation_fakes import FakeContext, Star, parameters

from madns_runtime.config import from_mapping
from madns_runtime.simulations.constellation.actions import SensorFault
from madns_runtime.simulations.constellation.equipment import Sensors
from madns_runtime.simulations.constellation.messages import Segment
from madns_runtime.simulations.constellation.orbit.constants import EGM_96
from madns_runtime.simulations.constellation.parameters import ScipyPropagator
from madns_runtime.simulations.constellation.thrust import Thrust
from madns_runtime.simulations.constellation.truth.propagation import (
    PropagationParameters,
    propagate,
)
from madns_runtime.simulations.constellation.vehicle.sensors.environment import Scene
from madns_runtime.simulations.constellation.vehicle.sensors.sensor import SensorSuite
from madns_runtime.simulations.constellation.vehicle.truth_buffer import TruthBuffer

EPOCH = "2026-03-20T12:00:00Z"
HZ = 10.0
LOW = np.array((6.678e6, 0.0, 0.0, 0.0, 1000.0, 7660.0))
"""300 km up, where drag is 7e-6 m/s^2."""
TURNED = (0.0, 0.0, math.sqrt(0.5), math.sqrt(0.5))
"""Body x on inertial y."""


def orbit(from_s, until_s, *, state=LOW, ballistic=None):
    """Truth of a satellite from its *state* at from_s on."""
    forces = ("two_body", "j2") if ballistic is None else ("two_body", "j2", "drag")
    settings = PropagationParameters(
        settings=ScipyPropagator(kind="scipy", forces=forces),
        gravity=EGM_96,
        epoch_utc=None,
        ballistic_m2_kg=None if ballistic is None else np.array([ballistic]),
    )
    knots_s = np.arange(from_s, until_s + 0.5)
    return propagate(state[None], from_s, knots_s, settings)[0]


class Bench:
    """An accelerometer on a vehicle with a truth of its own."""

    def __init__(self, *segments, **settings):
        self.buffer = TruthBuffer()
        for segment in segments:
            assert self.buffer.add(segment)
        context = FakeContext("agent-01", ("agent-01",), parameters())
        wanted = from_mapping(Sensors, {"accelerometer": {"rate_hz": HZ, **settings}})
        scene = Scene(EPOCH, self.buffer, EGM_96.radius_m)
        self.suite = SensorSuite(wanted, scene, context=context, chance=bytes(32))

    def run(self, until_s):
        """Return times and values of what was measured."""
        found = []
        for tick in range(round(until_s * HZ) + 1):
            t_s = tick / HZ
            reading = self.suite.step(tick, t_s, self.buffer.lookup(t_s)).get("accelerometer")
            if reading is not None:
                found.append((reading.t_s, *reading.values))
        rows = np.array(found)
        return rows[:, 0], rows[:, 1:]


def segment(states, *, t0_s=0.0, knot_s=1.0, revision=0, **rest):
    return Segment(revision=revision, t0_s=t0_s, knot_s=knot_s, states=states, **rest)


def test_who_coasts_feels_nothing_at_all():
    times_s, felt = Bench(segment(orbit(0.0, 20.0))).run(19.0)

    assert times_s[0] == 0.1  # the first has no measurement before it
    assert (felt == 0.0).all()
    assert len(felt) == 190


def test_an_impulse_is_felt_in_the_measurement_that_it_falls_in():
    before = orbit(0.0, 20.0)
    kicked = before[5] + np.array((0.0, 0.0, 0.0, 0.3, -0.1, 0.2))
    bench = Bench(
        segment(before[:6]), segment(orbit(5.0, 20.0, state=kicked), t0_s=5.0, revision=1)
    )

    times_s, felt = bench.run(19.0)

    at = int(np.argmax(np.abs(felt).sum(axis=1)))
    assert times_s[at] == 5.0
    assert felt[at] / HZ == pytest.approx((0.3, -0.1, 0.2), abs=1e-9)
    assert np.delete(felt, at, axis=0) == pytest.approx(0.0, abs=1e-9)


def test_a_burn_shorter_than_a_tick_is_felt_whole_and_in_body_axes():
    still = np.zeros((3, 6))
    attitude = np.tile((*TURNED, 0.0, 0.0, 0.0), (3, 1))
    burn = Thrust(start_s=1.01, acceleration_m_s2=(0.0, 5.0, 0.0))
    parts = ((0.0, 1.01, None), (1.01, 1.03, burn), (1.03, 3.0, None))
    bench = Bench(
        *(
            segment(still, t0_s=start, knot_s=(end - start) / 2, attitude=attitude, thrust=thrust)
            for start, end, thrust in parts
        ),
        rate_hz=2.0,
    )

    times_s, felt = bench.run(3.0)

    # 5 m/s^2 for 0.02 s; measurements are 0.5 s apart. Inertial y is body x.
    assert felt[times_s == 1.5][0] == pytest.approx((0.1 / 0.5, 0.0, 0.0), abs=1e-12)
    assert felt[times_s != 1.5] == pytest.approx(0.0, abs=1e-12)


def test_a_steady_push_on_a_body_that_spins_is_felt_in_the_axes_between_two_ticks():
    rate_rad_s, push_m_s2 = 0.6, 0.5
    knots_s = np.arange(21.0)
    half_rad = rate_rad_s * knots_s / 2.0
    nothing = np.zeros_like(knots_s)
    spun = (nothing, nothing, np.sin(half_rad), np.cos(half_rad))
    attitude = np.stack((*spun, nothing, nothing, nothing + rate_rad_s), axis=1)
    burn = Thrust(start_s=0.0, acceleration_m_s2=(push_m_s2, 0.0, 0.0))

    times_s, felt = Bench(segment(np.zeros((21, 6)), attitude=attitude, thrust=burn)).run(19.0)

    # Seen from the body the push turns back; turned as at the end of a tick it is 0.015 m/s^2 off.
    middle_rad = rate_rad_s * (times_s - 0.5 / HZ)
    mean = np.stack((np.cos(middle_rad), -np.sin(middle_rad), 0.0 * times_s), axis=1)
    assert felt == pytest.approx(push_m_s2 * mean, abs=1e-9)


def test_drag_is_that_of_truth():
    ballistic = 0.02
    dragged, free = orbit(0.0, 21.0, ballistic=ballistic), orbit(0.0, 21.0)
    bench = Bench(segment(dragged, ballistic_m2_kg=ballistic))

    _, felt = bench.run(20.0)

    # What drag has taken from the velocity; the orbits are too near to each other to feel other gravity.
    lost_m_s = (dragged - free)[20, 3:]
    assert np.linalg.norm(lost_m_s) > 1e-4
    assert felt.sum(axis=0) / HZ == pytest.approx(lost_m_s, rel=2e-3, abs=1e-7)


def test_without_drag_in_truth_none_is_felt():
    _, felt = Bench(segment(orbit(0.0, 21.0), ballistic_m2_kg=None)).run(20.0)

    assert (felt == 0.0).all()


def test_what_measurements_add_up_to_survives_those_that_never_come():
    thrust = Thrust(start_s=0.0, acceleration_m_s2=(0.5, 0.0, 0.0))
    burning = segment(np.zeros((21, 6)), thrust=thrust)

    times_s, felt = Bench(burning, dropout=0.4).run(20.0)

    assert 90 < len(felt) < 150
    assert felt[:, 0] == pytest.approx(0.5)
    gained_m_s = felt[:, 0] @ np.diff(times_s, prepend=0.0)
    assert gained_m_s == pytest.approx(0.5 * times_s[-1])


def test_what_was_given_while_it_was_dead_is_in_its_next_measurement():
    still, burn = np.zeros((3, 6)), Thrust(start_s=5.0, acceleration_m_s2=(0.5, 0.0, 0.0))
    parts = ((0.0, 5.0, None), (5.0, 7.0, burn), (7.0, 12.0, None))
    bench = Bench(
        *(
            segment(still, t0_s=start, knot_s=(end - start) / 2, thrust=thrust)
            for start, end, thrust in parts
        )
    )
    times_s, felt = [], []

    for tick in range(101):
        if tick == 40:
            bench.suite.begin_failure(1, SensorFault(sensor="accelerometer", fault="dead"))
        elif tick == 80:
            bench.suite.end_failure(1)
        state = bench.buffer.lookup(tick / HZ)
        reading = bench.suite.step(tick, tick / HZ, state).get("accelerometer")
        if reading is not None:
            times_s.append(reading.t_s)
            felt.append(reading.values[0])

    assert bench.suite.summary()["accelerometer"] == {"samples": 60, "dropped": 40, "blind": 1}
    assert np.array(felt) @ np.diff(times_s, prepend=0.0) == pytest.approx(0.5 * 2.0)


# With its host -----------------------------------------------------------------------------------

PILOT = """
class Guidance:
    def setup(self, context):
        self.context = context
    def step(self, t_s, readings):
        {body}
"""


def felt_by(folder, body, *, until_s, **vehicle):
    """Fly flight software on one satellite with an accelerometer; return times and what it felt."""
    (folder / "guidance.py").write_text(PILOT.format(body=body))
    star = Star(
        parameters(
            {"walker": "56:1/1/0", "altitude_km": 300},
            propagator={"kind": "scipy", "forces": ["two_body", "drag"]},
            vehicles=[{"sensors": {"accelerometer": {"rate_hz": HZ}}, **vehicle}],
            flight="guidance.py:Guidance",
        ),
        1,
        base_directory=folder,
        is_lockstep=True,
    )
    star.run(until_s)
    rows = np.array(star.contexts["agent-01"].records["accelerometer"])
    return rows[:, 1], rows[:, 2:]


@pytest.mark.parametrize("at_s", [14.0, 14.35, 45.0])
def test_a_new_ballistic_coefficient_is_felt_from_its_time_on(tmp_path, at_s):
    """On a knot, between two, and in truth that was not computed yet when it was commanded."""
    body = f"if t_s == 2.0: self.context.ballistic(0.03, at_s={at_s})"

    times_s, felt = felt_by(tmp_path, body, until_s=at_s + 3.0, ballistic_m2_kg_range=[0.01, 0.03])

    size = np.linalg.norm(felt, axis=1)
    late = times_s > at_s + 0.11
    assert size[late] == pytest.approx(3.0 * size[0], rel=0.02)
    assert size[times_s < at_s + 0.01] == pytest.approx(size[0], rel=0.02)
    assert 2e-6 < size[0] < 2e-5


def test_a_commanded_impulse_is_felt_as_the_host_gave_it(tmp_path):
    body = "if t_s == 2.0: self.context.delta_v((0.0, 0.3, 0.0), at_s=5.23)"

    times_s, felt = felt_by(
        tmp_path, body, until_s=8.0, thruster={"isp_s": 220, "propellant_kg": 5}
    )

    size = np.linalg.norm(felt, axis=1) / HZ
    assert times_s[int(np.argmax(size))] == pytest.approx(5.3)
    assert size.max() == pytest.approx(0.3, abs=2e-6)
    assert np.partition(size, -2)[-2] < 1e-5
