"""Finds the class of flight software that a scenario names."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Any

from madns_runtime.errors import BlamedError, PluginError
from madns_runtime.plugin.deferred_calls import deferral_fault
from madns_runtime.plugin.registry import load_function
from madns_runtime.simulations.constellation.flight.api import FlightSoftware

METHODS = ("setup", "step", "receive", "command_result", "message_refused", "finish")
"""Of the contract; flight software may lack any of them, but not all."""


def load_flight_class(spec: str, base_directory: Path) -> Callable[[], Any]:
    """
    Import a class of flight software; it is made without arguments.

    Args:
        spec: file.py:Class beside the scenario, or module:Class.
        base_directory: Folder of the scenario.

    Raises:
        BlamedError: It cannot be found, its file does not load, or it does not look like flight software.
        MissingExtraError: It needs an optional dependency that is not installed.
    """
    try:
        found = load_function(spec, base_directory)
    except PluginError as error:
        raise BlamedError(f"parameters.flight: {error}") from error
    faults = contract_faults(found)
    if faults:
        raise BlamedError(f"parameters.flight: {spec}: {'; '.join(faults)}")
    return found


def contract_faults(found: Any) -> list[str]:
    """Return what keeps a class from being flight software."""
    if not isinstance(found, type):
        return [f"expected a class, got {type(found).__name__}"]
    there = [name for name in METHODS if callable(getattr(found, name, None))]
    if not there:
        return [f"expected at least one of the methods {', '.join(METHODS)}"]
    faults = []
    try:
        inspect.signature(found).bind()
    except TypeError:
        faults.append("it must be made without arguments; take what it needs in setup(context)")
    except ValueError:  # a class written in C tells no signature
        return []
    for name in there:
        if fault := deferral_fault(getattr(found, name)):
            faults.append(f"{name}() {fault}")
        wanted = list(inspect.signature(getattr(FlightSoftware, name)).parameters)
        try:
            inspect.signature(getattr(found, name)).bind(*wanted)
        except TypeError:
            faults.append(f"{name}() must take ({', '.join(wanted)})")
        except ValueError:
            continue
    return faults
