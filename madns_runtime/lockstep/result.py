"""The account of a lockstep run, and its result in the shape of every run's. Pure."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, Final

from madns_runtime.faults.intended_losses import IntendedLosses, of_intended
from madns_runtime.lockstep.frames import Loss
from madns_runtime.medium.outcomes import between_agents
from madns_runtime.protocol.messages import SERVICE_NAMES
from madns_runtime.recording.newest_values import Value, told_columns

LOST: Final = "lost"
"""State of an agent that no worker runs."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EarlyEnd:
    """Why a run ends before its time."""

    who: str
    reason: str
    status: str = "failed"


@dataclass(slots=True)
class AgentAccount:
    """The host's counts of one agent."""

    up: list[int] = field(default_factory=lambda: [0] * len(SERVICE_NAMES))
    """Messages to the host, by class of service."""
    down: list[int] = field(default_factory=lambda: [0] * len(SERVICE_NAMES))
    too_late: int = 0
    """Messages of those that were sent when nobody was to receive any more."""
    not_sent: int = 0
    """Messages of the host's half that had nobody to go to."""
    deadlines_broken: int = 0
    peer_messages: Mapping[str, int] = field(default_factory=dict)
    """Its counts of messages between agents."""
    peer_messages_before: dict[str, int] = field(default_factory=dict)
    """The same counts of incarnations that were lost."""
    columns: list[Value] | None = None
    """The newest values of its columns; None before any were told."""
    state: str = "starting"
    """stopped once there is word that its records are closed."""
    reason: str | None = None
    """Why it was lost, the last time; None if it never was."""
    incarnations: int = 1
    ticks_away: int = 0
    """Ticks of earlier absences."""
    lost_at_tick: int | None = None
    """Tick that an agent that is away did not take any more."""
    summary: Mapping[str, Any] = field(default_factory=dict)
    records: Mapping[str, Any] = field(default_factory=dict)

    @property
    def is_lost(self) -> bool:
        """Whether no worker runs it."""
        return self.state == LOST

    def ticks_of(self, ticks: int) -> int:
        """Return how many of the run's *ticks* it was there for; none of them is ever missed."""
        away = 0 if self.lost_at_tick is None else ticks - self.lost_at_tick
        return ticks - self.ticks_away - away

    def to_mapping(self, ticks: int, reason: str | None) -> dict[str, Any]:
        """
        Return the agent's part of the result.

        Args:
            ticks: How many the run has taken.
            reason: Why it was lost, if the run ended by it.
        """
        own = self.ticks_of(ticks)
        return {
            "state": self.state if reason is None else LOST,
            "reason": reason or self.reason,
            "incarnations": self.incarnations,
            "ticks": {"due": own, "run": own, "missed": 0, "not_run": 0, "overrun_errors": 0},
            "rtf": None,
            "clock": None,
            "messages": self.messages(),
            "records": dict(self.records),
            "columns": self.columns or [],
            "simulation": dict(self.summary),
        }

    def messages(self) -> dict[str, Any]:
        """Return both directions' counts together; what is sent has arrived."""
        messages: dict[str, Any] = {}
        for number, service in enumerate(SERVICE_NAMES):
            count = self.up[number] + self.down[number]
            messages[service] = {"sent": count, "received": count, "lost": 0, "resent": 0}
        messages["sync"]["deadlines_broken"] = self.deadlines_broken
        messages["too_late"] = self.too_late
        messages["not_sent"] = self.not_sent
        return messages


@dataclass(slots=True)
class RunAccount:
    """Counts and times of a whole run."""

    names: tuple[str, ...]
    duration_s: float
    workers: int
    columns: tuple[str, ...] = ()
    """Fields of agents' streams whose newest values are told."""
    agents: list[AgentAccount] = field(init=False)
    ticks: int = 0
    """Run by every agent."""
    ticked_s: float = 0.0
    """Simulated time of the last one: who was to return after it had no tick to return at."""
    lost: dict[str, str] = field(default_factory=dict)
    """Agents that were lost, and are judged by it."""
    just_lost: list[int] = field(default_factory=list)
    """Agents whose loss the host's half has not heard of."""
    intended: IntendedLosses = field(default_factory=IntendedLosses)
    not_stopped: tuple[str, ...] = ()
    ending: EarlyEnd | None = None
    t0_utc: str | None = None
    began_s: float | None = None
    """Begin of simulated time on a monotonic clock, s."""
    wall_s: float | None = None
    """Wall time of the whole simulated time, s."""
    simulation: Mapping[str, Any] = field(default_factory=dict)
    peer_messages: Mapping[str, Any] = field(default_factory=dict)
    """The host's account of messages between agents."""
    faults: Mapping[str, Any] = field(default_factory=dict)
    """The account of faults of messages."""
    records: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Open an account for every agent."""
        self.agents = [AgentAccount() for _ in self.names]

    def set_states(self, state: str) -> None:
        """Note how far all agents are."""
        for agent in self.agents:
            if not agent.is_lost:
                agent.state = state

    def note_values(self, newest: Iterable[tuple[int, list[Value]]]) -> None:
        """Keep the newest values of columns that a worker told of its agents, by index, if it did."""
        for number, values in newest:
            self.agents[number].columns = values

    def lose(self, number: int, reason: str, *, is_kept: bool) -> None:
        """
        Note that no worker runs an agent any more.

        Args:
            number: The agent's.
            reason: Why, in words.
            is_kept: Whether the run goes on.
        """
        agent = self.agents[number]
        if not is_kept:
            self.lost[self.names[number]] = reason
        elif not agent.is_lost:
            agent.state, agent.reason, agent.lost_at_tick = LOST, reason, self.ticks
            self.just_lost.append(number)

    def note_loss(self, loss: Loss) -> None:
        """Note what a worker told of an agent that it lost."""
        agent = self.agents[loss.agent]
        agent.records = loss.records
        agent.deadlines_broken += loss.deadlines_broken
        agent.too_late += loss.unheard
        for name, count in loss.peer_messages.items():
            agent.peer_messages_before[name] = agent.peer_messages_before.get(name, 0) + count
        self.lose(loss.agent, loss.reason, is_kept=True)

    def take_back(self, number: int) -> int:
        """Note that an agent is to be made anew, and return the number of its incarnation."""
        agent = self.agents[number]
        agent.incarnations += 1
        if agent.lost_at_tick is not None:
            agent.ticks_away += self.ticks - agent.lost_at_tick
        agent.state, agent.lost_at_tick = "running", None
        return agent.incarnations

    def progress(self, t_s: float, now_s: float) -> dict[str, Any]:
        """Return the progress event at simulated time *t_s* and *now_s* of the monotonic clock."""
        speed = None
        if self.began_s is not None and now_s > self.began_s:
            speed = max(t_s, 0.0) / (now_s - self.began_s)
        told = [
            (name, agent.columns)
            for name, agent in zip(self.names, self.agents, strict=True)
            if agent.columns is not None
        ]
        # Who has stopped was complete before, and stays so in the last picture.
        states = ["complete" if a.state == "stopped" else a.state for a in self.agents]
        counts = {state: states.count(state) for state in ("ready", "running", "complete")}
        return {
            "event": "progress",
            "is_lockstep": True,
            "t_s": None if self.began_s is None else round(t_s, 3),
            "rtf": None if speed is None else round(speed, 3),
            **counts,
            "lost": max(len(self.lost), sum(agent.is_lost for agent in self.agents)),
            "ticks": sum(agent.ticks_of(self.ticks) for agent in self.agents),
            **told_columns(self.columns, told),
        }

    def result(self) -> dict[str, Any]:
        """Return the result as the operator's side expects it."""
        ending, wall_s = self.ending, self.wall_s if self.ending is None else None
        by_name = dict(zip(self.names, self.agents, strict=True))
        return {
            "status": "complete" if ending is None else ending.status,
            "who": ending.who if ending else None,
            "reason": ending.reason if ending else None,
            "t0_utc": self.t0_utc,
            "duration_s": self.duration_s,
            "completed_s": self.duration_s if ending is None else None,
            "wall_s": None if wall_s is None else round(wall_s, 6),
            "rtf": round(self.duration_s / wall_s, 3) if wall_s else None,
            "workers": self.workers,
            "agents": {
                name: {
                    **agent.to_mapping(self.ticks, None if agent.reason else self.lost.get(name)),
                    **of_intended(self.intended, name),
                }
                for name, agent in by_name.items()
            },
            "lost": sorted({*self.lost, *self.intended.overdue(self.ticked_s, 0.0)}),
            "lost_on_purpose": self.intended.names(),
            "not_stopped": list(self.not_stopped),
            "network": {},
            "messages": self._totals(),
            "between_agents": between_agents(
                self.peer_messages,
                (
                    counts
                    for agent in self.agents
                    for counts in (agent.peer_messages, agent.peer_messages_before)
                ),
            ),
            "refused": {},
            "faults": dict(self.faults),
            "records": dict(self.records),
            "columns": list(self.columns),
            "simulation": dict(self.simulation),
            "scheduling": {},
        }

    def _totals(self) -> dict[str, dict[str, int]]:
        added: dict[str, dict[str, int]] = {service: {} for service in SERVICE_NAMES}
        for agent in self.agents:
            messages = agent.messages()
            for service in SERVICE_NAMES:
                for name, count in messages[service].items():
                    added[service][name] = added[service].get(name, 0) + count
        return added
