"""Counters of a link: everything sent, received, lost, late, repeated and refused."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Final

REFUSALS: Final = (
    "short",
    "oversize",
    "version",
    "sender",
    "mac",
    "replay",
    "malformed",
)
"""Why a datagram is refused. `sender`: another session, agent, incarnation or direction."""


@dataclass(slots=True)
class ClassCounters:
    """Counts of one class of service, as one side sees them."""

    sent: int = 0
    """Messages taken for sending."""
    received: int = 0
    """Messages handed to the owner's side of the queue."""
    acknowledged: int = 0
    """Streams only: messages of ours that the peer has whole."""
    lost: int = 0
    """BEST: messages that never came (a receiver's count). Streams: messages given up unacknowledged."""
    resent: int = 0
    """Streams only: fragments sent again."""
    resent_spurious: int = 0
    """Streams only: of these, how many turned out needless."""
    duplicates: int = 0
    """Fragments (streams) or messages (BEST) that came twice in different datagrams."""
    late: int = 0
    """BEST only: overtaken by a newer one and dropped; not counted as lost."""
    dropped: int = 0
    """BEST only: pushed out of a full queue on this side by newer ones."""
    of_half: int = 0
    """BEST only: messages of this side's half taken for sending."""
    reached: int = 0
    """BEST only: how many the other side's half had sent with the newest of its messages that came: no gap tells of later ones."""


@dataclass(slots=True)
class LinkCounters:
    """Counts of one link."""

    best: ClassCounters = field(default_factory=ClassCounters)
    reliable: ClassCounters = field(default_factory=ClassCounters)
    sync: ClassCounters = field(default_factory=ClassCounters)
    refused: dict[str, int] = field(default_factory=lambda: dict.fromkeys(REFUSALS, 0))
    """Datagrams refused, by reason."""
    deadlines_broken: int = 0
    send_queue_full: int = 0
    """Messages that the bounded send queue did not take."""
    datagrams_sent: int = 0
    datagrams_received: int = 0
    """Accepted ones only, as bytes_received."""
    bytes_sent: int = 0
    bytes_received: int = 0

    def to_mapping(self) -> dict[str, int | dict[str, int]]:
        """Return the counts as plain mappings."""
        return asdict(self)
