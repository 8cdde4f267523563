"""Declarations of kinds of devices, looked at before they are believed: their writers made them by hand. Pure."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import fields, is_dataclass
from typing import Any, Final, TypeVar

from madns_runtime.errors import ConfigurationError, PluginError
from madns_runtime.hardware.contract import Channel, DeviceKind, Needs
from madns_runtime.hardware.stream_schemas import schema_of
from madns_runtime.plain_values import from_mapping, to_mapping
from madns_runtime.recording.stream_rules import check_schema

T = TypeVar("T", Channel, Needs)
CHANNELS_MAX: Final = 64
STREAMS_TAKEN: Final = frozenset(("events", "log", "device_state", "device_clock"))
"""Names of files that are recorded beside those of channels."""


def kind_faults(kind: DeviceKind) -> list[str]:
    """Return what is wrong with a descriptor, but for its channels and needs: these may depend on parameters."""
    found = [
        f"{name}: expected a text, got {value!r:.80}"
        for name in ("name", "summary")
        if not isinstance(value := getattr(kind, name), str)
    ]
    found += _rate_faults(kind)
    has_parameters = kind.parameters is not type(None)
    is_class = isinstance(kind.parameters, type)
    if has_parameters and not (is_class and is_dataclass(kind.parameters)):
        told = getattr(kind.parameters, "__name__", repr(kind.parameters))
        return [*found, f"parameters: expected a dataclass, got {told:.80}"]
    given: Any = kind.files
    if not isinstance(given, tuple | list):
        return [*found, f"files: expected a tuple of parameters' names, got {given!r:.80}"]
    known = {field.name for field in fields(kind.parameters)} if has_parameters else set()
    unknown = [name for name in given if name not in known]
    return found + [f"files: there is no parameter {name!r:.80}" for name in unknown]


def _rate_faults(kind: DeviceKind) -> Iterator[str]:
    for name in ("rate_hz", "rate_hz_max"):
        value = getattr(kind, name)
        is_number = isinstance(value, int | float) and not isinstance(value, bool)
        if not is_number or not 0.0 < value < math.inf:
            yield f"{name}: expected a number above 0, got {value!r:.80}"
            return
    if kind.rate_hz > kind.rate_hz_max:
        yield f"rate_hz: expected at most rate_hz_max ({kind.rate_hz_max:g}), got {kind.rate_hz:g}"


def declared_channels(kind: str, given: Any) -> tuple[Channel, ...]:
    """
    Return the channels that a kind gives, each with values of the right types.

    Raises:
        PluginError: They are none, or one has a value of another type.
    """
    if isinstance(given, Channel):
        raise PluginError(
            f"{kind}: channels: expected a tuple of channels, got one alone: a tuple of one ends with a comma,"
            " (Channel(...),)"
        )
    if not isinstance(given, Sequence) or isinstance(given, str | bytes):
        raise PluginError(f"{kind}: channels: expected a tuple of channels, got {given!r:.80}")
    return tuple(_declared_channel(kind, number, each) for number, each in enumerate(given))


def _declared_channel(kind: str, number: int, given: Any) -> Channel:
    if not isinstance(given, Channel):
        raise PluginError(f"{kind}: channels[{number}]: expected a Channel, got {given!r:.80}")
    return _declared(Channel, given, f"{kind}: channels[{number}] ({given.name!r:.80})")


def declared_needs(kind: str, given: Any) -> Needs:
    """
    Return the needs that a kind gives.

    Raises:
        PluginError: They are none, or hold a value of another type.
    """
    if not isinstance(given, Needs):
        raise PluginError(f"{kind}: needs: expected Needs(...), got {given!r:.80}")
    return _declared(Needs, given, f"{kind}: needs")


def _declared(cls: type[T], given: T, where: str) -> T:
    try:
        return from_mapping(cls, to_mapping(given), where)
    except ConfigurationError as error:
        raise PluginError(str(error)) from None


def _faults_of(channel: Channel) -> Iterator[str]:
    """Yield what is wrong with one channel, by itself or as a stream of records."""
    own = channel.faults()
    yield from own
    if not own:
        try:
            check_schema(schema_of(channel))
        except PluginError as error:
            yield str(error)


def channel_faults(channels: tuple[Channel, ...]) -> list[str]:
    """Return what is wrong with the channels that a kind declares."""
    if not channels or len(channels) > CHANNELS_MAX:
        return [f"expected 1 to {CHANNELS_MAX} channels, got {len(channels)}"]
    faults = [fault for channel in channels for fault in _faults_of(channel)]
    names = [channel.name for channel in channels]
    faults += [
        f"two channels are called {name}" for name in sorted(set(names)) if names.count(name) > 1
    ]
    taken = STREAMS_TAKEN & set(names)
    return faults + [f"no channel may be called {name}" for name in sorted(taken)]
