"""Crosslinks: what becomes of messages between vehicles, and that all of them are accounted for."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from radio_harness import Air

from madns_runtime.medium.carrier import LEAD_S
from madns_runtime.protocol.codec import pack
from madns_runtime.protocol.messages import Transmission
from madns_runtime.simulations.constellation.orbit.visibility import LIGHT_SPEED_M_S
from madns_runtime.simulations.constellation.parameters import Crosslinks as Settings
from madns_runtime.simulations.constellation.streams import LINKS
from madns_runtime.simulations.constellation.truth.radio.channel import (
    CROSSLINKS,
    OUTCOMES,
    CrosslinkMedium,
    index_of_names,
)

RADIUS_M = 7_158_137.0
RATE_RAD_S = math.sqrt(3.986004415e14 / RADIUS_M**3)
PAYLOAD = {"text": "hello"}
BITS = 8.0 * len(pack(PAYLOAD))


def ring(*degrees):
    """Return the truth of vehicles on one equatorial circle, and their names."""
    angles = np.radians(degrees)

    def states(t_s):
        u = angles + RATE_RAD_S * t_s
        cosine, sine, zero = np.cos(u), np.sin(u), np.zeros(len(u))
        speed = RADIUS_M * RATE_RAD_S
        return np.stack(
            (RADIUS_M * cosine, RADIUS_M * sine, zero, -speed * sine, speed * cosine, zero), axis=1
        )

    return states, tuple(f"v{number}" for number in range(len(degrees)))


class Truth:
    """What the host knows of the vehicles, from a function of all states."""

    def __init__(self, states):
        self.states = states

    def state(self, vehicle, t_s):
        states = self.states(t_s)
        return None if states is None else tuple(states[vehicle].tolist())


def links(*degrees, seed=1, states=None, **rest):
    truth, names = ring(*degrees)
    medium = CrosslinkMedium(
        Settings(**{"range_km_max": 20_000.0, **rest}),
        agents=names,
        satellites=tuple(f"SAT {number}" for number in range(len(names))),
        random=np.random.default_rng(seed),
        truth=Truth(states or truth),
    )
    return Air(medium, names, CROSSLINKS)


def message(to, *, sent_s=0.0, number=0, payload=PAYLOAD):
    return Transmission(to=to, sent_s=sent_s, number=number, payload=payload)


def outcomes(events):
    return [event.outcome for event in events]


def test_message_takes_its_length_light_time_and_processing():
    medium = links(0.0, 10.0, rate_bit_s=1000.0, processing_s=0.25)

    (event,) = medium.send(0, message("v1", sent_s=5.0), 5.1)
    ((receiver, delivery),) = medium.due(10.0)

    chord_m = 2.0 * RADIUS_M * math.sin(math.radians(5.0))
    # The receiver moves by the light time meanwhile, 8 ms at 7.5 km/s: 60 m.
    assert event.distance_m == pytest.approx(chord_m, abs=65.0)
    assert event.distance_m > chord_m + 10.0
    assert event.arrives_s == pytest.approx(
        5.0 + BITS / 1000.0 + 0.25 + event.distance_m / LIGHT_SPEED_M_S, abs=1e-12
    )
    assert (receiver, delivery.sender, delivery.sent_s, delivery.arrives_s, delivery.payload) == (
        1,
        "v0",
        5.0,
        event.arrives_s,
        PAYLOAD,
    )


def test_a_name_of_two_satellites_means_none_of_them():
    agents = ("v0", "v1", "v2", "SAT C")

    index = index_of_names(agents, ("SAT A", "SAT B", "SAT A", "SAT B", "SAT C"))

    assert index == {"v0": 0, "v1": 1, "v2": 2, "SAT C": 3}


def test_messages_of_one_transmitter_wait_for_each_other():
    medium = links(0.0, 10.0, 20.0, rate_bit_s=BITS)  # a second each

    arrivals = [
        medium.send(0, message("v1", number=number), 0.0)[0].arrives_s for number in range(3)
    ]
    (other,) = medium.send(2, message("v1"), 0.0)

    assert np.diff(arrivals) == pytest.approx([1.0, 1.0], abs=1e-6)
    assert other.arrives_s == pytest.approx(arrivals[0], abs=1e-4)


def test_full_queue_refuses_until_a_message_has_left():
    medium = links(0.0, 10.0, rate_bit_s=BITS, queue_max=2)

    got = [medium.send(0, message("v1", number=number), 0.0) for number in range(4)]
    later = medium.send(0, message("v1", sent_s=1.0, number=4), 1.0)

    assert [outcomes(events)[0] for events in got] == ["delivered"] * 3 + ["queue_full"]
    assert outcomes(later) == ["delivered"]
    assert later[0].arrives_s == pytest.approx(4.0, abs=0.01)


def test_earth_blocks_and_range_ends_links():
    medium = links(0.0, 10.0, 40.0, 60.0, range_km_max=3000.0)

    events = [medium.send(0, message(f"v{to}", number=to), 0.0)[0] for to in (1, 2, 3)]

    assert outcomes(events) == ["delivered", "out_of_range", "no_line_of_sight"]
    assert events[1].distance_m == pytest.approx(2 * RADIUS_M * math.sin(math.radians(20)), abs=150)
    assert events[1].arrives_s is None


def test_message_into_the_void_occupies_the_transmitter():
    medium = links(0.0, 10.0, 180.0, rate_bit_s=BITS)

    medium.send(0, message("v2"), 0.0)
    (event,) = medium.send(0, message("v1", number=1), 0.0)

    assert event.arrives_s == pytest.approx(2.0, abs=0.01)


def test_geometry_is_that_of_the_time_when_a_message_leaves():
    # Receivers on another orbit: at 0 s in range, 100 s later not.
    def states(t_s):
        return np.array(
            [[RADIUS_M, 0, 0, 0, 0, 0], [RADIUS_M, 1e6 + 5000.0 * t_s, 0, 0, 5000.0, 0]]
        )

    medium = links(0.0, 0.0, states=states, rate_bit_s=BITS / 100.0, range_km_max=1200.0)

    first = medium.send(0, message("v1"), 0.0)
    second = medium.send(0, message("v1", number=1), 0.0)

    assert outcomes(first + second) == ["delivered", "out_of_range"]


def test_broadcast_is_one_transmission_heard_by_all_in_view():
    medium = links(0.0, 10.0, -20.0, 180.0, 45.0, rate_bit_s=BITS, range_km_max=3000.0)

    events = medium.send(0, message("*"), 0.0)
    (after,) = medium.send(0, message("v1", number=1), 0.0)

    assert [(event.to, event.outcome) for event in events] == [
        ("v1", "delivered"),
        ("v2", "delivered"),
    ]
    light_s = [event.distance_m / LIGHT_SPEED_M_S for event in events]
    assert [event.arrives_s for event in events] == pytest.approx(
        [1.0 + light for light in light_s], abs=1e-12
    )
    assert light_s[1] > 1.9 * light_s[0]
    assert after.arrives_s == pytest.approx(2.0, abs=0.01)
    assert medium.summary()["transmissions"] == 2
    assert medium.summary()["sent"] == 3


@pytest.mark.parametrize("waits", [0, 1])
def test_broadcast_reaches_whom_a_message_to_each_alone_would_reach(waits):
    # At 50.36 deg the atmosphere gets in between; 300 s of waiting move those of another height by degrees.
    degrees = (0.0, 10.0, 49.0, 50.2, 50.5, 53.0, 60.0, 180.0)
    circle, _ = ring(*degrees)
    lower = np.linspace(1.0, 1.02, len(degrees))[:, None]
    scale = np.hstack((np.repeat(1.0 / lower, 3, axis=1), np.repeat(lower**0.5, 3, axis=1)))

    def states(t_s):
        return circle(t_s) * scale

    def sent(to):
        medium = links(*degrees, states=states, rate_bit_s=BITS / 300.0)
        for number in range(waits):
            medium.send(0, message("v1", number=number), 0.0)
        return medium.send(0, message(to, number=waits), 0.0)

    alone = [event for n in range(1, len(degrees)) for event in sent(f"v{n}")]
    reached = [event for event in alone if event.outcome == "delivered"]
    together = sent("*")
    assert [event.to for event in together] == [event.to for event in reached]
    for one, other in zip(together, reached, strict=True):
        assert one.distance_m == pytest.approx(other.distance_m, rel=1e-12)
        assert one.arrives_s == pytest.approx(other.arrives_s, abs=1e-9)


def test_receivers_of_a_broadcast_lose_it_each_by_itself():
    medium = links(*range(0, 40, 2), loss=0.5)

    counts = [
        outcomes(medium.send(0, message("*", number=number), 0.0)).count("lost")
        for number in range(20)
    ]

    # 190 of 380, by five standard deviations; and never all or nobody of 19.
    assert abs(sum(counts) - 190) < 49
    assert 0 < min(counts) <= max(counts) < 19


@pytest.mark.parametrize(
    ("degrees", "outcome"), [((0.0, 180.0), "no_line_of_sight"), ((0.0, 30.0), "out_of_range")]
)
def test_broadcast_that_nobody_hears_says_why(degrees, outcome):
    medium = links(*degrees, range_km_max=3000.0)

    (event,) = medium.send(0, message("*"), 0.0)

    assert (event.to, event.outcome) == ("*", outcome)


@pytest.mark.parametrize("to", ["v0", "SAT 0", "v9", "", "ground"])
def test_oneself_and_the_unknown_are_refused(to):
    medium = links(0.0, 10.0)

    (event,) = medium.send(0, message(to), 0.0)

    assert (event.to, event.outcome, event.arrives_s) == (to, "unknown_receiver", None)
    assert medium.due(1e9) == []


def test_vehicles_answer_to_their_satellites_names():
    (event,) = links(0.0, 10.0).send(0, message("SAT 1"), 0.0)

    assert (event.to, event.outcome) == ("v1", "delivered")


def test_share_of_losses_is_the_scenarios():
    medium = links(0.0, 10.0, loss=0.3)

    for number in range(2000):
        medium.send(0, message("v1", sent_s=float(number), number=number), 0.0)

    # Five standard deviations of a binomial: 5 sqrt(0.21 x 2000) = 102.
    assert abs(medium.summary()["lost"] - 600) < 102


def test_losses_depend_on_the_seed_alone():
    def lost(seed):
        medium = links(0.0, 10.0, loss=0.5, seed=seed)
        return [
            medium.send(0, message("v1", sent_s=float(n), number=n), 0.0)[0].outcome
            for n in range(50)
        ]

    assert lost(1) == lost(1)
    assert lost(1) != lost(2)


def test_deliveries_are_handed_out_ahead_of_time_once_and_in_order():
    medium = links(0.0, 10.0, 20.0, rate_bit_s=BITS)
    for number in range(3):
        medium.send(0, message("v1", number=number), 0.0)
    medium.send(2, message("v1", sent_s=0.5), 0.5)

    assert medium.next_s() == pytest.approx(1.0 - LEAD_S, abs=0.01)
    assert medium.due(-0.1) == []
    first, rest = medium.due(1.2), medium.due(1e9)
    assert [delivery.sender for _, delivery in first] == ["v0", "v2", "v0"]
    assert [delivery.arrives_s for _, delivery in rest] == pytest.approx([3.0], abs=0.01)
    assert medium.due(1e9) == []
    assert medium.next_s() is None


def test_message_heard_out_of_its_senders_order_is_refused():
    medium = links(0.0, 10.0)
    medium.send(0, message("v1", sent_s=2.0, number=7), 2.0)

    again = medium.send(0, message("v1", sent_s=2.0, number=7), 2.0)
    older = medium.send(0, message("v1", sent_s=1.0, number=8), 2.0)
    restarted = medium.send(0, message("v1", sent_s=3.0, number=0), 3.0)

    assert outcomes(again + older + restarted) == ["out_of_order", "out_of_order", "delivered"]


def test_message_of_a_time_without_truth_is_accounted():
    medium = links(0.0, 10.0, states=lambda t_s: None)

    assert outcomes(medium.send(0, message("v1"), 0.0)) == ["no_truth"]


def test_message_heard_after_its_arrival_is_counted():
    medium = links(0.0, 10.0)

    medium.send(0, message("v1"), 0.004)
    medium.send(0, message("v1", sent_s=1.0, number=1), 1.5)

    assert medium.summary()["heard_late"] == 1


def test_record_has_a_value_for_each_field():
    (event,) = links(0.0, 10.0).send(0, message("v1"), 0.0)

    assert len(event.to_record()) == len(LINKS)


TRAFFIC = st.lists(
    st.tuples(
        st.integers(0, 4),
        st.sampled_from(["*", "v0", "v1", "v2", "v3", "v4", "SAT 2", "nobody"]),
        st.sampled_from([0.0, 0.0, 0.1, 1.0]),
        st.integers(0, 300),
    ),
    max_size=40,
)


def by_sender(traffic):
    """Return each sender's messages in their order: time passes between some of them."""
    result = [[] for _ in range(5)]
    for sender, to, pause_s, size in traffic:
        sent = result[sender]
        sent_s = (sent[-1].sent_s if sent else 0.0) + pause_s
        sent.append(message(to, sent_s=sent_s, number=len(sent), payload=b"x" * size))
    return result


def run(queues, order):
    """Hear the senders' messages in an order, each sender's in its own, and return all that came of them."""
    medium = links(
        0.0, 20.0, 45.0, 80.0, 180.0, rate_bit_s=2000.0, queue_max=3, loss=0.3, range_km_max=5000.0
    )
    places, events = [0] * 5, []
    for sender in order:
        events += medium.send(sender, queues[sender][places[sender]], 0.0)
        places[sender] += 1
    return medium, sorted(events, key=repr), medium.due(1e9)


@pytest.mark.slow
@settings(deadline=None)
@given(traffic=TRAFFIC, data=st.data())
def test_outcomes_do_not_depend_on_whom_the_host_hears_first(traffic, data):
    queues = by_sender(traffic)
    order = [entry[0] for entry in traffic]
    shuffled = data.draw(st.permutations(order))

    _, events, deliveries = run(queues, order)
    medium, other_events, other_deliveries = run(queues, shuffled)

    assert other_events == events
    assert other_deliveries == deliveries
    counts = medium.summary()
    assert counts["transmissions"] == len(traffic)
    assert counts["sent"] == len(events) == sum(counts[outcome] for outcome in OUTCOMES)
    assert counts["delivered"] == counts["handed_over"] == len(deliveries)
    assert counts["in_flight"] == 0
