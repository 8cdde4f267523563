"""The result of a run in real time: what its links and its agents tell together."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest
from harness.host_links import host_link

from madns_runtime.faults.intended_losses import IntendedLosses
from madns_runtime.protocol.counters import LinkCounters
from madns_runtime.protocol.events import Phase
from madns_runtime.protocol.host_peers import Peer
from madns_runtime.protocol.link import Link
from madns_runtime.protocol.link_settings import PLUGIN_CHANNEL
from madns_runtime.protocol.messages import Service
from madns_runtime.realtime.host_result import HostReport


def result_of(link: Link | None = None, **records: Any) -> dict[str, Any]:
    peer = Peer(name="agent-01", index=1, phase=Phase.STOPPED, link=link, records=records)
    session: Any = SimpleNamespace(peers={"agent-01": peer}, refused={}, malformed_count=0)
    return HostReport(10.0).result(session, network={}, intended=IntendedLosses())


def test_what_an_agent_could_not_hold_during_its_set_up_is_lost():
    messages = {name: {"sent": 0, "received": 0} for name in ("best", "reliable")}
    messages["sync"] = {"sent": 0, "received": 0, "deadlines_broken": 0}
    assert result_of(messages=messages, held_dropped=0)["messages"]["reliable"]["lost"] == 0

    result = result_of(messages=messages, held_dropped=7)

    assert result["messages"]["reliable"]["lost"] == 7
    assert result["agents"]["agent-01"]["records"]["held_dropped"] == 7


def test_what_came_too_late_is_told_of_all_lives_of_an_agent():
    peer = Peer(
        name="agent-01",
        index=1,
        phase=Phase.STOPPED,
        retired_counters=[LinkCounters().to_mapping()],
        retired_records=[{"too_late": 2, "messages": LinkCounters().to_mapping()}],
        records={"too_late": 3, "messages": LinkCounters().to_mapping()},
    )
    session: Any = SimpleNamespace(peers={"agent-01": peer}, refused={}, malformed_count=0)

    result = HostReport(10.0).result(session, network={}, intended=IntendedLosses())

    assert result["agents"]["agent-01"]["messages"]["too_late"] == 5


def test_without_the_agents_own_count_nobody_knows_what_was_lost():
    assert result_of()["messages"]["reliable"]["lost"] is None


@pytest.mark.parametrize("again", ["disk full", "another"])
def test_trouble_with_records_is_told_once(again):
    report = HostReport(10.0)

    def told(of_agent, own=None):
        peers = {"agent-01": SimpleNamespace(report={"problem": of_agent} if of_agent else {})}
        return list(report.new_troubles(SimpleNamespace(peers=peers), own))

    assert told(None) == []
    assert told("disk full") == ["agent-01: records are being lost: disk full"]
    assert told(again) == []
    assert told(again, own="no space") == ["records are being lost: no space"]


def test_deadlines_that_were_broken_before_an_agent_came_again_stay_counted():
    earlier = LinkCounters(deadlines_broken=2).to_mapping()
    peer = Peer(name="agent-01", index=1, phase=Phase.STOPPED, retired_counters=[earlier])
    session: Any = SimpleNamespace(peers={"agent-01": peer}, refused={}, malformed_count=0)

    result = HostReport(10.0).result(session, network={}, intended=IntendedLosses())

    assert result["messages"]["sync"]["deadlines_broken"] == 2


def test_what_earlier_incarnations_counted_stays_counted():
    def words(received: int, deadlines_broken: int) -> dict[str, Any]:
        counts = {"received": received, "held": 0, "late": 0, "no_room": 0}
        return {"between_agents": counts, "messages": {"deadlines_broken": deadlines_broken}}

    peer = Peer(
        name="agent-01",
        index=1,
        phase=Phase.STOPPED,
        records=words(3, 1),
        retired_records=[words(40, 2), {}],
    )
    session: Any = SimpleNamespace(peers={"agent-01": peer}, refused={}, malformed_count=0)

    result = HostReport(10.0).result(
        session, network={}, carried={"sent": 50, "delivered": 43}, intended=IntendedLosses()
    )

    assert result["between_agents"]["receivers"]["received"] == 43
    assert result["messages"]["sync"]["deadlines_broken"] == 3


def ends() -> tuple[Link, Link]:
    """Return the agent's and the host's end of one conversation."""
    key, session = bytes(32), bytes(8)
    return Link.for_agent(key, session, 1, 7), host_link(key, session, 1, 7)


def send_best(sender: Link, receiver: Link, *, sent: int, lost: set[int]) -> None:
    """Send messages of a half, of which some do not come."""
    for number in range(sent):
        sender.send(b"x", Service.BEST, 1.0, channel=PLUGIN_CHANNEL)
        for datagram in sender.datagrams_to_send(1.0):
            if number not in lost:
                assert receiver.receive_datagram(datagram, 1.0)
        while receiver.next_message() is not None:
            pass


@pytest.mark.parametrize("lost", [{3}, {8, 9}, {0, 5, 9}, set(range(10)), set()])
@pytest.mark.parametrize("is_up", [True, False])
def test_best_messages_that_never_came_are_lost_also_where_none_came_behind_them(is_up, lost):
    agent, host = ends()
    sender, receiver = (agent, host) if is_up else (host, agent)

    send_best(sender, receiver, sent=10, lost=lost)

    best = result_of(host, messages=agent.counters.to_mapping())["messages"]["best"]
    assert (best["sent"], best["received"], best["lost"]) == (10, 10 - len(lost), len(lost))


def messages_of_two_incarnations(host, told, later_host, later_agent):
    """Return the account of messages of an agent that told so much in its first incarnation, and all in its second."""
    peer = Peer(
        name="agent-01",
        index=1,
        phase=Phase.STOPPED,
        link=later_host,
        records={"messages": later_agent.counters.to_mapping()},
        retired_counters=[host.counters.to_mapping()],
        retired_records=[told],
    )
    session: Any = SimpleNamespace(peers={"agent-01": peer}, refused={}, malformed_count=0)
    return HostReport(10.0).result(session, network={}, intended=IntendedLosses())["messages"]


def test_messages_of_earlier_incarnations_stay_counted():
    (agent, host), (later_agent, later_host) = ends(), ends()
    send_best(agent, host, sent=10, lost={2, 9})
    send_best(host, agent, sent=5, lost={0})
    send_best(later_agent, later_host, sent=3, lost={1})
    earlier = {"messages": agent.counters.to_mapping()}

    messages = messages_of_two_incarnations(host, earlier, later_host, later_agent)

    best = messages["best"]
    assert (best["sent"], best["received"], best["lost"]) == (18, 14, 4)


def test_of_a_killed_incarnation_counts_what_came_of_it_and_what_it_acknowledged():
    agent, host = ends()
    agent.send(b"a", Service.RELIABLE, 1.0)
    for number in range(3):
        host.send(b"h", Service.RELIABLE, 1.0)
        for datagram in host.datagrams_to_send(1.0) if number < 2 else ():
            agent.receive_datagram(datagram, 1.0)
    for datagram in agent.datagrams_to_send(1.0):
        host.receive_datagram(datagram, 1.0)
    send_best(agent, host, sent=10, lost={2})
    later_agent, later_host = ends()
    host.abandon()

    messages = messages_of_two_incarnations(host, {}, later_host, later_agent)

    reliable, best = messages["reliable"], messages["best"]
    assert (reliable["sent"], reliable["received"], reliable["to_lost_agents"]) == (4, 3, 1)
    assert (best["sent"], best["received"], best["lost"]) == (10, 9, 1)
    assert reliable["lost"] == 0


def test_what_found_no_room_in_earlier_incarnations_stays_counted():
    def words(held_dropped: int, **losses: int) -> dict[str, Any]:
        return {"held_dropped": held_dropped, "device_losses": {"pi22/imu": losses}, "messages": {}}

    peer = Peer(
        name="agent-01",
        index=1,
        phase=Phase.STOPPED,
        records=words(2, writes_lost=1, frames_missed=7),
        retired_records=[words(3, writes_lost=10, frames_dropped=4, frames_missed=5), {}],
    )
    session: Any = SimpleNamespace(peers={"agent-01": peer}, refused={}, malformed_count=0)

    result = HostReport(10.0).result(session, network={}, intended=IntendedLosses())

    assert result["messages"]["reliable"]["lost"] == 5
    assert result["agents"]["agent-01"]["records"]["device_losses"] == {
        "pi22/imu": {"writes_lost": 11, "frames_dropped": 4, "frames_missed": 7}
    }
