"""What the host reads and sends by packets: datagrams of one process come together, and are answered together."""

from __future__ import annotations

import math
import socket
from types import SimpleNamespace

import pytest

from madns_runtime.config import Agents, HostLaunch, Network, RunConfig, Timeouts, TimeSettings
from madns_runtime.errors import PluginError
from madns_runtime.protocol.bundle import BUNDLE, bundle_up, split
from madns_runtime.protocol.datagram import OVERHEAD_BYTES, PREFIX, Role, Seal
from madns_runtime.protocol.host_session import HostSession
from madns_runtime.protocol.link import Link
from madns_runtime.protocol.link_settings import LinkSettings
from madns_runtime.protocol.messages import VERSION, Service
from madns_runtime.reactor.udp import UdpSocket
from madns_runtime.realtime.host_link import HostPort


@pytest.fixture
def port():
    # Without a session: what is tried here is the socket's side alone.
    port = HostPort.__new__(HostPort)
    port.socket = UdpSocket.bind("127.0.0.1", 0, receive_buffer_bytes=262_144)
    port._kept_for, port._kept = None, []
    port.session = SimpleNamespace(until_forged=iter)
    yield port
    port.socket.close()


@pytest.fixture
def agents(port):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as handle:
        handle.bind(("127.0.0.1", 0))
        handle.connect(port.socket.address)
        handle.settimeout(5)
        yield handle


def datagram(fill):
    return bytes([1]) + fill * OVERHEAD_BYTES


def test_a_bundle_is_answered_by_one(port, agents):
    sent = [datagram(b"a"), datagram(b"b"), datagram(b"c")]
    (bundle,) = bundle_up(sent)
    agents.send(bundle)
    port.read(lambda data, address: port._post(data[::-1], address))

    assert split(agents.recv(2048)) == [data[::-1] for data in sent]


def test_a_datagram_by_itself_is_answered_at_once(port, agents):
    agents.send(datagram(b"a"))
    got = []

    def take(data, address):
        port._post(data, address)
        got.append(agents.recv(2048))

    port.read(take)
    assert got == [datagram(b"a")]


def test_what_goes_elsewhere_does_not_wait_for_the_answers(port, agents):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", 0))
        other.settimeout(5)
        (bundle,) = bundle_up([datagram(b"a"), datagram(b"b")])
        agents.send(bundle)
        got = []

        def take(data, address):
            port._post(data, other.getsockname())
            got.append(other.recv(2048))

        port.read(take)
    assert got == [datagram(b"a"), datagram(b"b")]


def test_answers_leave_also_when_a_call_fails(port, agents):
    (bundle,) = bundle_up([datagram(b"a"), datagram(b"b")])
    agents.send(bundle)

    def take(data, address):
        port._post(data, address)
        raise ValueError("a plug-in")

    with pytest.raises(ValueError, match="a plug-in"):
        port.read(take)
    assert agents.recv(2048) == datagram(b"a")
    assert port._kept_for is None


def test_a_malformed_bundle_is_handed_on_to_be_refused(port, agents):
    agents.send(bytes([BUNDLE, 1, 2, 3]))
    agents.send(bytes([BUNDLE, 1, 2]))
    got = []
    port.read(lambda data, address: got.append(data))

    assert got == [bytes([BUNDLE, 1, 2, 3])]
    assert [data for data, _ in port.waiting()] == [bytes([BUNDLE, 1, 2])]
    port.read(lambda data, address: got.append(data))
    assert len(got) == 1


SESSION, RUN_KEY = bytes(8), bytes(range(32))


def forged(incarnation_id, *, session=SESSION):
    """Return a datagram that claims to be of the first agent's, without the run's key."""
    prefix = PREFIX.pack(VERSION, Role.AGENT, 1, incarnation_id, session)
    return prefix + bytes(OVERHEAD_BYTES - len(prefix))


def checked_by(session, port, way):
    """Return which datagrams of what waits in the socket a session was given."""
    given = []

    def take(data, address):
        given.append(data)
        session.receive_data(data, address, 1.0)

    port.session = session
    if way == "read":
        port.read(take)
    else:
        for data, address in port.waiting():
            take(data, address)
    return given


@pytest.fixture
def session():
    wire = LinkSettings(run_key=RUN_KEY, session=SESSION)
    names = ("agent-01", "agent-02")
    return HostSession(names, wire, timeouts=Timeouts(), on_agent_loss="abort", now_s=0.0)


@pytest.mark.parametrize("way", ["read", "waiting"])
@pytest.mark.parametrize("reason", ["mac", "session", "known"])
def test_behind_a_forged_datagram_the_rest_of_a_packet_is_not_looked_at(
    port, agents, session, way, reason
):
    if reason == "known":
        link = Link.for_agent(RUN_KEY, SESSION, 1, 0)
        link.send_urgent(b"\xff", Service.BEST, 0.5)
        (first,) = link.datagrams_to_send(0.5)
        session.receive_data(first, ("127.0.0.1", 1), 0.5)
    run = bytes([7] * 8) if reason == "session" else SESSION
    ids = [0] * 16 if reason == "known" else range(16)
    (bundle,) = bundle_up([forged(number, session=run) for number in ids])
    agents.send(bundle)

    given = checked_by(session, port, way)

    assert len(given) == 1
    assert session.refused["behind_forged"] == 15
    assert session.refused["mac"] == (reason == "mac")


@pytest.mark.parametrize("way", ["read", "waiting"])
def test_what_came_twice_or_of_an_earlier_process_holds_up_nothing_behind_it(
    port, agents, session, way
):
    links = [Link.for_agent(RUN_KEY, SESSION, index, index) for index in (1, 2)]
    for link in links:
        link.send_urgent(b"\xff", Service.BEST, 0.5)
    first, second = (link.datagrams_to_send(0.5)[0] for link in links)
    session.receive_data(first, ("127.0.0.1", 1), 0.5)
    session.peers["agent-01"].incarnation_ids_seen.add(9)
    (bundle,) = bundle_up([first, forged(9), second])
    agents.send(bundle)

    assert checked_by(session, port, way) == [first, forged(9), second]
    assert session.peers["agent-02"].link is not None
    assert session.refused["behind_forged"] == 0


def test_a_datagram_that_came_twice_is_checked_as_often_as_any(session, monkeypatch):
    checks = []
    find_fault = Seal.find_fault
    monkeypatch.setattr(
        Seal, "find_fault", lambda seal, data: checks.append(data) or find_fault(seal, data)
    )
    link = Link.for_agent(RUN_KEY, SESSION, 1, 0)
    link.send_urgent(b"\xff", Service.BEST, 0.5)
    (first,) = link.datagrams_to_send(0.5)
    session.receive_data(first, ("127.0.0.1", 1), 0.5)
    checks.clear()

    session.receive_data(first, ("127.0.0.1", 1), 0.6)

    assert checks == [first]


def test_no_link_is_made_for_one_who_does_not_have_the_key(session, monkeypatch):
    made = []
    monkeypatch.setattr(Link, "__init__", lambda self, **given: made.append(given))

    session.receive_data(forged(5), ("127.0.0.1", 1), 1.0)

    assert made == []
    assert session.refused["mac"] == 1


@pytest.mark.parametrize(
    ("to", "service", "deadline_s"),
    [
        ("nobody", Service.BEST, None),
        ("agent-01", 1, None),
        ("agent-01", Service.BEST, 5.0),
        ("agent-01", Service.SYNC, math.nan),
    ],
)
def test_what_cannot_be_sent_is_told_to_who_sends_it_also_where_a_fault_would_hold_it(
    port, to, service, deadline_s
):
    held = []
    port.session, port.t0_s = SimpleNamespace(peers={"agent-01": None}), 0.0
    port.faults = SimpleNamespace(send=lambda *message: held.append(message) or True)

    with pytest.raises(PluginError):
        port.send(to, [1], service, deadline_s=deadline_s)
    assert held == []
    port.send("agent-01", [1], Service.BEST)
    assert len(held) == 1


@pytest.mark.parametrize(
    ("t0_s", "t_s", "due_s"),
    [(100.0, 0.0, 100.0), (100.0, 8.5, 108.5)]
    + [(100.0, 8.6, math.inf), (100.0, None, math.inf), (None, 0.0, math.inf)],
)
def test_a_timer_waits_for_a_simulated_time_of_the_run_alone(port, t0_s, t_s, due_s):
    port.t0_s = t0_s

    assert port.due_s(t_s, end_s=8.5) == due_s


def test_agents_have_time_for_the_last_tick_of_a_run_of_no_whole_periods():
    config = RunConfig(
        run="trial",
        scenario="trial",
        simulation="trial",
        base_directory=".",
        agents=Agents(count=2, tick_hz=0.25),
        time=TimeSettings(duration_s=8.5),
        network=Network(address="127.0.0.1", port=0),
    )
    launch = HostLaunch(config=config, run_key_hex="00" * 32, session_hex="00" * 8, directory=".")
    loop = SimpleNamespace(now_s=lambda: 0.0, call_at=lambda when_s, call: None)
    port = HostPort(launch, reactor=loop, on_due=lambda: None)
    started = []
    port.session = SimpleNamespace(start=lambda *given: started.append(given))

    port.t0_s = 100.0
    port.tell_start(99.5)
    port.socket.close()

    assert started == [(100.0, 12.0, 99.5)]
