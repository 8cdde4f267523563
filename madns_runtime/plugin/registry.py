"""
Finds simulations: by registered name, as `module:attribute`, or as `./file.py:attribute` beside a scenario.

A descriptor that comes from here names its parts in full, so that whoever holds it can load them.
A file is loaded under a name made from its path: the same file is the same module in every process
that resolves it, and its classes can be found again by name.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import importlib
import importlib.util
import inspect
import re
import sys
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any, Literal

from madns_runtime.bounded_files import FileRefused, check_regular_file, real_path
from madns_runtime.config import from_mapping
from madns_runtime.errors import MadnsError, MissingExtraError, PluginError
from madns_runtime.plain_values import shown
from madns_runtime.plugin.api import AgentSimulation, HostSimulation, Simulation
from madns_runtime.plugin.code_places import (
    CODE_BYTES_MAX,
    MODULE_PREFIX,
    blame,
    last_place,
    line_in,
    told_place,
)
from madns_runtime.plugin.deferred_calls import deferral_fault
from madns_runtime.plugin.descriptor_faults import descriptor_faults
from madns_runtime.plugin.entry_points import place_of_name, registered
from madns_runtime.plugin.isolation import is_interruption, missing_extra, said
from madns_runtime.plugin.time_limit import hold
from madns_runtime.reactor.forking import CAME_BACK, generation
from madns_runtime.similar_words import did_you_mean

GROUP = "madns.simulations"
PARTS = (
    "agent",
    "host",
    "demand",
    "check",
    "check_actions",
    "streams",
    "labels",
    "device_uses",
    "place_uses",
    "rerun",
    "medium",
    "tabulate",
    "figures",
    "document",
    "compare",
)
"""Fields of a descriptor that name a part of the simulation, the halves first."""

Role = Literal["host", "agent"]
CONTRACTS: Mapping[Role, tuple[type, tuple[str, ...]]] = {
    "host": (
        HostSimulation,
        (
            "setup",
            "initial_data",
            "start",
            "receive",
            "timer",
            "result",
            "agent_lost",
            "agent_rejoined",
            "finish",
        ),
    ),
    "agent": (AgentSimulation, ("setup", "step", "receive", "finish")),
}
"""Base class of each half, and the methods that a half must have."""


class IdleHost(HostSimulation):
    """The host's half of a simulation whose host has nothing to do."""


def registered_names() -> tuple[str, ...]:
    """Return the names of all installed simulations, sorted."""
    return tuple(sorted(registered(GROUP)))


def resolve(spec: str, base_directory: Path) -> Simulation:
    """
    Find a simulation.

    Args:
        spec: A registered name, module:attribute, or ./file.py:attribute.
        base_directory: Folder of the scenario; files are found from here.

    Raises:
        PluginError: There is no such simulation, or more than one of that name, its file does not load, or its
            descriptor is faulty.
        MissingExtraError: It needs an optional dependency that is not installed.
    """
    if ":" in spec:
        where = spec
    else:
        if spec not in registered(GROUP):
            raise PluginError(_unknown_name(spec, sorted(registered(GROUP)), base_directory))
        where = place_of_name(GROUP, spec)
    module, descriptor = load_object(where, base_directory)
    return _checked(descriptor, where, module)


BEGIN_ACTION = "begin_action"


def load_half(descriptor: Simulation, role: Role, base_directory: Path) -> Callable[[], Any]:
    """
    Import one half of a simulation and return its class, made without arguments.

    Raises:
        PluginError: It cannot be found or lacks a method of its contract.
        MissingExtraError: It needs an optional dependency that is not installed.
    """
    where = descriptor.host if role == "host" else descriptor.agent
    words = ", ".join(each.word for each in descriptor.actions if each.carried_out_by == role)
    if where is None and words:
        raise PluginError(f"host: expected a class that carries out {words}, got None")
    if where is None:
        return IdleHost
    half: Callable[[], Any]
    _, half = load_object(where, base_directory)
    faults = _contract_faults(half, role)
    inherited = (None, getattr(CONTRACTS[role][0], BEGIN_ACTION))
    if words and getattr(half, BEGIN_ACTION, None) in inherited:
        faults.append(f"no method {BEGIN_ACTION}() of its own, to carry out {words}")
    if faults:
        raise PluginError(f"{told_place(where, half)}: {'; '.join(faults)}")
    return half


def load_function(where: str, base_directory: Path) -> Callable[..., Any]:
    """
    Import a descriptor's `demand`, `check` or `medium`.

    Raises:
        PluginError: It cannot be found or is no function.
        MissingExtraError: It needs an optional dependency that is not installed.
    """
    function: Callable[..., Any]
    _, function = load_object(where, base_directory)
    if not callable(function):
        raise PluginError(
            f"{told_place(where)}: expected a function, got {type(function).__name__}"
        )
    return function


def part_faults(descriptor: Simulation, base_directory: Path) -> list[str]:
    """
    Import every part that a descriptor names, and say what is wrong with each.

    For a file that somebody is writing just now: a registered simulation's parts are loaded when
    they are needed, as its host may import a large library.
    """
    roles: tuple[Role, ...] = ("agent", "host")
    loads: list[Callable[[], object]] = [
        *(partial(load_half, descriptor, role, base_directory) for role in roles),
        *(
            partial(load_function, where, base_directory)
            for where in (getattr(descriptor, part) for part in PARTS[2:])
            if where is not None
        ),
    ]
    return [fault for load in loads if (fault := _fault_of(load))]


def is_file(spec: str) -> bool:
    """Tell whether a spec names a file beside the scenario, and no installed module."""
    place = spec.rpartition(":")[0]
    return place.endswith(".py") or "/" in place


def is_shipped(spec: str) -> bool:
    """Tell whether a spec means a simulation of this package; nothing is imported."""
    if ":" not in spec:
        found = registered(GROUP).get(spec, ())
        return bool(found) and all(map(is_shipped, found))
    return not is_file(spec) and spec.startswith(f"{__name__.partition('.')[0]}.")


def parse_parameters(descriptor: Simulation, mapping: Mapping[str, Any]) -> Any:
    """
    Build the simulation's parameters from a plain mapping that was validated where the file was read.

    Raises:
        ConfigurationError: A name is unknown or missing, or a value has another type.
        PluginError: The class itself refuses them.
    """
    kind = descriptor.parameters
    try:
        with hold():
            return from_mapping(kind, mapping, "parameters")
    except MadnsError:
        raise
    except BaseException as error:  # of its own __post_init__
        if is_interruption(error):
            raise
        raise PluginError(f"{blame(error, kind)}: {kind.__name__}: {said(error)}") from error


def _unknown_name(spec: str, known: list[str], base_directory: Path) -> str:
    text = f"no simulation named {spec!r}{did_you_mean(spec, known)}"
    if spec.endswith(".py") or (base_directory / f"{spec}.py").is_file():
        path = spec if spec.endswith(".py") else f"{spec}.py"
        path = path if path.startswith((".", "/")) else f"./{path}"
        text += f"; a file's simulation is written {path}:simulation"
    return f"{text}; installed are {', '.join(known) or 'none'}"


def load_object(where: str, base_directory: Path) -> tuple[ModuleType, Any]:
    """
    Import what a spec names, and return its module and itself.

    Args:
        where: module:NAME or ./file.py:NAME.
        base_directory: Folder from which files are found.

    Raises:
        PluginError: It cannot be found, or its module does not load.
        MissingExtraError: It needs an optional dependency that is not installed.
    """
    place, _, attribute = where.rpartition(":")
    if not place or not attribute.isidentifier():
        raise PluginError(f"{where!r}: expected module:attribute or ./file.py:attribute")
    forks = generation()
    if is_file(where):
        module = _load_file(base_directory / place, where)
    elif place.startswith(MODULE_PREFIX) and place in sys.modules:
        module = sys.modules[place]
    else:
        module = _load_module(place, where)
    if generation() != forks:  # this is the copy: it would go on as its parent does
        raise PluginError(f"{told_place(where)}: when it was imported, it {CAME_BACK}")
    return module, _attribute(module, attribute, where)


def _load_module(name: str, where: str) -> ModuleType:
    try:
        with hold():
            return importlib.import_module(name)
    except ImportError as error:
        raise _translated(error, where) from error
    except BaseException as error:  # a plug-in may raise anything
        if is_interruption(error):
            raise
        raise PluginError(f"{where}: {last_place(error, name)}{said(error)}") from error


def _load_file(path: Path, where: str) -> ModuleType:
    path = real_path(path)
    name = module_name(path)
    if name in sys.modules:
        return sys.modules[name]
    try:
        check_regular_file(path, bytes_max=CODE_BYTES_MAX)
    except FileNotFoundError:
        raise PluginError(f"{where}: no file {path}") from None
    except FileRefused as error:
        raise PluginError(f"{where}: {error}") from None
    except OSError as error:  # such as a link to itself
        raise PluginError(f"{where}: {path}: cannot be read: {error.strerror}") from None
    specification = importlib.util.spec_from_file_location(name, path)
    if specification is None or specification.loader is None:
        raise PluginError(f"{where}: expected a Python file ending in .py, got {path.name}")
    module = importlib.util.module_from_spec(specification)
    sys.modules[name] = module  # before it runs: its dataclasses look their module up by name
    try:
        with _neighbours_importable(path.parent), hold():
            specification.loader.exec_module(module)
    except BaseException as error:
        del sys.modules[name]
        if isinstance(error, ImportError):
            raise _translated(error, f"{path}{line_in(error, path)}") from error
        if is_interruption(error):
            raise
        raise PluginError(f"{path}{line_in(error, path)}: {said(error)}") from error
    return module


@contextlib.contextmanager
def _neighbours_importable(folder: Path) -> Iterator[None]:
    """Let a file import its neighbours while it loads; last in the path, so that none hides an installed module."""
    entry = str(folder)
    sys.path.append(entry)
    try:
        yield
    finally:
        with contextlib.suppress(ValueError):
            # From the end: the same folder may have been there before.
            del sys.path[len(sys.path) - 1 - sys.path[::-1].index(entry)]


def module_name(path: Path) -> str:
    """Return the module name of a plug-in file: readable, importable, and one for each path."""
    digest = hashlib.blake2b(str(real_path(path)).encode(), digest_size=8).hexdigest()
    return f"{MODULE_PREFIX}{re.sub(r'[^0-9A-Za-z_]', '_', path.stem)}_{digest}"


def _translated(error: ImportError, where: str) -> PluginError | MissingExtraError:
    return missing_extra(error) or PluginError(f"{where}: {error}")


def _fault_of(load: Callable[[], object]) -> str | None:
    try:
        load()
    except (PluginError, MissingExtraError) as error:
        return str(error)
    return None


def _attribute(module: ModuleType, name: str, where: str) -> Any:
    try:
        return getattr(module, name)
    except AttributeError:
        public = [key for key in vars(module) if not key.startswith("_")]
        hint = did_you_mean(name, public)
        if where.startswith(MODULE_PREFIX):
            raise PluginError(f"{told_place(where)}: there is no {name!r}{hint}") from None
        file = getattr(module, "__file__", None) or module.__name__
        raise PluginError(f"{where}: {file} has no {name!r}{hint}") from None


def _checked(descriptor: Any, where: str, module: ModuleType) -> Simulation:
    """Return the descriptor with `:Class` written out in full, or say what is wrong with it."""
    if not isinstance(descriptor, Simulation):
        raise PluginError(
            f"{where}: expected a madns_runtime.plugin.api.Simulation, got {type(descriptor).__name__}"
        )
    try:
        faults = [*descriptor_faults(descriptor)]
    except Exception as error:  # a mapping's or a text's class may raise anything
        raise PluginError(f"{where}: looking at the descriptor: {said(error)}") from error
    parts: dict[str, Any] = {}
    for part in PARTS:
        value = getattr(descriptor, part)
        if value is None and part != "agent":
            continue
        text = value if isinstance(value, str) else ""
        if ":" not in text:
            faults.append(f"{part}: expected 'module:name' or ':name', got {shown(value)}")
        elif text.startswith(":"):
            parts[part] = f"{module.__name__}{text}"
    if faults:
        raise PluginError(f"{where}: {'; '.join(faults)}")
    return dataclasses.replace(descriptor, **parts)


def _contract_faults(half: Any, role: Role) -> list[str]:
    contract, methods = CONTRACTS[role]
    if not isinstance(half, type):
        return [f"expected a class, got {type(half).__name__}"]
    faults = [f"no method {name}()" for name in methods if not callable(getattr(half, name, None))]
    if faults:
        faults.append(f"subclass {contract.__name__} to inherit what is not needed")
    # Also those that a half may do without: a run would find out when it first calls them, which may be late.
    for name in (each for each in vars(contract) if not each.startswith("_")):
        method, agreed = getattr(half, name, None), getattr(contract, name)
        wanted = tuple(inspect.signature(agreed).parameters)
        if callable(method) and not _takes(method, wanted):
            faults.append(f"{name}() must take ({', '.join(wanted)})")
        if fault := deferral_fault(method):
            faults.append(f"{name}() {fault}")
    if not _takes(half, ()):
        faults.append("it must be made without arguments; take what it needs in setup()")
    return faults


def _takes(function: Callable[..., Any], arguments: tuple[str, ...]) -> bool:
    try:
        inspect.signature(function).bind(*arguments)
    except TypeError:
        return False
    except ValueError:  # what is written in C tells no signature
        return True
    return True
