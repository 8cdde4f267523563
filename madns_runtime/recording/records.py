"""
Schemas of record streams.

A stream is one JSON Lines file. Line 1 is the schema; every other line is a record: an array in the
order of the fields (fast streams) or an object (events). Two more lines are no records, and each has a
single key: {"t0_utc": "..."} follows as soon as simulated time zero is known, where line 1 was written
before it was; the last line of a stream that was closed properly is
{"end": {"records": N, "dropped": N, "not_finite": N}}. A file without that line was cut.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final, Literal

SCHEMA_VERSION = 1
WHOLE_MAX: Final = 2**53
"""Up to here every whole number is a float, and all readers of JSON agree on it."""


@dataclass(frozen=True, slots=True)
class Field:
    """One value of a record: its name (unit last), the unit's symbol and its kind."""

    name: str
    unit: str = ""
    kind: Literal["float", "int", "str", "bool", "json", "packed"] = "float"
    """packed: text that its simulation alone reads; it is left out of tables."""
    digits: int | None = None
    """Decimal places that are recorded of a float; None for all. In a stream that has such a field every other
    one is an int: `number_rows` then rounds and encodes many records at once."""
    words: tuple[str, ...] = ()
    """All texts that a field of kind str ever holds; empty where any may come. A check of another is refused before a run."""


FIELD_KINDS = ("float", "int", "str", "bool", "json", "packed")
"""All kinds of fields."""
NUMBER_KINDS = ("float", "int")
"""Kinds of numbers."""


@dataclass(frozen=True, slots=True)
class StreamSchema:
    """One stream: file name without suffix, its fields, and the shape of its records."""

    name: str
    fields: tuple[Field, ...]
    shape: Literal["array", "object"] = "array"

    @property
    def seconds(self) -> str:
        """Name of the first float in seconds: the time of a record that has neither t_s nor a tick; empty without."""
        found = (field.name for field in self.fields if (field.unit, field.kind) == ("s", "float"))
        return next(found, "")

    def header(self, *, run: str, source: str, t0_utc: str | None) -> dict[str, Any]:
        """
        Return line 1 of the file.

        Args:
            run: Name of the run.
            source: Who records: host, an agent's or a machine's name.
            t0_utc: Simulated time zero in UTC (ISO 8601), None while it is not known.
        """
        return {
            "schema": SCHEMA_VERSION,
            "stream": self.name,
            "shape": self.shape,
            "fields": [{"name": f.name, "unit": f.unit, "kind": f.kind} for f in self.fields],
            "run": run,
            "source": source,
            "t0_utc": t0_utc,
        }


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameworkSchema(StreamSchema):
    """A stream of the framework's own, who records it, and when."""

    roles: tuple[Literal["agent", "host", "machine"], ...]
    """All that record it, but devices."""
    is_real_time_only: bool
    """Whether no run in lockstep records it: no time passes there that could be late."""


TICKS = FrameworkSchema(
    "ticks",
    (
        Field("tick", "", "int"),
        Field("lateness_us", "us", "int"),
        Field("margin_us", "us", "int"),
        Field("missed", "", "int"),
    ),
    roles=("agent",),
    is_real_time_only=True,
)
"""Every tick of an agent: wake-up minus deadline, time left when the step ended, ticks skipped before it."""

LATE_TICKS = FrameworkSchema(
    "late_ticks",
    (
        Field("tick", "", "int"),
        Field("lateness_us", "us", "int"),
        Field("missed", "", "int"),
        Field("cause", "", "str"),
    ),
    roles=("agent",),
    is_real_time_only=True,
)
"""
Ticks that began too late, or not at all (*missed*, just before this one), and what was measured to be the cause.

Those that no other followed stand before the one that would have come next, with a lateness of 0.
"""

CLOCK = FrameworkSchema(
    "clock",
    (
        Field("t_s", "s"),
        Field("offset_us", "us"),
        Field("drift_ppm", "1e-6"),
        Field("uncertainty_us", "us"),
        Field("round_trip_us_min", "us"),
    ),
    roles=("agent",),
    is_real_time_only=True,
)
"""An agent's estimate of the host's clock minus its own; the round trip is the window's least."""

EVENTS = FrameworkSchema(
    "events",
    (Field("t_s", "s"), Field("utc", "", "str"), Field("event", "", "str")),
    shape="object",
    roles=("agent", "host"),
    is_real_time_only=False,
)
"""State changes, losses, deadlines broken, and who was the cause."""

HOST_EVENT_WORDS = (
    "agent", "agent_rejoined", "not_stopped", "condition_met", "action_began", "action_ended", "action_resumed", "fault",
)  # fmt: skip
"""Words of `events` that the host's half alone records."""
AGENT_EVENT_WORDS = (
    "start", "phase", "scheduling", "killed", "hang_begins", "hang_ends", "slow_begins", "slow_ends", "clock_stepped",
    "clock_drift_begins", "clock_drift_ends", "device_losses",
)  # fmt: skip
"""Words of `events` that agents alone record."""
EVENT_WORDS = (
    "end", "state", "emergency", "action_refused", "sync_deadline_broken", "device", *HOST_EVENT_WORDS, *AGENT_EVENT_WORDS,
)  # fmt: skip
"""All that `events` of agents and of the host's half hold in `event`: a simulation records its own in streams of its own."""

DEVICE_EVENT_WORDS = (
    "opened", "closed", "made_safe", "ending", "end", "fault", "error", "frozen", "refused", "underrun", "empty_reads",
)  # fmt: skip
"""All that `events` of a device hold in `event`."""

DEVICE_LOSSES = "device_losses"
"""Of EVENT_WORDS, and key of an agent's account: what found no room between it and its devices."""

LOG = FrameworkSchema(
    "log",
    (
        Field("t_s", "s"),
        Field("utc", "", "str"),
        Field("level", "", "str"),
        Field("text", "", "str"),
    ),
    shape="object",
    roles=("agent", "host"),
    is_real_time_only=False,
)
"""Logged sentences, as loud as recording.verbosity lets through."""

LOG_LEVELS = {"critical": 50, "error": 40, "warning": 30, "info": 20, "debug": 10}
"""All that `log` holds in `level`, each with its number in Python's logging."""

HEALTH = FrameworkSchema(
    "health",
    (
        Field("utc", "", "str"),
        Field("monotonic_s", "s"),
        Field("cpu_percent", "%"),
        Field("cpu_percent_by_core", "%", "json"),
        Field("core_temperature_c", "degC"),
        Field("throttled_bits", "", "int"),
        Field("throttling", "", "json"),
        Field("ram_total_bytes", "B", "int"),
        Field("ram_used_bytes", "B", "int"),
        Field("ram_free_bytes", "B", "int"),
        Field("ram_percent", "%"),
        Field("disk_total_bytes", "B", "int"),
        Field("disk_used_bytes", "B", "int"),
        Field("disk_free_bytes", "B", "int"),
        Field("disk_percent", "%"),
        Field("disk_reads", "", "int"),
        Field("disk_writes", "", "int"),
        Field("disk_read_bytes", "B", "int"),
        Field("disk_written_bytes", "B", "int"),
        Field("disk_read_time_ms", "ms", "int"),
        Field("disk_write_time_ms", "ms", "int"),
        Field("network_sent_bytes", "B", "int"),
        Field("network_received_bytes", "B", "int"),
        Field("network_sent_packets", "", "int"),
        Field("network_received_packets", "", "int"),
        Field("network_errors", "", "int"),
        Field("network_drops", "", "int"),
        Field("loopback_bytes", "B", "int"),
        Field("network_sent_bytes_per_s", "B/s"),
        Field("network_received_bytes_per_s", "B/s"),
        Field("disk_read_bytes_per_s", "B/s"),
        Field("disk_written_bytes_per_s", "B/s"),
        Field("udp_sockets", "", "int"),
        Field("tcp_connections", "", "int"),
        Field("load_1min", ""),
        Field("load_5min", ""),
        Field("load_15min", ""),
        Field("process_uptime_s", "s"),
        Field("board_uptime_s", "s"),
    ),
    roles=("machine",),
    is_real_time_only=True,
)
"""State of health of one machine (thesis A.1.4). Counters run from the machine's start; what a machine
does not offer is null. It keeps the wall clock's time and the machine's own monotonic one, for the
process that samples it knows no simulated time."""

PROCESS = FrameworkSchema(
    "process",
    (
        Field("t_s", "s"),
        Field("cpu_percent", "%"),
        Field("rss_bytes", "B", "int"),
        Field("major_faults", "", "int"),
        Field("voluntary_switches", "", "int"),
        Field("involuntary_switches", "", "int"),
    ),
    roles=("agent",),
    is_real_time_only=True,
)
"""Use of resources by a process of the run: CPU since its last record, memory, and counters since its start."""

FRAMEWORK_SCHEMAS = {
    schema.name: schema for schema in (TICKS, LATE_TICKS, CLOCK, EVENTS, LOG, HEALTH, PROCESS)
}
FRAMEWORK_STREAMS = frozenset(FRAMEWORK_SCHEMAS)
"""Names that no simulation's stream can have."""
