"""Settings that both ends of a run's links share, and the bounds of a link, chosen by its owner."""

from __future__ import annotations

from dataclasses import dataclass, field

from madns_runtime.errors import MadnsError
from madns_runtime.protocol.datagram import (
    DATAGRAM_BYTES_MAX,
    WINDOW_FRAGMENTS_MAX,
    WINDOW_FRAGMENTS_MIN,
)

PLUGIN_CHANNEL = 1
"""Channel of plug-ins' BEST messages: the framework's own go by channel 0, so that neither pushes the other out."""


class SendQueueFull(MadnsError):
    """The peer takes messages more slowly than the plug-in sends them; the message was not queued."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkLimits:
    """Bounds of one link."""

    receive_window_bytes: int = 64 * 1024
    """Bytes that the peer may have under way to us: the socket's receive buffer divided by the peers.
    Counted in whole datagrams, a quarter of them for SYNC, the others for RELIABLE, at least 4 each."""
    send_queue_bytes_max: int = 32 * 1024 * 1024
    """Messages of each stream that wait or are not acknowledged."""
    best_queue_max: int = 256
    """BEST messages between two calls, in either direction; newer ones push out older ones."""
    pace_bytes_per_s: float = 8e6
    """Rate of RELIABLE fragments beyond a burst."""
    pace_burst_bytes: int = 16 * DATAGRAM_BYTES_MAX

    def get_windows(self) -> tuple[int, int]:
        """Return the windows of RELIABLE and SYNC in fragments."""
        total = self.receive_window_bytes // DATAGRAM_BYTES_MAX
        sync = min(max(total // 4, WINDOW_FRAGMENTS_MIN), WINDOW_FRAGMENTS_MAX)
        reliable = min(max(total - sync, WINDOW_FRAGMENTS_MIN), WINDOW_FRAGMENTS_MAX)
        return reliable, sync


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkSettings:
    """The secret of a run, its name on the wire, and the bounds of its links."""

    run_key: bytes = field(repr=False)
    """32 bytes; the keys of every agent and direction derive from it."""
    session: bytes
    """8 bytes that stand in every datagram's header."""
    limits: LinkLimits = field(default_factory=LinkLimits)
