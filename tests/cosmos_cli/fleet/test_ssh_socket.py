"""A machine that takes no more bytes is given up, and whoever writes to it is told why."""

import contextlib
import socket
from types import SimpleNamespace

import pytest

from cosmos_cli.fleet.failure import FailureKind, MachineFailure
from cosmos_cli.fleet.ssh.socket import SEND_STALL_S_MAX, SshSocket, _peer_address
from cosmos_cli.fleet.ssh.stream import SshStream


@pytest.fixture
def clock(monkeypatch):
    made = SimpleNamespace(now_s=0.0)
    monkeypatch.setattr(
        "cosmos_cli.fleet.ssh.socket.time", SimpleNamespace(monotonic=lambda: made.now_s)
    )
    return made


def test_machine_that_takes_no_more_bytes_is_given_up_and_the_cause_is_told(clock):
    ours, theirs = socket.socketpair()
    with ours, theirs:
        wire = SshSocket(ours)
        wire.settimeout(0.05)
        with contextlib.suppress(TimeoutError):
            while True:
                wire.send(bytes(4096))
        clock.now_s = SEND_STALL_S_MAX * 0.9
        with pytest.raises(TimeoutError):
            wire.send(b"more")
        clock.now_s = SEND_STALL_S_MAX * 1.1
        with pytest.raises(ConnectionAbortedError):
            wire.send(b"more")

    # It is the thread that reads who notices: until then the connection passes for a sound one.
    event = SimpleNamespace(set_event=lambda bell: None)
    channel = SimpleNamespace(
        in_buffer=event, in_stderr_buffer=event, closed=True, close=lambda: None
    )
    stream = SshStream(channel, SimpleNamespace(is_active=lambda: True, wire=wire))
    with pytest.raises(MachineFailure) as told:
        stream.write(b"more")
    stream.close()

    assert told.value.kind is FailureKind.LOST
    assert told.value.text == "the connection is lost (it takes no more bytes)"


@pytest.mark.parametrize(
    ("family", "name", "expected"),
    [
        (socket.AF_INET, ("10.0.0.1", 22), "10.0.0.1"),
        (socket.AF_INET6, ("2001:db8::1", 22, 0, 0), "2001:db8::1"),
        (socket.AF_INET6, ("fe80::1", 22, 0, 1), f"fe80::1%{socket.if_indextoname(1)}"),
    ],
)
def test_link_local_address_of_a_machine_comes_with_its_link(family, name, expected):
    sock = SimpleNamespace(family=family, getpeername=lambda: name)

    assert _peer_address(sock) == expected
