"""Streams that a scenario's rules may name: its simulation's, its devices' and the framework's own. Pure."""

from __future__ import annotations

import copy
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

from cosmos_cli.models.document import did_you_mean
from cosmos_cli.models.expectation import owner_of
from madns_runtime.conditions.condition import AGENT, HOST, TICK, TIME
from madns_runtime.hardware.contract import Channel
from madns_runtime.hardware.stream_schemas import DEVICE_CLOCK, DEVICE_STATE, schema_of
from madns_runtime.plugin.api import DeclaredStream
from madns_runtime.recording.records import (
    AGENT_EVENT_WORDS,
    DEVICE_EVENT_WORDS,
    EVENT_WORDS,
    EVENTS,
    FRAMEWORK_SCHEMAS,
    HOST_EVENT_WORDS,
    LOG,
    LOG_LEVELS,
    NUMBER_KINDS,
    Field,
)
from madns_runtime.units import conversion

REAL_TIME_ONLY = tuple(
    name for name, schema in FRAMEWORK_SCHEMAS.items() if schema.is_real_time_only
)
"""Framework streams that no run in lockstep records."""
NOT_A_VALUE = ("json", "packed")
OF_DEVICES_OWN = (DEVICE_STATE, DEVICE_CLOCK, EVENTS, LOG)
"""Streams of a device beside its channels: how it fares, not what it measures."""
INPUT_HEAD = tuple(field.name for field in schema_of(Channel(name="any")).fields[:-1])
FRAME_FIELDS = tuple(
    field.name for field in schema_of(Channel(name="any", is_frame=True)).fields[len(INPUT_HEAD) :]
)
"""Names of what a device records of an input, before its values, and of frames as values."""
EVENT_PLACE = (EVENTS.name, "event")
WORDS = {EVENT_PLACE: EVENT_WORDS, (LOG.name, "level"): tuple(LOG_LEVELS)}
"""All texts that a field of a stream of the framework's ever holds."""
Role = Literal["agent", "host", "machine", "device"]
APART: tuple[Role, ...] = ("machine", "device")
"""Roles that record in a process of their own, which no condition is evaluated in."""


@dataclass(frozen=True, slots=True, kw_only=True)
class KnownStream:
    """A stream, and who records it."""

    role: Role
    name: str
    fields: tuple[Field, ...]
    is_open: bool = False
    """Whether further fields may follow these, known only in the run."""
    sources: tuple[str, ...] | None = None
    """Full names of the devices that record it; None if they are not known, or it is of no device."""

    def is_used_by(self, agents: Collection[str]) -> bool:
        """Tell whether a device of some agents records it, or may, or it is of no device."""
        return self.sources is None or any(owner_of(name) in agents for name in self.sources)


@dataclass(frozen=True, slots=True, kw_only=True)
class KnownDevice:
    """A device of some agents, or of machines."""

    name: str
    """By which agents know it, such as imu."""
    sources: tuple[str, ...] | None
    """Full names of all of this name, such as agent-02/imu; None for one of an inventory, whose machines are not known."""
    streams: Mapping[str, tuple[Field, ...]] | None
    """Fields by channel; None if its channels are not known."""

    def known_streams(self) -> list[KnownStream]:
        """Return all that it records: its channels, and its own state."""
        own = {schema.name: schema.fields for schema in OF_DEVICES_OWN}
        own[EVENTS.name] = tuple(
            replace(field, words=DEVICE_EVENT_WORDS) if field.name == "event" else field
            for field in EVENTS.fields
        )
        return [
            KnownStream(
                role="device",
                name=f"{self.name}.{name}",
                fields=fields,
                is_open=name == EVENTS.name,
                sources=self.sources,
            )
            for name, fields in {**(self.streams or {}), **own}.items()
        ]


FRAMEWORK = tuple(
    KnownStream(role=role, name=schema.name, fields=schema.fields, is_open=schema is EVENTS)
    for schema in FRAMEWORK_SCHEMAS.values()
    for role in schema.roles
)


def _source_fault(word: str, sources: Collection[str]) -> str | None:
    """Return that none of those whose events count records a word of theirs; None if one may."""
    if word in HOST_EVENT_WORDS and HOST not in sources:
        return f"{word} is an event of the host's half alone: write agents: [{HOST}]"
    if word in AGENT_EVENT_WORDS and sources and not set(sources) - {HOST}:
        return f"{word} is an event of agents alone: leave out agents: [{HOST}], or name agents"
    return None


def channel_fields(channels: Iterable[Channel]) -> dict[str, tuple[Field, ...]]:
    """Return the fields of what a device records of its channels, by channel."""
    return {channel.name: schema_of(channel).fields for channel in channels}


class KnownStreams:
    """
    Streams by name and who records them.

    Args:
        declared: By the simulation; None if it declares none, and then any other name may be one.
        devices: That agents use.
        is_partial: Whether the simulation could not be asked, as while its parameters have faults.
    """

    def __init__(
        self,
        declared: Sequence[DeclaredStream] | None,
        devices: Sequence[KnownDevice] = (),
        *,
        is_partial: bool = False,
    ) -> None:
        self._is_declared = declared is not None
        self._is_partial = is_partial
        self._channels_open: dict[str, list[KnownDevice]] = {}
        for device in devices:
            if device.streams is None:
                self._channels_open.setdefault(device.name, []).append(device)
        self._streams: dict[str, list[KnownStream]] = {}
        own = [
            KnownStream(role=each.role, name=each.name, fields=each.fields, is_open=each.is_open)
            for each in declared or ()
        ]
        of_devices = [stream for device in devices for stream in device.known_streams()]
        for stream in (*FRAMEWORK, *own, *of_devices):
            self._streams.setdefault(stream.name, []).append(stream)
        self._devices = {each.name for each in devices}

    def used_by(self, agents: Collection[str]) -> KnownStreams:
        """Return the same with the devices of some agents alone, where these have one of a name: others may measure something else."""
        chosen = copy.copy(self)
        chosen._streams = {
            name: [each for each in found if each.is_used_by(agents)] or found
            for name, found in self._streams.items()
        }
        return chosen

    def of(self, name: str) -> list[KnownStream]:
        """Return the streams of a name: of the agents, of the host's half, or one of each; or of machines or devices."""
        found = self._streams.get(name)
        if found is not None:
            return found
        return [
            KnownStream(role="device", name=name, fields=(), is_open=True, sources=each.sources)
            for each in self._channels_open.get(self._device_of(name), ())
        ]

    def stream_fault(self, name: str) -> str | None:
        """Return what is wrong with a stream's name; None if it may be one."""
        is_of_device = self._device_of(name) in self._devices
        if self.of(name) or not (self._is_declared or is_of_device):
            return None
        if name in self._devices:
            known = [each for each in self._streams if self._device_of(each) == name]
            told = ", ".join(known) or f"{name}.CHANNEL"
            return f"{name} is a device: expected a channel of it, such as {told}"
        return f"no stream {name!r} is recorded{did_you_mean(name, list(self._streams))}"

    def is_unasked(self, *names: str) -> bool:
        """Tell whether one of these streams may be the simulation's, which could not be asked about it."""
        return self._is_partial and not all(self.of(name) for name in names)

    def has_numbers(self, device: str) -> bool:
        """Tell whether an input of a device is of numbers, and no frame; so it may be where its channels are not known."""
        if device not in self._devices or device in self._channels_open:
            return True
        own = [found for name, found in self._streams.items() if self._device_of(name) == device]
        fields = [tuple(field.name for field in each.fields) for found in own for each in found]
        inputs = [names for names in fields if names[: len(INPUT_HEAD)] == INPUT_HEAD]
        return any(names[len(INPUT_HEAD) :] != FRAME_FIELDS for names in inputs)

    def _device_of(self, stream: str) -> str:
        return stream.rpartition(".")[0]

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

    def word_fault(
        self, stream: str, field: str, word: object, sources: Collection[str]
    ) -> str | None:
        """
        Return what is wrong with a text that is waited for in a field; None if it may come.

        Args:
            stream: Its name.
            field: Of its records.
            word: The text.
            sources: Names or globs of those whose records count: agents and `host`; empty for agents alone.
        """
        words = self.words(stream, field)
        if not words or not isinstance(word, str):
            return None
        if word in words:
            return _source_fault(word, sources) if (stream, field) == EVENT_PLACE else None
        guess = did_you_mean(word, words)
        if stream == EVENTS.name and not guess.endswith("?"):
            guess += "; a simulation's own words stand in its own streams: name one under stream"
        return f"stream {stream} never holds {word!r:.40} in {field}{guess}"

    def words(self, stream: str, field: str) -> tuple[str, ...]:
        """Return all texts that a field ever holds; empty if any may come."""
        if found := WORDS.get((stream, field)):
            return found
        known = []
        for on in self.of(stream):
            own = [each.words for each in on.fields if each.name == field]
            known += own or ([()] if on.is_open else [])
        return tuple(dict.fromkeys(word for words in known for word in words)) if all(known) else ()

    def field(self, stream: str, name: str) -> Field | None:
        """Return a field; None if it is not known."""
        fields = (field for each in self.of(stream) for field in each.fields)
        return next((field for field in fields if field.name == name), None)

    def has_time(self, stream: str) -> bool:
        """Tell whether records of a stream tell when they are of: t_s, a tick of an agent, or else a field in s."""
        found = self.of(stream)
        timed = [each for each in found if each.role != "machine"]  # health has clocks of its own
        return not found or any(
            each.is_open
            or any(
                (field.name == TIME and field.kind in ("float", "int"))
                or (field.name == TICK and each.role == "agent")
                or (field.unit == "s" and field.kind == "float")
                for field in each.fields
            )
            for each in timed
        )

    def roles(self, stream: str) -> set[str]:
        """Return who records a stream: agent, host or both; of one that is not known, agents."""
        return {each.role for each in self.of(stream)} or {"agent"}

    def is_apart(self, stream: str) -> bool:
        """Tell whether a stream is recorded in processes of machines or devices alone."""
        return self.roles(stream) <= set(APART)

    def bounds_unit(self, stream: str, field: str, given: str) -> str:
        """
        Return the unit that bounds of a field are in: the one that is *given*, or else its own, "".

        Where not all record it in one unit, bounds without any are in the unit that was declared first.
        """
        units = self._units(stream, field)
        return given or (units[0] if len(units) > 1 else "")

    def _units(self, stream: str, field: str) -> list[str]:
        """Return the units in which numbers of a field are recorded, the one that was declared first before others."""
        found = (each for on in self.of(stream) for each in on.fields if each.name == field)
        return list(dict.fromkeys(each.unit for each in found if each.kind in NUMBER_KINDS))

    def kinds_fault(self, stream: str, field: str) -> str | None:
        """Return that devices measure different things by a field of one name, of which no bounds are; None if they do not."""
        units = self._units(stream, field)
        if self.roles(stream) != {"device"} or all(
            conversion(units[0], each) is not None for each in units
        ):
            return None
        told = " and in ".join(each or "1" for each in units)
        return (
            f"devices record {field} of stream {stream} in {told}, which do not convert:"
            " name agents whose devices measure the same, one check for each kind"
        )

    def apart_fault(self, stream: str, field: str = "") -> str | None:
        """Return why nothing can wait for a value of a stream in the run; None if it can."""
        units = self._units(stream, field)
        if len(units) > 1:
            return (
                f"stream {stream} has {field} in {' and in '.join(each or '1' for each in units)}, by who records it,"
                " so nothing acts on it in the run"
            )
        if not self.is_apart(stream):
            return None
        whose = "a machine" if self.roles(stream) == {"machine"} else "a device"
        return (
            f"stream {stream} is recorded by {whose} and not by agents, so nothing acts on it in the run:"
            " name a stream of the simulation that has the value"
        )

    def sources(self, stream: str) -> tuple[str, ...] | None:
        """Return the full names of the devices that record a stream; None if they are not known."""
        found = [each.sources for each in self.of(stream) if each.role == "device"]
        if not found or any(each is None for each in found):
            return None
        return tuple(dict.fromkeys(name for each in found for name in each or ()))

    def names_agents(self, stream: str) -> bool:
        """Tell whether a stream of the host's half says in each record which agent it is about."""
        return any(
            field.name == AGENT and field.kind == "str"
            for each in self.of(stream)
            if each.role == "host"
            for field in each.fields
        )
