"""What faults do to messages: by chance under the seed, the same in whatever order, and never without a count."""

import itertools
import math
import random
from collections import defaultdict
from dataclasses import asdict
from types import SimpleNamespace

import pytest

from madns_runtime.faults.intended_losses import IntendedLosses
from madns_runtime.faults.late_messages import LateMessage, LateMessages
from madns_runtime.faults.message_faults import MessageEnds, MessageFaults
from madns_runtime.faults.message_rules import DOWN, UP, MessageRule, MessageRules
from madns_runtime.faults.step_faults import StepFaults
from madns_runtime.medium.outcomes import DELIVERED, LOST, LinkOutcome
from madns_runtime.protocol.messages import Service, Transmission
from madns_runtime.timeline.action import ActionRefused, TimelineAction
from madns_runtime.timeline.fault_kinds import (
    FAULT_KINDS,
    FAULT_WORDS,
    LOSSES,
    MESSAGE_FAULTS,
    STEP_FAULTS,
)

AGENTS = ("a", "b", "c", "d")
BEST, RELIABLE = Service.BEST, Service.RELIABLE


def rule(word, agents=("a",), number=1, **parameters):
    return MessageRule(
        number=number,
        chance=number,
        word=word,
        agents=frozenset(agents),
        parameters={"traffic": "all"} | parameters,
    )


def rules_of(*rules, seed=7):
    found = MessageRules(AGENTS, seed)
    for each in rules:
        found.add(each)
    return found


def action(word, agents=("a",), number=1, for_s=None, **parameters):
    return TimelineAction(
        number=number,
        word=word,
        agents=agents,
        parameters={"traffic": "all"} | parameters,
        t_s=0.0,
        for_s=for_s,
    )


class Rig:
    """Faults with both ends of the messages, and a clock that is set."""

    def __init__(self, seed=7):
        self.now_s = 0.0
        self.received, self.sent, self.engaged = [], [], []
        self.faults = MessageFaults(
            AGENTS,
            seed,
            now_s=lambda: self.now_s,
            ends=MessageEnds(
                receive=lambda agent, message: self.received.append((agent, message)),
                send=self._send,
                engage=self.engaged.append,
                held=lambda: None,
            ),
        )

    def _send(self, to, message, service, *, deadline_s):
        if not self.faults.send(to, message, service, deadline_s):
            self.sent.append((to, message, deadline_s))

    def pass_time(self, to_s):
        while (next_s := self.faults.next_s()) is not None and next_s <= to_s:
            self.now_s = next_s
            self.faults.release()
        self.now_s = to_s

    def counts(self):
        return self.faults.to_mapping()["with_host"]


def test_every_fault_is_of_agents_of_their_steps_or_of_messages():
    assert sorted((*LOSSES, *STEP_FAULTS, *MESSAGE_FAULTS)) == sorted(FAULT_WORDS)


@pytest.mark.parametrize("word", MESSAGE_FAULTS)
def test_every_fault_of_messages_touches_some_between_agents(word):
    (kind,) = (kind for kind in FAULT_KINDS if kind.word == word)
    needed = {"delay_s": 1.0} if word == "delay_messages" else {}
    rules = rules_of(rule(word, **asdict(kind.parameters(**needed))))

    assert [n for n in range(20) if not rules.of_way("a", "b", n).is_plain] != []


@pytest.mark.parametrize("word", STEP_FAULTS)
def test_every_fault_of_steps_withholds_some(word):
    faults = StepFaults()
    faults.begin(1, word, 2.0)

    assert any(faults.withholds(tick) for tick in range(4))


def test_a_fault_of_messages_that_nobody_knows_how_to_insert_is_told():
    with pytest.raises(ValueError, match="got 'squeeze_messages'"):
        rules_of(rule("squeeze_messages")).of_way("a", "b", 1)


def test_a_fifth_of_messages_is_lost_and_the_same_ones_under_the_same_seed():
    def lost(seed):
        rules = rules_of(rule("lose_messages", probability=0.2), seed=seed)
        return [rules.of_host("a", UP, BEST).is_lost for _ in range(5000)]

    assert 0.18 < sum(lost(7)) / 5000 < 0.22
    assert lost(7) == lost(7) != lost(8)


def test_what_must_arrive_is_late_by_resends_and_never_lost():
    rules = rules_of(rule("lose_messages", probability=0.5))

    fates = [rules.of_host("a", DOWN, RELIABLE) for _ in range(1000)]
    assert not any(fate.is_lost for fate in fates)
    late = [fate.late_s for fate in fates if fate.late_s]
    assert 400 < len(late) < 600
    assert min(late) >= 0.05


def test_chance_of_one_agent_does_not_depend_on_how_much_others_send():
    alone = rules_of(rule("lose_messages", AGENTS, probability=0.5))
    among = rules_of(rule("lose_messages", AGENTS, probability=0.5))
    own = [alone.of_host("a", UP, BEST).is_lost for _ in range(50)]

    mixed = []
    for _ in range(50):
        among.of_host("b", UP, BEST)
        mixed.append(among.of_host("a", UP, BEST).is_lost)
    assert own == mixed


def test_chance_of_a_fault_does_not_depend_on_messages_that_other_faults_were_shown():
    alone, behind = rules_of(), rules_of(rule("lose_messages", number=7, probability=0.5))
    for _ in range(3):
        behind.of_host("a", UP, BEST)
    fates = []
    for rules in (alone, behind):
        rules.add(rule("lose_messages", probability=0.5))
        rules.remove(7)
        fates.append([rules.of_host("a", UP, BEST).is_lost for _ in range(50)])

    assert fates[0] == fates[1]


def test_a_partition_parts_its_agents_from_all_others_and_touches_nothing_with_the_host():
    rules = rules_of(rule("partition", ("a", "b")))

    heard = {
        (s, r): not rules.of_way(s, r, 1).is_lost for s, r in itertools.permutations(AGENTS, 2)
    }
    assert {pair for pair, is_heard in heard.items() if is_heard} == {
        *itertools.permutations("ab", 2),
        *itertools.permutations("cd", 2),
    }
    assert not rules.concern("a")


@pytest.mark.parametrize("side", [("a", "b"), ("c", "d")])
def test_a_partition_parts_nobody_from_a_place_whichever_side_is_named(side):
    rules = rules_of(rule("partition", side))

    ways = [(agent, "ground:north") for agent in AGENTS]
    ways += [(place, agent) for agent, place in ways]
    assert not any(rules.of_way(*way, 1).is_lost for way in ways)
    rules.add(rule("lose_messages", ("a",), number=2, probability=1.0))
    assert [way for way in ways if rules.of_way(*way, 1).is_lost] == [ways[0], ways[4]]


def test_two_partitions_make_three_sides():
    rules = rules_of(rule("partition", ("a",)), rule("partition", ("b",), number=2))

    lost = {(s, r) for s, r in itertools.permutations(AGENTS, 2) if rules.of_way(s, r, 1).is_lost}
    assert lost == set(itertools.permutations(AGENTS, 2)) - set(itertools.permutations("cd", 2))


@pytest.mark.parametrize(
    ("traffic", "with_host", "between"),
    [("all", True, True), ("with_host", True, False), ("between_agents", False, True)],
)
def test_traffic_says_which_messages(traffic, with_host, between):
    rules = rules_of(rule("lose_messages", probability=1.0, traffic=traffic))

    assert rules.concern("a") == with_host
    assert rules.of_way("b", "a", 5).is_lost == between


def test_delayed_messages_come_in_order_where_their_class_promises_it():
    rig = Rig()
    rig.faults.begin(action("delay_messages", delay_s=0.5, jitter_s=1.0))
    for number in range(20):
        rig.now_s = 0.1 * number
        rig.faults.take("a", ["reliable", number], RELIABLE)
        rig.faults.take("a", ["best", number], BEST)
    rig.pass_time(10.0)

    reliable = [m[1] for _, m in rig.received if m[0] == "reliable"]
    best = [m[1] for _, m in rig.received if m[0] == "best"]
    assert reliable == list(range(20))
    assert sorted(best) == list(range(20)) != best
    assert rig.counts()["late"] == rig.counts()["released"] == 40


@pytest.mark.parametrize(("delay_s", "ticks"), [(0.1, 1), (0.3, 3), (0.4, 4), (0.7, 7)])
def test_delayed_messages_come_at_the_tick_at_which_their_time_has_come(delay_s, ticks):
    """0.1 + 0.2 is more than 0.3 in binary numbers: they would wait for the tick after."""
    rig = Rig()
    rig.faults.begin(action("delay_messages", delay_s=delay_s, jitter_s=0.0))
    came = {}
    for tick in range(60):
        rig.now_s = tick / 10
        rig.faults.release()
        came |= {sent: tick for _, sent in rig.received if sent not in came}
        rig.faults.take("a", tick, BEST)

    assert came == {tick: tick + ticks for tick in range(60 - ticks)}


def test_delayed_messages_between_agents_arrive_at_the_sum_of_both_times():
    rig = Rig()
    rig.faults.begin(action("delay_messages", delay_s=0.2, jitter_s=0.0))
    outcome = LinkOutcome(to="b", outcome=DELIVERED, arrives_s=0.1)
    transmission = SimpleNamespace(number=1)

    (late,) = rig.faults.ways("a", transmission, [outcome])

    assert late.arrives_s == 0.3


def test_a_message_behind_a_late_one_waits_also_when_the_fault_is_over():
    rig = Rig()
    begun = action("delay_messages", delay_s=5.0, jitter_s=0.0)
    rig.faults.begin(begun)
    rig.faults.take("a", "first", RELIABLE)
    rig.now_s = 1.0
    rig.faults.end(begun)
    rig.faults.take("a", "second", RELIABLE)
    rig.faults.take("a", "telemetry", BEST)
    assert rig.engaged == [True]

    rig.pass_time(6.0)
    assert [message for _, message in rig.received] == ["telemetry", "first", "second"]
    assert rig.engaged == [True, False]


def test_a_link_that_is_down_holds_what_must_arrive_until_it_is_up():
    rig = Rig()
    begun = action("link_down")
    rig.faults.begin(begun)
    for number in range(3):
        rig.faults.take("a", number, RELIABLE)
        rig._send("a", number, RELIABLE, deadline_s=None)
        rig.faults.take("a", "telemetry", BEST)
    rig.pass_time(100.0)
    assert (rig.received, rig.sent) == ([], [])

    rig.faults.end(begun)
    rig.pass_time(100.2)
    assert [message for _, message in rig.received] == [0, 1, 2]
    assert [message for _, message, _ in rig.sent] == [0, 1, 2]
    assert rig.counts() == {"seen": 9, "late": 6, "lost": 3, "released": 6, "left": 0}


def test_a_doubled_message_comes_twice_unless_its_class_promises_once():
    rig = Rig()
    rig.faults.begin(action("duplicate_messages", probability=1.0))
    rig.faults.take("a", "up", BEST)
    rig.faults.take("a", "once", RELIABLE)
    rig._send("a", "down", BEST, deadline_s=None)

    assert [message for _, message in rig.received] == ["up", "up", "once"]
    assert [message for _, message, _ in rig.sent] == ["down", "down"]
    assert (rig.counts()["doubled"], rig.counts()["double_discarded"]) == (2, 1)


def test_a_message_that_is_lost_does_not_count_as_doubled():
    rig = Rig()
    rig.faults.begin(action("duplicate_messages", probability=1.0))
    rig.faults.begin(action("lose_messages", number=2, probability=0.5))

    for value in range(100):
        rig.faults.take("a", value, BEST)

    counts = rig.counts()
    assert 20 < counts["lost"] < 80
    assert counts["doubled"] == counts["passed"] == 100 - counts["lost"]
    assert len(rig.received) == 2 * counts["doubled"]


def test_a_doubled_message_that_is_late_is_one_in_the_account_and_comes_twice():
    rig = Rig()
    rig.faults.begin(action("duplicate_messages", probability=1.0))
    rig.faults.begin(action("delay_messages", number=2, delay_s=1.0, jitter_s=0.0))
    rig.faults.take("a", "up", BEST)
    assert (rig.counts()["late"], rig.counts()["left"]) == (1, 1)

    rig.pass_time(2.0)
    assert [message for _, message in rig.received] == ["up", "up"]
    assert (rig.counts()["released"], rig.counts()["left"]) == (1, 0)


def test_what_a_link_held_does_not_overtake_what_was_late_before_it_went_down():
    rig = Rig()
    delay, down = (
        action("delay_messages", delay_s=10.0, jitter_s=0.0),
        action("link_down", number=2),
    )
    rig.faults.begin(delay)
    rig.faults.take("a", "late", RELIABLE)
    rig.faults.end(delay)
    rig.faults.begin(down)
    rig.faults.take("a", "held", RELIABLE)
    rig.now_s = 1.0
    rig.faults.end(down)

    rig.pass_time(20.0)
    assert [message for _, message in rig.received] == ["late", "held"]


def test_what_comes_when_the_time_of_one_before_it_has_just_come_waits_behind_it():
    rig = Rig()
    rig.faults.begin(action("delay_messages", delay_s=1.0, jitter_s=0.0, for_s=0.5))
    rig.faults.take("a", "late", RELIABLE)
    rig.faults.end(action("delay_messages"))
    rig.now_s = 1.001  # the host's loop takes a datagram before its timer
    rig.faults.take("a", "next", RELIABLE)
    assert rig.received == []

    rig.pass_time(2.0)
    assert [message for _, message in rig.received] == ["late", "next"]


FAULTS = (
    ("lose_messages", {"probability": 0.5}),
    ("delay_messages", {"delay_s": 2.0, "jitter_s": 1.0}),
    ("reorder_messages", {"probability": 0.5, "within_s": 3.0}),
    ("duplicate_messages", {"probability": 0.5}),
    ("link_down", {}),
)


@pytest.mark.parametrize("seed", range(60))
def test_whatever_happens_the_account_adds_up_and_ordered_classes_keep_their_order(seed):
    draw, rig = random.Random(seed), Rig(seed)
    sent, in_force = defaultdict(list), []
    for number in range(80):
        chance = draw.random()
        if chance < 0.1:
            word, parameters = draw.choice(FAULTS)
            agents = tuple(draw.sample(AGENTS, 2))
            in_force.append(action(word, agents, number, **parameters))
            rig.faults.begin(in_force[-1])
        elif chance < 0.2 and in_force:
            rig.faults.end(in_force.pop(draw.randrange(len(in_force))))
        elif chance < 0.4:
            rig.now_s += draw.choice((0.1, 1.0))
            if draw.random() < 0.5:
                rig.faults.release()
        else:
            agent, service = draw.choice("ab"), draw.choice(list(Service))
            if draw.random() < 0.5:
                sent["up", agent, service].append(number)
                rig.faults.take(agent, ["up", service, number], service)
            else:
                sent["down", agent, service].append(number)
                rig._send(agent, ["down", service, number], service, deadline_s=None)
        counts = defaultdict(int, rig.faults.to_mapping().get("with_host", {}))
        assert counts["seen"] == counts["passed"] + counts["lost"] + counts["late"]
        assert counts["late"] == counts["released"] + counts["left"]
    for each in in_force:
        rig.faults.end(each)
    rig.pass_time(rig.now_s + 500.0)

    came = defaultdict(list)
    for agent, (way, service, number), *_ in (*rig.received, *rig.sent):
        came[way, agent, service].append(number)
    ordered = {key: numbers for key, numbers in sent.items() if key[2] is not BEST}
    assert {key: came[key] for key in ordered} == ordered


def test_what_waits_is_as_it_was_sent():
    rig = Rig()
    rig.faults.begin(action("delay_messages", delay_s=1.0, jitter_s=0.0))
    message = {"state": [1, 2]}
    rig._send("a", message, RELIABLE, deadline_s=None)
    message["state"][0] = 9
    rig.pass_time(2.0)

    assert rig.sent == [("a", {"state": [1, 2]}, None)]


def test_a_deadline_that_a_fault_broke_is_counted_with_the_fault():
    rig = Rig()
    rig.faults.begin(action("delay_messages", delay_s=1.0, jitter_s=0.0))
    rig._send("a", "early", Service.SYNC, deadline_s=5.0)
    rig._send("a", "late", Service.SYNC, deadline_s=0.5)
    rig.pass_time(2.0)

    assert rig.sent == [("a", "early", 5.0), ("a", "late", None)]
    assert rig.counts()["deadlines_broken"] == 1


def test_agents_that_no_fault_names_are_not_touched():
    rig = Rig()
    rig.faults.begin(action("lose_messages", probability=1.0))
    rig.faults.take("b", "up", BEST)
    rig._send("b", "down", BEST, deadline_s=None)

    assert (rig.received, rig.sent) == ([("b", "up")], [("b", "down", None)])
    assert rig.faults.to_mapping() == {}


def test_messages_between_agents_are_lost_late_and_doubled_beyond_what_the_medium_says():
    rig = Rig()
    rig.faults.begin(action("lose_messages", ("a",), probability=1.0))
    rig.faults.begin(action("delay_messages", ("b",), number=2, delay_s=3.0, jitter_s=0.0))
    rig.faults.begin(action("duplicate_messages", ("c",), number=3, probability=1.0))

    def ways(to):
        sent = Transmission(to, 4, 10.0, "hello")
        outcomes = [LinkOutcome(to=to, outcome=DELIVERED, arrives_s=11.0)]
        found = rig.faults.ways("d", sent, outcomes)
        return [(each.outcome, each.arrives_s) for each in found]

    assert ways("a") == [(LOST, None)]
    assert ways("b") == [(DELIVERED, 14.0)]
    assert ways("c") == [(DELIVERED, 11.0), (DELIVERED, 11.0)]
    refused = [LinkOutcome(to="a", outcome="out_of_range")]
    assert rig.faults.ways("d", Transmission("a", 5, 10.0, ""), refused) == refused


def test_what_is_held_back_has_a_bound(monkeypatch):
    monkeypatch.setattr("madns_runtime.faults.late_messages.LATE_MAX", 2)
    late = LateMessages()

    kept = [late.put(LateMessage("a", UP, 1, n), math.inf) for n in range(3)]
    assert kept == [True, True, False]


def test_a_slow_agent_steps_in_one_of_so_many_ticks_and_a_hung_one_in_none():
    faults = StepFaults()
    faults.begin(1, "slow", 3.0)
    assert [tick for tick in range(9) if not faults.withholds(tick)] == [0, 3, 6]

    faults.begin(2, "hang")
    assert all(faults.withholds(tick) for tick in range(9))
    assert faults.end(2) and faults.end(1)
    assert not faults.are_in_force
    assert faults.withheld == 6 + 9


@pytest.mark.parametrize("factor", [1.1, 1.5, 2.5, 7.0, 999.5])
def test_an_agent_that_is_slow_by_no_whole_factor_steps_in_one_of_so_many_ticks_too(factor):
    faults = StepFaults()
    faults.begin(1, "slow", factor)

    stepped = [tick for tick in range(100_000) if not faults.withholds(tick)]
    assert stepped[0] == 0
    assert len(stepped) == pytest.approx(100_000 / factor, abs=1)


def test_the_end_of_a_fault_that_an_earlier_start_had_leaves_the_one_of_now_in_force():
    faults = StepFaults()
    faults.begin(7, "hang")
    faults.begin(8, "slow", 3.0)

    assert not faults.end(3) and not faults.end(4), "a hang and a slow 3.0 from before the restart"
    assert (faults.is_hung, faults.factor) == (True, math.inf)
    assert faults.end(7)
    assert (faults.is_hung, faults.factor) == (False, 3.0)


def test_a_loss_that_was_ordered_is_excused_once_and_a_return_that_failed_is_not():
    losses = IntendedLosses()
    losses.order("a", "killed on purpose", returns_s=20.0)
    assert losses.take("a", 1) == "killed on purpose"
    assert losses.take("a", 1) is None
    assert losses.take("b", 1) is None
    assert losses.are_expected(lambda agent, returns_s: (agent, returns_s) == ("a", 20.0))
    assert losses.overdue(24.0) == {}
    assert "was to return at t = 20 s" in losses.overdue(60.0)["a"]

    losses.returned("a")
    assert losses.overdue(60.0) == {}
    assert not losses.are_expected(lambda agent, returns_s: (agent, returns_s) == ("a", 20.0))
    assert (losses.names(), losses.incarnations("a")) == (["a"], [1])


def test_a_partition_of_all_agents_is_refused_as_it_parts_nobody():
    rig = Rig()

    with pytest.raises(ActionRefused, match="nobody is left on the other"):
        rig.faults.begin(action("partition", AGENTS))
    rig.faults.begin(action("partition", AGENTS[:3]))

    assert rig.engaged == [True]


def test_a_fault_that_begins_later_than_it_was_due_holds_messages_up_to_its_own_end():
    rig = Rig()
    rig.now_s = 3.0
    rig.faults.begin(action("lose_messages", for_s=1.0, probability=1.0))

    rig.faults.take("a", "word", RELIABLE)
    assert rig.received == []
    rig.pass_time(3.9)
    assert rig.received == []
    rig.pass_time(6.0)

    assert rig.received == [("a", "word")]
