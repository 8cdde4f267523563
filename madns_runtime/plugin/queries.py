"""
Queries to a simulation before a run: its faults (`check`) and its demands (`demand`).

What comes back is checked here, so that a slip in a plug-in is told as such and not met later.
"""

from __future__ import annotations

import dataclasses
import functools
import importlib
import inspect
import itertools
import math
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, TypeVar

from madns_runtime.errors import PluginError
from madns_runtime.plugin.api import (
    DeclaredStream,
    Demand,
    DeviceUse,
    Flow,
    PlaceUse,
    PlannedAction,
    Rerun,
    Simulation,
)
from madns_runtime.plugin.code_places import place_of
from madns_runtime.plugin.isolation import call_plugin
from madns_runtime.plugin.registry import load_function
from madns_runtime.recording.records import FIELD_KINDS, FRAMEWORK_STREAMS, HEALTH, Field

OF_SCENARIOS = ("check", "check_actions", "streams", "labels", "device_uses", "place_uses")
"""Parts of a descriptor that a scenario is read with."""
NO_FIGURES = ("name", "flows", "measured")
"""Fields of a Demand or a Flow that are no amounts."""
UNSAID = ("within_s",)
"""Figures that may be None."""
ENDLESS = ("buffer_s", "lead_s")
"""Figures that may be infinite: of who needs nothing, and of who commands nothing."""
CHECK_MORE = ("names", "duration_s", "is_lockstep", "tick_hz")
"""What a `check` may take beside parameters, count of agents and folder."""
FIGURE_MAX = 1e18
"""Of bytes, seconds and hertz; what is beyond is a slip, and its products with agents and rates need no infinity."""
Use = TypeVar("Use", DeviceUse, PlaceUse)


def import_questions(simulation: Simulation) -> None:
    """Import what a shipped simulation answers with while a scenario is read."""
    for where in filter(None, (getattr(simulation, part) for part in OF_SCENARIOS)):
        importlib.import_module(where.partition(":")[0])


def ask_check(  # noqa: PLR0913 - what a scenario is; all but two by name
    where: str,
    base_directory: Path,
    *,
    parameters: Any,
    agents: int,
    names: tuple[str, ...] = (),
    duration_s: float = 0.0,
    is_lockstep: bool = False,
    tick_hz: float = 0.0,
) -> list[str]:
    """
    Return the faults that a simulation's `check` finds.

    Args:
        where: module:function.
        base_directory: Folder of the scenario.
        parameters: An instance of the simulation's parameters.
        agents: How many there are.
        names: Their names; this and the others are for a `check` that takes them, see `_more_taken`.
        duration_s: Of the run.
        is_lockstep: Whether simulated time waits for everybody.
        tick_hz: Rate of every agent's loop.

    Raises:
        PluginError: It cannot be found, raised, or did not return a list of texts.
        MissingExtraError: It needs an optional dependency that is not installed.
    """
    function = load_function(where, base_directory)
    more = dict(zip(CHECK_MORE, (names, duration_s, is_lockstep, tick_hz), strict=True))
    in_order, by_name = _more_taken(function)
    arguments = [parameters, agents, base_directory, *(more[name] for name in in_order)]
    named = {name: more[name] for name in by_name}
    ask = functools.wraps(function)(lambda *given: function(*given, **named))
    return _asked_texts("check", ask if named else function, arguments)


def ask_check_actions(
    where: str,
    base_directory: Path,
    *,
    parameters: Any,
    actions: tuple[PlannedAction, ...],
    agents: tuple[str, ...],
) -> list[str]:
    """
    Return the faults that a simulation's `check_actions` finds in a timeline.

    Args:
        where: module:function.
        base_directory: Folder of the scenario.
        parameters: An instance of the simulation's parameters.
        actions: Entries of the timeline whose words the simulation declares.
        agents: Names of all agents.

    Raises:
        PluginError: It cannot be found, raised, or did not return a list of texts.
        MissingExtraError: It needs an optional dependency that is not installed.
    """
    function = load_function(where, base_directory)
    return _asked_texts("check_actions", function, [parameters, actions, agents, base_directory])


def _asked_texts(name: str, function: Callable[..., Any], arguments: list[Any]) -> list[str]:
    found = call_plugin(name, function, *arguments, finish=_unfolded)
    if not isinstance(found, list) or not all(isinstance(text, str) for text in found):
        raise PluginError(
            f"{place_of(function)}: {name}() must return a list of texts, empty if nothing is wrong;"
            f" got {_shown(found)}"
        )
    return found


def ask_demand(
    where: str, base_directory: Path, *, parameters: Any, agents: int, tick_hz: float
) -> Demand:
    """
    Return what a simulation asks of host and network.

    Args:
        where: module:function.
        base_directory: Folder of the scenario.
        parameters: An instance of the simulation's parameters.
        agents: How many there are.
        tick_hz: Rate of every agent's loop.

    Raises:
        PluginError: It cannot be found, raised, or did not return a proper Demand.
        MissingExtraError: It needs an optional dependency that is not installed.
    """
    function = load_function(where, base_directory)
    demand: Demand = call_plugin("demand", function, parameters, agents, tick_hz, base_directory)
    fault = _demand_fault(demand)
    if fault:
        raise PluginError(f"{place_of(function)}: demand() {fault}")
    return demand


def ask_streams(
    where: str, base_directory: Path, *, parameters: Any, agents: tuple[str, ...]
) -> tuple[DeclaredStream, ...]:
    """
    Return the streams that a simulation declares.

    Args:
        where: module:function.
        base_directory: Folder of the scenario.
        parameters: An instance of the simulation's parameters.
        agents: Their names.

    Raises:
        PluginError: It cannot be found, raised, or did not return proper declarations.
        MissingExtraError: It needs an optional dependency that is not installed.
    """
    function = load_function(where, base_directory)
    found = call_plugin("streams", function, parameters, agents, finish=_unfolded)
    fault = _streams_fault(found)
    if fault:
        raise PluginError(f"{place_of(function)}: streams() {fault}")
    return tuple(found)


def ask_labels(
    where: str, base_directory: Path, *, parameters: Any, agents: tuple[str, ...]
) -> dict[str, str]:
    """
    Return the second names that a simulation gives to agents.

    Args:
        where: module:function.
        base_directory: Folder of the scenario.
        parameters: An instance of the simulation's parameters.
        agents: Their names.

    Raises:
        PluginError: It cannot be found, raised, or did not return a mapping of agents to texts.
        MissingExtraError: It needs an optional dependency that is not installed.
    """
    function = load_function(where, base_directory)
    found = call_plugin("labels", function, parameters, agents, base_directory)
    known = set(agents)
    if not isinstance(found, Mapping) or not all(
        agent in known and isinstance(label, str) and label for agent, label in found.items()
    ):
        raise PluginError(
            f"{place_of(function)}: labels() must return a mapping of agents' names to texts,"
            f" got {_shown(found)}"
        )
    return dict(found)


def ask_device_uses(
    where: str, base_directory: Path, *, parameters: Any, agents: tuple[str, ...]
) -> tuple[DeviceUse, ...]:
    """
    Return the channels of devices that a simulation's parameters name.

    Args:
        where: module:function.
        base_directory: Folder of the scenario.
        parameters: An instance of the simulation's parameters.
        agents: Their names.

    Raises:
        PluginError: It cannot be found, raised, or did not return uses by agents of the scenario.
        MissingExtraError: It needs an optional dependency that is not installed.
    """
    return _ask_uses(
        "device_uses", DeviceUse, where, base_directory, arguments=(parameters, agents)
    )


def ask_place_uses(
    where: str, base_directory: Path, *, parameters: Any, agents: tuple[str, ...]
) -> tuple[PlaceUse, ...]:
    """
    Return what each agent takes of its machine for itself alone.

    Args:
        where: module:function.
        base_directory: Folder of the scenario.
        parameters: An instance of the simulation's parameters.
        agents: Their names.

    Raises:
        PluginError: It cannot be found, raised, or did not return uses by agents of the scenario.
        MissingExtraError: It needs an optional dependency that is not installed.
    """
    return _ask_uses("place_uses", PlaceUse, where, base_directory, arguments=(parameters, agents))


def _ask_uses(
    name: str,
    kind: type[Use],
    where: str,
    base_directory: Path,
    *,
    arguments: tuple[Any, tuple[str, ...]],
) -> tuple[Use, ...]:
    function = load_function(where, base_directory)
    found = call_plugin(name, function, *arguments, base_directory, finish=_unfolded)
    known = set(arguments[1])
    if not isinstance(found, list) or not all(
        isinstance(use, kind) and use.agent in known for use in found
    ):
        raise PluginError(
            f"{place_of(function)}: {name}() must return {kind.__name__}s of madns_runtime.plugin.api by agents of the"
            f" scenario, got {_shown(found)}"
        )
    return tuple(found)


def ask_rerun(
    where: str, base_directory: Path, *, parameters: Any, agents: tuple[str, ...], run: Path
) -> Rerun:
    """
    Return how a simulation flies a recorded run again.

    Args:
        where: module:function.
        base_directory: Folder of the scenario.
        parameters: An instance of the simulation's parameters.
        agents: Their names.
        run: The run directory.

    Raises:
        PluginError: It cannot be found, raised, or did not return a proper Rerun.
        MissingExtraError: It needs an optional dependency that is not installed.
    """
    function = load_function(where, base_directory)
    found = call_plugin("rerun", function, parameters, agents, run)
    if isinstance(found, Rerun) and _are_texts(found.remarks) and _are_texts(found.unlike):
        return found
    raise PluginError(
        f"{place_of(function)}: rerun() must return a Rerun of madns_runtime.plugin.api,"
        f" got {_shown(found)}"
    )


def _are_texts(given: Any) -> bool:
    return isinstance(given, tuple | list) and all(isinstance(text, str) for text in given)


def _streams_fault(found: Any) -> str | None:
    if not isinstance(found, list) or not all(isinstance(item, DeclaredStream) for item in found):
        return f"must return DeclaredStreams of madns_runtime.plugin.api, got {_shown(found)}"
    seen = set()
    for item in found:
        place = (item.role, item.name)
        if item.role not in ("host", "agent") or not isinstance(item.name, str):
            return f"must name a stream by a text, of role host or agent, got {_shown(place)}"
        if item.name in FRAMEWORK_STREAMS or place in seen:
            whose = "the framework" if item.name in FRAMEWORK_STREAMS else "another of them"
            return f"declares the {item.role}'s stream {item.name!r}, which belongs to {whose}"
        seen.add(place)
        fields: Any = item.fields
        if not isinstance(fields, tuple | list) or not all(isinstance(f, Field) for f in fields):
            return f"must give {item.name!r} fields as a tuple of Field, got {_shown(fields)}"
        for field in fields:
            if field.kind not in FIELD_KINDS:
                kinds = ", ".join(FIELD_KINDS)
                return f"must give {item.name!r} fields of kind {kinds}, got {_shown(field)}"
    of_host = {*FRAMEWORK_STREAMS, *(name for role, name in seen if role == "host")}
    taken = {f"machine_{HEALTH.name}", *(f"host_{name}" for name in of_host)}
    return next(
        (
            f"declares the agent's stream {name!r}, whose table would be that of {_who_has(name)}"
            for role, name in sorted(seen)
            if role == "agent" and name in taken
        ),
        None,
    )


def _who_has(table: str) -> str:
    role, _, stream = table.partition("_")
    return f"the {role}'s stream {stream!r}: choose another name"


def _more_taken(function: Callable[..., Any]) -> tuple[list[str], list[str]]:
    """Return which of CHECK_MORE a `check` takes after its first three arguments in that order, and which by name alone."""
    try:
        parameters = list(inspect.signature(function).parameters.values())[3:]
    except (TypeError, ValueError):  # a function written in C tells no signature
        return [], []
    keyword_only = inspect.Parameter.KEYWORD_ONLY
    in_order = [each.name for each in parameters if each.kind is not keyword_only]
    by_name = [each.name for each in parameters if each.kind is keyword_only]
    pairs = zip(CHECK_MORE, in_order, strict=False)
    taken = [name for name, _ in itertools.takewhile(lambda pair: pair[0] == pair[1], pairs)]
    return taken, [name for name in by_name if name in CHECK_MORE]


def _unfolded(found: Any) -> Any:
    return list(found) if isinstance(found, Iterable) and not isinstance(found, str) else found


def _demand_fault(demand: Any) -> str | None:
    if not isinstance(demand, Demand):
        return f"must return a madns_runtime.plugin.api.Demand, got {_shown(demand)}"
    flows: Any = demand.flows
    if not isinstance(flows, tuple | list) or not all(isinstance(flow, Flow) for flow in flows):
        return f"must return flows as a tuple of Flow, got {_shown(flows)}"
    for flow in flows:
        if not isinstance(flow.name, str):
            return f"must name flows by texts, got {_shown(flow.name)}"
    for owner, label in [(demand, "demand"), *((flow, f"flow {flow.name!r}") for flow in flows)]:
        for field in dataclasses.fields(owner):
            value, name = getattr(owner, field.name), field.name
            if value is None and name in UNSAID:
                continue
            if name not in NO_FIGURES and not _is_amount(value, may_be_endless=name in ENDLESS):
                endless = ", or math.inf" if name in ENDLESS else ""
                limits = f"of at least 0 and at most {FIGURE_MAX:g}{endless}"
                return f"must return figures {limits}, got {name} = {_shown(value)} of {label}"
    return None


def _is_amount(value: Any, *, may_be_endless: bool) -> bool:
    """Tell whether a value is a number, not negative, not NaN and not beyond all measure."""
    if not isinstance(value, int | float) or isinstance(value, bool):
        return False
    return 0 <= value <= FIGURE_MAX or (may_be_endless and value == math.inf)


def _shown(value: Any) -> str:
    """Return a value for a message; whole numbers of thousands of digits have no text, and a class may refuse one."""
    try:
        return f"{value!r:.100}"
    except Exception:  # noqa: BLE001 - __repr__ of a plug-in's class may raise anything
        return f"a {type(value).__name__} that cannot be shown"
