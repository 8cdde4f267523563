"""The host's account of a run: progress on the way, and the result at its end."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

from madns_runtime.faults.intended_losses import IntendedLosses, of_intended
from madns_runtime.medium.outcomes import between_agents
from madns_runtime.protocol.events import Phase
from madns_runtime.protocol.host_peers import Peer
from madns_runtime.protocol.host_session import HostSession
from madns_runtime.protocol.messages import SERVICE_NAMES
from madns_runtime.recording.newest_values import told_columns
from madns_runtime.recording.records import DEVICE_LOSSES

_Ends = tuple[Mapping[str, Any], Mapping[str, Any] | None]
"""Counters of a link as its two ends told them: the host, and the agent, None of one that gave no word."""


@dataclass(slots=True)
class HostReport:
    """Collects what the result will hold while the run goes on."""

    duration_s: float
    columns: tuple[str, ...] = ()
    """Fields of agents' streams whose newest values are told."""
    t0_utc: str | None = None
    lost: dict[str, str] = field(default_factory=dict)
    intended_lost: dict[str, str] = field(default_factory=dict)
    """Why agents were lost on purpose, the last time."""
    not_stopped: tuple[str, ...] = ()
    """Agents that gave no word that their records are closed."""
    simulation: Mapping[str, Any] = field(default_factory=dict)
    records: Mapping[str, Any] = field(default_factory=dict)
    scheduling: Mapping[str, Any] = field(default_factory=dict)
    ending_status: str | None = None
    """Status of a run that an order of the operator ends."""
    _who: str | None = None
    _reason: str | None = None
    completed_s: float | None = None
    """Simulated time of the host at which every agent had run its simulated time, s."""
    _told: set[str] = field(default_factory=set)
    """Agents, and "" for the host, whose trouble with their records has been told."""

    def fail(self, who: str, reason: str) -> None:
        """Keep the first cause."""
        if self._reason is None:
            self._who, self._reason = who, reason

    def new_troubles(self, session: HostSession, own: str | None) -> Iterator[str]:
        """Yield words for who has trouble with its records, the first time; *own* is the host's."""
        problems = {"": own, **{name: p.report.get("problem") for name, p in session.peers.items()}}
        for who, problem in problems.items():
            if problem and who not in self._told:
                self._told.add(who)
                yield f"{who}{': ' if who else ''}records are being lost: {problem}"

    def progress(self, session: HostSession, t_s: float | None) -> dict[str, Any]:
        """Return the progress event: what the agents' newest reports say."""
        reports = [peer.report for peer in session.peers.values() if peer.report]
        factors = [r["rtf"] for r in reports if r.get("rtf") is not None]
        uplink_lost = sum(
            peer.link.counters.best.lost for peer in session.peers.values() if peer.link
        )
        told = [
            (peer.name, peer.report["columns"])
            for peer in session.peers.values()
            if "columns" in peer.report
        ]
        ready = (Phase.READY, Phase.SETTING_UP, Phase.SIMULATION_READY)
        return {
            "event": "progress",
            "t_s": None if t_s is None else round(min(t_s, self.duration_s), 3),
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
            **told_columns(self.columns, told),
        }

    def result(
        self,
        session: HostSession,
        *,
        network: Mapping[str, Any],
        carried: Mapping[str, Any] = MappingProxyType({}),
        intended: IntendedLosses,
    ) -> dict[str, Any]:
        """
        Return the result as the operator's side expects it.

        Args:
            session: The run's.
            network: Counts of the host's socket.
            carried: The host's account of messages between agents.
            intended: The losses that were ordered.
        """
        overdue = intended.overdue(self.duration_s) if self._reason is None else {}
        reasons = {**self.intended_lost, **overdue, **self.lost}
        agents = {
            name: {
                **_agent_result(peer, reasons.get(name), intended.incarnations(name)),
                **of_intended(intended, name),
            }
            for name, peer in session.peers.items()
        }
        ended = self.ending_status or "failed"
        status = "complete" if self._reason is None else ended
        return {
            "status": status,
            "who": self._who,
            "reason": self._reason,
            "t0_utc": self.t0_utc,
            "duration_s": self.duration_s,
            "completed_s": self.completed_s,
            "rtf": _worst_rtf(agents.values()),
            "agents": agents,
            "lost": sorted({*self.lost, *overdue}),
            "lost_on_purpose": intended.names(),
            "not_stopped": list(self.not_stopped),
            "network": network,
            "messages": _totals(agents.values()),
            "between_agents": between_agents(
                carried,
                (
                    records.get("between_agents", {})
                    for peer in session.peers.values()
                    for records in (*peer.retired_records, peer.records)
                ),
            ),
            "refused": dict(session.refused),
            "malformed_messages": session.malformed_count,
            "records": self.records,
            "columns": list(self.columns),
            "simulation": self.simulation,
            "scheduling": self.scheduling,
        }


def _agent_result(
    peer: Peer, loss_reason: str | None, ended_on_purpose: Sequence[int]
) -> dict[str, Any]:
    summary = dict(peer.summary)
    simulation = summary.pop("simulation", {})
    incarnations = (*peer.retired_records, peer.records)
    records = {**peer.records, **_device_losses(incarnations)}
    return {
        "state": peer.phase.value,
        "reason": loss_reason,
        "incarnations": len(peer.incarnation_ids_seen),
        **summary,
        "messages": _messages(
            peer,
            records.pop("messages", None),
            sum(told.get("held_dropped", 0) for told in incarnations),
            ended_on_purpose=ended_on_purpose,
        )
        | {"too_late": sum(told.get("too_late", 0) for told in incarnations)},
        "records": records,
        "simulation": simulation,
    }


def _device_losses(incarnations: Iterable[Mapping[str, Any]]) -> dict[str, Any]:
    """Return what found no room between an agent and its devices, all incarnations together, by device and kind."""
    total: dict[str, dict[str, int]] = {}
    for records in incarnations:
        for device, counts in records.get(DEVICE_LOSSES, {}).items():
            joined = total.setdefault(device, {})
            for name, count in counts.items():
                # A device's process counts what was missed in all incarnations of an agent.
                joined[name] = count + (0 if name == "frames_missed" else joined.get(name, 0))
    return {DEVICE_LOSSES: total} if total else {}


def _messages(
    peer: Peer,
    agent_side: Mapping[str, Any] | None,
    held_dropped: int,
    *,
    ended_on_purpose: Sequence[int] = (),
) -> dict[str, Any]:
    """
    Join both ends' counters of an agent's link.

    The agent counts before its last word, the host after it. Without the agent's own count nobody
    knows what was lost: None, and a check on it does not hold. What came while the agent's half was
    being set up, and was too much to hold (*held_dropped*), never reached it: lost, of whichever class.
    Deadlines that an end on purpose broke are told apart: nothing else could become of them.
    """
    host_side: Mapping[str, Any] = peer.link.counters.to_mapping() if peer.link else {}
    earlier = zip(peer.retired_counters, peer.retired_records, strict=False)
    ends = [*((host, told.get("messages")) for host, told in earlier), (host_side, agent_side)]
    joined: dict[str, Any] = {service: _joined(service, ends) for service in SERVICE_NAMES}
    incarnations = (*peer.retired_counters, host_side)
    broken = [side.get("deadlines_broken", 0) for side in incarnations]
    excused = [count for number, count in enumerate(broken, start=1) if number in ended_on_purpose]
    own = sum(
        side.get("deadlines_broken", 0)
        for side in (*(each.get("messages", {}) for each in peer.retired_records), agent_side or {})
    )
    joined["sync"]["deadlines_broken"] = own + sum(broken) - sum(excused)
    if any(excused):
        joined["sync"]["deadlines_broken_on_purpose"] = sum(excused)
    if joined["reliable"]["lost"] is not None:
        joined["reliable"]["lost"] += held_dropped
    joined["not_sent"] = peer.not_sent
    joined["agent"] = dict(agent_side or {})
    joined["host"] = dict(host_side)
    if peer.retired_counters:
        joined["host_earlier"] = list(peer.retired_counters)
    return joined


def _joined(service: str, ends: Sequence[_Ends]) -> dict[str, int | None]:
    """Return the counts of one class of service, summed over incarnations; what a stream lost is the last one's."""
    incarnations = [
        _of_incarnation(service, host_side, agent_side) for host_side, agent_side in ends
    ]
    names = ("sent", "received", "lost", "resent", "late")
    joined: dict[str, int | None] = {
        name: sum(each[name] or 0 for each in incarnations) for name in names
    }
    return joined if service == "best" else {**joined, "lost": incarnations[-1]["lost"]}


def _of_incarnation(
    service: str, host_side: Mapping[str, Any], agent_side: Mapping[str, Any] | None
) -> dict[str, int | None]:
    down: Mapping[str, Any] = host_side.get(service, {})
    up: Mapping[str, Any] = (
        _of_silent(service, down) if agent_side is None else agent_side.get(service, {})
    )
    # AgentStopped, in SYNC, is sent after the agent has counted.
    last_word = 1 if service == "sync" and agent_side is not None else 0
    sent_up, sent_down = up.get("sent", 0) + last_word, down.get("sent", 0)
    lost: int | None = None
    if service == "best":
        # Gaps between what came; one that is pushed out of the sender's queue leaves a gap as well.
        lost = up.get("lost", 0) + down.get("lost", 0)
        if agent_side is not None:
            lost += _behind_newest(up, down) + _behind_newest(down, up)
    elif agent_side is not None:
        lost = max(0, sent_up - down.get("received", 0)) + max(0, sent_down - up.get("received", 0))
    return {
        "sent": sent_up + sent_down,
        "received": up.get("received", 0) + down.get("received", 0),
        "lost": lost,
        "resent": up.get("resent", 0) + down.get("resent", 0),
        "late": up.get("late", 0) + down.get("late", 0),
    }


def _of_silent(service: str, down: Mapping[str, Any]) -> dict[str, int]:
    """Return what the host knows of the counts of an agent that gave no word: what came of it, and what it acknowledged."""
    if service == "best":
        return {"sent": sum(down.get(name, 0) for name in ("received", "lost", "late"))}
    return {"sent": down.get("received", 0), "received": down.get("acknowledged", 0)}


def _behind_newest(sender: Mapping[str, Any], receiver: Mapping[str, Any]) -> int:
    """Return how many BEST messages a half sent after the newest that came: the last ones, or all, were lost."""
    return max(0, int(sender.get("of_half", 0)) - int(receiver.get("reached", 0)))


def _totals(agents: Iterable[Mapping[str, Any]]) -> dict[str, dict[str, int | None]]:
    """
    Add up the messages of all agents.

    What was sent to agents that were lost is not judged with the rest, but told: "to_lost_agents".
    """
    totals: dict[str, dict[str, int | None]] = {service: {} for service in SERVICE_NAMES}
    for agent in agents:
        is_lost = agent["state"] == Phase.LOST.value
        for service in SERVICE_NAMES:
            total = totals[service]
            for name, count in agent["messages"][service].items():
                if is_lost and name == "lost":
                    total.setdefault("lost", 0)
                    continue
                before = total.get(name, 0)
                total[name] = None if count is None or before is None else before + count
            down = agent["messages"]["host"].get(service, {})
            undelivered = down.get("lost", 0) if is_lost and service != "best" else 0
            earlier = agent["messages"].get("host_earlier", ())
            undelivered += sum(one[service]["lost"] for one in earlier if service != "best")
            total["to_lost_agents"] = (total.get("to_lost_agents") or 0) + undelivered
    return totals


def _worst_rtf(agents: Iterable[Mapping[str, Any]]) -> float | None:
    """Return the real-time factor that is farthest from 1, of the agents that ran to the end."""
    told = [agent for agent in agents if agent.get("rtf") is not None]
    # One that came back late in a run has too short a time for a rate of its own.
    stayed = [agent for agent in told if "ended_on_purpose" not in agent]
    factors = [agent["rtf"] for agent in stayed or told]
    return max(factors, key=lambda rtf: abs(rtf - 1.0)) if factors else None


def _median(values: list[float]) -> float | None:
    return sorted(values)[len(values) // 2] if values else None
