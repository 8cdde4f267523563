"""Ground stations: passes against Skyfield and by hand, and messages through passes only."""

import itertools
import json
import math
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from radio_harness import Air
from sgp4.api import Satrec, SatrecArray, jday

from madns_runtime.errors import ConfigurationError
from madns_runtime.medium.carrier import LEAD_S
from madns_runtime.protocol.codec import pack
from madns_runtime.protocol.messages import Transmission
from madns_runtime.simulations.constellation.orbit.constants import EARTH_RADIUS_M
from madns_runtime.simulations.constellation.orbit.earth import (
    days_since_j2000,
    gmst_rad,
    gmst_rate_rad_s,
)
from madns_runtime.simulations.constellation.orbit.visibility import LIGHT_SPEED_M_S
from madns_runtime.simulations.constellation.parameters import GroundStation, Uplink
from madns_runtime.simulations.constellation.streams import CONTACTS
from madns_runtime.simulations.constellation.truth.radio.channel import OUTCOMES, TO_GROUND
from madns_runtime.simulations.constellation.truth.radio.ground_stations import GroundSegment

ROOT = Path(__file__).parents[2]
AUTHORITY = json.loads((ROOT / "tests/authorities/passes.json").read_text())
EPOCH = datetime(2017, 3, 7, 12, tzinfo=UTC)

# One satellite on an equatorial circle, over stations on the equator: passes by hand.
RADIUS_M = EARTH_RADIUS_M + 780e3
ORBIT_RAD_S = math.sqrt(3.986004415e14 / RADIUS_M**3)
TURN_RAD_S = gmst_rate_rad_s(days_since_j2000(EPOCH))
ZERO_DEG = math.degrees(gmst_rad(days_since_j2000(EPOCH)))
BEHIND_RAD = math.radians(40.0)
"""The first vehicle starts so far west of the first station, each further one as far west of the one before."""
MASK_RAD = math.radians(10.0)
REACH_RAD = math.acos(EARTH_RADIUS_M / RADIUS_M * math.cos(MASK_RAD)) - MASK_RAD
"""Angle at the Earth's centre between station and vehicle on the mask."""
RISE_S = (BEHIND_RAD - REACH_RAD) / (ORBIT_RAD_S - TURN_RAD_S)
SET_S = (BEHIND_RAD + REACH_RAD) / (ORBIT_RAD_S - TURN_RAD_S)
PERIOD_S = math.tau / (ORBIT_RAD_S - TURN_RAD_S)
TEXT = "reboot"
BITS = 8.0 * len(pack(TEXT))


def equatorial(vehicles):
    phases = -BEHIND_RAD * np.arange(1, vehicles + 1)

    def states(t_s):
        u = phases + ORBIT_RAD_S * t_s
        cosine, sine, zero = np.cos(u), np.sin(u), np.zeros(vehicles)
        speed = RADIUS_M * ORBIT_RAD_S
        return np.stack(
            (RADIUS_M * cosine, RADIUS_M * sine, zero, -speed * sine, speed * cosine, zero), axis=1
        )

    return states


def station(name="here", *, east_deg=0.0, mask_deg=10.0, **rest):
    longitude = (east_deg - ZERO_DEG) % 360.0
    return GroundStation(
        name=name,
        latitude_deg=0.0,
        longitude_deg=longitude,
        elevation_deg_min=mask_deg,
        **rest,
    )


class Truth:
    """What the host knows of the vehicles, from a function of all states."""

    def __init__(self, states):
        self.states = states

    def state(self, vehicle, t_s):
        states = self.states(t_s)
        return None if states is None else tuple(states[vehicle].tolist())


def ground(*stations, uplinks=(), vehicles=1, states=None, seed=1):
    names = tuple(f"v{number}" for number in range(vehicles))
    segment = GroundSegment(
        stations or (station(),),
        [Uplink(at_s=at_s, to=to, text=text) for at_s, to, text in uplinks],
        agents=names,
        satellites=tuple(name.upper() for name in names),
        epoch_utc=EPOCH,
        random=np.random.default_rng(seed),
        truth=Truth(states or equatorial(vehicles)),
    )
    return Air(segment, names, TO_GROUND)


def fly(segment, until_s, *, from_s=0.0, step_s=1.0):
    """Let time pass and return all contacts, deliveries and events of uplinks."""
    contacts, deliveries, events = [], [], []
    for tick in range(math.ceil((until_s - from_s) / step_s) + 1):
        t_s = from_s + tick * step_s
        due = segment.due(t_s)
        assert all(delivery.arrives_s >= t_s - step_s for _, delivery in due)
        deliveries += due
        contacts += segment.contacts(t_s)
        events += segment.uplink_events()
    return contacts, deliveries, events


def message(to="ground", *, sent_s, number=0, payload=TEXT):
    return Transmission(to=to, sent_s=sent_s, number=number, payload=payload)


# Passes.


def skyfield_satellites():
    lines = (ROOT / "scenarios/data/iridium10.tle").read_text().splitlines()
    names = tuple(line.strip() for line in lines[::3])
    sets = SatrecArray(
        [Satrec.twoline2rv(*pair) for pair in zip(lines[1::3], lines[2::3], strict=True)]
    )

    def states(t_s):
        at = EPOCH + timedelta(seconds=math.floor(t_s))
        day, fraction = jday(at.year, at.month, at.day, at.hour, at.minute, at.second)
        fraction += (t_s - math.floor(t_s)) / 86_400.0
        error, r_km, v_km_s = sets.sgp4(np.array([day]), np.array([fraction]))
        assert not error.any()
        return np.concatenate((r_km[:, 0], v_km_s[:, 0]), axis=1) * 1e3

    return names, states


@pytest.mark.slow
def test_passes_of_iridium_are_skyfields():
    names, states = skyfield_satellites()
    segment = GroundSegment(
        [GroundStation(name=name, **place) for name, place in AUTHORITY["stations"].items()],
        [],
        agents=names,
        satellites=names,
        epoch_utc=EPOCH,
        random=np.random.default_rng(0),
        truth=Truth(states),
    )

    contacts, _, _ = fly(Air(segment, names, TO_GROUND), AUTHORITY["span_s"], step_s=30.0)

    got = {}
    for contact in contacts:
        if contact.event == "set" and contact.rise_s > 0.0:
            row = (contact.rise_s, contact.set_s, contact.elevation_deg_max)
            got.setdefault((contact.agent, contact.station), []).append(row)
    expected = {
        (agent, name): [(rise, end, height) for rise, _, end, height in rows]
        for agent, stations in AUTHORITY["passes"].items()
        for name, rows in stations.items()
    }
    assert sum(map(len, expected.values())) > 90
    assert got.keys() == expected.keys()
    for pair, rows in expected.items():
        found = np.array(got[pair])
        assert found.shape == np.array(rows).shape
        difference = np.abs(found - np.array(rows)).max(axis=0)
        assert difference[0] < 1e-3, "rise, s"
        assert difference[1] < 1e-3, "set, s"
        assert difference[2] < 1e-4, "highest elevation, deg"


def test_pass_over_the_equator_is_that_computed_by_hand():
    contacts, _, _ = fly(ground(), SET_S + 5.0)

    rise, end = contacts
    assert (rise.event, end.event) == ("rise", "set")
    assert rise.rise_s == end.rise_s == pytest.approx(RISE_S, abs=1e-4)
    assert end.set_s == pytest.approx(SET_S, abs=1e-4)
    assert end.elevation_deg_max == pytest.approx(90.0, abs=1e-2)
    assert (rise.set_s, rise.elevation_deg_max) == (None, None)
    assert len(end.to_record()) == len(CONTACTS)


@pytest.mark.slow
@given(short_s=st.floats(0.01, 15.0), phase_s=st.floats(0.0, 10.0))
@settings(deadline=None, max_examples=40)
def test_pass_shorter_than_the_step_is_not_missed(short_s, phase_s):
    # A mask so high that the pass lasts short_s, at any phase of the looks.
    reach = 0.5 * short_s * (ORBIT_RAD_S - TURN_RAD_S)
    across, up = RADIUS_M * math.sin(reach), RADIUS_M * math.cos(reach) - EARTH_RADIUS_M
    mask_deg = math.degrees(math.atan2(up, across))
    shift_deg = math.degrees(phase_s * (ORBIT_RAD_S - TURN_RAD_S))
    middle_s = BEHIND_RAD / (ORBIT_RAD_S - TURN_RAD_S) + phase_s

    segment = ground(station(east_deg=shift_deg, mask_deg=mask_deg))
    contacts, _, _ = fly(segment, middle_s + 30.0, step_s=7.0)

    assert [contact.event for contact in contacts] == ["rise", "set"]
    assert contacts[1].rise_s == pytest.approx(middle_s - short_s / 2.0, abs=1e-3)
    assert contacts[1].set_s == pytest.approx(middle_s + short_s / 2.0, abs=1e-3)


@pytest.mark.slow
def test_passes_are_the_same_however_little_truth_is_known_ahead():
    clock = [0.0]
    truth = equatorial(1)

    def known(t_s):
        return truth(t_s) if clock[0] - 0.2 <= t_s <= clock[0] + 0.5 else None

    segment, contacts = ground(states=known), []
    for tick in range(int(SET_S * 5) + 10):
        clock[0] = tick / 5.0
        segment.due(clock[0])
        contacts += segment.contacts(clock[0])

    assert contacts[-1].rise_s == pytest.approx(RISE_S, abs=1e-3)
    assert contacts[-1].set_s == pytest.approx(SET_S, abs=1e-3)


def test_passes_survive_a_host_that_fell_behind_and_forgot():
    truth = Truth(equatorial(1))
    truth.state = lambda vehicle, t_s: None  # between two looks nothing is known any more
    names = ("v0",)
    segment = GroundSegment(
        [station()],
        [],
        agents=names,
        satellites=names,
        epoch_utc=EPOCH,
        random=np.random.default_rng(1),
        truth=truth,
    )

    contacts, _, _ = fly(Air(segment, names, TO_GROUND), SET_S + 5.0)

    assert contacts[1].rise_s == pytest.approx(RISE_S, abs=1e-3)
    assert contacts[1].set_s == pytest.approx(SET_S, abs=1e-3)


def test_a_pass_is_counted_when_it_begins_and_not_when_it_is_foreseen():
    segment, counts = ground(), []
    for t_s in (RISE_S - 0.5, RISE_S + 0.5, SET_S - 0.5, SET_S + 0.5):
        fly(segment, t_s, from_s=t_s)
        summary = segment.summary()
        counts.append((summary["passes"], summary["passes_open"]))

    assert counts == [(0, 0), (1, 1), (1, 1), (1, 0)]


def test_looks_are_few():
    asked = []
    truth = equatorial(1)

    def counted(t_s):
        asked.append(t_s)
        return truth(t_s)

    fly(ground(states=counted), RISE_S - 20.0, step_s=0.1)

    # One look in 10 s, and none more where nobody rises.
    assert len(asked) <= RISE_S / 10.0 + 2


def test_next_time_wanted_is_that_of_the_next_look_contact_or_delivery():
    segment = ground(uplinks=[(0.0, "v0", TEXT)])
    t_s, times = 0.0, []
    deliveries, contacts = [], []
    while t_s < SET_S + 1.0:
        deliveries += segment.due(t_s)
        contacts += segment.contacts(t_s)
        following = segment.next_s()
        assert following > t_s
        t_s = following
        times.append(t_s)

    assert len(times) < SET_S / 10.0 + 6
    assert [contact.event for contact in contacts] == ["rise", "set"]
    assert len(deliveries) == 1


def test_vehicle_in_view_at_the_start_rises_then():
    contacts, _, _ = fly(ground(station(east_deg=-40.0)), 5.0)

    assert [(contact.event, contact.rise_s) for contact in contacts] == [("rise", 0.0)]


def test_without_stations_nothing_is_wanted():
    segment = GroundSegment(
        [],
        [],
        agents=("v0",),
        satellites=("V0",),
        epoch_utc=EPOCH,
        random=np.random.default_rng(1),
        truth=Truth(equatorial(1)),
    )
    segment = Air(segment, ("v0",), TO_GROUND)

    assert segment.due(0.0) == []
    assert segment.next_s() is None
    assert segment.send(0, message(sent_s=0.0), 0.0)[0].outcome == "unknown_receiver"


# Messages up.


def test_uplink_leaves_as_its_vehicle_rises():
    segment = ground(
        station(rate_bit_s=BITS),
        uplinks=[(0.0, "V0", TEXT), (1.0, "v0", TEXT), (RISE_S + 60.0, "v0", TEXT)],
    )

    _, deliveries, events = fly(segment, SET_S)

    # On the mask: sin(10 deg + reach) and the law of sines give the distance.
    distance_m = RADIUS_M * math.sin(REACH_RAD) / math.cos(MASK_RAD)
    arrivals = [delivery.arrives_s for _, delivery in deliveries]
    assert arrivals[0] == pytest.approx(RISE_S + 1.0 + distance_m / LIGHT_SPEED_M_S, abs=1e-3)
    assert np.diff(arrivals) == pytest.approx([1.0, 59.0], abs=0.01)
    assert [(vehicle, delivery.sender) for vehicle, delivery in deliveries] == [
        (0, "ground:here")
    ] * 3
    assert [(event.number, event.to, event.outcome) for event in events] == [
        (number, "v0", "delivered") for number in range(3)
    ]
    assert segment.summary()["uplinks_waiting"] == 0


def test_uplink_is_handed_over_before_it_arrives():
    segment = ground(uplinks=[(0.0, "v0", TEXT)])

    assert segment.due(RISE_S - LEAD_S - 0.1) == []
    assert len(segment.due(RISE_S - LEAD_S + 0.1)) == 1


def test_uplink_is_handed_over_before_it_arrives_where_truth_is_known_for_seconds_only():
    clock = [0.0]
    truth = equatorial(1)

    def known(t_s):
        return truth(t_s) if clock[0] - 1.0 <= t_s <= clock[0] + 3.0 else None

    segment, handed_s = ground(states=known, uplinks=[(0.0, "v0", TEXT)]), []
    for tick in range(int(RISE_S * 10) + 20):
        clock[0] = tick / 10.0
        handed_s += [clock[0] for _ in segment.due(clock[0])]

    assert handed_s == pytest.approx([RISE_S - LEAD_S], abs=0.2)


def test_uplink_that_does_not_end_within_the_pass_waits_for_the_next():
    segment = ground(station(rate_bit_s=BITS / 2.0), uplinks=[(SET_S - 1.0, "v0", TEXT)])

    _, first, _ = fly(segment, SET_S + 10.0)
    waiting = segment.summary()["uplinks_waiting"]
    _, later, _ = fly(segment, RISE_S + PERIOD_S + 10.0, from_s=SET_S, step_s=9.0)

    assert (first, waiting) == ([], 1)
    assert later[0][1].arrives_s == pytest.approx(RISE_S + PERIOD_S + 2.0, abs=0.1)


def test_uplinks_leave_in_their_order_whichever_station_has_time():
    slow = station("slow", east_deg=-40.0, rate_bit_s=BITS / 13.0)
    quick = station("quick", east_deg=-40.0, rate_bit_s=BITS / 3.0)

    _, _, events = fly(ground(slow, quick, uplinks=[(0.0, "v0", TEXT)] * 8), 30.0)

    assert [event.number for event in events] == list(range(8))
    assert {event.sender for event in events} == {"ground:slow", "ground:quick"}
    assert np.diff([event.sent_s for event in events]).min() >= 0.0


def test_message_longer_than_a_pass_is_not_ended_in_the_next_one():
    # It would begin in this pass and end in the middle of the next.
    rate_bit_s = BITS / PERIOD_S
    segment = ground(station(rate_bit_s=rate_bit_s), uplinks=[(0.0, "v0", TEXT)])
    middle_s = (RISE_S + SET_S) / 2.0

    (down,) = segment.send(0, message(sent_s=middle_s), middle_s)
    _, _, up = fly(segment, SET_S)

    assert down.outcome == "no_contact"
    assert up == []


def test_uplink_of_a_late_time_waits_for_it():
    segment = ground(uplinks=[(1e6, "v0", TEXT)])

    _, deliveries, events = fly(segment, SET_S)

    assert deliveries == events == []
    assert segment.summary()["uplinks_waiting"] == 1


def test_an_uplink_that_is_added_leaves_before_one_of_a_later_time():
    segment = ground(station(rate_bit_s=BITS), uplinks=[(0.0, "v0", TEXT), (1e6, "v0", TEXT)])
    fly(segment, 1.0)

    assert segment.medium.add_uplink(Uplink(at_s=1.0, to="v0", text="added"), "here")
    _, deliveries, events = fly(segment, SET_S, from_s=1.0)

    assert [delivery.payload for _, delivery in deliveries] == [TEXT, "added"]
    assert [event.number for event in events] == [0, 2]
    assert segment.summary()["uplinks_waiting"] == 1


def test_stations_and_uplinks_that_cannot_be_are_all_named():
    with pytest.raises(ConfigurationError) as caught:
        ground(station(), station(), uplinks=[(0.0, "v0", TEXT), (0.0, "nobody", TEXT)])

    assert "one station named 'here', got 2" in str(caught.value)
    assert "parameters.uplinks.1.to" in str(caught.value)


# Messages down.


def test_message_goes_down_within_a_pass_only():
    segment = ground()
    middle_s = (RISE_S + SET_S) / 2.0
    times = (RISE_S - 0.01, RISE_S + 0.01, middle_s, SET_S - 0.01, SET_S + 0.01)

    events = [
        segment.send(0, message(sent_s=t_s, number=number), t_s)[0]
        for number, t_s in enumerate(times)
    ]

    assert [event.outcome for event in events] == [
        "no_contact",
        "delivered",
        "delivered",
        "delivered",
        "no_contact",
    ]
    assert events[2].to == "ground:here"
    assert events[2].distance_m == pytest.approx(780e3, abs=1.0)
    assert events[2].arrives_s == pytest.approx(
        middle_s + BITS / 1e6 + 780e3 / LIGHT_SPEED_M_S, abs=1e-9
    )


def test_message_too_long_for_the_rest_of_the_pass_is_refused_and_holds_up_nobody():
    segment = ground(station(rate_bit_s=BITS))

    long, short = (
        segment.send(0, message(sent_s=SET_S - 1.5, number=number, payload=payload), SET_S)[0]
        for number, payload in enumerate((TEXT * 2, TEXT))
    )

    assert (long.outcome, short.outcome) == ("no_contact", "delivered")
    assert short.arrives_s == pytest.approx(SET_S - 0.5, abs=0.02)


def test_message_for_any_station_reaches_the_one_it_stands_highest_over():
    near, far = station("near", east_deg=-38.0), station("far", east_deg=-30.0)

    def outcome(to):
        (event,) = ground(far, near).send(0, message(to, sent_s=0.0), 0.0)
        return event.to, event.outcome

    assert outcome("ground") == ("ground:near", "delivered")
    assert outcome("ground:far") == ("ground:far", "delivered")
    assert outcome("ground:none") == ("ground:none", "unknown_receiver")


def test_standing_highest_is_not_standing_furthest_above_the_mask():
    strict, lenient = station(east_deg=-38.0, mask_deg=60.0), station("far", east_deg=-33.0)

    (event,) = ground(lenient, strict).send(0, message(sent_s=0.0), 0.0)

    assert (event.to, event.outcome) == ("ground:here", "delivered")


def test_station_moves_on_while_the_signal_comes_down():
    east_deg = -30.0
    (event,) = ground(station(east_deg=east_deg)).send(0, message(sent_s=0.0), 0.0)

    def distance_m(light_s):
        # A vehicle 40 deg west of the first meridian, a station that turns with the Earth.
        apart = BEHIND_RAD + math.radians(east_deg) + TURN_RAD_S * light_s
        square = RADIUS_M**2 + EARTH_RADIUS_M**2
        return math.sqrt(square - 2.0 * RADIUS_M * EARTH_RADIUS_M * math.cos(apart))

    still_m = distance_m(0.0)
    moved_m = distance_m(still_m / LIGHT_SPEED_M_S)
    assert moved_m - still_m > 1.0
    assert event.distance_m == pytest.approx(moved_m, abs=0.01)


def test_downlinks_wait_for_each_other_and_are_bounded():
    segment = ground(station(east_deg=-40.0, rate_bit_s=BITS * 10.0))

    events = [segment.send(0, message(sent_s=0.0, number=n), 0.0)[0] for n in range(300)]

    assert [event.outcome for event in events[:257]] == ["delivered"] * 257
    assert {event.outcome for event in events[257:]} == {"queue_full"}
    assert np.diff([event.arrives_s for event in events[:257]]) == pytest.approx(0.1, abs=1e-3)


@pytest.mark.parametrize(
    ("states", "sent_s", "number", "outcome"),
    [(lambda t_s: None, 5.0, 1, "no_truth"), (None, -1.0, 1, "out_of_order")],
)
def test_downlink_that_cannot_be_judged_is_accounted(states, sent_s, number, outcome):
    segment = ground(states=states)
    segment.send(0, message(sent_s=0.0), 0.0)

    assert segment.send(0, message(sent_s=sent_s, number=number), 0.0)[0].outcome == outcome


@pytest.mark.slow
@given(
    sends=st.lists(
        st.tuples(
            st.integers(0, 2),
            st.sampled_from(["ground", "ground:here", "ground:there", "ground:none"]),
            st.sampled_from([0.0, 1.0, 90.0]),
        ),
        max_size=20,
    ),
    uplinks=st.lists(
        st.tuples(st.floats(0.0, 600.0), st.sampled_from(["v0", "V1", "v2"]), st.text(max_size=40)),
        max_size=8,
    ),
    loss=st.sampled_from([0.0, 0.5]),
)
@settings(deadline=None, max_examples=30)
def test_every_message_of_both_ways_is_accounted(sends, uplinks, loss):
    stations = [
        station(rate_bit_s=100.0, loss=loss),
        station("there", east_deg=25.0, rate_bit_s=50.0, loss=loss),
    ]
    segment = ground(*stations, uplinks=uplinks, vehicles=3)
    clock, events = [0.0] * 3, []
    for number, (sender, to, pause_s) in enumerate(sends):
        clock[sender] += pause_s
        events += segment.send(sender, message(to, sent_s=clock[sender], number=number), 0.0)

    _, deliveries, up = fly(segment, 700.0, step_s=20.0)

    counts = segment.summary()
    assert counts["sent"] == len(events) + len(up) == sum(counts[name] for name in OUTCOMES)
    assert counts["transmissions"] == len(sends) + len(up)
    assert len(up) + counts["uplinks_waiting"] == len(uplinks)
    delivered = [event for event in up if event.outcome == "delivered"]
    assert len(deliveries) + counts["in_flight"] == len(delivered)
    in_order = sorted(up, key=lambda event: (event.to, uplinks[event.number][0], event.number))
    for before, after in itertools.pairwise(in_order):
        assert before.to != after.to or before.sent_s <= after.sent_s
