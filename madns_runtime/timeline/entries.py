"""One entry of a timeline as host and agents are told of it: agents by name, parameters validated. Pure."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True, slots=True, kw_only=True)
class ScheduledEntry:
    """An action that is to happen, and one of four rules of when: at_s, every_s, rate_per_h or condition."""

    action: str
    """Word of the action."""
    agents: tuple[str, ...] = ()
    """Names of the agents that it acts on."""
    parameters: Mapping[str, Any] = field(default_factory=dict)
    """Of the action, defaults filled in."""
    for_s: float | None = None
    """How long it lasts, s."""
    at_s: float | None = None
    """Once, at this simulated time, s."""
    every_s: float | None = None
    """At from_s, and every so many seconds after it up to to_s."""
    rate_per_h: float | None = None
    """By chance between from_s and to_s, so often an hour on average: each agent for itself."""
    from_s: float = 0.0
    to_s: float | None = None
    """None: the end of the run."""
    condition: int | None = None
    """Once, when the run's condition of this number is first met."""
