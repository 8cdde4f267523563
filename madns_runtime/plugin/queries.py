"""
Queries to a simulation before a run: its faults (`check`) and its demands (`demand`).

What comes back is checked here, so that a slip in a plug-in is told as such and not met later.
"""

from __future__ import annotations

import functools
import importlib
import inspect
import itertools
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from madns_runtime.errors import PluginError
from madns_runtime.plugin.answer_faults import (
    demand_fault,
    labels_fault,
    rerun_fault,
    streams_fault,
    texts_fault,
    uses_fault,
)
from madns_runtime.plugin.api import (
    DeclaredStream,
    Demand,
    DeviceUse,
    PlaceUse,
    PlannedAction,
    Rerun,
    Simulation,
)
from madns_runtime.plugin.code_places import place_of
from madns_runtime.plugin.isolation import call_plugin, unfolded
from madns_runtime.plugin.registry import load_function

OF_SCENARIOS = ("check", "check_actions", "streams", "labels", "device_uses", "place_uses")
"""Parts of a descriptor that a scenario is read with."""
CHECK_MORE = ("names", "duration_s", "is_lockstep", "tick_hz")
"""Arguments that a `check` may take beside parameters, count of agents and folder."""
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
    texts: list[str] = _asked(name, function, arguments, texts_fault, unfolds=True)
    return texts


def _asked(
    name: str,
    function: Callable[..., Any],
    arguments: Sequence[Any],
    fault_of: Callable[[Any], str | None],
    *,
    unfolds: bool = False,
) -> Any:
    """
    Return what a function of a descriptor returns, once *fault_of* finds nothing wrong with it.

    That is looked at where what its classes raise is told as the function's own fault.

    Raises:
        PluginError: It raised, or returned something else than it must.
        MissingExtraError: It needs an optional dependency that is not installed.
    """

    def judge(found: Any) -> Any:
        if unfolds:
            found = unfolded(list(found) if isinstance(found, Mapping) else found)
        fault = fault_of(found)
        if fault:
            raise PluginError(f"{place_of(function)}: {name}() {fault}")
        return found

    return call_plugin(name, function, *arguments, finish=judge)


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
    arguments = (parameters, agents, tick_hz, base_directory)
    demand: Demand = _asked("demand", function, arguments, demand_fault)
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
    return tuple(_asked("streams", function, (parameters, agents), streams_fault, unfolds=True))


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
    arguments = (parameters, agents, base_directory)
    return dict(_asked("labels", function, arguments, partial(labels_fault, agents)))


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
    fault_of = partial(uses_fault, kind, set(arguments[1]))
    return tuple(_asked(name, function, (*arguments, base_directory), fault_of, unfolds=True))


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
    found: Rerun = _asked("rerun", function, (parameters, agents, run), rerun_fault)
    return found


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
