import contextlib
import errno
import itertools
import socket

import pytest

from madns_runtime.errors import MachineError
from madns_runtime.reactor import udp
from madns_runtime.reactor.reactor import Reactor
from madns_runtime.reactor.udp import UdpSocket, buffer_warning

pytestmark = pytest.mark.process

BUFFER_BYTES = 65_536


def has_ipv6():
    with contextlib.suppress(OSError), socket.socket(socket.AF_INET6, socket.SOCK_DGRAM) as probe:
        probe.bind(("::1", 0))
        return True
    return False


needs_ipv6 = pytest.mark.skipif(not has_ipv6(), reason="no IPv6 loopback here")


@pytest.fixture
def made():
    sockets = []
    yield sockets
    for one in sockets:
        one.close()


@pytest.fixture
def bind(made):
    def bind(address="127.0.0.1", port=0, receive_buffer_bytes=BUFFER_BYTES):
        made.append(UdpSocket.bind(address, port, receive_buffer_bytes=receive_buffer_bytes))
        return made[-1]

    return bind


@pytest.fixture
def connect(made):
    def connect(address, port):
        made.append(UdpSocket.connect(address, port, receive_buffer_bytes=BUFFER_BYTES))
        return made[-1]

    return connect


class StubbornHandle:
    """A socket whose kernel answers as it is told."""

    def __init__(self, *answers):
        self.answers = list(answers)

    def _answer(self, *_):
        answer = self.answers.pop(0)
        if isinstance(answer, Exception):
            raise answer
        return answer

    send = sendto = recv = recvfrom = _answer

    def setblocking(self, flag):
        assert flag is False

    def setsockopt(self, *_):
        raise PermissionError

    def getsockopt(self, *arguments):
        return 2 * 4096 if len(arguments) == 2 else b""

    def close(self):
        self.answers = [OSError(errno.EBADF, "closed")]


def stubborn(*answers):
    return UdpSocket(StubbornHandle(*answers), 4096)


@pytest.mark.parametrize("address", ["127.0.0.1", pytest.param("::1", marks=needs_ipv6)])
def test_datagrams_go_there_and_back(bind, connect, address):
    host = bind(address)
    agent = connect(address, host.address[1])

    assert agent.send(b"question")
    [(data, sender)] = host.receive_all()
    assert data == b"question"
    assert sender == agent.address
    assert host.send(b"answer", sender)
    assert [data for data, _ in agent.receive_all()] == [b"answer"]
    assert (host.sent, host.received, agent.sent, agent.received) == (1, 1, 1, 1)


@needs_ipv6
def test_host_on_all_addresses_hears_both_families(bind, connect):
    host = bind("::")
    for address in ("127.0.0.1", "::1"):
        assert connect(address, host.address[1]).send(address.encode())

    assert [data for data, _ in host.receive_all()] == [b"127.0.0.1", b"::1"]


def test_names_are_resolved(bind, connect):
    host = bind("127.0.0.1")

    assert connect("localhost", host.address[1]).send(b"x")


def test_connected_socket_hears_its_peer_only(bind, connect):
    host, stranger = bind(), bind()
    agent = connect("127.0.0.1", host.address[1])

    stranger.send(b"stranger", agent.address)
    host.send(b"host", agent.address)

    assert [data for data, _ in agent.receive_all()] == [b"host"]


def test_receiving_is_bounded_and_never_waits(bind, connect):
    host = bind()
    agent = connect("127.0.0.1", host.address[1])
    assert list(host.receive_all()) == []
    for k in range(10):
        agent.send(bytes([k]))

    assert [data[0] for data, _ in host.receive_all(limit=4)] == [0, 1, 2, 3]
    assert [data[0] for data, _ in itertools.islice(host.receive_all(), 2)] == [4, 5]
    assert [data[0] for data, _ in host.receive_all()] == [6, 7, 8, 9]


def test_reader_may_close_the_socket_while_it_receives(bind, connect):
    host = bind()
    agent = connect("127.0.0.1", host.address[1])
    agent.send(b"one")
    agent.send(b"two")

    seen = []
    for data, _ in host.receive_all():
        seen.append(data)
        host.close()

    assert seen == [b"one"]
    assert host.dropped_by_kernel is None


def test_reactor_wakes_for_a_datagram(bind, connect):
    host = bind()
    agent = connect("127.0.0.1", host.address[1])
    reactor = Reactor()
    seen = []

    def readable():
        seen.extend(data for data, _ in host.receive_all())
        reactor.stop()

    reactor.add_reader(host.fileno(), readable)
    reactor.call_at(0.0, lambda: agent.send(b"x"))
    reactor.run()
    reactor.close()

    assert seen == [b"x"]


def test_taken_port_names_address_and_port_and_what_to_do(bind):
    port = bind().address[1]

    with pytest.raises(MachineError, match=rf"127\.0\.0\.1:{port}: the UDP port is taken.*0 for"):
        bind(port=port)


def test_foreign_address_is_named(bind):
    with pytest.raises(MachineError, match=r"192\.0\.2\.1:0: this machine has no such address"):
        bind("192.0.2.1")


def test_unknown_name_is_named(bind, connect):
    for make in (lambda: bind("no.such.host.invalid", 5), lambda: connect("a..b", 5)):
        with pytest.raises(MachineError, match="cannot be resolved"):
            make()


@pytest.mark.parametrize(
    ("number", "expected"),
    [(errno.EACCES, "1024 or above"), (errno.ENOBUFS, "cannot listen")],
)
def test_other_refusals_to_listen_are_told(bind, monkeypatch, number, expected):
    class Refusing(socket.socket):
        def bind(self, where):
            raise OSError(number, "refused")

    monkeypatch.setattr(udp.socket, "socket", Refusing)

    with pytest.raises(MachineError, match=expected):
        bind()


def test_peer_without_a_route_is_named(connect, monkeypatch):
    class Routeless(socket.socket):
        def connect(self, where):
            raise OSError(errno.ENETUNREACH, "Network is unreachable")

    monkeypatch.setattr(udp.socket, "socket", Routeless)

    expected = (
        r"192\.0\.2\.1:7: cannot be reached.*unreachable.*network\.address.*cosmos_host_address"
    )
    with pytest.raises(MachineError, match=expected):
        connect("192.0.2.1", 7)


def test_silent_port_is_counted_and_not_raised(bind, connect):
    gone = bind()
    agent = connect("127.0.0.1", gone.address[1])
    gone.close()

    agent.send(b"draws an ICMP answer")
    assert list(agent.receive_all()) == []
    assert agent.peer_refused == 1

    agent.send(b"draws another")
    assert agent.send(b"is sent although the answer is read first") is True
    assert agent.peer_refused == 2


@pytest.mark.parametrize(
    ("answers", "sent", "refused", "peer_refused", "failures"),
    [
        ([1], True, 0, 0, 0),
        ([BlockingIOError(errno.EAGAIN, "full")], False, 1, 0, 0),
        ([OSError(errno.ENOBUFS, "no buffers")], False, 1, 0, 0),
        ([OSError(errno.ENETDOWN, "network is down")], False, 0, 0, 1),
        ([ConnectionRefusedError(errno.ECONNREFUSED, "x"), 1], True, 0, 1, 0),
        ([ConnectionRefusedError(errno.ECONNREFUSED, "x")] * 2, False, 0, 2, 0),
        (
            [ConnectionRefusedError(errno.ECONNREFUSED, "x"), BlockingIOError(errno.EAGAIN, "x")],
            False,
            1,
            1,
            0,
        ),
    ],
)
def test_what_the_kernel_does_not_send_is_counted(answers, sent, refused, peer_refused, failures):
    one = stubborn(*answers)

    assert one.send(b"x") is sent
    assert (one.sent, one.send_refused, one.peer_refused, one.failures) == (
        int(sent),
        refused,
        peer_refused,
        failures,
    )
    assert (one.last_failure is not None) == bool(failures)


def test_errors_that_come_in_place_of_datagrams_are_counted():
    one = stubborn(
        ConnectionRefusedError(errno.ECONNREFUSED, "x"),
        OSError(errno.EHOSTUNREACH, "no route"),
        (b"data", ("127.0.0.1", 5)),
        BlockingIOError(errno.EAGAIN, "empty"),
    )

    assert [data for data, _ in one.receive_all()] == [b"data"]
    assert (one.peer_refused, one.failures, one.received) == (1, 1, 1)
    assert "no route" in one.last_failure


def test_buffer_that_is_granted_needs_no_warning(bind):
    one = bind(receive_buffer_bytes=BUFFER_BYTES)

    assert one.receive_buffer_bytes >= BUFFER_BYTES
    assert one.warning is None


def test_smaller_buffer_is_a_warning_that_names_the_setting():
    assert buffer_warning(4096, 4096) is None

    warning = buffer_warning(4_194_304, 212_992)

    assert "4194304" in warning
    assert "212992" in warning
    assert "net.core.rmem_max=4194304" in warning


def test_kernel_that_refuses_every_buffer_is_warned_about():
    one = UdpSocket(StubbornHandle(), 1_000_000)

    assert one.receive_buffer_bytes == 4096
    assert "net.core.rmem_max=1000000" in one.warning


def test_system_without_linux_options_reads_back_what_it_grants(monkeypatch):
    monkeypatch.setattr(udp, "IS_LINUX", False)
    one = UdpSocket(StubbornHandle(), 8192)

    assert one.receive_buffer_bytes == 8192
    assert one.dropped_by_kernel is None


@pytest.mark.skipif(not udp.IS_LINUX, reason="the counter is Linux's")
def test_datagrams_that_the_kernel_dropped_are_known(bind, connect):
    host = bind(receive_buffer_bytes=4096)
    agent = connect("127.0.0.1", host.address[1])
    count = 500
    assert host.dropped_by_kernel == 0

    for _ in range(count):
        assert agent.send(bytes(1000))
    received = len(list(host.receive_all(limit=count)))

    assert 0 < received < count
    assert host.dropped_by_kernel == count - received


def test_drop_counter_that_is_cut_short_is_not_known():
    assert stubborn().dropped_by_kernel is None


def test_drop_counter_that_the_kernel_refuses_is_not_known(monkeypatch):
    one = stubborn()
    monkeypatch.setattr(
        one._socket, "getsockopt", lambda *_: (_ for _ in ()).throw(OSError(errno.ENOPROTOOPT, ""))
    )

    assert one.dropped_by_kernel is None
