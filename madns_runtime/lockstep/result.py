"""The result of a lockstep run, in the shape of every run's. Pure."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from madns_runtime.lockstep.post import SERVICES


@dataclass(slots=True)
class AgentAccount:
    """What the host counts of one agent."""

    up: list[int] = field(default_factory=lambda: [0] * len(SERVICES))
    """Messages to the host, by class of service."""
    down: list[int] = field(default_factory=lambda: [0] * len(SERVICES))
    too_late: int = 0
    """Of those, sent when nobody was to receive any more."""
    deadlines_broken: int = 0
    state: str = "starting"
    summary: Mapping[str, Any] = field(default_factory=dict)
    records: Mapping[str, Any] = field(default_factory=dict)

    def to_mapping(self, ticks: int, reason: str | None) -> dict[str, Any]:
        """
        Return the agent's part of the result.

        Args:
            ticks: How many it has run; none is ever missed.
            reason: Why it was lost, if it was.
        """
        return {
            "state": self.state if reason is None else "lost",
            "reason": reason,
            "incarnations": 1,
            "ticks": {"due": ticks, "run": ticks, "missed": 0, "not_run": 0, "overrun_errors": 0},
            "rtf": None,
            "clock": None,
            "messages": self._messages(),
            "records": dict(self.records),
            "simulation": dict(self.summary),
        }

    def _messages(self) -> dict[str, Any]:
        messages: dict[str, Any] = {}
        for number, service in enumerate(SERVICES):
            count = self.up[number] + self.down[number]
            messages[service] = {"sent": count, "received": count, "lost": 0, "resent": 0}
        messages["sync"]["deadlines_broken"] = self.deadlines_broken
        messages["too_late"] = self.too_late
        return messages


def totals(accounts: Mapping[str, AgentAccount]) -> dict[str, dict[str, int]]:
    """Return the messages of all agents together, by class of service."""
    added: dict[str, dict[str, int]] = {service: {} for service in SERVICES}
    for account in accounts.values():
        messages = account.to_mapping(0, None)["messages"]
        for service in SERVICES:
            for name, count in messages[service].items():
                added[service][name] = added[service].get(name, 0) + count
    return added
