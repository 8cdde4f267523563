"""
What children say on their standard output, one JSON object a line, as typed events.

Pure: bytes in, a value out. A line that is none of these is a `Noise`, which is logged and never fatal:
a plug-in may print.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import orjson

NOISE_CHARACTERS_MAX = 500
"""Of a line that is no event, this much is shown."""


@dataclass(frozen=True, slots=True)
class Listening:
    """The host has bound its socket."""

    address: str
    port: int


@dataclass(frozen=True, slots=True)
class StateChanged:
    """The host is in another state (DESIGN 6)."""

    state: str


@dataclass(frozen=True, slots=True)
class AgentChanged:
    """An agent has come further, or is lost."""

    agent: str
    state: str
    reason: str | None
    incarnation: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Progress:
    """How the run fares, about twice a second."""

    t_s: float | None = None
    rtf: float | None = None
    ready: int = 0
    running: int = 0
    lost: int = 0
    complete: int = 0
    ticks: int = 0
    missed: int = 0
    lateness_us_p50: float | None = None
    lateness_us_p99: float | None = None
    lost_messages: int = 0
    records_dropped: int = 0
    is_lockstep: bool = False
    """Simulated time waits for everybody: rtf is the speed, and no tick has a lateness."""


@dataclass(frozen=True, slots=True)
class Logged:
    """A sentence that was worth showing."""

    level: str
    source: str
    text: str


@dataclass(frozen=True, slots=True)
class Finished:
    """
    The child is about to end; a host's result says how the run went, a supervisor has none.

    A host may also say where it lies instead: {"result": null, "file": "result.json"}, always the same
    place, beside its records.
    """

    result: Mapping[str, Any] | None


@dataclass(frozen=True, slots=True)
class AgentStarted:
    """A supervisor has started an agent's process."""

    agent: str
    pid: int
    incarnation: int


@dataclass(frozen=True, slots=True)
class AgentExited:
    """An agent's process has ended."""

    agent: str
    pid: int
    how: str
    is_abnormal: bool
    will_restart: bool


@dataclass(frozen=True, slots=True)
class ProcessKnown:
    """A program on another machine has this number there, which is also its group's."""

    pid: int


@dataclass(frozen=True, slots=True)
class Pong:
    """The answer to ping number *n*."""

    n: int


@dataclass(frozen=True, slots=True)
class Noise:
    """A line that is no event."""

    text: str


Event = (
    Listening
    | StateChanged
    | AgentChanged
    | Progress
    | Logged
    | Finished
    | AgentStarted
    | AgentExited
    | ProcessKnown
    | Pong
    | Noise
)


def parse_event(line: bytes) -> Event:
    """Return what *line* says; `Noise` if it is no event or lacks a field."""
    try:
        document = orjson.loads(line)
        return _PARSERS[document["event"]](document)
    except (orjson.JSONDecodeError, KeyError, TypeError, ValueError):
        return Noise(line.decode(errors="replace").strip()[:NOISE_CHARACTERS_MAX])


def _listening(d: Mapping[str, Any]) -> Event:
    return Listening(str(d["address"]), int(d["port"]))


def _state(d: Mapping[str, Any]) -> Event:
    return StateChanged(str(d["state"]))


def _agent(d: Mapping[str, Any]) -> Event:
    reason = d.get("reason")
    return AgentChanged(
        str(d["agent"]),
        str(d["state"]),
        None if reason is None else str(reason),
        int(d.get("incarnation") or 1),
    )


def _progress(d: Mapping[str, Any]) -> Event:
    return Progress(
        t_s=_float(d.get("t_s")),
        rtf=_float(d.get("rtf")),
        ready=int(d.get("ready") or 0),
        running=int(d.get("running") or 0),
        lost=int(d.get("lost") or 0),
        complete=int(d.get("complete") or 0),
        ticks=int(d.get("ticks") or 0),
        missed=int(d.get("missed") or 0),
        lateness_us_p50=_float(d.get("lateness_us_p50")),
        lateness_us_p99=_float(d.get("lateness_us_p99")),
        lost_messages=int(d.get("lost_messages") or 0),
        records_dropped=int(d.get("records_dropped") or 0),
        is_lockstep=bool(d.get("is_lockstep")),
    )


def _log(d: Mapping[str, Any]) -> Event:
    return Logged(str(d["level"]), str(d.get("source") or ""), str(d["text"]))


def _finished(d: Mapping[str, Any]) -> Event:
    result = d.get("result")
    return Finished(result if isinstance(result, dict) else None)


def _started(d: Mapping[str, Any]) -> Event:
    return AgentStarted(str(d["agent"]), int(d["pid"]), int(d.get("incarnation") or 1))


def _exited(d: Mapping[str, Any]) -> Event:
    code, signal_name = d.get("code"), d.get("signal")
    how = d.get("how") or (f"killed by {signal_name}" if signal_name else f"exit code {code}")
    return AgentExited(
        str(d["agent"]),
        int(d["pid"]),
        str(how),
        is_abnormal=signal_name is not None or code != 0,
        will_restart=bool(d.get("will_restart")),
    )


def _process(d: Mapping[str, Any]) -> Event:
    return ProcessKnown(int(d["pid"]))


def _pong(d: Mapping[str, Any]) -> Event:
    return Pong(int(d["n"]))


def _float(value: Any) -> float | None:
    return None if value is None else float(value)


_PARSERS: Mapping[str, Callable[[Mapping[str, Any]], Event]] = {
    "listening": _listening,
    "state": _state,
    "agent": _agent,
    "progress": _progress,
    "log": _log,
    "finished": _finished,
    "started": _started,
    "exited": _exited,
    "process": _process,
    "pong": _pong,
}
