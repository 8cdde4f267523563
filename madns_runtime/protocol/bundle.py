"""
Several datagrams of one sender in one packet of the network: what many agents of a process say at one time, and the answers.

    BUNDLE, then of each datagram its length (2 bytes, little-endian) and the datagram itself

Each datagram keeps its own seal. What stands behind one with a wrong seal the host does not look at, but counts it: all are
of one sender. A datagram by itself travels as it is; none begins with BUNDLE, which is no version.
"""

from __future__ import annotations

from collections.abc import Sequence
from struct import Struct
from typing import Final

from madns_runtime.protocol.datagram import DATAGRAM_BYTES_MAX, OVERHEAD_BYTES

BUNDLE: Final = 0xB5
"""First byte; datagrams begin with their version."""

_LENGTH: Final = Struct("<H")
_LENGTH_BYTES: Final = _LENGTH.size
_MARK: Final = bytes([BUNDLE])
_ROOM: Final = DATAGRAM_BYTES_MAX - len(_MARK)


def bundle_up(datagrams: Sequence[bytes]) -> list[bytes]:
    """
    Return packets that carry *datagrams*, in order, none longer than a datagram may be.

    A datagram to which no other fits is not wrapped.
    """
    if len(datagrams) == 1:
        return list(datagrams)
    packets: list[bytes] = []
    begun: list[bytes] = []
    room = _ROOM
    for datagram in datagrams:
        size = len(datagram) + _LENGTH_BYTES
        if size > room and begun:
            packets.append(_wrap(begun))
            begun, room = [], _ROOM
        begun.append(datagram)
        room -= size
    packets.append(_wrap(begun))
    return packets


def _wrap(datagrams: list[bytes]) -> bytes:
    if len(datagrams) == 1:
        return datagrams[0]
    pack = _LENGTH.pack
    parts = [_MARK]
    for datagram in datagrams:
        parts += (pack(len(datagram)), datagram)
    return b"".join(parts)


def is_bundle(packet: bytes) -> bool:
    """Tell whether a packet is more than one datagram, or claims to be."""
    return packet[:1] == _MARK


def split(packet: bytes) -> list[bytes] | None:
    """Return the datagrams of a bundle; None if it is malformed: empty, too long, cut, or with a piece that can be none."""
    end = len(packet)
    if not len(_MARK) < end <= DATAGRAM_BYTES_MAX:
        return None
    datagrams = []
    at = len(_MARK)
    while at < end:
        start = at + _LENGTH_BYTES
        if start > end:
            return None
        (size,) = _LENGTH.unpack_from(packet, at)
        at = start + size
        if at > end or size < OVERHEAD_BYTES:
            return None
        datagrams.append(packet[start:at])
    return datagrams
