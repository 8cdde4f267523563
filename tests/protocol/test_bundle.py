"""Several datagrams in one packet: what fits together, and what is no bundle."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from madns_runtime.protocol.bundle import BUNDLE, bundle_up, is_bundle, split
from madns_runtime.protocol.datagram import DATAGRAM_BYTES_MAX, OVERHEAD_BYTES, agent_index_of
from madns_runtime.protocol.messages import VERSION

datagrams = st.lists(
    st.integers(OVERHEAD_BYTES, DATAGRAM_BYTES_MAX).map(lambda size: bytes([VERSION]) * size),
    min_size=1,
    max_size=40,
)


def unpacked(packets):
    return [one for packet in packets for one in (split(packet) if is_bundle(packet) else [packet])]


@given(datagrams)
def test_what_was_bundled_comes_out_as_it_was_and_in_order(given_datagrams):
    packets = bundle_up(given_datagrams)

    assert unpacked(packets) == given_datagrams
    assert all(len(packet) <= DATAGRAM_BYTES_MAX for packet in packets)


def test_a_tick_of_eight_agents_is_one_packet():
    assert len(bundle_up([bytes([VERSION]) * 130] * 8)) == 1


def test_a_datagram_by_itself_is_not_wrapped():
    large, small = bytes([VERSION]) * DATAGRAM_BYTES_MAX, bytes([VERSION]) * 100

    assert bundle_up([small]) == [small]
    assert bundle_up([large, small, large]) == [large, small, large]


@pytest.mark.parametrize(
    "packet",
    [
        bytes([BUNDLE, 90]),
        bytes([BUNDLE]) + (OVERHEAD_BYTES - 1).to_bytes(2, "little") + bytes(OVERHEAD_BYTES - 1),
        bytes([BUNDLE]) + (OVERHEAD_BYTES + 1).to_bytes(2, "little") + bytes(OVERHEAD_BYTES),
        bytes([BUNDLE]) + bytes(2),
        bytes([BUNDLE]) * (DATAGRAM_BYTES_MAX + 1),
        bytes([BUNDLE]),
    ],
    ids=["cut length", "too short a piece", "cut piece", "empty piece", "too long", "nothing"],
)
def test_malformed_bundles_are_refused_whole(packet):
    assert is_bundle(packet)
    assert split(packet) is None


@given(st.binary(max_size=DATAGRAM_BYTES_MAX))
def test_no_bytes_make_it_fail(data):
    pieces = split(bytes([BUNDLE]) + data)

    assert pieces is None or all(len(piece) >= OVERHEAD_BYTES for piece in pieces)


def test_agent_of_what_is_no_datagram_is_some_number():
    assert agent_index_of(b"") == 0
    assert agent_index_of(bytes([VERSION, 0, 5, 1, 0])) == 261
