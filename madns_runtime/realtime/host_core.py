"""The core of a host in real time: what most of its other parts work with."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from madns_runtime.config import HostLaunch
from madns_runtime.plugin.half import HostHalf
from madns_runtime.reactor.reactor import Reactor
from madns_runtime.realtime.host_link import HostPort
from madns_runtime.recording.run_journal import RunJournal


@dataclass(frozen=True, slots=True, kw_only=True)
class RealtimeCore:
    """Loop, session, records and simulation of one run, and how to call and end it."""

    launch: HostLaunch
    reactor: Reactor
    port: HostPort
    """Knows simulated time and the agents."""
    journal: RunJournal
    half: HostHalf
    guard: Callable[..., Any]
    """Calls what it is given; what that raises ends the run."""
    pump: Callable[[], None]
    """Carries out and sends what is due."""
    end: Callable[[str, str, str], None]
    """Ends the run, given who wants it, why, and the status."""
