"""What the host tells of a run: progress on the way, and the result at its end."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

from madns_runtime.protocol.host_events import Peer, Phase
from madns_runtime.protocol.host_session import HostSession

SERVICES = ("best", "reliable", "sync")


@dataclass(slots=True)
class HostReport:
    """Collects what the result will hold while the run goes on."""

    duration_s: float
    t0_utc: str | None = None
    lost: dict[str, str] = field(default_factory=dict)
    simulation: Mapping[str, Any] = field(default_factory=dict)
    records: Mapping[str, Any] = field(default_factory=dict)
    scheduling: Mapping[str, Any] = field(default_factory=dict)
    ending_status: str | None = None
    """What an order of the operator makes of the run."""
    problems_told: set[str] = field(default_factory=set)
    """Whose trouble with its records has been told."""
    _who: str | None = None
    _reason: str | None = None
    _completed_s: float | None = None

    def fail(self, who: str, reason: str) -> None:
        """Keep the first cause."""
        if self._reason is None:
            self._who, self._reason = who, reason

    def completed(self, t_s: float) -> None:
        """Every agent has run its simulated time, at simulated time *t_s* of the host."""
        self._completed_s = t_s

    def result(self, session: HostSession) -> dict[str, Any]:
        """Return the result as the operator's side expects it."""
        agents = {
            name: _agent_result(peer, self.lost.get(name)) for name, peer in session.peers.items()
        }
        ended = self.ending_status or "failed"
        status = "complete" if self._reason is None else ended
        return {
            "status": status,
            "who": self._who,
            "reason": self._reason,
            "t0_utc": self.t0_utc,
            "duration_s": self.duration_s,
            "completed_s": self._completed_s,
            "rtf": _worst_rtf(agents.values()),
            "agents": agents,
            "lost": sorted(self.lost),
            "messages": _totals(agent["messages"] for agent in agents.values()),
            "refused": {**session.refused, "malformed": session.malformed_count},
            "records": self.records,
            "simulation": self.simulation,
            "scheduling": self.scheduling,
        }


def _agent_result(peer: Peer, loss_reason: str | None) -> dict[str, Any]:
    summary = dict(peer.summary)
    simulation = summary.pop("simulation", {})
    records = dict(peer.records)
    return {
        "state": peer.phase.value,
        "reason": loss_reason,
        "incarnations": len(peer.incarnations_seen),
        **summary,
        "messages": _messages(peer, records.pop("messages", None)),
        "records": records,
        "simulation": simulation,
    }


def _messages(peer: Peer, agent_side: Mapping[str, Any] | None) -> dict[str, Any]:
    """
    Join both ends' counters of an agent's link.

    What one end sent in a stream and the other never had is lost. Without the agent's own count only
    what the host saw is told.
    """
    host_side: Mapping[str, Any] = peer.link.counters.to_mapping() if peer.link else {}
    joined: dict[str, Any] = {}
    for service in SERVICES:
        up: Mapping[str, Any] = (agent_side or {}).get(service, {})
        down: Mapping[str, Any] = host_side.get(service, {})
        sent = up.get("sent", 0) + down.get("sent", 0)
        received = up.get("received", 0) + down.get("received", 0)
        if service == "best":
            # What the receivers missed between two that came, and what a full queue pushed out.
            lost = sum(side.get(name, 0) for side in (up, down) for name in ("lost", "dropped"))
        elif agent_side is None:
            lost = down.get("lost", 0)
        else:
            lost = max(0, up.get("sent", 0) - down.get("received", 0)) + max(
                0, down.get("sent", 0) - up.get("received", 0)
            )
        joined[service] = {
            "sent": sent,
            "received": received,
            "lost": lost,
            "resent": up.get("resent", 0) + down.get("resent", 0),
            "late": up.get("late", 0) + down.get("late", 0),
            "deadlines_broken": up.get("deadlines_broken", 0) + down.get("deadlines_broken", 0),
        }
    joined["agent"] = dict(agent_side or {})
    joined["host"] = dict(host_side)
    if peer.retired_counters:
        joined["host_earlier"] = list(peer.retired_counters)
    return joined


def _totals(messages: Iterable[Mapping[str, Any]]) -> dict[str, dict[str, int]]:
    totals: dict[str, dict[str, int]] = {service: {} for service in SERVICES}
    for one in messages:
        for service in SERVICES:
            for name, count in one[service].items():
                totals[service][name] = totals[service].get(name, 0) + count
    return totals


def _worst_rtf(agents: Iterable[Mapping[str, Any]]) -> float | None:
    """Return the real-time factor that is farthest from 1, of the agents that ran to the end."""
    factors = [agent["rtf"] for agent in agents if agent.get("rtf") is not None]
    return max(factors, key=lambda rtf: abs(rtf - 1.0)) if factors else None


def progress_report(session: HostSession, t_s: float | None, duration_s: float) -> dict[str, Any]:
    """Return the progress event: what the agents' newest reports say."""
    reports = [peer.report for peer in session.peers.values() if peer.report]
    factors = [r["rtf"] for r in reports if r.get("rtf") is not None]
    uplink_lost = sum(peer.link.counters.best.lost for peer in session.peers.values() if peer.link)
    ready = (Phase.READY, Phase.SETTING_UP, Phase.SIMULATION_READY)
    return {
        "event": "progress",
        "t_s": None if t_s is None else round(min(t_s, duration_s), 3),
        "rtf": max(factors, key=lambda rtf: abs(rtf - 1.0)) if factors else None,
        "ready": len(session.agents_in(*ready)),
        "running": len(session.agents_in(Phase.RUNNING)),
        "complete": len(session.agents_in(Phase.COMPLETE, Phase.STOPPED)),
        "lost": len(session.agents_in(Phase.LOST)),
        "ticks": sum(r.get("ticks", 0) for r in reports),
        "missed": sum(r.get("missed", 0) for r in reports),
        "lateness_us_p50": _median([r["late_p50_us"] for r in reports if "late_p50_us" in r]),
        "lateness_us_p99": max(
            (r["late_p99_us"] for r in reports if "late_p99_us" in r), default=None
        ),
        "lost_messages": uplink_lost + sum(r.get("lost", 0) for r in reports),
        "records_dropped": sum(r.get("dropped", 0) for r in reports),
    }


def _median(values: list[float]) -> float | None:
    return sorted(values)[len(values) // 2] if values else None
