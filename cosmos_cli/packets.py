"""
Packets lost, repeated and out of order, by agent: what the simulation counted and what its link kept from it. Pure.

A simulation never sees a packet twice, or behind a newer one, for its link has dropped it; only the
link's counters know. A lost packet it does miss, whatever became of it: that count stands for itself.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from cosmos_cli.expectation import mapping_at

SERVICES = ("best", "reliable", "sync")
OWN_NAMES = ("lost", "duplicated", "out_of_order")
"""As a simulation's summary calls them."""


def packet_counts(agents: Mapping[str, Any]) -> dict[str, dict[str, int | None]]:
    """
    Return lost, duplicated and out_of_order by agent; empty where no simulation counts packets.

    Args:
        agents: The host's result by agent: "messages" of its link, "simulation" as it summed up.

    An agent that died summed nothing up: of it the link's counters are told alone, None if it has none. A packet that came
    behind a newer one counts as out of order, and as lost too, for it never reached the simulation.
    """
    own = {name: mapping_at(agents, name, "simulation") for name in agents}
    counting = [summary for summary in own.values() if any(key in summary for key in OWN_NAMES)]
    if not counting:
        return {}
    used = {str(summary["service"]) for summary in counting if "service" in summary}
    services = tuple(name for name in SERVICES if name in used) or SERVICES
    return {
        name: _of_agent(mapping_at(agents, name, "messages"), own[name], services) for name in own
    }


def duplicates_by_service(agents: Mapping[str, Any]) -> dict[str, int]:
    """Return what came twice on any agent's link, by class: messages of BEST, fragments of streams."""
    return {
        service: sum(
            _sum(mapping_at(agents, name, "messages"), (service,), "duplicates") for name in agents
        )
        for service in SERVICES
    }


def _of_agent(
    messages: Mapping[str, Any], own: Mapping[str, Any], services: tuple[str, ...]
) -> dict[str, int | None]:
    of_link = [mapping_at(messages, service).get("lost") for service in services]
    link_lost = None if None in of_link else sum(map(_whole, of_link))
    return {
        "lost": _whole(own["lost"]) if "lost" in own else link_lost,
        "duplicated": _whole(own.get("duplicated")) + _sum(messages, services, "duplicates"),
        "out_of_order": _whole(own.get("out_of_order")) + _sum(messages, services, "late"),
    }


def _sum(messages: Mapping[str, Any], services: tuple[str, ...], count: str) -> int:
    return sum(
        _whole(mapping_at(end, service).get(count))
        for end in _ends(messages)
        for service in services
    )


def _ends(messages: Mapping[str, Any]) -> Iterator[Mapping[str, Any]]:
    """Yield the counters of both ends of a link, and of the host's ends to earlier incarnations."""
    yield mapping_at(messages, "agent")
    yield mapping_at(messages, "host")
    earlier = messages.get("host_earlier")
    yield from (e for e in (earlier if isinstance(earlier, list) else ()) if isinstance(e, Mapping))


def _whole(value: object) -> int:
    return value if isinstance(value, int) and not isinstance(value, bool) else 0
