"""The socket that the agents of a process share: dealt out by agent, sent together, malformed packets refused by somebody."""

from __future__ import annotations

import socket
from types import SimpleNamespace

import pytest

from madns_runtime.config import Recording, Timeouts
from madns_runtime.protocol.bundle import BUNDLE, bundle_up, split
from madns_runtime.protocol.datagram import OVERHEAD_BYTES
from madns_runtime.realtime.process_port import MOVED_S, PING_INTERVAL_S, ProcessPort
from madns_runtime.timing.late_causes import Cause


class Loop:
    """What a port asks of the reactor."""

    slept_s = 0.0

    def __init__(self):
        self.readers = {}

    def add_reader(self, fd, callback):
        self.readers[fd] = callback

    def remove_reader(self, fd):
        del self.readers[fd]

    def turn(self):
        for callback in list(self.readers.values()):
            callback()


@pytest.fixture
def host():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as handle:
        handle.bind(("127.0.0.1", 0))
        handle.settimeout(5)
        yield handle


def port_of(host, agents, loop=None, silence_s=2.5):
    launch = SimpleNamespace(
        host_address="127.0.0.1",
        host_port=host.getsockname()[1],
        config=SimpleNamespace(recording=Recording(), timeouts=Timeouts(silence_s=silence_s)),
    )
    return ProcessPort(launch, loop or Loop(), agents)


def datagram(index, fill=b"x"):
    return bytes([1, 0, index, 0]) + fill * OVERHEAD_BYTES


def test_each_agent_gets_what_is_for_it(host):
    loop = Loop()
    port = port_of(host, 2, loop)
    got = {7: [], 8: []}
    for index in got:
        port.listen(index, got[index].append)
    port.send(b"hello")
    _, address = host.recvfrom(2048)

    (bundle,) = bundle_up([datagram(7), datagram(8), datagram(7, b"y")])
    host.sendto(bundle, address)
    host.sendto(datagram(8, b"z"), address)
    loop.turn()

    assert got == {7: [datagram(7), datagram(7, b"y")], 8: [datagram(8), datagram(8, b"z")]}


def test_a_clock_that_moves_has_the_ticks_of_all_packs_timed_anew_and_one_that_stands_those_of_none(
    host,
):
    port, armed = port_of(host, 9), []
    port.arms += [lambda: armed.append("first pack"), lambda: armed.append("second pack")]

    def learn(offset_s):
        port.clock.offset_s = lambda local_s: offset_s
        port.follow_clock()
        told, armed[:] = list(armed), []
        return told

    assert learn(-0.0095) == ["first pack", "second pack"]
    assert learn(-0.0095 + MOVED_S / 2) == []
    assert learn(0.0) == ["first pack", "second pack"]
    assert learn(MOVED_S / 2) == []


def test_what_is_done_behind_a_packet_is_no_part_of_the_time_in_which_it_was_received(host):
    loop, order = Loop(), []
    port = port_of(host, 1, loop)
    port.account.add = lambda span: order.append(span.cause)
    port.after_packet = lambda: order.append("behind")
    port.listen(7, lambda data: order.append("taken"))
    port.send(b"hello")
    _, address = host.recvfrom(2048)

    host.sendto(datagram(7), address)
    loop.turn()

    assert order == ["taken", Cause.RECEIVING, "behind"]


@pytest.mark.parametrize(
    "packet", [datagram(9), b"", bytes([BUNDLE, 1])], ids=["stranger", "empty", "malformed"]
)
def test_what_is_nobodys_is_refused_by_the_first(host, packet):
    loop = Loop()
    port = port_of(host, 2, loop)
    first, second = [], []
    port.listen(7, first.append)
    port.listen(8, second.append)
    port.send(b"hello")
    _, address = host.recvfrom(2048)

    host.sendto(packet, address)
    loop.turn()

    assert (first, second) == ([packet], [])


def test_what_is_for_an_agent_that_has_left_is_told_as_such_and_no_foreign_datagram(host):
    loop = Loop()
    port = port_of(host, 3, loop)
    taken, refused = [], []
    port.listen(7, taken.append, refused.append)
    port.listen(8, taken.append)
    port.send(b"hello")
    _, address = host.recvfrom(2048)
    port.leave(8)

    for index in (8, 9):
        host.sendto(datagram(index), address)
        loop.turn()
    first = list(taken)
    port.listen(8, taken.append)  # it returns
    host.sendto(datagram(8, b"y"), address)
    loop.turn()

    assert first == [datagram(9)]  # nobody's ever
    assert refused == ["old_incarnation"]
    assert taken[1:] == [datagram(8, b"y")]


def test_what_is_sent_in_a_block_leaves_together_and_in_order(host):
    port = port_of(host, 3)
    port.begin()
    for index in (1, 2, 3):
        port.send(datagram(index))
    port.begin()
    port.send(datagram(1, b"y"))
    port.end()
    port.end()
    port.send(datagram(2, b"z"))

    assert split(host.recv(2048)) == [datagram(1), datagram(2), datagram(3), datagram(1, b"y")]
    assert host.recv(2048) == datagram(2, b"z")


def test_what_cannot_wait_takes_along_what_came_before_it(host):
    port = port_of(host, 2)
    port.begin()
    port.send(datagram(1))
    port.send_waiting()
    assert host.recv(2048) == datagram(1)
    port.send(datagram(2))
    port.end()
    assert host.recv(2048) == datagram(2)


def test_what_waits_is_sent_when_the_block_fails(host):
    loop = Loop()
    port = port_of(host, 2, loop)

    def fail(data):
        port.send(datagram(1))
        raise ValueError("a plug-in")

    port.listen(7, fail)
    port.send(b"hello")
    _, address = host.recvfrom(2048)
    (bundle,) = bundle_up([datagram(7), datagram(7)])
    host.sendto(bundle, address)
    with pytest.raises(ValueError, match="a plug-in"):
        loop.turn()

    assert host.recv(2048) == datagram(1)
    port.send(datagram(2))
    assert host.recv(2048) == datagram(2)


def test_the_last_agent_closes_the_socket(host):
    loop = Loop()
    port = port_of(host, 2, loop)
    port.listen(1, list)
    port.listen(2, list)
    port.leave(1)
    assert port.socket.fileno() >= 0
    port.leave(2)
    port.leave(2)

    assert port.socket.fileno() == -1
    assert not loop.readers


def test_windows_of_all_agents_fit_half_the_buffer(host):
    alone, many = port_of(host, 1), port_of(host, 64)

    assert alone.window_bytes == alone.socket.receive_buffer_bytes // 4
    assert 64 * many.window_bytes <= max(many.socket.receive_buffer_bytes // 2, 64 * 5600)


def test_one_agent_brings_the_clock_up_and_many_ping_more_rarely(host):
    port = port_of(host, 64)
    plans = [port.pings() for _ in range(64)]

    assert [plan.brings_clock_up for plan in plans] == [True, *[False] * 63]
    assert {plan.interval_s for plan in plans} == {4 * PING_INTERVAL_S}
    assert sorted({plan.delay_s for plan in plans}) == [plan.delay_s for plan in plans]
    assert port_of(host, 1).pings().interval_s == PING_INTERVAL_S


@pytest.mark.parametrize("agents", [1, 8, 64])
@pytest.mark.parametrize("silence_s", [0.21, 0.5, 1.0, 2.5])
def test_no_agent_is_silent_for_as_long_as_makes_it_lost(host, agents, silence_s):
    port = port_of(host, agents, silence_s=silence_s)
    plan = [port.pings() for _ in range(agents)][-1]
    slack_s = plan.slack_s(tick_period_s=1.0)

    longest_s = max(plan.next_s(0.0, at_s / 100) - at_s / 100 for at_s in range(1000)) + slack_s

    assert longest_s < 0.81 * silence_s


def test_agent_that_has_returned_often_says_how_it_is_within_an_interval(host):
    port = port_of(host, 2)
    plans = [port.pings() for _ in range(100)]

    assert max(plan.delay_s for plan in plans) <= PING_INTERVAL_S
    assert [plan.brings_clock_up for plan in plans] == [True, *[False] * 99]
