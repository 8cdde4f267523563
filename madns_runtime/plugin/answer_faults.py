"""Faults in what the functions of a simulation's descriptor return, in words. Pure."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

from madns_runtime.errors import ConfigurationError, PluginError
from madns_runtime.plain_values import (
    LINE_CHARACTERS_MAX,
    are_texts,
    from_mapping,
    is_line,
    shown,
    to_mapping,
)
from madns_runtime.plugin.api import DeclaredStream, Demand, DeviceUse, Flow, PlaceUse, Rerun
from madns_runtime.recording.records import (
    FIELD_KINDS,
    FRAMEWORK_STREAMS,
    Field,
    StreamSchema,
)
from madns_runtime.recording.stream_rules import check_agent_name, check_schema

NO_FIGURES = ("name", "flows", "measured")
"""Fields of a Demand or a Flow that are no amounts."""
UNSAID = ("within_s",)
"""Figures that may be None."""
ENDLESS = ("buffer_s", "lead_s")
"""Figures that may be infinite: of who needs nothing, and of who commands nothing."""
NO_LABELS = {"host": "the host", "*": "all agents"}
"""Texts that are no second name of an agent, and what they mean."""
FIGURE_MAX = 1e18
"""Of bytes, seconds and hertz; what is beyond is a slip, and its products with agents and rates need no infinity."""


def texts_fault(found: Any) -> str | None:
    """Return what is wrong with the answer of `check` or `check_actions`; None if nothing is."""
    if isinstance(found, list) and are_texts(found):
        return None
    return f"must return a list of texts, empty if nothing is wrong; got {shown(found)}"


def labels_fault(agents: tuple[str, ...], found: Any) -> str | None:
    """Return what is wrong with second names of *agents*; None if nothing is."""
    known = set(agents)
    if not isinstance(found, Mapping) or not all(
        agent in known and isinstance(label, str) and label for agent, label in found.items()
    ):
        return f"must return a mapping of agents' names to texts, got {shown(found)}"
    for agent, label in found.items():
        if not is_line(label):
            return (
                f"must call {agent} by a text of at most {LINE_CHARACTERS_MAX} printable characters,"
                f" got {shown(label)}"
            )
        if label in known and label != agent:
            return f"calls {agent} {label}, which is another agent's name: nobody could tell them apart"
        if label in NO_LABELS:
            return (
                f"calls {agent} {label}, which means {NO_LABELS[label]} wherever an agent is named"
            )
    return None


def uses_fault(kind: type[DeviceUse] | type[PlaceUse], known: set[str], found: Any) -> str | None:
    """Return what is wrong with uses of one kind by agents that are known; None if nothing is."""
    if not isinstance(found, list) or not all(
        isinstance(use, kind) and _is_among(use.agent, known) for use in found
    ):
        return (
            f"must return {kind.__name__}s of madns_runtime.plugin.api by agents of the scenario,"
            f" got {shown(found)}"
        )
    return next(filter(None, map(_kind_fault, found)), None)


def _is_among(name: Any, known: set[str]) -> bool:
    return isinstance(name, str) and name in known


def _kind_fault(item: Any) -> str | None:
    """Return what is wrong with the fields of a value, by their annotations, or with a text that no file can hold."""
    plain = to_mapping(item)
    try:
        from_mapping(type(item), plain)
    except ConfigurationError as error:
        return f"must return fields of their kinds: {error}"
    for name, value in plain.items():
        if isinstance(value, str) and not is_line(value):
            return (
                f"must return texts of at most {LINE_CHARACTERS_MAX} printable characters, got {name}"
                f" {shown(value)}"
            )
    return None


def rerun_fault(found: Any) -> str | None:
    """Return what is wrong with the answer of `rerun`; None if nothing is."""
    if isinstance(found, Rerun) and are_texts(found.remarks) and are_texts(found.unlike):
        return None
    return f"must return a Rerun of madns_runtime.plugin.api, got {shown(found)}"


def streams_fault(found: Any) -> str | None:
    """Return what is wrong with declared streams; None if nothing is."""
    if not isinstance(found, list) or not all(isinstance(item, DeclaredStream) for item in found):
        return f"must return DeclaredStreams of madns_runtime.plugin.api, got {shown(found)}"
    seen = set()
    for item in found:
        place = (item.role, item.name)
        if (
            not isinstance(item.role, str)
            or item.role not in ("host", "agent")
            or not isinstance(item.name, str)
        ):
            return f"must name a stream by a text, of role host or agent, got {shown(place)}"
        if item.name in FRAMEWORK_STREAMS or place in seen:
            whose = "the framework" if item.name in FRAMEWORK_STREAMS else "another of them"
            return f"declares the {item.role}'s stream {item.name!r}, which belongs to {whose}"
        seen.add(place)
        fields: Any = item.fields
        if not isinstance(fields, tuple | list) or not all(isinstance(f, Field) for f in fields):
            return f"must give {item.name!r} fields as a tuple of Field, got {shown(fields)}"
    return next(filter(None, map(_stream_fault, found)), None)


def _stream_fault(item: DeclaredStream) -> str | None:
    """Return what keeps a declared stream from being opened."""
    for field in item.fields:
        kind: Any = field.kind
        if not isinstance(kind, str) or kind not in FIELD_KINDS:
            kinds = ", ".join(FIELD_KINDS)
            return f"must give {item.name!r} fields of kind {kinds}, got {shown(field)}"
    try:
        if item.fields or not item.is_open:
            check_schema(StreamSchema(item.name, tuple(item.fields)))
        if item.role == "agent":
            check_agent_name(item.name)
    except PluginError as error:
        return f"declares what cannot be opened: {error}"
    return _kind_fault(item)


def demand_fault(demand: Any) -> str | None:
    """Return what is wrong with a demand; None if nothing is."""
    if not isinstance(demand, Demand):
        return f"must return a madns_runtime.plugin.api.Demand, got {shown(demand)}"
    flows: Any = demand.flows
    if not isinstance(flows, tuple | list) or not all(isinstance(flow, Flow) for flow in flows):
        return f"must return flows as a tuple of Flow, got {shown(flows)}"
    for flow in flows:
        if not isinstance(flow.name, str):
            return f"must name flows by texts, got {shown(flow.name)}"
    for owner, label in [(demand, "demand"), *((flow, f"flow {flow.name!r}") for flow in flows)]:
        for field in dataclasses.fields(owner):
            value, name = getattr(owner, field.name), field.name
            if value is None and name in UNSAID:
                continue
            if name not in NO_FIGURES and not _is_amount(value, may_be_endless=name in ENDLESS):
                endless = ", or math.inf" if name in ENDLESS else ""
                limits = f"of at least 0 and at most {FIGURE_MAX:g}{endless}"
                return f"must return figures {limits}, got {name} = {shown(value)} of {label}"
    return next(filter(None, map(_kind_fault, (demand, *flows))), None)


def _is_amount(value: Any, *, may_be_endless: bool) -> bool:
    """Tell whether a value is a number, not negative, not NaN and not beyond all measure."""
    if not isinstance(value, int | float) or isinstance(value, bool):
        return False
    return 0 <= value <= FIGURE_MAX or (may_be_endless and value == math.inf)
