"""What both ends of a run's links share."""

from __future__ import annotations

from dataclasses import dataclass, field

from madns_runtime.protocol.limits import LinkLimits

PLUGIN_CHANNEL = 1
"""Of BEST messages: the framework's own go by channel 0, so that neither pushes the other out."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Wire:
    """The secret of a run, its name on the wire, and the bounds of its links."""

    run_key: bytes = field(repr=False)
    """32 bytes; the keys of every agent and direction derive from it."""
    session: bytes
    """8 bytes that stand in every datagram's header."""
    limits: LinkLimits = field(default_factory=LinkLimits)
