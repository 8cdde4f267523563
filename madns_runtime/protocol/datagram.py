"""
The layout of a datagram, and its seal: who sent it, and that nobody changed it.

A datagram is HEADER (64 bytes), frames, MAC (16 bytes). The header's first 16 bytes, its prefix, name
the conversation and stay the same in all datagrams of one direction; then come the packet number, the
acknowledgements and the windows granted. The MAC is keyed BLAKE2b over everything before it.

Every conversation has its own pair of keys, one a direction, derived from the run key, the session,
the agent and the agent's incarnation id (drawn anew whenever its process starts). A packet number is
therefore never used twice with one key, and nothing that an earlier process sent is valid for a later.
"""

from __future__ import annotations

import hmac
from dataclasses import dataclass
from enum import IntEnum
from hashlib import blake2b
from struct import Struct
from typing import Final, NamedTuple

from madns_runtime.protocol.messages import VERSION, Service

DATAGRAM_BYTES_MAX: Final = 1400
MAC_BYTES: Final = 16
KEY_BYTES: Final = 32
SESSION_BYTES: Final = 8
AGENT_INDEX_MAX: Final = 65_535
INCARNATION_ID_MAX: Final = 2**32 - 1

PREFIX: Final = Struct("<BBHI8s")
"""version, role of the sender, agent index, incarnation id, session."""
REST: Final = Struct("<QQQQQHHHBB")
"""packet number; largest packet received and the 64 before it; next fragment expected, RELIABLE then
SYNC; fragments granted beyond these, RELIABLE then SYNC; time between receiving that largest packet and
this datagram in ACK_DELAY_UNIT_S; contents; zero."""
PREFIX_BYTES: Final = PREFIX.size
HEADER_BYTES: Final = PREFIX.size + REST.size
OVERHEAD_BYTES: Final = HEADER_BYTES + MAC_BYTES
PAYLOAD_BYTES_MAX: Final = DATAGRAM_BYTES_MAX - OVERHEAD_BYTES

FRAME: Final = Struct("<BBHQ")
"""service, channel (BEST only), payload bytes, number of the message (BEST) or fragment."""
FRAME_BYTES: Final = FRAME.size
FRAGMENT_BYTES_MAX: Final = PAYLOAD_BYTES_MAX - FRAME_BYTES
BEST_BYTES_MAX: Final = FRAGMENT_BYTES_MAX
"""The longest body of a BEST message: one datagram."""

MESSAGE_PREFIX: Final = Struct("<I")
"""channel in the upper 8 bits, body length in the lower 24: every value is a valid one."""
MESSAGE_BYTES_MAX: Final = (1 << 24) - 1
CHANNEL_MAX: Final = 255
WINDOW_FRAGMENTS_MIN: Final = 4
"""Window that every receiver grants from the start, before its first datagram has come."""
WINDOW_FRAGMENTS_MAX: Final = 0xFFFF

PROBE: Final = 8
"""A header's contents are the bits 1 << service of its frames, and this one: tell me what you grant."""
ELICITING: Final = 1 << Service.RELIABLE | 1 << Service.SYNC | PROBE
"""Contents that want to be acknowledged ..."""
AT_ONCE: Final = 1 << Service.SYNC | PROBE
"""... and these without delay."""
BEST_ALONE: Final = 1 << Service.BEST

STREAMS: Final = Struct("<QQHH")
"""State of the streams in a header, RELIABLE then SYNC: how far they are, and what is granted."""
HEADER_REST: Final = Struct(f"<QQQ{STREAMS.size}sHBB")
"""REST with STREAMS in one piece: from one datagram to the next it is the same, unless a stream moves."""
ALONE: Final = Struct(f"<{PREFIX_BYTES}s{HEADER_REST.format[1:]}{FRAME.format[1:]}")
"""A whole header and that of the one frame behind it."""
ALONE_AT: Final = HEADER_BYTES + FRAME_BYTES
ALONE_BYTES_MIN: Final = ALONE_AT + MAC_BYTES

_PEEK: Final = Struct("<BBHI8sQ")
_AGENT_AT: Final = 2
_AGENT_BYTES: Final = 2


class Role(IntEnum):
    """The sender of a datagram."""

    AGENT = 0
    HOST = 1


@dataclass(frozen=True, slots=True)
class LinkKeys:
    """The MAC keys of one conversation, 32 bytes a direction."""

    up: bytes
    """Agent to host."""
    down: bytes
    """Host to agent."""

    def __repr__(self) -> str:
        """Show no key: representations end up in logs."""
        return "LinkKeys(...)"


def derive_keys(run_key: bytes, session: bytes, agent_index: int, incarnation_id: int) -> LinkKeys:
    """
    Derive the two keys of one agent's conversation with the host.

    Args:
        run_key: Secret of the run, 32 to 64 bytes.
        session: Public number of the run, 8 bytes.
        agent_index: 1 to 65535.
        incarnation_id: Drawn by the agent's process at its start, 32 bits.

    Raises:
        ValueError: An argument is out of bounds.
    """
    if not KEY_BYTES <= len(run_key) <= 64:
        raise ValueError(f"expected a run key of 32 to 64 bytes, got {len(run_key)}")
    context = _pack_prefix(session, agent_index, incarnation_id, Role.AGENT)
    return LinkKeys(
        up=blake2b(context, digest_size=KEY_BYTES, key=run_key, person=b"madns link up").digest(),
        down=blake2b(
            context, digest_size=KEY_BYTES, key=run_key, person=b"madns link down"
        ).digest(),
    )


def _pack_prefix(session: bytes, agent_index: int, incarnation_id: int, role: Role) -> bytes:
    if len(session) != SESSION_BYTES:
        raise ValueError(f"expected a session of {SESSION_BYTES} bytes, got {len(session)}")
    if not 1 <= agent_index <= AGENT_INDEX_MAX:
        raise ValueError(f"expected an agent index of 1 to {AGENT_INDEX_MAX}, got {agent_index}")
    if not 0 <= incarnation_id <= INCARNATION_ID_MAX:
        raise ValueError(f"expected an incarnation id of 32 bits, got {incarnation_id}")
    return PREFIX.pack(VERSION, role, agent_index, incarnation_id, session)


def agent_index_of(datagram: bytes) -> int:
    """Return the agent that a datagram claims to be of or for; whatever stands there if it is none."""
    return int.from_bytes(datagram[_AGENT_AT : _AGENT_AT + _AGENT_BYTES], "little")


class Header(NamedTuple):
    """Claims of a datagram about itself. Nothing of it is proven before its MAC is."""

    version: int
    role: int
    agent_index: int
    incarnation_id: int
    session: bytes
    packet_number: int

    @staticmethod
    def peek(datagram: bytes) -> Header | None:
        """Return the claims of a datagram, None if it is too short or too long to be one."""
        if OVERHEAD_BYTES <= len(datagram) <= DATAGRAM_BYTES_MAX:
            return Header._make(_PEEK.unpack_from(datagram))
        return None


class Seal:
    """One side's end of a conversation: seals what it sends, checks what it receives."""

    __slots__ = (
        "agent_index",
        "incarnation_id",
        "peer_prefix",
        "prefix",
        "receive_mac",
        "send_mac",
    )

    def __init__(
        self, keys: LinkKeys, role: Role, *, session: bytes, agent_index: int, incarnation_id: int
    ) -> None:
        is_agent = role is Role.AGENT
        peer = Role.HOST if is_agent else Role.AGENT
        self.agent_index = agent_index
        self.incarnation_id = incarnation_id
        self.prefix = _pack_prefix(session, agent_index, incarnation_id, role)
        self.peer_prefix = _pack_prefix(session, agent_index, incarnation_id, peer)
        send_key, receive_key = (keys.up, keys.down) if is_agent else (keys.down, keys.up)
        # Copying a hash that has taken its key already is faster than keying a new one.
        self.send_mac = blake2b(digest_size=MAC_BYTES, key=send_key)
        self.receive_mac = blake2b(digest_size=MAC_BYTES, key=receive_key)

    @classmethod
    def derive(
        cls, run_key: bytes, session: bytes, agent_index: int, incarnation_id: int, role: Role
    ) -> Seal:
        """Return the end of *role* in a conversation; see `derive_keys` for the other arguments."""
        keys = derive_keys(run_key, session, agent_index, incarnation_id)
        return cls(
            keys, role, session=session, agent_index=agent_index, incarnation_id=incarnation_id
        )

    def close(self, rest: bytes, payload: bytes) -> bytes:
        """Return the datagram of a packed header rest (see REST) and the frames behind it."""
        body = self.prefix + rest + payload
        mac = self.send_mac.copy()
        mac.update(body)
        return body + mac.digest()

    def find_fault(self, datagram: bytes) -> str | None:
        """Return why a datagram is not from the peer of this conversation, None if it is."""
        size = len(datagram)
        if size > DATAGRAM_BYTES_MAX:
            return "oversize"
        if size < OVERHEAD_BYTES:
            return "short"
        if datagram[:PREFIX_BYTES] != self.peer_prefix:
            return "version" if datagram[0] != VERSION else "sender"
        mac = self.receive_mac.copy()
        mac.update(datagram[:-MAC_BYTES])
        if not hmac.compare_digest(mac.digest(), datagram[-MAC_BYTES:]):
            return "mac"
        return None
