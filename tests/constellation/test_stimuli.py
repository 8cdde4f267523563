"""Stimuli: which truth a device is given at which time, in whose axes, and what a new revision of truth replaces."""

from __future__ import annotations

import math
from datetime import datetime
from types import SimpleNamespace

import numpy as np
import pytest
from constellation_fakes import FakeContext, parameters
from harness.cosmos_command import LOOSE, CosmosCommand

from cosmos_cli.errors import InputError
from cosmos_cli.models.loading import load_scenario
from madns_runtime.config import from_mapping
from madns_runtime.errors import PluginError
from madns_runtime.recording.reader import read_stream
from madns_runtime.simulations.constellation.check import find_faults
from madns_runtime.simulations.constellation.equipment import Magnetometer
from madns_runtime.simulations.constellation.messages import Initial, Segment
from madns_runtime.simulations.constellation.orbit.constants import EGM_96
from madns_runtime.simulations.constellation.orbit.earth import (
    days_since_j2000,
    fixed_to_teme,
    gmst_rad,
)
from madns_runtime.simulations.constellation.orbit.quaternions import multiply, normalised, rotate
from madns_runtime.simulations.constellation.orbit.sun import sun_m
from madns_runtime.simulations.constellation.stimulus import SOURCES, Stimulus
from madns_runtime.simulations.constellation.vehicle.future_truth import FutureTruth
from madns_runtime.simulations.constellation.vehicle.sensors.environment import Scene
from madns_runtime.simulations.constellation.vehicle.sensors.instruments import FluxGate
from madns_runtime.simulations.constellation.vehicle.stimuli import Stimuli, earth_fixed_state
from madns_runtime.simulations.constellation.vehicle.truth_buffer import (
    SEGMENTS_MAX,
    TruthBuffer,
)

EPOCH = "2026-03-20T12:00:00Z"
LEO = (7.158e6, 0.0, 0.0, 0.0, 1000.0, 7390.0)
TURNED = (0.0, 0.0, math.sqrt(0.5), math.sqrt(0.5))
RATES = (0.001, -0.002, 0.003)


class Played:
    """A device that keeps what it would put out."""

    def __init__(self, size):
        self.size = size
        self.points = {}
        self.calls = []

    def size_of(self, channel):
        return self.size

    def play(self, channel, points, *, from_s=None):
        points = list(points)
        first_s = points[0][0] if points else math.inf
        start_s = first_s if from_s is None else from_s
        assert start_s <= first_s
        assert points or from_s is not None
        self.calls.append((start_s, len(points)))
        self.points = {t: v for t, v in self.points.items() if t < start_s} | dict(points)


def segment(t0_s, knots=11, *, revision=0, x_m=0.0, attitude=True, state=LEO):
    times = t0_s + np.arange(knots)
    states = np.tile(np.array(state), (knots, 1))
    states[:, 0] += x_m + times * state[3]
    states[:, 1] += times * state[4]
    states[:, 2] += times * state[5]
    turned = np.tile(np.array((*TURNED, 0.0, 0.0, 0.0)), (knots, 1)) if attitude else None
    return Segment(revision=revision, t0_s=t0_s, knot_s=1.0, states=states, attitude=turned)


def play(first, **settings):
    """Return stimuli of one setting, and the device that they go to."""
    stimulus = Stimulus(channel="coil.field", **settings)
    device = Played(SOURCES[stimulus.source].size)
    context = FakeContext("agent-01", ("agent-01",), parameters())
    context.hardware = {"coil": device}
    initial = Initial(satellite="S1", frame="TEME", epoch_utc=EPOCH, segment=first)
    return Stimuli((stimulus,), context, initial), device


def run(stimuli, until_s, from_s=0.0, tick_s=0.1):
    for k in range(round(from_s / tick_s), round(until_s / tick_s)):
        stimuli.step(k * tick_s)


def test_points_are_handed_over_ahead_each_once_and_in_a_few_messages():
    stimuli, device = play(segment(0.0), source="position", rate_hz=20.0, lead_s=1.0)
    assert max(device.points) == 1.0  # before time runs

    run(stimuli, 5.0)

    assert list(device.points) == [k / 20 for k in range(len(device.points))]
    assert 5.0 + 0.75 - 0.15 <= max(device.points) <= 5.9 + 1e-9
    assert sum(count for _, count in device.calls) == len(device.points)
    assert len(device.calls) <= 21
    assert device.points[2.5] == pytest.approx((LEO[0], 2500.0, 2.5 * 7390.0))


def test_without_truth_nothing_is_made_up_and_it_goes_on_when_that_comes():
    stimuli, device = play(segment(0.0, knots=3), source="velocity", rate_hz=10.0, lead_s=1.0)
    run(stimuli, 1.9)
    assert max(device.points) == 2.0

    stimuli.take(segment(2.0), 1.95)
    run(stimuli, 3.0, 1.9)

    assert list(device.points) == [k / 10 for k in range(len(device.points))]
    assert max(device.points) >= 3.5
    assert stimuli.finish(3.0)["coil.field"]["replacements"] == 0
    assert max(device.points) < 3.0


def test_a_profile_ends_in_good_order_with_the_run():
    stimuli, device = play(segment(0.0, knots=80), source="velocity", rate_hz=10.0, lead_s=2.0)
    run(stimuli, 60.0)

    assert max(device.points) == 60.0
    assert device.calls[-1] == (60.1, 0)
    stimuli.take(segment(59.0, revision=1), 58.0)
    assert device.calls[-1] == (60.1, 0)


def test_a_new_revision_replaces_the_future_from_its_time_on():
    stimuli, device = play(segment(0.0), source="position", rate_hz=10.0, lead_s=2.0)
    run(stimuli, 1.0)
    assert max(device.points) >= 2.4

    stimuli.take(segment(1.55, revision=1, x_m=1000.0), 1.0)

    assert {t for t, v in device.points.items() if v[0] > LEO[0] + 999.0} == {
        t for t in device.points if t >= 1.55
    }
    assert list(device.points) == [k / 10 for k in range(len(device.points))]
    run(stimuli, 4.0, 1.0)
    assert all(v[0] == LEO[0] + 1000.0 for t, v in device.points.items() if t >= 1.55)
    told = stimuli.finish(9.0)["coil.field"]
    assert (told["replacements"], told["omitted"]) == (1, 0)


def test_a_revision_from_a_rounding_after_a_point_replaces_that_point():
    stimuli, device = play(segment(0.0), source="position", rate_hz=10.0, lead_s=2.0)
    run(stimuli, 0.1)

    stimuli.take(segment(0.1 + 0.2, revision=1, x_m=1000.0), 0.1)

    assert 0.1 + 0.2 > 3 / 10
    assert device.points[3 / 10][0] == LEO[0] + 1000.0
    assert list(device.points) == [k / 10 for k in range(len(device.points))]


def test_segments_of_a_revision_that_come_out_of_order_end_up_in_order():
    stimuli, device = play(segment(0.0), source="position", rate_hz=10.0, lead_s=3.0)
    stimuli.take(segment(2.0, revision=1, x_m=500.0), 0.5)
    stimuli.take(segment(1.0, knots=2, revision=1, x_m=500.0), 0.6)
    run(stimuli, 1.0, 0.6)

    changed = [t for t, v in device.points.items() if v[0] > LEO[0] + 499.0]
    assert changed == [t for t in device.points if t >= 1.0]
    assert list(device.points) == [k / 10 for k in range(len(device.points))]


def test_a_revision_that_comes_late_gives_the_value_that_holds_now_and_no_older_one():
    stimuli, device = play(segment(0.0), source="position", rate_hz=10.0, lead_s=1.0)
    run(stimuli, 2.0)
    device.calls.clear()

    stimuli.take(segment(1.0, revision=1, x_m=1000.0), 2.05)

    assert device.calls[0][0] == 1.0
    assert [t for t in device.points if t >= 1.0][0] == 2.0
    assert device.points[2.0][0] == LEO[0] + 1000.0
    assert stimuli.finish(9.0)["coil.field"]["omitted"] == 10


def test_a_vehicle_that_is_commanded_at_every_tick_is_given_its_newest_truth():
    stimuli, device = play(segment(0.0, knots=41), source="position", rate_hz=10.0, lead_s=1.0)

    for k in range(200):
        stimuli.take(segment(0.1 * k + 0.2, knots=31, revision=k + 1, x_m=k + 1.0), 0.1 * k)
        stimuli.step(0.1 * k)

    # From 20.1 s on the last revision; a tenth of a second of each before it.
    assert device.points[20.5][0] == pytest.approx(LEO[0] + 200.0)
    assert device.points[15.0][0] == pytest.approx(LEO[0] + 149.0)
    assert stimuli.finish(20.0)["coil.field"]["segments_refused"] == 0


def test_truth_that_a_newer_revision_has_replaced_takes_no_room_when_it_comes_late():
    truth = FutureTruth()
    assert truth.add(segment(5.0, revision=2, x_m=2.0))

    assert not any(truth.add(segment(5.0, revision=1, x_m=1.0)) for _ in range(2 * SEGMENTS_MAX))
    assert truth.add(segment(0.0, revision=1, x_m=1.0))

    assert truth.refused == 0
    assert [truth.lookup(t_s)[0] - LEO[0] for t_s in (4.9, 5.0, 9.9)] == [1.0, 2.0, 2.0]


def scene_at(state, t_s=0.0):
    scene = Scene(EPOCH, TruthBuffer(), EGM_96.radius_m)
    scene.move(t_s, state)
    return scene


def test_a_field_is_given_in_the_devices_axes_scaled_and_saturated():
    scene = scene_at((*LEO, *TURNED, *RATES))
    body_t = FluxGate(Magnetometer(), scene).measure(scene, [0.0, 0.0, 0.0])
    x, y, z = body_t
    rows = ((0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (1.0, 0.0, 0.0))
    still = {"source": "magnetic_field", "rate_hz": 1.0}

    _, plain = play(segment(0.0), **still)
    _, rolled = play(segment(0.0), **still, alignment=rows, scale=1e6, bias=(1.0, 2.0, 3.0))
    quaternion = normalised((0.5, 0.5, 0.5, 0.5))
    _, turned = play(segment(0.0), **still, alignment=quaternion)
    stimuli, held = play(segment(0.0), **still, limits=(-1e-6, 1e-6))

    assert plain.points[0.0] == pytest.approx(body_t, rel=1e-12)
    assert rolled.points[0.0] == pytest.approx((1e6 * y + 1.0, 1e6 * z + 2.0, 1e6 * x + 3.0))
    assert turned.points[0.0] == pytest.approx(rotate(quaternion, body_t), rel=1e-12)
    assert held.points[0.0] == tuple(max(min(v, 1e-6), -1e-6) for v in body_t)
    assert stimuli.finish(5.0)["coil.field"]["saturated"] == 2  # at 0 and 1 s


def test_an_attitude_is_given_with_the_devices_own_turned_on():
    mounted = normalised((0.1, 0.2, 0.3, 0.9))
    _, device = play(segment(0.0), source="quaternion", alignment=mounted)

    told = device.points[0.5]
    assert told == pytest.approx(multiply(TURNED, mounted), abs=1e-12)
    assert rotate(told, (1, 2, 3)) == pytest.approx(rotate(mounted, rotate(TURNED, (1, 2, 3))))


def test_the_sun_is_dark_in_the_umbra():
    sun = np.array(sun_m(days_since_j2000(datetime.fromisoformat(EPOCH))))
    away = -7.158e6 * sun / np.linalg.norm(sun)

    _, lit = play(segment(0.0, state=(*-away, 0.0, 0.0, 0.0)), source="sun_direction")
    _, dark = play(segment(0.0, state=(*away, 0.0, 0.0, 0.0)), source="sun_direction")

    assert math.hypot(*lit.points[0.0]) == pytest.approx(1.0)
    assert dark.points[0.0] == (0.0, 0.0, 0.0)


def test_an_earth_fixed_state_is_teme_turned_by_sidereal_time_and_its_velocity_the_derivative():
    def state_at(t_s):
        angle = 1e-3 * t_s
        r = np.array((math.cos(angle), 0.6 * math.sin(angle), 0.8 * math.sin(angle))) * 7.1e6
        v = np.array((-math.sin(angle), 0.6 * math.cos(angle), 0.8 * math.cos(angle))) * 7.1e3
        return (*r, *v)

    told = np.array(earth_fixed_state(scene_at(state_at(50.0), 50.0)))
    days = days_since_j2000(datetime.fromisoformat(EPOCH), 50.0)
    assert fixed_to_teme(told[:3], gmst_rad(days)) == pytest.approx(state_at(50.0)[:3], abs=1e-6)

    step_s = 0.5
    before, after = (
        np.array(earth_fixed_state(scene_at(state_at(t), t))[:3])
        for t in (50.0 - step_s, 50.0 + step_s)
    )
    # Central differences err by step^2 / 6 of the third derivative, 7 mm/s^3, and by the digits of sidereal time.
    assert (after - before) / (2 * step_s) == pytest.approx(told[3:], abs=2e-3)


def test_a_channel_of_another_size_is_refused_when_the_vehicle_is_set_up():
    context = SimpleNamespace(hardware={"coil": Played(3)}, parameters=parameters(), duration_s=9.0)
    initial = Initial(satellite="S1", frame="TEME", epoch_utc=EPOCH, segment=None)

    with pytest.raises(PluginError, match="coil.line takes 3 numbers, and these are 6"):
        Stimuli((Stimulus(source="earth_fixed_state", channel="coil.line"),), context, initial)


BODY = {"inertia_kg_m2": [1.0, 1.0, 1.0]}


@pytest.mark.parametrize(
    ("written", "body", "field", "what"),
    [
        ({"source": "magnetic_field"}, None, "source", "needs a vehicle with attitude"),
        ({"source": "body_rates", "channel": "coil"}, BODY, "channel", "expected DEVICE.CHANNEL"),
        ({"source": "position", "scale": [1.0, 2.0]}, None, "scale", "or 3 for position, got 2"),
        ({"source": "quaternion", "bias": [1.0] * 3}, BODY, "bias", "or 4 for quaternion, got 3"),
        ({"source": "position", "limits": [1.0, -1.0]}, None, "limits", "expected least"),
        ({"source": "position", "lead_s": 10.0}, None, "lead_s", "half of segments.buffer_s, 5 s"),
        ({"source": "position", "alignment": [0, 0, 0, 1]}, None, "alignment", "no body axes"),
        ({"source": "body_rates", "alignment": [1, 1, 0, 0]}, BODY, "alignment", "length 1"),
        (
            {"source": "quaternion", "alignment": [[1, 0, 0], [0, 1, 0], [0, 0, 1]]},
            BODY,
            "alignment",
            "got a matrix",
        ),
    ],
)
def test_what_does_not_fit_is_told_by_its_field(written, body, field, what):
    vehicle = {"stimuli": [{"channel": "coil.field", **written}], "attitude": body}
    params = parameters(vehicles=[vehicle], segments={"buffer_s": 10.0})

    [fault] = find_faults(params, 6, ".")

    assert fault.startswith(f"parameters.vehicles[0].stimuli[0].{field}: ")
    assert what in fault


def test_a_channel_takes_one_stimulus():
    one = {"source": "position", "channel": "coil.field"}
    params = parameters(vehicles=[{"stimuli": [one, one]}])

    [fault] = find_faults(params, 6, ".")
    assert fault == (
        "parameters.vehicles[0].stimuli[1].channel: expected every channel once, got coil.field again"
    )
    assert from_mapping(Stimulus, one).rate_hz == 10.0


KIND = """
from madns_runtime.hardware.contract import Channel, DeviceKind, Sample, SimulatedDevice


class Coil(SimulatedDevice):
    kind = DeviceKind(
        name="coil",
        summary="three windings that keep what they are given",
        channels=(
            Channel(name="held", shape=(3,)),
            Channel(name="field", direction="out", shape=(3,), safe=0.0, underrun="safe"),
        ),
        needs_hardware=False,
        follows_simulated_time=True,
    )

    def open(self):
        self.held = (0.0, 0.0, 0.0)
        return ""

    def sample_at(self, t_s):
        return Sample(values={"held": self.held}, taken_s=t_s)

    def write(self, values, due_s):
        self.held = values["field"]
"""
SCENARIO = """
name: fed
simulation: constellation
agents: {count: 2, tick_hz: 5}
time: {mode: lockstep, duration_s: 20}
hardware:
  armed: true
  devices: [{name: coil, kind: ./coil.py:Coil, rate_hz: 10}]
parameters:
  epoch_utc: "2026-03-20T12:00:00Z"
  satellites: {walker: "60:2/1/0", altitude_km: 600}
  segments: {buffer_s: 8}
  vehicles:
    - attitude: {inertia_kg_m2: [2, 3, 4], rates_deg_s: [3, 1, 0]}
      sensors: {magnetometer: {rate_hz: 5}}
      stimuli: [{source: magnetic_field, channel: coil.field, rate_hz: 10, scale: 1.0e+6}]
"""


FIELD = "parameters.vehicles[0].stimuli[0]"


@pytest.mark.process
@pytest.mark.parametrize(
    ("change", "words"),
    [
        (f"{FIELD}.channel=coyl.field", "expected a device that the agent uses (coil), got 'coyl'"),
        (f"{FIELD}.channel=coil.held", "coil has no output 'held'"),
        (f"{FIELD}.source=quaternion", "coil.field: expected values of 4 numbers, got 3"),
        ("hardware.armed=false", "an output moves only with hardware.armed: true"),
    ],
)
def test_what_does_not_fit_a_device_is_found_before_a_run(tmp_path, change, words):
    (tmp_path / "coil.py").write_text(KIND)
    scenario = tmp_path / "fed.yaml"
    scenario.write_text(SCENARIO)

    with pytest.raises(InputError) as refused:
        load_scenario(scenario, (change,))

    [text] = [fault.text for fault in refused.value.faults]
    assert words in text


@pytest.mark.process
def test_in_lockstep_a_coil_is_given_what_the_magnetometer_beside_it_measures(tmp_path):
    (tmp_path / "coil.py").write_text(KIND)
    scenario = tmp_path / "fed.yaml"
    scenario.write_text(SCENARIO)
    cosmos = CosmosCommand(tmp_path)

    (code, first), (_, second) = (cosmos.run(scenario, *LOOSE) for _ in range(2))

    assert code == 0, first["verdict"]
    assert first["records_sha256"] == second["records_sha256"]
    folder = cosmos.directory(first)
    rows = read_stream(folder / "agents" / "agent-01" / "magnetometer.jsonl").records()
    measured = {row[1]: row[2:] for row in rows}
    rows = read_stream(folder / "devices" / "agent-01" / "coil" / "field.jsonl").records()
    played = {t_s: (late_us, *values) for t_s, late_us, *values in rows}
    assert list(played) == [k / 10 for k in range(199)]
    for t_s, values in measured.items():
        assert played[t_s][0] == 0
        assert played[t_s][1:] == pytest.approx([1e6 * value for value in values], abs=2e-3)
    held = read_stream(folder / "devices" / "agent-01" / "coil" / "held.jsonl").records()
    assert {t: v for t, _, _, *v in held} == {t: list(v[1:]) for t, v in played.items()}
    told = first["devices"]["agent-01/coil"]["stimulus"]["field"]
    assert (told["played"], told["late"], told["skipped"], told["underruns"]) == (199, 0, 0, 0)
    names = {check["name"] for check in first["checks"]}
    assert {"hardware.stimulus_late", "hardware.stimulus_underruns"} <= names
