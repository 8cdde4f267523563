"""Entries of a ring that cannot be are refused, members far from the median do not count, and neighbours may be left."""

import math

import numpy as np
import pytest

from madns_runtime.simulations.constellation.flight.entry_screening import (
    JUMP_RAD,
    SMA_CHANGE_M,
    EntryGate,
    near_median,
)
from madns_runtime.simulations.constellation.flight.gossip import (
    ENTRY,
    Gossip,
    Neighbourhood,
)
from madns_runtime.simulations.constellation.flight.ring_consensus import RingSettings

DRIFT_RAD_S_M = -2.2e-10
EXCHANGE_S = 300.0
ORBIT = {"altitude_km": 780, "inclination_deg": 86.4}


def gate():
    return EntryGate(drift_rad_s_m=DRIFT_RAD_S_M, exchange_s=EXCHANGE_S)


def told(member, phase_rad, sma_m=0.0, age=0):
    return np.array([(member, age, phase_rad, sma_m, 0.0)], dtype=ENTRY).tobytes()


@pytest.mark.parametrize(
    ("off_rad", "change_m", "rounds", "accepted"),
    [
        (0.9 * JUMP_RAD, 0.0, 1, True),
        (1.1 * JUMP_RAD, 0.0, 1, False),
        # Who burnt meanwhile may have done so right after the one entry or right before the other.
        (JUMP_RAD + 0.4 * 2.2e-10 * 1000.0 * 40 * EXCHANGE_S, 1000.0, 40, True),
        (JUMP_RAD + 0.6 * 2.2e-10 * 1000.0 * 40 * EXCHANGE_S, 1000.0, 40, False),
        (0.0, 1.1 * SMA_CHANGE_M, 1, False),
        (math.tau, 0.0, 1, True),
    ],
)
def test_entry_must_lie_where_the_one_before_it_leads(off_rad, change_m, rounds, accepted):
    led_rad = 0.1 + DRIFT_RAD_S_M * (200.0 + 0.5 * change_m) * rounds * EXCHANGE_S

    found = gate().accepts(
        phases_rad=(np.array([0.1]), np.array([led_rad + off_rad])),
        smas_m=(np.array([200.0]), np.array([200.0 + change_m])),
        rounds=np.array([rounds]),
    )

    assert found.tolist() == [accepted]


def test_lie_about_a_known_member_is_refused_counted_and_the_truth_carried_on():
    mine = Gossip(3, 0, rounds_max=20, gate=gate())
    mine.enter(0, 0.0, 0.0)
    mine.hear("b", 0, told(1, 0.001), 0)
    mine.enter(1, 0.0, 0.0)

    mine.hear("liar", 1, told(1, 0.035), 1)
    mine.hear("liar", 1, told(2, 0.5), 1)

    known = mine.known(1)
    # Of the third nothing was known: the first word is believed.
    assert mine.refused == 1
    assert known.phases_rad == pytest.approx([0.0, 0.001, 0.5])
    assert known.ages.tolist() == [0, 1, 0]


def test_members_far_from_the_median_do_not_count():
    values = np.array([0.0, 1e-3, -1e-3, 2e-3, 0.5])

    assert near_median(values, 1e-3).tolist() == [True, True, True, True, False]
    # However alike the others are, nobody is cut off for noise.
    assert near_median(np.array([0.0, 0.0, 0.0, 4e-3]), 1e-3).all()


def test_neighbour_that_is_silent_is_left_for_good_where_nothing_is_repaired():
    around = Neighbourhood(("b", "c"), ("z",), now=0, patience=2, repairs=False)
    chosen = []
    for now in range(6):
        around.hear("z", True, now)
        if now > 3:
            around.hear("b", True, now)
        around.hear("c", True, now)
        chosen.append(around.choose(now))

    # c is no nearest neighbour and is neither asked nor answered; b comes back too late.
    assert chosen[:2] == [{"b": True, "z": True}] * 2
    assert chosen[2:] == [{"z": True}] * 4
    assert [around.listens_to(name) for name in "bcz"] == [False, False, True]


def test_ring_that_is_repaired_listens_to_everybody():
    around = Neighbourhood(("b",), ("z",), now=0, patience=2)

    assert all(around.listens_to(name) for name in "bcz")
    assert [around.choose(now) for now in range(3)][-1] == {"b": True, "z": True}


@pytest.mark.parametrize(
    ("name", "value", "expected"),
    [
        ("repairs", 1, "expected true or false, got 1"),
        ("screens", "yes", "expected true or false, got 'yes'"),
        ("patience_exchanges", 0.5, "expected >= 1, got 0.5"),
    ],
)
def test_settings_of_repair_and_screening_have_bounds(name, value, expected):
    with pytest.raises(ValueError, match=f"flight.settings.{name}: {expected}"):
        RingSettings.from_mapping({**ORBIT, name: value})


def test_settings_of_repair_and_screening_are_off_unless_asked_for():
    plain = RingSettings.from_mapping(ORBIT)

    assert (plain.repairs, plain.screens, plain.patience_exchanges) == (True, False, 5)
    assert RingSettings.from_mapping({**ORBIT, "screens": True}).screens is True
