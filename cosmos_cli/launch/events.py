"""
Events on the children's standard output, one JSON object per line.

Pure: bytes in, a value out. A line that is none of these is a `Noise`, which is logged and never fatal:
a plug-in may print.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import orjson

from cosmos_cli.evidence.run_documents import LEVELS_MAX
from cosmos_cli.ui.foreign_text import clean_line
from madns_runtime.plain_values import is_nested_deeper, mapping_at
from madns_runtime.recording.newest_values import Value, clean_values
from madns_runtime.recording.records import WHOLE_MAX

NOISE_CHARACTERS_MAX = 500
"""Characters shown of a line that is no event."""


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
    """An agent has come further, or is lost: the counts show it, and the host's log gives the reason."""

    agent: str
    state: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Progress:
    """Progress of the run, about twice per second."""

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
    columns: tuple[str, ...] = ()
    """Fields of agents' streams that the simulation wants shown."""
    values: Mapping[str, Sequence[Value]] = field(default_factory=dict)
    """Their newest values by agent, of the first agents."""
    values_left_out: int = 0
    """Agents that have values, too."""


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
    is_on_purpose: bool = False
    """Whether a fault has ended it, which counts as no failure."""
    will_restart: bool = False


@dataclass(frozen=True, slots=True)
class DeviceChanged:
    """A device has another status: never, ok, stale or lost."""

    device: str
    """Full name of the device, such as pi22/imu."""
    status: str
    why: str = ""

    @property
    def text(self) -> str:
        """The change in words."""
        because = f": {self.why}" if self.why else ""
        return f"device {self.device}: {self.status}{because}"


@dataclass(frozen=True, slots=True)
class FaultInserted:
    """A supervisor's answer to the order to insert a fault; *refusal* is empty if it is in force."""

    number: int
    """Number of the order."""
    refusal: str


@dataclass(frozen=True, slots=True)
class ProcessKnown:
    """A program on another machine has this number there, which is also its group's."""

    pid: int


@dataclass(frozen=True, slots=True)
class Loading:
    """Plug-in code that a child loads before it can be heard again; empty once that is done."""

    doing: str


@dataclass(frozen=True, slots=True)
class PingAnswered:
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
    | DeviceChanged
    | FaultInserted
    | ProcessKnown
    | Loading
    | PingAnswered
    | Noise
)


def parse_event(line: bytes) -> Event:
    """Return what *line* says; `Noise` if it is no event or lacks a field."""
    try:
        document = orjson.loads(line)
        return _PARSERS[document["event"]](document)
    except (KeyError, TypeError, ValueError, OverflowError, RecursionError):
        return Noise(line.decode(errors="replace").strip()[:NOISE_CHARACTERS_MAX])


def _progress(d: Mapping[str, Any]) -> Event:
    columns = tuple(map(str, d.get("columns") or ()))
    values = mapping_at(d, "values")
    return Progress(
        t_s=_float(d.get("t_s")),
        rtf=_float(d.get("rtf")),
        ready=_whole(d.get("ready") or 0),
        running=_whole(d.get("running") or 0),
        lost=_whole(d.get("lost") or 0),
        complete=_whole(d.get("complete") or 0),
        ticks=_whole(d.get("ticks") or 0),
        missed=_whole(d.get("missed") or 0),
        lateness_us_p50=_float(d.get("lateness_us_p50")),
        lateness_us_p99=_float(d.get("lateness_us_p99")),
        lost_messages=_whole(d.get("lost_messages") or 0),
        records_dropped=_whole(d.get("records_dropped") or 0),
        is_lockstep=bool(d.get("is_lockstep")),
        columns=columns,
        values={str(agent): clean_values(own, len(columns)) for agent, own in values.items()},
        values_left_out=_whole(d.get("values_left_out") or 0),
    )


def _finished(d: Mapping[str, Any]) -> Event:
    result = d.get("result")
    # One that is nested deeper could not be written down; what lies beside the records may be another.
    is_fit = isinstance(result, dict) and not is_nested_deeper(result, LEVELS_MAX)
    return Finished(result if is_fit else None)


def _exited(d: Mapping[str, Any]) -> Event:
    code, signal_name = d.get("code"), d.get("signal")
    how = d.get("how") or (f"killed by {signal_name}" if signal_name else f"exit code {code}")
    return AgentExited(
        str(d["agent"]),
        _whole(d["pid"]),
        str(how),
        is_abnormal=signal_name is not None or code != 0,
        is_on_purpose=bool(d.get("on_purpose")),
        will_restart=bool(d.get("will_restart")),
    )


def _line(value: Any) -> str:
    """Return text of a driver or a board as one line that may be shown."""
    return clean_line(str(value))


def _whole(value: Any) -> int:
    """
    Return a whole number that can be told again.

    Raises:
        ValueError: It is none, or one beyond what all readers of JSON agree on.
    """
    number = int(value)
    if abs(number) > WHOLE_MAX:
        raise ValueError("a number beyond all counts")
    return number


def _float(value: Any) -> float | None:
    return None if value is None else float(value)


_PARSERS: Mapping[str, Callable[[Mapping[str, Any]], Event]] = {
    "listening": lambda d: Listening(str(d["address"]), _whole(d["port"])),
    "state": lambda d: StateChanged(str(d["state"])),
    "agent": lambda d: AgentChanged(str(d["agent"]), str(d["state"])),
    "progress": _progress,
    "log": lambda d: Logged(str(d["level"]), str(d.get("source") or ""), str(d["text"])),
    "finished": _finished,
    "started": lambda d: AgentStarted(
        str(d["agent"]), _whole(d["pid"]), _whole(d.get("incarnation") or 1)
    ),
    "exited": _exited,
    "device": lambda d: DeviceChanged(
        _line(d["device"]), _line(d["status"]), _line(d.get("why") or "")
    ),
    "injected": lambda d: FaultInserted(_whole(d["order"]), _line(d.get("refusal") or "")),
    "process": lambda d: ProcessKnown(_whole(d["pid"])),
    "loading": lambda d: Loading(str(d["doing"])),
    "pong": lambda d: PingAnswered(_whole(d["n"])),
}
