"""What the host reads and sends by packets: datagrams of one process come together, and are answered together."""

from __future__ import annotations

import math
import socket
from types import SimpleNamespace

import pytest

from madns_runtime.config import Agents, HostLaunch, Network, RunConfig, TimeSettings
from madns_runtime.errors import PluginError
from madns_runtime.protocol.bundle import BUNDLE, bundle_up, split
from madns_runtime.protocol.datagram import OVERHEAD_BYTES
from madns_runtime.protocol.messages import Service
from madns_runtime.reactor.udp import UdpSocket
from madns_runtime.realtime.host_link import HostPort


@pytest.fixture
def port():
    # Without a session: what is tried here is the socket's side alone.
    port = HostPort.__new__(HostPort)
    port.socket = UdpSocket.bind("127.0.0.1", 0, receive_buffer_bytes=262_144)
    port._kept_for, port._kept = None, []
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
