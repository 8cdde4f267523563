"""What members of a ring know of each other: over chains, around gaps, past losses; and whom they ask."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
from harness.nights import by_night

from madns_runtime.simulations.constellation.flight.api import Reading
from madns_runtime.simulations.constellation.flight.gossip import (
    CANDIDATES_MAX,
    ENTRIES_MAX,
    ENTRY,
    SILENT_ROUNDS,
    Gossip,
    Neighbourhood,
)
from madns_runtime.simulations.constellation.flight.ring_consensus import RingMember
from madns_runtime.simulations.constellation.messages import Delivery
from madns_runtime.simulations.constellation.orbit.constants import EGM_96
from madns_runtime.simulations.constellation.orbit.mean_elements import (
    CircularElements,
    osculating_from_mean,
    state_from_circular,
)

EXCHANGE_S = 300.0
SETTINGS = {
    "slots": "even",
    "altitude_km": 780.0,
    "inclination_deg": 86.4,
    "exchange_s": EXCHANGE_S,
}
TOLERANCE_DEG = 3e-3
"""States made by the first-order map swing by 31 m in their mean semi-major axis: so far they are carried on in\n80 rounds."""
REACH = 10
"""Slots of 3.87 deg that 5000 km bridge."""


def state(latitude_rad, *, sma_m=0.0, raan_rad=0.3):
    mean = CircularElements(
        a_m=EGM_96.radius_m + 780e3 + sma_m, ex=0.0, ey=0.0,
        i_rad=math.radians(86.4), raan_rad=raan_rad, lam_rad=latitude_rad,
    )  # fmt: skip
    return state_from_circular(osculating_from_mean(mean, EGM_96), EGM_96.mu_m3_s2)


class Air:
    """Members that exchange by a radio of limited reach, some of them dead, some messages lost; none moves."""

    def __init__(self, errors_deg, *, spacing_deg=None, dead=(), loss=0.0):
        count = len(errors_deg)
        self.errors_deg, self.dead, self.loss = np.asarray(errors_deg), set(dead), loss
        self.names = tuple(f"v{number}" for number in range(count))
        self.spacing_deg = spacing_deg or 360.0 / count
        settings = SETTINGS | ({"spacing_deg": spacing_deg} if spacing_deg else {})
        self.messages, self.largest_bytes, self.round = [], 0, 0
        self._chance = np.random.default_rng(3)
        self.members = [
            RingMember(
                SimpleNamespace(settings=settings, index=n, agents=self.names, send=self._radio(n)),
                follows_sma=False,
            )
            for n in range(count)
        ]

    def _radio(self, index):
        return lambda to, payload: self.messages.append((index, self.names.index(to), payload))

    def run(self, rounds):
        """Exchange, and return how many messages each one sent in the last round."""
        for _ in range(rounds):
            t_s = self.round * EXCHANGE_S
            living = [n for n in range(len(self.members)) if n not in self.dead]
            before = [member.sent for member in self.members]
            for n in living:
                member = self.members[n]
                place = math.radians(self.errors_deg[n] + self.spacing_deg * n)
                member.exchange(Reading(t_s, state(place + member.rate_rad_s * t_s)))
            self._deliver(t_s)
            self.round += 1
        return [self.members[n].sent - before[n] for n in living]

    def _deliver(self, t_s):
        count = len(self.members)
        around = not round(360.0 - count * self.spacing_deg, 6)
        for sender, to, payload in self.messages:
            self.largest_bytes = max(self.largest_bytes, len(payload["entries"]))
            apart = abs(sender - to)
            is_near = (min(apart, count - apart) if around else apart) <= REACH
            if is_near and to not in self.dead and self._chance.random() >= self.loss:
                said = Delivery(
                    sender=self.names[sender], sent_s=t_s, arrives_s=t_s, payload=payload
                )
                self.members[to].hear(said)
        self.messages.clear()

    def beliefs_deg(self):
        """What the living believe of themselves, and what is so."""
        living = [n for n in range(len(self.members)) if n not in self.dead]
        believed = [math.degrees(self.members[n].slot_error_rad) for n in living]
        return believed, self.errors_deg[living] - self.errors_deg[living].mean()


def wave_deg(count):
    """Half a wave from the first to the last: what neighbours see least of."""
    return 0.28 * np.cos(math.pi * (np.arange(count) + 0.5) / count)


COMMON_PHASES = [
    (40, 80, {"loss": 0.3, "dead": (0, 1, 20)}),
    (93, 46, {}),
    (77, 76, {"spacing_deg": 2.0}),
    # Two neighbours dead: asked across the gap after some rounds, half the ring further on.
    (93, 46 + SILENT_ROUNDS + 4, {"dead": (45, 46)}),
    # So wide a gap that nobody is in reach across it: news goes the other way round.
    (93, 81, {"dead": range(40, 51)}),
    (93, 60, {"loss": 0.1}),
    (77, 110, {"spacing_deg": 2.0, "loss": 0.1}),
]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("count", "rounds", "options"), by_night(COMMON_PHASES, day=COMMON_PHASES[:2])
)
def test_everybody_knows_the_common_phase_after_as_many_rounds_as_lie_between(
    count, rounds, options
):
    air = Air(wave_deg(count), **options)

    air.run(rounds + 1)
    believed, true = air.beliefs_deg()

    assert believed == pytest.approx(true.tolist(), abs=TOLERANCE_DEG)
    assert air.largest_bytes <= ENTRIES_MAX * ENTRY.itemsize


@pytest.mark.slow
def test_gap_is_bridged_by_two_messages_a_round_as_ever():
    air = Air(wave_deg(93), dead=(45, 46))

    sent = air.run(30)

    assert set(sent) == {2}
    assert air.members[44].neighbours == ("v43", "v47")
    assert air.members[47].neighbours == ("v44", "v48")


@pytest.mark.slow
def test_dead_are_forgotten_by_all_in_the_same_round_and_their_neighbours_find_each_other():
    air = Air(wave_deg(24))
    air.run(30)
    air.dead = {7, 8}

    air.run(24 * 2 + 24)
    before = [air.members[n].members for n in range(24) if n not in air.dead]
    air.run(2)
    after = [air.members[n].members for n in range(24) if n not in air.dead]
    believed, true = air.beliefs_deg()

    assert set(before) == {24}
    assert set(after) == {22}
    assert believed == pytest.approx(true.tolist(), abs=TOLERANCE_DEG)
    assert air.members[6].neighbours == ("v5", "v9")


def test_restarted_neighbour_is_taken_back_and_the_farther_one_is_asked_no_more():
    air = Air(wave_deg(12), dead=(4,))
    air.run(20)
    beside = air.members[3].neighbours
    air.dead = set()

    sent = air.run(SILENT_ROUNDS + 3)

    assert beside == ("v2", "v5")
    assert air.members[3].neighbours == ("v2", "v4")
    assert set(sent) == {2}


def test_message_tells_so_many_at_most_and_all_in_turn():
    count = 3 * ENTRIES_MAX
    rich, poor = (Gossip(count, index, rounds_max=2 * count) for index in (0, 1))
    crowd = np.zeros(ENTRIES_MAX, dtype=ENTRY)
    for first in range(0, count, ENTRIES_MAX):
        crowd["member"] = np.arange(first, first + ENTRIES_MAX)
        rich.hear("crowd", 5, crowd.tobytes(), 5)
    rich.enter(5, 0.1, 3.0)

    told = [rich.tell("poor", now) for now in (5, 6, 7, 8)]
    for now, entries in enumerate(told, start=5):
        poor.hear("rich", now, entries, now)

    assert {len(entries) for entries in told} == {ENTRIES_MAX * ENTRY.itemsize}
    # Of itself it knows nothing until it measures.
    assert len(poor.known(8).ages) == count - 1


@pytest.mark.parametrize(
    ("said", "entries"),
    [
        (5, b"\x01" * (ENTRY.itemsize + 1)),
        (5, b"\x00" * ENTRY.itemsize * (ENTRIES_MAX + 1)),
        (7, np.array([(1, 0, 0.1, 0.0, 0.0)], dtype=ENTRY).tobytes()),
        (-1, np.array([(1, 0, 0.1, 0.0, 0.0)], dtype=ENTRY).tobytes()),
        (10**30, np.array([(1, 0, 0.1, 0.0, 0.0)], dtype=ENTRY).tobytes()),
        (5, np.array([(3, 0, 0.1, 0.0, 0.0)], dtype=ENTRY).tobytes()),
        (5, np.array([(1, 0, math.nan, 0.0, 0.0)], dtype=ENTRY).tobytes()),
        (5, np.array([(1, 0, 0.1, math.inf, 0.0)], dtype=ENTRY).tobytes()),
        # Where one is oneself nobody else knows better.
        (5, np.array([(0, 0, 2.0, 0.0, 0.0)], dtype=ENTRY).tobytes()),
    ],
)
def test_what_nobody_can_have_measured_is_left_alone(said, entries):
    mine = Gossip(3, 0, rounds_max=10)
    mine.enter(4, 0.5, 1.0)

    mine.hear("b", said, entries, 5)

    assert mine.known(5).phases_rad.tolist() == [0.5]
    assert mine.known(5).ages.tolist() == [1]


def test_older_news_does_not_replace_newer():
    mine = Gossip(2, 0, rounds_max=10)
    for said, age, phase in ((5, 1, 0.25), (5, 3, 0.5), (6, 2, 0.75)):
        entry = np.array([(1, age, phase, 0.0, 0.0)], dtype=ENTRY)
        mine.hear("b", said, entry.tobytes(), 6)

    assert mine.known(6).phases_rad.tolist() == [0.25]
    assert mine.known(6).ages.tolist() == [2]


def test_drift_is_carried_on_between_old_news():
    # One 500 m higher falls behind; what was heard of it ten rounds ago is not where it is.
    sent = []
    context = SimpleNamespace(
        settings=SETTINGS, index=0, agents=("a", "b"), send=lambda to, payload: sent.append(to)
    )
    member = RingMember(context, follows_sma=False)
    member.exchange(Reading(0.0, state(0.0)))
    entry = np.array([(1, 0, 0.0, 500.0, 500.0)], dtype=ENTRY).tobytes()
    said = {"round": 0, "asks": True, "entries": entry}
    member.hear(Delivery(sender="b", sent_s=0.0, arrives_s=0.0, payload=said))

    t_s = 10 * EXCHANGE_S
    member.exchange(Reading(t_s, state(member.rate_rad_s * t_s)))

    behind = 1.5 * member.rate_rad_s / member.design.a_m * 500.0 * t_s
    assert member.slot_error_rad == pytest.approx(0.5 * behind, rel=0.01)
    assert member.sma_ring_m == pytest.approx(member.design.a_m + 250.0, abs=5.0)


def test_under_drag_those_of_whom_news_is_old_are_taken_to_have_fallen_as_all_do():
    # Two fall by 200 m a round, the second heard of every fourth round only: last three rounds ago.
    context = SimpleNamespace(
        settings=SETTINGS, index=0, agents=("a", "b"), send=lambda to, payload: None
    )
    members = [RingMember(context, follows_sma=follows) for follows in (True, False)]
    for number in range(9):
        t_s, fallen_m = number * EXCHANGE_S, 200.0 * number
        for member in members:
            if number % 4 == 1:
                entry = np.array([(1, 0, 0.0, -fallen_m, 0.0)], dtype=ENTRY).tobytes()
                said = {"round": number, "asks": True, "entries": entry}
                member.hear(Delivery(sender="b", sent_s=t_s, arrives_s=t_s, payload=said))
            member.exchange(Reading(t_s, state(member.rate_rad_s * t_s, sma_m=-fallen_m)))

    height_m = [member.sma_ring_m - member.design.a_m for member in members]
    assert height_m == pytest.approx([-1600.0, 0.0], abs=60.0)


def test_those_of_another_plane_in_view_are_no_members_of_ones_ring():
    # Two planes of two satellites each, which all hear each other's first words.
    names, air = tuple("abcd"), []

    def radio(sender):
        return SimpleNamespace(
            settings=SETTINGS | {"slots": "kept"},
            index=names.index(sender),
            agents=names,
            send=lambda to, payload: air.append((sender, to, payload)),
            broadcast=lambda payload: air.extend(
                (sender, to, payload) for to in names if to != sender
            ),
        )

    members = {name: RingMember(radio(name), follows_sma=False) for name in names}
    for number in range(8):
        t_s = number * EXCHANGE_S
        for place, (name, member) in enumerate(members.items()):
            raan_rad, sma_m = (0.3, 0.0) if name in "ab" else (1.3, 4000.0)
            turned_rad = 0.3 * place + member.rate_rad_s * t_s
            member.exchange(Reading(t_s, state(turned_rad, sma_m=sma_m, raan_rad=raan_rad)))
        for sender, to, payload in air:
            said = Delivery(sender=sender, sent_s=t_s, arrives_s=t_s, payload=payload)
            members[to].hear(said)
        air.clear()

    assert [member.neighbours for member in members.values()] == [("b",), ("a",), ("d",), ("c",)]
    assert {member.members for member in members.values()} == {2}


@pytest.mark.parametrize(
    "payload",
    [
        "hello",
        {"round": 0, "asks": True},
        {"round": 0.0, "asks": True, "entries": b""},
        {"round": 0, "asks": 1, "entries": b""},
        {"round": 0, "asks": True, "entries": [1, 2]},
    ],
)
def test_message_that_is_not_of_the_rings_is_none_of_its_business(payload):
    context = SimpleNamespace(
        settings=SETTINGS, index=0, agents=("a", "b"), send=lambda to, payload: None
    )
    member = RingMember(context, follows_sma=False)
    for number in range(3):
        at = number * EXCHANGE_S
        member.exchange(Reading(at, state(member.rate_rad_s * at)))
        member.hear(Delivery(sender="b", sent_s=at, arrives_s=at, payload=payload))

    assert member.members == 1
    assert member.slot_error_rad == 0.0


def test_end_of_a_chain_looks_for_nobody_beyond_it():
    around = Neighbourhood(("b", "c"), (), now=0)

    chosen = [around.choose(now) for now in range(SILENT_ROUNDS + 4)]

    assert chosen[:SILENT_ROUNDS] == [{"b": True}] * SILENT_ROUNDS
    assert {name for one in chosen for name in one} == {"b", "c"}


def test_whoever_asks_is_answered_and_only_as_long_as_it_asks():
    around = Neighbourhood(("b",), ("z",), now=0)
    around.hear("f", True, 0)

    chosen = []
    for now in range(SILENT_ROUNDS + 1):
        for name in ("b", "z"):
            around.hear(name, True, now)
        chosen.append(around.choose(now))

    assert chosen[0] == {"z": True, "b": True, "f": False}
    assert chosen[-1] == {"z": True, "b": True}


def test_nobody_farther_than_so_many_is_asked():
    names = [f"v{number}" for number in range(100)]
    around = Neighbourhood(names, (), now=0)

    asked = {name for now in range(200) for name in around.choose(now)}

    assert asked == set(names[:CANDIDATES_MAX])
