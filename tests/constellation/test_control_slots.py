"""Slots of a ring, kept by burns and by drag, each satellite knowing two neighbours: converging, and not if wrong."""

import math
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from control_harness import SCENARIOS, Fleet, flight_class

from madns_runtime.simulations.constellation.flight.api import Reading
from madns_runtime.simulations.constellation.flight.ring_consensus import RingMember, RingSettings
from madns_runtime.simulations.constellation.messages import Delivery
from madns_runtime.simulations.constellation.orbit.atmosphere import density_kg_m3, height_m
from madns_runtime.simulations.constellation.orbit.constants import EGM_96
from madns_runtime.simulations.constellation.orbit.mean_elements import (
    CircularElements,
    mean_from_state,
    osculating_from_mean,
    state_from_circular,
)

RING = 12
SLOTS = {"slots": "even", "altitude_km": 780.0, "inclination_deg": 86.4, "exchange_s": 300.0}
DRAG = SLOTS | {"altitude_km": 400.0, "density_kg_m3": 3.7e-12}
BALLISTIC = (0.01, 0.06)
DAY_S = 86_400.0


def mean_orbit(altitude_km, latitude_rad, *, sma_m=0.0):
    return CircularElements(
        a_m=EGM_96.radius_m + altitude_km * 1e3 + sma_m,
        ex=0.0,
        ey=0.0,
        i_rad=math.radians(86.4),
        raan_rad=0.3,
        lam_rad=latitude_rad,
    )


def state(mean):
    return state_from_circular(osculating_from_mean(mean, EGM_96), EGM_96.mu_m3_s2)


def ring(altitude_km, *, rms_deg=0.2, count=RING, phase_rad=3.1):
    """A ring with slot errors; its common phase is nobody's business."""
    errors = np.random.default_rng(7).normal(size=count)
    errors -= errors.mean()
    errors *= math.radians(rms_deg) / np.sqrt(np.mean(errors**2))
    places = phase_rad + math.tau * np.arange(count) / count + errors
    return [state(mean_orbit(altitude_km, place)) for place in places.tolist()]


def latitudes_rad(states):
    return np.array([mean_from_state(tuple(s[:3]), tuple(s[3:]), EGM_96).lam_rad for s in states])


def slot_error_deg(states, *, slots_rad=None):
    """Root mean square error against slots, of even spacing by default, whatever the common phase; from truth."""
    if slots_rad is None:
        slots_rad = math.tau * np.arange(len(states)) / len(states)
    place = latitudes_rad(np.asarray(states).tolist()) - slots_rad
    turned = np.exp(1j * place)
    error = np.angle(turned / turned.mean())
    return math.degrees(float(np.sqrt(np.mean((error - error.mean()) ** 2))))


def density_at(state):
    r = state[:3, None]
    return density_kg_m3(height_m(r, np.sum(r * r, axis=0), EGM_96.radius_m))[0]


def slot_keepers(**options):
    return Fleet(
        flight_class("slot_keeping.py", "SlotKeeping"), ring(780.0), settings=SLOTS, **options
    )


def drag_keepers(**options):
    return Fleet(
        flight_class("drag_phasing.py", "DragPhasing"),
        ring(400.0),
        settings=DRAG,
        tick_s=300.0,
        forces=("two_body", "j2", "drag"),
        ballistic=0.035,
        ballistic_range=BALLISTIC,
        **options,
    )


@pytest.mark.slow
def test_slot_keeping_brings_the_ring_to_even_spacing_in_a_day_with_little_delta_v():
    fleet = slot_keepers(tick_s=60.0)
    before_deg = slot_error_deg(fleet.states)

    fleet.run(DAY_S)
    finished = [one.finish() for one in fleet.software]

    assert before_deg == pytest.approx(0.2, rel=1e-3)
    assert slot_error_deg(fleet.states) < 0.02
    # Up and down again for 0.16 deg on average: 2/3 a dlam / tau twice is 0.45 m/s at most.
    assert 0.1 < float(fleet.delta_v_m_s.mean()) < 0.5
    assert [one["delta_v_m_s"] for one in finished] == pytest.approx(fleet.delta_v_m_s.tolist())
    # What it believes of itself is what is true.
    assert max(abs(one["slot_error_deg"]) for one in finished) < 0.05
    # Two neighbours, once an exchange: nobody speaks to anybody else.
    assert {one["messages"] for one in finished} == {2 * int(DAY_S / 300.0)}
    assert {one["neighbours"] for one in finished} == {2}


@pytest.mark.nightly
@pytest.mark.slow
def test_chain_whose_middle_dies_keeps_one_phase_over_the_gap():
    # Half a wave of error along the chain, and after five hours two of its middle fall silent.
    count, spacing_deg = 16, 2.0
    wave_deg = 0.28 * np.cos(math.pi * (np.arange(count) + 0.5) / count)
    slots_rad = np.radians(spacing_deg * np.arange(count))
    places = 3.1 + slots_rad + np.radians(wave_deg)
    fleet = Fleet(
        flight_class("slot_keeping.py", "SlotKeeping"),
        [state(mean_orbit(780.0, place)) for place in places.tolist()],
        settings=SLOTS | {"spacing_deg": spacing_deg},
        dies_s={7: 5 * 3600.0, 8: 5 * 3600.0},
    )
    living = [index for index in range(count) if index not in (7, 8)]

    fleet.run(DAY_S)
    finished = [fleet.software[index].finish() for index in living]
    believed = [one["slot_error_deg"] for one in finished]

    after_deg = slot_error_deg(fleet.states[living], slots_rad=slots_rad[living])
    assert after_deg < 0.02
    assert math.sqrt(np.mean(np.square(believed))) == pytest.approx(after_deg, abs=2e-3)
    # Up and down again for 0.2 deg on average, as the living had, is 0.58 m/s.
    assert float(fleet.delta_v_m_s[living].mean()) < 0.6
    assert [one["neighbours"] for one in finished] == [1, *[2] * 12, 1]
    # Forgotten by all, after as many rounds as news could have been on its way.
    assert {one["members"] for one in finished} == {14}


@pytest.mark.slow
def test_slot_keeping_leaves_orbits_round():
    fleet = slot_keepers(tick_s=60.0)

    fleet.run(DAY_S / 2)
    means = [mean_from_state(tuple(s[:3]), tuple(s[3:]), EGM_96) for s in fleet.states.tolist()]

    # Burns of some 0.1 m/s would each leave e = 2 dv / v = 3e-5 if not undone half an orbit later.
    assert max(math.hypot(mean.ex, mean.ey) for mean in means) < 6e-5


@pytest.mark.nightly
@pytest.mark.slow
def test_slot_keeping_with_burns_of_the_wrong_sign_scatters_the_ring():
    fleet = slot_keepers(tick_s=60.0, sign=-1.0)

    fleet.run(DAY_S / 2)

    assert slot_error_deg(fleet.states) > 0.3


@pytest.mark.nightly
@pytest.mark.slow
def test_drag_phasing_brings_the_ring_to_even_spacing_without_propellant():
    fleet = drag_keepers()

    fleet.run(2 * DAY_S)

    assert slot_error_deg(fleet.states) < 0.04
    assert not fleet.delta_v_m_s.any()
    assert all(one.finish()["commands"] > 1 for one in fleet.software)


@pytest.mark.nightly
@pytest.mark.slow
def test_drag_phasing_with_high_and_low_exchanged_scatters_the_ring():
    fleet = drag_keepers(sign=-1.0)

    fleet.run(DAY_S)

    assert slot_error_deg(fleet.states) > 0.3


@pytest.mark.slow
def test_phase_gained_under_differential_drag_is_theorys():
    # theta'' = 3/2 rho v^2 / a dB between a high-drag and a low-drag satellite of one orbit.
    class Held:
        def setup(self, context):
            context.ballistic(BALLISTIC[context.index], at_s=0.0)

        def step(self, t_s, readings):
            """Fly as it is."""

        def command_result(self, result):
            """Nothing to learn."""

    start = mean_orbit(450.0, 1.0)
    fleet = Fleet(
        Held,
        [state(start)] * 2,
        tick_s=60.0,
        forces=("two_body", "j2", "drag"),
        ballistic=0.0,
        ballistic_range=BALLISTIC,
    )
    densities = []
    fleet.run(DAY_S / 4, lambda _t, states: densities.append(density_at(states[0])))
    low, high = latitudes_rad(fleet.states.tolist())

    speed2 = EGM_96.mu_m3_s2 / start.a_m
    acceleration = 1.5 * np.mean(densities) * speed2 / start.a_m * (BALLISTIC[1] - BALLISTIC[0])
    # The atmosphere turns with the Earth: in a polar orbit that takes v^2 up by 0.5 %, and e moves too.
    assert high - low == pytest.approx(0.5 * acceleration * (DAY_S / 4) ** 2, rel=0.05)


@pytest.mark.slow
def test_satellites_keep_the_phases_of_the_start_with_the_neighbours_of_their_plane():
    # Up to 300 m apart in height, they would drift apart by 0.3 deg in the day.
    places = [0.0, 0.3, 0.5, 1.0]
    heights_m = [150.0, -150.0, 100.0, -100.0]
    states = [state(mean_orbit(780.0, p, sma_m=h)) for p, h in zip(places, heights_m, strict=True)]
    settings = SLOTS | {"slots": "kept", "time_constant_h": 5.0}
    kept = Fleet(
        flight_class("slot_keeping.py", "SlotKeeping"), states, settings=settings, tick_s=60.0
    )

    kept.run(DAY_S)
    drift = latitudes_rad(kept.states.tolist()) - np.array(places)
    means = [mean_from_state(tuple(s[:3]), tuple(s[3:]), EGM_96).a_m for s in kept.states.tolist()]

    assert np.degrees(np.ptp(drift)) < 0.05
    assert np.ptp(means) < 30.0
    assert [one.finish()["neighbours"] for one in kept.software] == [1, 2, 2, 1]


def test_satellite_that_is_nobodys_nearest_is_adopted_and_agrees_with_the_others():
    # The last one's only neighbour by height is the first, whose own nearest one is the second.
    places, heights_m = [0.0, 0.3, 0.5], [0.0, 4000.0, -4000.0]
    states = [state(mean_orbit(780.0, p, sma_m=h)) for p, h in zip(places, heights_m, strict=True)]
    settings = SLOTS | {"slots": "kept"}
    kept = Fleet(
        flight_class("slot_keeping.py", "SlotKeeping"), states, settings=settings, tick_s=60.0
    )

    kept.run(4 * 3600.0)
    agreed_km = [one._ring.sma_ring_m / 1e3 for one in kept.software]

    assert [one.finish()["neighbours"] for one in kept.software] == [2, 1, 1]
    assert np.ptp(agreed_km) < 0.1
    assert np.mean(agreed_km) == pytest.approx(EGM_96.radius_m / 1e3 + 780.0, abs=1.0)


@pytest.mark.process
@pytest.mark.parametrize(
    ("file", "arguments"),
    [
        ("ring93.csv", ()),
        ("dragring93.csv", ("--altitude-km", "450", "--inclination-deg", "97.2")),
        (
            "chain77.csv",
            ("--count", "77", "--spacing-deg", "2", "--wave-share", "0.5", "--name", "CHAIN"),
        ),
    ],
)
def test_rings_of_the_scenarios_are_what_their_generator_writes(file, arguments):
    made = subprocess.run(
        [sys.executable, SCENARIOS / "data" / "make_ring.py", *arguments],
        capture_output=True,
        text=True,
        check=True,
    )

    assert made.stdout == (SCENARIOS / "data" / file).read_text("utf-8")


def test_faults_of_a_rings_settings_are_named():
    with pytest.raises(ValueError, match="altitude_km and inclination_deg"):
        RingSettings.from_mapping({"slots": "even"})
    with pytest.raises(ValueError, match="even or kept"):
        RingSettings.from_mapping(SLOTS | {"slots": "odd"})
    with pytest.raises(ValueError, match="exchange_s"):
        RingSettings.from_mapping(SLOTS | {"exchange_s": 0})
    with pytest.raises(ValueError, match="spacing_deg: expected > 0 and <= 360, got 0"):
        RingSettings.from_mapping(SLOTS | {"spacing_deg": 0})
    # What judges slots takes a text for no spacing: they would be all around for it.
    for given in ("2", True, [2.0]):
        with pytest.raises(ValueError, match="spacing_deg: expected a number, got"):
            RingSettings.from_mapping(SLOTS | {"spacing_deg": given})
    context = SimpleNamespace(settings=SLOTS | {"spacing_deg": 100}, index=0, agents=tuple("abcd"))
    with pytest.raises(ValueError, match="expected at most 90 for 4 agents, got 100"):
        RingMember(context, follows_sma=False)


@pytest.mark.parametrize("wrong", [{"lam": None}, {"normal": [0.0, 1.0]}, {"a": math.nan}])
def test_first_words_that_are_none_of_a_rings_are_left_alone(wrong):
    said = []
    context = SimpleNamespace(settings=SLOTS | {"slots": "kept"}, index=0, agents=("a", "b", "c"))
    context.broadcast = context.send = lambda *message: said.append(message)
    member = RingMember(context, follows_sma=False)
    mean = mean_orbit(780.0, 0.0)
    sine = math.sin(mean.i_rad)
    normal = [sine * math.sin(0.3), -sine * math.cos(0.3), math.cos(mean.i_rad)]
    hello = {"round": 0, "asks": False, "entries": b"", "t_s": 0.0, "a": mean.a_m, "normal": normal}

    member.exchange(Reading(0.0, state(mean)))
    member.hear(Delivery("b", 0.0, 0.1, hello | {"lam": 0.1}))
    member.hear(Delivery("c", 0.0, 0.1, hello | {"lam": -0.1} | wrong))
    member.exchange(Reading(300.0, state(mean)))

    assert member.neighbours == ("b",)
