"""The host's end of a conversation, which it makes of the seal that it has tried a stranger's datagram by."""

from __future__ import annotations

from madns_runtime.protocol.datagram import Role, Seal
from madns_runtime.protocol.link import Link
from madns_runtime.protocol.link_settings import LinkLimits


def host_link(
    run_key: bytes,
    session: bytes,
    agent_index: int,
    incarnation_id: int,
    *,
    limits: LinkLimits | None = None,
) -> Link:
    """Return the host's end, as `Link.for_agent` returns the agent's."""
    seal = Seal.derive(run_key, session, agent_index, incarnation_id, Role.HOST)
    return Link(seal=seal, limits=limits or LinkLimits())
