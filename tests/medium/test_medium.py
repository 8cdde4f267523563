"""Messages between agents, piece by piece: mailbox, carrier, and the medium made of four answers."""

import math
import weakref

import numpy as np
import pytest

from madns_runtime.errors import MessageTooLarge, PluginError
from madns_runtime.medium import carrier
from madns_runtime.medium.carrier import LEAD_S, Carrier
from madns_runtime.medium.links import LinkMedium
from madns_runtime.medium.mailbox import HELD_MAX, NUMBERS_PER_INCARNATION, Mailbox
from madns_runtime.medium.outcomes import (
    CHANNELS_MAX,
    EVERYBODY,
    WORDS_MAX,
    LinkOutcome,
    MessageAccount,
    between_agents,
)
from madns_runtime.protocol.codec import pack
from madns_runtime.protocol.link_settings import SendQueueFull
from madns_runtime.protocol.messages import (
    Delivery,
    Service,
    Transmission,
    TransmissionRefusal,
)

NAMES = ("car-1", "car-2", "car-3")
PAYLOAD = {"x_m": 1.0}
BYTES = len(pack(PAYLOAD))


# The sender's and the receiver's side.


def mailbox(**rest):
    sent = []
    box = Mailbox("car-1", NAMES, post=sent.append, **{"has_medium": True, **rest})
    return box, sent


def delivery(arrives_s, sender="car-2", sent_s=0.0, payload=None):
    return Delivery(sender, sent_s, arrives_s, payload)


def test_messages_bear_the_time_of_the_tick_and_a_number_each():
    box, sent = mailbox()
    box.due(0.5)

    numbers = [
        box.send("car-2", "a"),
        box.send(EVERYBODY, "b"),
        box.transmit("kiosk", "c", number=9),
    ]
    numbers.append(box.send("car-3", "d"))

    assert numbers == [0, 1, 9, 10]
    assert sent == [
        Transmission("car-2", 0, 0.5, "a"),
        Transmission("*", 1, 0.5, "b"),
        Transmission("kiosk", 9, 0.5, "c"),
        Transmission("car-3", 10, 0.5, "d"),
    ]


def test_a_process_started_anew_gives_no_number_twice():
    box, sent = mailbox(incarnation=2)
    box.due(0.5)

    assert box.send("car-2", "a") == NUMBERS_PER_INCARNATION


@pytest.mark.parametrize("to", ["car-9", "car-1", "", 3, ["car-2"]])
def test_an_agent_that_does_not_exist_is_the_senders_fault(to):
    box, sent = mailbox()
    box.due(0.0)

    with pytest.raises(PluginError, match="expected a receiver"):
        box.send(to, PAYLOAD)
    assert sent == []


def test_what_cannot_be_sent_to_agents_is_told():
    box, sent = mailbox()
    with pytest.raises(PluginError, match=r"no time before the first tick.* in step\(\)"):
        box.send("car-2", PAYLOAD)
    box.due(0.0)
    with pytest.raises(PluginError, match="RELIABLE and no deadline"):
        box.send("car-2", PAYLOAD, Service.BEST)
    with pytest.raises(PluginError, match="RELIABLE and no deadline"):
        box.send("car-2", PAYLOAD, Service.RELIABLE, 3.0)
    with pytest.raises(PluginError, match='declares no medium.* medium=":function"'):
        mailbox(has_medium=False)[0].send("car-2", PAYLOAD)
    assert sent == []


@pytest.mark.parametrize(
    ("to", "number", "told"),
    [
        (5, None, "receiver's name, got 5"),
        (None, None, "name"),
        ("kiosk", "7", "whole number of less than 2..62, got '7'"),
        ("kiosk", 2**63 - 1, "less than 2..62, got 9223372036854775807"),
    ],
)
def test_a_receiver_or_number_that_is_none_is_the_senders_fault(to, number, told):
    box, sent = mailbox()
    box.due(0.0)

    with pytest.raises(PluginError, match=told):
        box.transmit(to, PAYLOAD, number=number)
    assert sent == []


def test_a_message_is_held_until_the_first_tick_at_or_after_its_arrival():
    box, _ = mailbox()
    box.due(0.0)
    for one in (delivery(0.31), delivery(0.2, "car-3"), delivery(0.2, "car-2")):
        box.add(one)

    heard = {t_s: [one.sender for one in box.due(t_s)] for t_s in (0.1, 0.2, 0.3, 0.4)}

    assert heard == {0.1: [], 0.2: ["car-2", "car-3"], 0.3: [], 0.4: ["car-2"]}
    assert box.counts() == {"received": 3, "held": 0, "late": 0, "no_room": 0}


def test_a_message_from_nearby_is_received_in_the_tick_after_its_own_and_is_not_late():
    box, _ = mailbox()
    before, after = delivery(0.1 + 1e-10, sent_s=0.1), delivery(0.1 + 2e-10, "car-3")
    box.add(before)
    box.add(after)

    assert box.due(0.1) == [after]
    box.add(delivery(0.1 + 1e-10, "car-3", sent_s=0.1))
    assert [one.sender for one in box.due(0.2)] == ["car-2", "car-3"]
    assert box.counts() == {"received": 3, "held": 0, "late": 0, "no_room": 0}


def test_a_late_message_is_received_in_the_next_tick_and_counted():
    box, _ = mailbox()
    box.due(1.0)
    box.add(delivery(0.95))

    assert len(box.due(1.1)) == 1
    assert box.counts() == {"received": 1, "held": 0, "late": 1, "no_room": 0}


def test_what_finds_no_room_is_counted():
    box, _ = mailbox()
    for _ in range(HELD_MAX + 3):
        box.add(delivery(9.0))

    assert box.counts() == {"received": 0, "held": HELD_MAX, "late": 0, "no_room": 3}


# The host's side.


class Unlimited(dict):
    """A payload of which can be told whether somebody holds it."""


class Desk:
    """A carrier, its clock, and what it posted; *broken* raises for a receiver, or says that it is not there."""

    def __init__(self, broken=None, **settings):
        self.now_s, self.posted, self.broken = 0.0, [], broken or {}
        self.carrier = Carrier(NAMES, self._post, lambda: self.now_s, **settings)

    def _post(self, to, message):
        error = self.broken.get(to)
        if isinstance(error, Exception):
            raise error
        self.posted.append((to, message))
        return error is None

    def enter(self, *outcomes, sender="car-1", number=0):
        transmission = Transmission("*", number, 0.0, PAYLOAD)
        self.carrier.enter(sender, transmission, outcomes)
        return self

    def at(self, t_s):
        self.now_s = t_s
        self.carrier.hand_over()
        return self


def delivered(to, arrives_s):
    return LinkOutcome(to=to, outcome="delivered", arrives_s=arrives_s, size_bytes=BYTES)


def adds_up(account):
    return account["sent"] == sum(
        account[fate] for fate in ("delivered", "lost", "refused", "in_flight", "undelivered")
    )


def test_messages_are_handed_over_ahead_of_their_time_in_the_order_of_arrival():
    desk = Desk().enter(delivered("car-2", 5.0), delivered("car-3", 3.0))

    assert desk.carrier.next_s() == 3.0 - LEAD_S
    assert desk.at(1.9).posted == []
    assert [to for to, _ in desk.at(2.0).posted] == ["car-3"]
    account = desk.carrier.to_mapping()
    assert (account["delivered"], account["in_flight"]) == (1, 1)
    assert [to for to, _ in desk.at(9.0).posted] == ["car-3", "car-2"]
    assert desk.posted[0][1] == Delivery("car-1", 0.0, 3.0, PAYLOAD)
    assert desk.carrier.next_s() is None


def test_the_sender_is_told_of_a_refusal_and_of_no_loss():
    desk = Desk().enter(LinkOutcome(to="car-2", outcome="lost"))
    desk.enter(LinkOutcome(to="car-3", outcome="out_of_range"), number=7)

    assert desk.posted == [("car-1", TransmissionRefusal(7, "*", 0.0, "out_of_range"))]
    assert desk.carrier.to_mapping()["refused_because"] == {"out_of_range": 1}


def test_every_message_is_accounted_whatever_becomes_of_it():
    desk = Desk(broken={"car-3": SendQueueFull("full"), "car-2": False})
    desk.enter(delivered("car-2", 1.0), delivered("car-3", 1.0), delivered("car-1", 1.0))
    desk.enter(delivered("car-1", 99.0), LinkOutcome(to="car-2", outcome="lost"))
    desk.enter(LinkOutcome(to="*", outcome="too_fast"), sender="kiosk")
    desk.enter(delivered("kiosk", 2.0)).at(1.5)
    desk.broken["car-1"] = MessageTooLarge("long")
    desk.enter(LinkOutcome(to="*", outcome="too_fast"))

    account = desk.carrier.to_mapping()
    assert account == {
        "transmissions": 5,
        "sent": 8,
        "delivered": 2,  # to car-1, and to the kiosk, which is no agent
        "lost": 1,
        "refused": 2,
        "refused_because": {"too_fast": 2},
        "refusals_untold": 1,  # car-1 took no more; the kiosk is no agent
        "in_flight": 1,
        "undelivered": 2,
        "unqueued": 1,  # car-3 was there and took no more; car-2 was lost
        "known_late": 0,
    }
    assert adds_up(account)


def test_what_arrives_after_the_runs_end_is_on_its_way_and_not_kept():
    desk = Desk(end_s=10.0)
    payload = Unlimited()
    kept = weakref.ref(payload)
    outcomes = [
        delivered("car-2", 10.0 + LEAD_S),
        delivered("car-3", 12.0),
        delivered("car-2", 1e9),
    ]
    desk.carrier.enter("car-1", Transmission("*", 0, 0.0, payload), outcomes[1:])
    del payload

    assert kept() is None
    assert desk.carrier.next_s() is None
    desk.enter(outcomes[0], number=1)
    assert desk.carrier.next_s() == 10.0
    account = desk.at(10.0).carrier.to_mapping()
    assert (account["sent"], account["delivered"], account["in_flight"]) == (3, 1, 2)
    assert adds_up(account)


def test_messages_on_their_way_are_kept_up_to_a_bound(monkeypatch):
    monkeypatch.setattr(carrier, "KEPT_MAX", 3)
    desk = Desk().enter(*(delivered("car-2", 50.0 + number) for number in range(5)))

    account = desk.carrier.to_mapping()
    assert (account["in_flight"], account["undelivered"], account["unqueued"]) == (3, 2, 2)
    assert adds_up(account)
    assert len(desk.at(99.0).posted) == 3
    assert adds_up(desk.carrier.to_mapping())


def test_a_message_with_endless_outcomes_is_a_fault_of_the_medium(monkeypatch):
    monkeypatch.setattr(carrier, "OUTCOMES_MAX", 3)

    with pytest.raises(
        PluginError, match="a list of 4 LinkOutcome of one message: expected at most 3"
    ):
        Desk().enter(*(delivered("car-2", 5.0) for _ in range(4)))


def test_what_the_host_knows_only_after_its_arrival_is_counted():
    desk = Desk().at(2.0).enter(delivered("car-2", 1.0), delivered("car-3", 2.5))

    assert desk.carrier.to_mapping()["known_late"] == 1


def test_a_runs_account_has_both_sides_and_is_empty_without_messages():
    counts = [{"received": 2, "late": 1}, {"received": 3}]

    assert between_agents({}, counts) == {}
    assert between_agents({"sent": 5}, counts)["receivers"] == {"received": 5, "late": 1}
    assert Desk().carrier.to_mapping() == {}


# The medium of four answers.


def medium(**rest):
    answers = {"delay_s": 0.005, **rest}
    return LinkMedium(NAMES, np.random.default_rng(answers.pop("seed", 1)), **answers)


def carried(air, to="car-2", sender="car-1", number=0, sent_s=0.0):
    return air.carry(sender, Transmission(to, number, sent_s, PAYLOAD))


def test_a_message_takes_its_turn_its_length_and_its_delay():
    air = medium(rate_byte_s=BYTES, delay_s=lambda sender, receiver, t_s: 0.25 + t_s)

    arrivals = [carried(air, number=number)[0].arrives_s for number in range(3)]

    assert arrivals == [1.25, 3.25, 5.25]


def test_a_delay_below_what_tells_times_apart_still_arrives_later():
    (outcome,) = carried(medium(delay_s=1e-300), sent_s=2.5)

    assert outcome.arrives_s == math.nextafter(2.5, math.inf)


def test_a_full_transmitter_refuses():
    air = medium(rate_byte_s=BYTES, queue_max=1)

    outcomes = [carried(air, number=number)[0].outcome for number in range(3)]

    assert outcomes == ["delivered", "delivered", "queue_full"]


def test_reach_says_who_receives_and_why_not():
    def reach(sender, receiver, t_s):
        return "out_of_range" if receiver == "car-3" else None

    air = medium(reach=reach)

    (refused,) = carried(air, "car-3")
    (heard,) = carried(air, EVERYBODY, number=1)
    (nobody,) = carried(medium(reach=lambda *way: "wall"), EVERYBODY)

    assert (refused.to, refused.outcome) == ("car-3", "out_of_range")
    assert (heard.to, heard.outcome) == ("car-2", "delivered")
    assert (nobody.to, nobody.outcome) == ("*", "nobody_in_reach")


@pytest.mark.parametrize("word", ["lost", "delivered", ""])
def test_a_reach_refuses_for_a_reason_and_does_not_say_what_became_of_a_message(word):
    air = medium(reach=lambda *way: word)

    with pytest.raises(PluginError, match=r"^reach\('car-1', .* expected None .*, else why not"):
        carried(air, "car-3")


@pytest.mark.parametrize("to", ["car-1", "car-9", "kiosk"])
def test_oneself_and_the_unknown_are_refused(to):
    assert carried(medium(), to)[0].outcome == "unknown_receiver"


def test_messages_out_of_order_are_refused():
    air = medium()
    carried(air, sent_s=2.0, number=7)

    assert carried(air, sent_s=1.0, number=8)[0].outcome == "out_of_order"


def test_losses_are_the_share_wanted_and_hang_on_the_seed_alone():
    def lost(seed, order):
        air, found = medium(seed=seed, loss=0.3), set()
        for number in range(1000):
            for sender in order:
                (outcome,) = carried(air, "car-3", sender, number=number)
                if outcome.outcome == "lost":
                    found.add((sender, number))
        return found

    first = lost(1, ("car-1", "car-2"))

    # Five standard deviations of a binomial: 5 sqrt(0.21 x 2000) = 102.
    assert abs(len(first) - 600) < 5 * math.sqrt(0.21 * 2000)
    assert lost(1, ("car-2", "car-1")) == first
    assert lost(2, ("car-1", "car-2")) != first


@pytest.mark.parametrize(
    ("outcome", "told"),
    [
        (
            LinkOutcome(to="car-2", outcome="delivered", arrives_s="5"),
            r"arrives_s '5': expected a sim",
        ),
        (
            LinkOutcome(to="car-2", outcome=True),
            r"outcome True: expected 'delivered', 'lost', or a word",
        ),
        (LinkOutcome(to="car-2", outcome=""), r"outcome '': expected"),
        (LinkOutcome(to="car-2", outcome=None), r"outcome None: expected"),
        (LinkOutcome(to="car-2", outcome="a" * 201), r"outcome 'aaa+: expected .* at most 200"),
        (
            LinkOutcome(to="car-2", outcome="lost", channel="c" * 201),
            r"channel 'ccc+: expected .* at most 200",
        ),
        (LinkOutcome(to="car-2", outcome="lost", channel="a\nb"), r"channel 'a\\nb': expected"),
        (LinkOutcome(to=["car-2"], outcome="lost"), r"to \['car-2'\]: expected a receiver's name"),
        (LinkOutcome(to=2, outcome="lost"), r"to 2: expected"),
        (LinkOutcome(to="car-2", outcome="lost", channel=[]), r"channel \[\]: expected a text"),
        (
            LinkOutcome(to="car-2", outcome="lost", size_bytes="9"),
            r"size_bytes '9': expected a number",
        ),
        (LinkOutcome(to="car-2", outcome="lost", size_bytes=math.nan), r"size_bytes nan: expected"),
        (
            LinkOutcome(to="car-2", outcome="lost", size_bytes=-1),
            r"size_bytes -1: expected a number",
        ),
        (
            LinkOutcome(to="*", outcome="delivered", arrives_s=5.0),
            r"that delivers to '\*': expected one for each receiver, by name",
        ),
    ],
)
def test_an_outcome_of_other_values_is_the_mediums_fault_and_enters_no_account(outcome, told):
    desk = Desk()

    with pytest.raises(PluginError, match=f"a LinkOutcome (with )?{told}"):
        desk.enter(outcome)
    assert desk.carrier.to_mapping() == {}


def test_numbers_and_texts_of_numpy_in_an_outcome_become_plain():
    desk = Desk().enter(
        LinkOutcome(
            to=np.str_("car-2"),
            outcome="delivered",
            arrives_s=np.float32(0.5),
            size_bytes=np.int64(9),
        ),
        LinkOutcome(to="car-3", outcome=np.str_("busy")),
    )
    desk.at(0.0)

    (_, refusal), (to, found) = desk.posted
    assert type(refusal.reason) is type(to) is str
    assert type(found.arrives_s) is float
    assert list(map(type, desk.carrier.to_mapping()["refused_because"])) == [str]


@pytest.mark.parametrize(
    ("answers", "told"),
    [
        ({"loss": 5}, "loss: expected a share from 0 to 1, got 5"),
        ({"loss": math.nan}, "loss: expected a share"),
        (
            {"rate_byte_s": 0},
            "rate_byte_s: expected bytes per second, more than 0, or math.inf, got 0",
        ),
        ({"rate_byte_s": math.nan}, "rate_byte_s: expected"),
        ({"delay_s": 0.0}, "delay_s: expected seconds, more than 0, or a function"),
        ({"delay_s": "0.1"}, "delay_s: expected seconds"),
        (
            {"delay_s": lambda sender, receiver: 0.1},
            r"delay_s: .* or a function of \(sender, receiver, t_s\), got .*<lambda>\(sender, receiver\)$",
        ),
        (
            {"reach": lambda sender: None},
            r"reach: expected None or a function of \(sender, receiver, t_s\), got .*<lambda>\(sender\)$",
        ),
        ({"reach": 1}, "reach: expected None or a function of .*, got 1$"),
        ({"queue_max": -1}, "queue_max: expected a whole number, 0 or more, got -1"),
    ],
)
def test_a_medium_that_cannot_be_is_refused_when_it_is_made(answers, told):
    with pytest.raises(PluginError, match=f"LinkMedium: {told}"):
        LinkMedium(NAMES, np.random.default_rng(1), **{"delay_s": 0.1, **answers})


def test_functions_of_which_no_arguments_are_known_are_taken_as_they_are():
    def near(*who, **rest):
        return None

    for reach in (near, dict, None):
        medium(reach=reach)


@pytest.mark.parametrize("answer", [True, False, 3, ""])
def test_a_reach_that_answers_yes_or_no_is_told_what_to_return(answer):
    medium = LinkMedium(
        NAMES, np.random.default_rng(1), delay_s=0.1, reach=lambda sender, receiver, t_s: answer
    )

    with pytest.raises(
        PluginError,
        match=r"reach\('car-1', 'car-2', 0\) of test_medium\.py:\d+ returned .* expected None if",
    ):
        medium.carry("car-1", Transmission("car-2", 0, 0.0, PAYLOAD))


@pytest.mark.parametrize("answer", [None, 0.0, -1.0, math.nan, math.inf, "0.1"])
def test_a_delay_that_is_none_is_told_with_whom_it_was_asked_for(answer):
    medium = LinkMedium(
        NAMES, np.random.default_rng(1), delay_s=lambda sender, receiver, t_s: answer
    )

    with pytest.raises(
        PluginError,
        match=r"delay_s\('car-1', 'car-2', 0\) of test_medium\.py:\d+ returned .* expected sec",
    ):
        medium.carry("car-1", Transmission("car-2", 0, 0.0, PAYLOAD))


def test_reasons_beyond_a_number_are_counted_together_and_what_arrives_by_itself():
    account = MessageAccount()
    words = [f"out of range by {metres} m" for metres in range(WORDS_MAX + 10)]
    for word in (*words, words[0], "delivered", "lost"):
        account.enter(LinkOutcome(to="b", outcome=word), now_s=0.0)

    assert account.sent == account.outcomes.total() == WORDS_MAX + 13
    assert account.outcomes["others"] == 10
    assert account.outcomes[words[0]] == 2
    assert account.outcomes["delivered"] == account.outcomes["lost"] == 1


def test_channels_beyond_a_number_share_an_account_and_a_run_tells_no_more_words_than_one_of_them():
    desk = Desk()
    for number in range(CHANNELS_MAX + 10):
        for word in (f"jammed_{number}", f"shadowed_{number}"):
            desk.enter(LinkOutcome(to="car-2", outcome=word, channel=f"channel {number}"))

    account = desk.carrier.to_mapping()
    assert account["sent"] == account["refused"] == 2 * (CHANNELS_MAX + 10)
    assert desk.carrier.account("others").transmissions == 20
    assert desk.carrier.account("never heard of") is desk.carrier.account("others")
    assert len(account["refused_because"]) == WORDS_MAX + 1
    assert sum(account["refused_because"].values()) == account["refused"]
