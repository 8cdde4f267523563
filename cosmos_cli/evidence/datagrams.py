"""
Packets and datagrams of a run: lost, repeated, out of order, and refused, from the host's result. Pure.

A simulation never sees a packet twice, or behind a newer one, for its link has dropped it; only the
link's counters know. A lost packet it does miss, whatever became of it: that count stands for itself.
Datagrams that are of no agent's link the host counts by themselves; each link counts its own at both ends.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

from cosmos_cli.evidence.completeness import NOTHING
from madns_runtime.plain_values import mapping_at
from madns_runtime.protocol.messages import SERVICE_NAMES
from madns_runtime.recording.records import WHOLE_MAX

OWN_NAMES = ("lost", "duplicated", "out_of_order")
"""Names in a simulation's summary."""
WORDS: Final[Mapping[str, str]] = {
    "mac": "wrong seal",
    "replay": "repeated",
    "oversize": "too long",
    "short": "too short",
    "version": "another protocol version",
    "session": "another run",
    "sender": "another sender",
    "unknown_agent": "unknown agent",
    "old_incarnation": "an agent's earlier process",
    "behind_forged": "in one packet behind one refused",
    "malformed": "malformed",
}
"""Reasons, as people read them."""
USUAL: Final = frozenset({"replay", "old_incarnation"})
"""Reasons that a network, or an agent that was started again, brings about by itself."""
FOREIGN_MAX: Final = 10
"""More datagrams than this, refused for a reason that is not usual, are worth a remark: somebody else sends."""
USUAL_MAX: Final = 1000
"""The same bound for the usual reasons."""


def packet_counts(
    agents: Mapping[str, Any], faults: Mapping[str, Any] = NOTHING
) -> dict[str, dict[str, int | None]]:
    """
    Return lost, duplicated and out_of_order by agent; empty where the simulation counts no packets.

    One that does counts all three in an agent's summary, beside the `service` that its packets go by: a single `lost`
    of another summary may mean anything.

    Args:
        agents: The host's result by agent: "messages" of its link, "simulation" as it summed up.
        faults: Its account of the messages that inserted faults were shown, by agent.

    An agent that was lost summed nothing up, and one that came back only its last incarnation: for both it is what the
    link lost and what a fault took, None if the link counted nothing. A packet that came behind a newer one counts as out of order, and as lost too, for it never reached the simulation.
    """
    own = {name: mapping_at(agents, name, "simulation") for name in agents}
    used = {
        str(summary["service"])
        for summary in own.values()
        if all(key in summary for key in ("service", *OWN_NAMES))
    }
    if not used:
        return {}
    services = tuple(name for name in SERVICE_NAMES if name in used) or SERVICE_NAMES
    return {
        name: _packets_of(
            mapping_at(agents, name, "messages"),
            own[name],
            services,
            has_returned=whole_count(mapping_at(agents, name).get("incarnations")) > 1,
            taken=whole_count(mapping_at(faults, name).get("lost")),
        )
        for name in own
    }


def duplicates_by_service(agents: Mapping[str, Any]) -> dict[str, int]:
    """Return what came twice on any agent's link, by class: messages of BEST, fragments of streams."""
    return {
        service: sum(
            _sum(mapping_at(agents, name, "messages"), (service,), "duplicates") for name in agents
        )
        for service in SERVICE_NAMES
    }


def _packets_of(
    messages: Mapping[str, Any],
    own: Mapping[str, Any],
    services: tuple[str, ...],
    *,
    has_returned: bool,
    taken: int,
) -> dict[str, int | None]:
    of_link = [mapping_at(messages, service).get("lost") for service in services]
    link_lost = None if None in of_link else sum(map(whole_count, of_link)) + taken
    return {
        "lost": whole_count(own["lost"]) if "lost" in own and not has_returned else link_lost,
        "duplicated": whole_count(own.get("duplicated")) + _sum(messages, services, "duplicates"),
        "out_of_order": whole_count(own.get("out_of_order")) + _sum(messages, services, "late"),
    }


def _sum(messages: Mapping[str, Any], services: tuple[str, ...], count: str) -> int:
    return sum(
        whole_count(mapping_at(end, service).get(count))
        for end in (mapping_at(messages, "agent"), *_host_ends(messages))
        for service in services
    )


def _host_ends(messages: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """Return the counters of the host's end of a link, and of its ends to earlier incarnations."""
    earlier = messages.get("host_earlier")
    ends = [messages.get("host"), *(earlier if isinstance(earlier, list) else ())]
    return [end for end in ends if isinstance(end, Mapping)]


def whole_count(value: object) -> int:
    """Return a count from a file; 0 for what is none."""
    if isinstance(value, int) and not isinstance(value, bool) and abs(value) <= WHOLE_MAX:
        return value
    return 0


def datagram_account(result: Mapping[str, Any]) -> dict[str, Any]:
    """
    Return what the host and every agent received and refused; empty where no datagrams travelled.

    Args:
        result: The host's.

    The agents that gave no word at their end have None: nobody knows. An agent's later process stands for it.
    """
    agents = mapping_at(result, "agents")
    network = mapping_at(result, "network")
    if not network:
        return {}
    links = (mapping_at(agents, name, "messages") for name in agents)
    at_host = (mapping_at(end, "refused") for messages in links for end in _host_ends(messages))
    host = _add(mapping_at(result, "refused"), *at_host)
    by_process = {
        "host": _entry(network, host),
        **{name: _datagrams_of(mapping_at(agents, name)) for name in agents},
    }
    refused = sum(entry["refused"] for entry in by_process.values() if entry is not None)
    own = {name: entry for name, entry in by_process.items() if name != "host"}
    return {"refused": refused, "host": by_process["host"], "agents": own}


def datagram_remarks(account: Mapping[str, Any]) -> tuple[str, ...]:
    """Return a remark for the host, and each agent, that refused more than chance explains."""
    processes = {"host": mapping_at(account, "host"), **mapping_at(account, "agents")}
    return tuple(
        f"{name}: {entry['refused']} datagrams refused ({listed(entry['by_reason'])});"
        " something else sends to its UDP port, or a link repeats or damages what it carries"
        for name, entry in processes.items()
        if entry and _is_much(entry["by_reason"])
    )


def listed(by_reason: Mapping[str, int]) -> str:
    """Return counts by reason in words, the largest first."""
    counts = sorted(by_reason.items(), key=lambda item: (-item[1], item[0]))
    return ", ".join(f"{WORDS.get(reason, reason)} {count}" for reason, count in counts)


def _is_much(by_reason: Mapping[str, int]) -> bool:
    usual = sum(count for reason, count in by_reason.items() if reason in USUAL)
    return usual > USUAL_MAX or sum(by_reason.values()) - usual > FOREIGN_MAX


def _datagrams_of(agent: Mapping[str, Any]) -> dict[str, Any] | None:
    counters = mapping_at(agent, "messages", "agent")
    if not counters:
        return None
    return _entry(mapping_at(agent, "records", "network"), mapping_at(counters, "refused"))


def _entry(network: Mapping[str, Any], refused: Mapping[str, Any]) -> dict[str, Any]:
    by_reason = {reason: count for reason, count in _add(refused).items() if count}
    return {
        "received": network.get("received"),
        "dropped_by_kernel": network.get("dropped_by_kernel"),
        "refused": sum(by_reason.values()),
        "by_reason": by_reason,
    }


def _add(*counts: Mapping[str, Any]) -> dict[str, int]:
    total: dict[str, int] = {}
    for mapping in counts:
        for reason, count in mapping.items():
            if isinstance(count, int) and not isinstance(count, bool):
                total[reason] = total.get(reason, 0) + whole_count(count)
    return total
