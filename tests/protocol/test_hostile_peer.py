"""A peer that holds the key and lies: memory, timers and the account of what is queued stay bounded and true."""

from __future__ import annotations

import contextlib
import random

import pytest
from harness.host_links import host_link
from lossy_wire import RUN_KEY, SESSION
from test_link_hostile import frame

from madns_runtime.protocol.datagram import (
    DATAGRAM_BYTES_MAX,
    PAYLOAD_BYTES_MAX,
    REST,
    Role,
    Seal,
    derive_keys,
)
from madns_runtime.protocol.link_settings import LinkLimits, SendQueueFull
from madns_runtime.protocol.messages import Service
from madns_runtime.protocol.sending import LOST_PACKETS_MAX

STEPS = 500
MESSAGE_BYTES = 3000
"""The longest that the liar announces and does not finish, beside one of 16 MB."""
LIMITS = LinkLimits(receive_window_bytes=12 * DATAGRAM_BYTES_MAX, send_queue_bytes_max=50_000)
LARGEST = 2**64 - 1


class Liar:
    """Seals headers and frames of which next to nothing is true, most of it near enough to be taken."""

    def __init__(self, seed, host):
        self.chance = random.Random(seed)
        self.host = host
        self.number = 0
        self.seal = Seal(
            derive_keys(RUN_KEY, SESSION, 7, 99),
            Role.AGENT,
            session=SESSION,
            agent_index=7,
            incarnation_id=99,
        )

    def near(self, value):
        offset = self.chance.choice((0, 0, 0, -1, 1, -5, 5, 100, LARGEST))
        return max(0, min(LARGEST, value + offset))

    def frames(self):
        payload = b""
        for _ in range(self.chance.randrange(4)):
            kind = self.chance.choice((0, 1, 2, 2, 3))
            expected = self.chance.randrange(10)
            if kind in (Service.RELIABLE, Service.SYNC):
                expected = self.host._incoming.streams[kind - 1].next_expected
            prefix = self.chance.choice((b"", b"\xff\xff\xff\x00", bytes(4), b"\x05\x00\x00\x00"))
            body = prefix + self.chance.randbytes(self.chance.choice((0, 1, 4, 200)))
            payload += frame(kind, self.near(expected), body)
        return payload[:PAYLOAD_BYTES_MAX]

    def datagram(self):
        chance, host = self.chance, self.host
        self.number += chance.choice((1, 1, 1, 2, 70, 1030))
        reliable, sync = host._outgoing.streams
        header = REST.pack(
            max(1, self.number + chance.choice((0, 0, 0, -1, -70, -1100))),
            self.near(chance.randrange(host._packets.newest + 1)),
            chance.getrandbits(64),
            self.near(reliable.base),
            self.near(sync.base),
            chance.choice((0, 1, 4, 65_535)),
            chance.choice((0, 1, 4, 65_535)),
            chance.choice((0, 100, 65_535)),
            chance.randrange(256),
            chance.randrange(256),
        )
        return self.seal.close(header, self.frames())


def send_something(host, chance, now_s):
    with contextlib.suppress(SendQueueFull):
        host.send(
            chance.randbytes(chance.choice((0, 10, MESSAGE_BYTES))),
            chance.choice((Service.RELIABLE, Service.SYNC)),
            now_s,
            deadline_s=now_s + chance.choice((-1.0, 0.01, 1.0)),
        )


def unacknowledged_bytes(stream):
    """Return what really waits in a stream, counted message by message."""
    carried = 0
    for fragment in stream._unacknowledged.values():
        carried += len(fragment.frame) - len(frame(body=b""))
    return carried + sum(map(len, stream._pending)) - stream._offset


@pytest.mark.parametrize("seed", range(8))
def test_peer_that_lies_in_every_field_costs_bounded_memory_and_no_standstill(seed):
    host = host_link(RUN_KEY, SESSION, 7, 99, limits=LIMITS)
    liar = Liar(seed, host)
    chance = liar.chance
    now_s = 1.0
    for _ in range(STEPS):
        now_s += chance.choice((0.0, 0.0001, 0.01, 0.3))
        send_something(host, chance, now_s)
        datagram = liar.datagram()
        if host.open_best(datagram, now_s) is None:
            host.receive_datagram(datagram, now_s)
        while chance.random() < 0.9 and host.next_message() is not None:
            pass
        timer_s = host.get_timer()
        if timer_s is not None and timer_s <= now_s:
            host.handle_timer(now_s)
        datagrams = host.datagrams_to_send(now_s)

        timer_s = host.get_timer()
        assert timer_s is None or timer_s > now_s
        assert all(len(data) <= DATAGRAM_BYTES_MAX for data in datagrams)
        # One unfinished message per stream is held, fed by what the windows let in, and they let in little.
        assert host.held_bytes <= STEPS * 4 * 204
        for stream in host._incoming.streams:
            assert len(stream._held) <= stream.window
        for stream in host._outgoing.streams:
            assert len(stream._lost) <= LOST_PACKETS_MAX
            assert stream.queued_bytes == unacknowledged_bytes(stream)
    refused = host.counters.refused
    assert refused["malformed"] > 0
    assert refused["replay"] > 0
    assert host.counters.datagrams_received > STEPS / 10
