"""
Finds kinds of devices, and checks what they declare.

A kind is registered by the entry point `madns.devices`, or named as `module:NAME` or `./file.py:NAME`. NAME is a
`DeviceKind`, or a `Device` class that bears one as its `kind`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Any, Final

from madns_runtime.declared_bounds import bound_faults
from madns_runtime.errors import ConfigurationError, MachineError, PluginError
from madns_runtime.hardware.contract import Channel, Device, DeviceKind, Needs, SimulatedDevice
from madns_runtime.hardware.kind_declaration import (
    channel_faults,
    declared_channels,
    declared_needs,
    kind_faults,
)
from madns_runtime.plain_values import from_mapping
from madns_runtime.plugin.code_places import told_place
from madns_runtime.plugin.entry_points import place_of_name, registered
from madns_runtime.plugin.isolation import call_plugin
from madns_runtime.plugin.registry import load_object
from madns_runtime.similar_words import did_you_mean

GROUP: Final = "madns.devices"


@dataclass(frozen=True, slots=True, kw_only=True)
class DeviceProgram:
    """A kind with its parameters: what drives one device."""

    kind: DeviceKind
    parameters: Any
    channels: tuple[Channel, ...]
    needs: Needs
    make: Callable[[], Device]
    """Imports the driver's class and makes it; for the device's process."""


def registered_kinds() -> tuple[str, ...]:
    """Return the names of all installed kinds, sorted."""
    return tuple(sorted(registered(GROUP)))


def resolve_kind(spec: str, base_directory: Path) -> DeviceKind:
    """
    Find a kind; no library of the device's is imported.

    Args:
        spec: A registered name, module:NAME, or ./file.py:NAME.
        base_directory: Folder from which files are found.

    Raises:
        PluginError: There is no such kind, its file does not load, or its descriptor is faulty.
        MissingExtraError: It needs an optional dependency that is not installed.
    """
    where = spec
    if ":" not in spec:
        entries = registered(GROUP)
        if spec not in entries:
            known = ", ".join(sorted(entries)) or "none"
            raise PluginError(
                f"no kind of device named {spec!r}{did_you_mean(spec, entries)}; installed are {known}"
            )
        where = place_of_name(GROUP, spec)
    module, found = load_object(where, base_directory)
    kind = getattr(found, "kind", None) if isinstance(found, type) else found
    if not isinstance(kind, DeviceKind):
        raise PluginError(
            f"{where}: expected a madns_runtime.hardware.contract.DeviceKind, or a Device class with one as its"
            f" `kind`, got {found!r:.80}"
        )
    if wrong := kind_faults(kind):
        raise PluginError(f"{told_place(where, found)}: {'; '.join(wrong)}")
    driver = found if isinstance(found, type) else kind.device
    if not isinstance(driver, str) and (fault := _class_fault(kind, driver)):
        raise PluginError(f"{told_place(where, found)}: {fault}")
    if isinstance(found, type):
        return replace(kind, device=found)
    if isinstance(kind.device, str) and kind.device.startswith(":"):
        return replace(kind, device=f"{module.__name__}{kind.device}")
    return kind


def prepare(spec: str, parameters: Mapping[str, Any], base_directory: Path) -> DeviceProgram:
    """
    Return what drives a device of a kind with these parameters.

    Raises:
        PluginError: There is no such kind, or what it declares is faulty.
        ConfigurationError: A parameter is unknown, missing, or of another type.
        MissingExtraError: It needs an optional dependency that is not installed.
    """
    kind = resolve_kind(spec, base_directory)
    if kind.parameters is type(None):
        if parameters:
            raise PluginError(f"{kind.name} takes no parameters, got {', '.join(parameters)}")
        values = None
    else:
        values = _with_paths(
            from_mapping(kind.parameters, parameters, f"{kind.name}.parameters"), base_directory
        )
        if beyond := bound_faults(values, f"{kind.name}.parameters"):
            raise ConfigurationError("; ".join(beyond))
    declared: Any = kind.channels
    if callable(declared):
        declared = call_plugin(f"{kind.name}.channels", declared, values)
    channels = declared_channels(kind.name, declared)
    declared = kind.needs
    if callable(declared):
        declared = call_plugin(f"{kind.name}.needs", declared, values)
    needs = declared_needs(kind.name, declared)
    faults = channel_faults(channels)
    if faults:
        raise PluginError(f"{kind.name}: {'; '.join(faults)}")
    return DeviceProgram(
        kind=kind,
        parameters=values,
        channels=channels,
        needs=needs,
        make=partial(_make, replace(kind, needs=needs), values, base_directory),
    )


def _with_paths(parameters: Any, base_directory: Path) -> Any:
    """Return parameters whose paths are found from *base_directory*."""
    paths = {
        field.name: base_directory / value
        for field in fields(parameters)
        if isinstance(value := getattr(parameters, field.name), Path)
    }
    return replace(parameters, **paths)


def _make(kind: DeviceKind, parameters: Any, base_directory: Path) -> Device:
    """
    Make the driver.

    Raises:
        PluginError: Its class cannot be found, or is no `Device`.
        MachineError: A library that it imports is not installed.
    """
    driver: Any = kind.device
    where = kind.name
    if isinstance(driver, str):
        try:
            _, driver = load_object(driver, base_directory)
            where = f"{kind.name}: {told_place(str(kind.device), driver)}"
        except PluginError as error:
            raise _library_missing(kind, error.__cause__) or error from None
    if fault := _class_fault(kind, driver):
        raise PluginError(f"{where}: {fault}")
    device: Device = driver(parameters)
    return device


def _class_fault(kind: DeviceKind, driver: Any) -> str:
    """Return what is wrong with what a kind gives as its driver's class; empty if nothing is."""
    wanted = SimulatedDevice if kind.follows_simulated_time else Device
    if isinstance(driver, type) and issubclass(driver, wanted):
        return ""
    got = getattr(driver, "__qualname__", f"{driver!r:.80}")
    if kind.follows_simulated_time:
        return f"follows_simulated_time needs a subclass of SimulatedDevice (sample_at), got {got}"
    return f"expected a subclass of Device, got {got}"


def _library_missing(kind: DeviceKind, cause: BaseException | None) -> MachineError | None:
    """Return what to tell if an import failed for want of a library that the kind declares."""
    needs = kind.needs
    if not isinstance(cause, ModuleNotFoundError) or not isinstance(needs, Needs):
        return None
    if needs.requirements:
        names = " ".join(map(repr, needs.requirements))
        cure = f"pip install {names}, or `cosmos up` on the machine that has the device"
    elif needs.packages:
        cure = f"sudo apt install {' '.join(needs.packages)}"
    else:
        return None
    return MachineError(f"{kind.name}: the module {cause.name} is not installed here; {cure}")
