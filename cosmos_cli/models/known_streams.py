"""Streams that a scenario's rules may name: those that its simulation declares, and the framework's own. Pure."""

from __future__ import annotations

from dataclasses import dataclass

from cosmos_cli.models.document import did_you_mean
from madns_runtime.conditions.condition import AGENT, TICK, TIME
from madns_runtime.plugin.api import DeclaredStream
from madns_runtime.recording.records import CLOCK, EVENTS, LATE_TICKS, PROCESS, TICKS, Field

REAL_TIME_ONLY = tuple(schema.name for schema in (TICKS, LATE_TICKS, CLOCK, PROCESS))
"""Framework streams that no run in lockstep records: no time passes there that could be late."""
FRAMEWORK = tuple(
    DeclaredStream(role="agent", name=schema.name, fields=schema.fields)
    for schema in (TICKS, LATE_TICKS, CLOCK, PROCESS)
) + tuple(
    DeclaredStream(role=role, name=EVENTS.name, fields=EVENTS.fields, is_open=True)
    for role in ("agent", "host")
)
NOT_A_VALUE = ("json", "packed")


@dataclass(frozen=True, slots=True)
class KnownStreams:
    """
    Streams by name and who records them.

    Args:
        declared: By the simulation; None if it declares none, and then any other name may be one.
    """

    declared: tuple[DeclaredStream, ...] | None

    @property
    def is_complete(self) -> bool:
        """Whether every stream is known."""
        return self.declared is not None

    def of(self, name: str) -> list[DeclaredStream]:
        """Return the streams of a name: of the agents, of the host's half, or one of each."""
        return [each for each in (*FRAMEWORK, *(self.declared or ())) if each.name == name]

    def names(self) -> list[str]:
        """Return all names."""
        return list(dict.fromkeys(each.name for each in (*FRAMEWORK, *(self.declared or ()))))

    def stream_fault(self, name: str) -> str | None:
        """Return what is wrong with a stream's name; None if it may be one."""
        if self.of(name) or not self.is_complete:
            return None
        return f"no stream {name!r} is recorded{did_you_mean(name, self.names())}"

    def field_fault(self, stream: str, name: str) -> str | None:
        """Return what is wrong with a field's name; None if the stream has, or may have, a value of that name."""
        found = self.of(stream)
        if not found:
            return None
        field = self.field(stream, name)
        if field is not None and field.kind in NOT_A_VALUE:
            return f"stream {stream}: {name} is no single value that has bounds"
        if field is not None or any(each.is_open for each in found):
            return None
        known = list(dict.fromkeys(field.name for each in found for field in each.fields))
        return f"stream {stream} has no field {name!r}{did_you_mean(name, known)}"

    def field(self, stream: str, name: str) -> Field | None:
        """Return a field; None if it is not known."""
        fields = (field for each in self.of(stream) for field in each.fields)
        return next((field for field in fields if field.name == name), None)

    def has_time(self, stream: str) -> bool:
        """Tell whether records of a stream tell when they are of: t_s, a tick of an agent, or else a field in s."""
        found = self.of(stream)
        return not found or any(
            each.is_open
            or any(
                field.name == TIME
                or (field.name == TICK and each.role == "agent")
                or (field.unit == "s" and field.kind == "float")
                for field in each.fields
            )
            for each in found
        )

    def roles(self, stream: str) -> set[str]:
        """Return who records a stream: agent, host or both; of one that is not known, agents."""
        return {each.role for each in self.of(stream)} or {"agent"}

    def names_agents(self, stream: str) -> bool:
        """Tell whether a stream of the host's half says in each record which agent it is about."""
        return any(
            field.name == AGENT and field.kind == "str"
            for each in self.of(stream)
            if each.role == "host"
            for field in each.fields
        )
