"""
What the operator asks a simulation before a run: what is wrong (`check`), and what it needs (`demand`).

What comes back is checked here, so that a slip in a plug-in is told as such and not met later.
"""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from madns_runtime.errors import PluginError
from madns_runtime.plugin.api import Demand, Flow
from madns_runtime.plugin.guard import call_plugin, place_of
from madns_runtime.plugin.registry import load_function

NO_FIGURES = ("name", "flows", "measured")
"""Fields of a Demand or a Flow that are no amounts."""


def ask_check(
    where: str,
    base_directory: Path,
    *,
    parameters: Any,
    agents: int,
    names: tuple[str, ...] = (),
) -> list[str]:
    """
    Return the faults that a simulation's `check` finds.

    Args:
        where: module:function.
        base_directory: Folder of the scenario.
        parameters: An instance of the simulation's parameters.
        agents: How many there are.
        names: Their names, for a `check` whose fourth parameter is called names.

    Raises:
        PluginError: It cannot be found, raised, or did not return a list of texts.
        MissingExtraError: It needs an optional dependency that is not installed.
    """
    function = load_function(where, base_directory)
    arguments = [parameters, agents, base_directory]
    if _takes_names(function):
        arguments.append(names)
    found = call_plugin("check", function, *arguments, finish=_unfolded)
    if not isinstance(found, list) or not all(isinstance(text, str) for text in found):
        raise PluginError(
            f"{place_of(function)}: check() must return a list of texts, empty if nothing is wrong;"
            f" got {found!r:.100}"
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
    demand = call_plugin("demand", function, parameters, agents, tick_hz, base_directory)
    fault = _demand_fault(demand)
    if fault:
        raise PluginError(f"{place_of(function)}: demand() {fault}")
    return demand  # type: ignore[no-any-return]


def _takes_names(function: Callable[..., Any]) -> bool:
    try:
        return "names" in list(inspect.signature(function).parameters)[3:4]
    except (TypeError, ValueError):  # a function written in C tells no signature
        return False


def _unfolded(found: Any) -> Any:
    return list(found) if isinstance(found, Iterable) and not isinstance(found, str) else found


def _demand_fault(demand: Any) -> str | None:
    if not isinstance(demand, Demand):
        return f"must return a madns_runtime.plugin.api.Demand, got {demand!r:.100}"
    flows: Any = demand.flows
    if not isinstance(flows, tuple | list) or not all(isinstance(flow, Flow) for flow in flows):
        return f"must return flows as a tuple of Flow, got {flows!r:.100}"
    for owner, label in [(demand, "demand"), *((flow, f"flow {flow.name!r}") for flow in flows)]:
        for field in dataclasses.fields(owner):
            value = getattr(owner, field.name)
            if field.name not in NO_FIGURES and not _is_amount(value):
                return f"must return figures of at least 0, got {field.name} = {value!r:.100} of {label}"
    return None


def _is_amount(value: Any) -> bool:
    """Tell whether a value is a number, not negative and not NaN; infinity is one."""
    return isinstance(value, int | float) and not isinstance(value, bool) and value >= 0
