"""What waits for room at an agent arrives in order, and what is given up is counted."""

import time

from madns_runtime.hardware import messages, outbox
from madns_runtime.hardware.count_table import TABLE_BYTES, CountTable, missed_name
from madns_runtime.hardware.outbox import UserOutbox
from madns_runtime.reactor.reactor import Reactor


def counts_in_memory():
    return CountTable(memoryview(bytearray(TABLE_BYTES)))


def run(reactor, seconds):
    reactor.call_at(time.monotonic() + seconds, reactor.stop)
    reactor.run()


def test_what_finds_no_room_arrives_later_and_in_order():
    reactor = Reactor()
    agent, device = messages.make_pair()
    box = UserOutbox({"agent-01": device}, reactor, counts_in_memory())

    assert sum(box.send([messages.FRAME, number]) for number in range(5000)) == 0
    got = [number for _, number in messages.receive_all(agent)]
    assert len(got) < 5000  # the kernel takes less than that at once
    deadline_s = time.monotonic() + 120
    while len(got) < 5000 and time.monotonic() < deadline_s:
        run(reactor, 0.01)
        got += [number for _, number in messages.receive_all(agent)]
    reactor.close()

    assert got == list(range(5000))


def test_what_comes_while_others_wait_does_not_put_them_off():
    reactor = Reactor()
    agent, device = messages.make_pair()
    box = UserOutbox({"agent-01": device}, reactor, counts_in_memory())
    sent = 0
    deadline_s = time.monotonic() + 120
    while sent < 3000:
        box.send([messages.FRAME, sent])
        sent += 1
    got = list(messages.receive_all(agent))
    began = len(got)
    while len(got) == began and time.monotonic() < deadline_s:
        box.send([messages.FRAME, sent])
        sent += 1
        run(reactor, 0.002)
        got += messages.receive_all(agent)
    reactor.close()

    assert len(got) > began


def test_who_never_takes_anything_loses_a_counted_number(monkeypatch):
    monkeypatch.setattr(outbox, "WAITING_MAX", 10)
    reactor = Reactor()
    agent, device = messages.make_pair()
    counts = counts_in_memory()
    taking, taken_from = messages.make_pair()
    box = UserOutbox({"agent-01": device, "agent-02": taken_from}, reactor, counts)

    lost = 0
    for number in range(5000):
        lost += box.send([messages.FRAME, number])
        list(messages.receive_all(taking))
    taken = len(list(messages.receive_all(agent)))
    reactor.close()

    assert lost == 5000 - taken - 10
    assert counts.read() == {missed_name("agent-01"): lost}


def test_very_many_agents_that_take_nothing_leave_room_for_a_devices_own_counts(monkeypatch):
    monkeypatch.setattr(outbox, "WAITING_MAX", 1)
    reactor = Reactor()
    pairs = {
        f"agent-{number:03d}": messages.make_pair() for number in range(outbox.USERS_NAMED_MAX + 6)
    }
    counts = counts_in_memory()
    box = UserOutbox({agent: ends[1] for agent, ends in pairs.items()}, reactor, counts)

    lost = sum(box.send([messages.FRAME, number]) for number in range(3000))
    reactor.close()
    counts.add("lost_bytes", 7)

    told = counts.read()
    assert told.pop("lost_bytes") == 7
    assert lost > 0 and sum(told.values()) == lost
