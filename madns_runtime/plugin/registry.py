"""
Finds simulations: by registered name, as `module:attribute`, or as `./file.py:attribute` beside a scenario.

A descriptor that comes from here names its parts in full, so that whoever holds it can load them.
A file is loaded under a name made from its path: the same file is the same module in every process
that resolves it, and its classes can be found again by name.
"""

from __future__ import annotations

import contextlib
import dataclasses
import difflib
import hashlib
import importlib
import importlib.util
import inspect
import re
import sys
import traceback
from collections.abc import Callable, Iterator, Mapping
from importlib import metadata
from pathlib import Path
from types import ModuleType
from typing import Any, Literal

from madns_runtime.config import from_mapping
from madns_runtime.errors import MissingExtraError, PluginError
from madns_runtime.plugin.api import AgentSimulation, HostSimulation, Simulation
from madns_runtime.plugin.guard import missing_extra, place_of, said, talk_on_stderr

GROUP = "madns.simulations"
MODULE_PREFIX = "madns_plugin_"
HOST_METHODS = (
    "setup",
    "initial_data",
    "start",
    "receive",
    "timer",
    "result",
    "agent_lost",
    "agent_rejoined",
    "finish",
)
AGENT_METHODS = ("setup", "step", "receive", "finish")

Role = Literal["host", "agent"]


class IdleHost(HostSimulation):
    """The host's half of a simulation whose host has nothing to do."""


def registered_names() -> tuple[str, ...]:
    """Return the names of all installed simulations, sorted."""
    return tuple(sorted({entry.name for entry in metadata.entry_points(group=GROUP)}))


def resolve(spec: str, base_directory: Path) -> Simulation:
    """
    Find a simulation.

    Args:
        spec: A registered name, module:attribute, or ./file.py:attribute.
        base_directory: Folder of the scenario; files are found from here.

    Raises:
        PluginError: There is no such simulation, its file does not load, or its descriptor is faulty.
        MissingExtraError: It needs an optional dependency that is not installed.
    """
    if ":" in spec:
        where = spec
    else:
        entries = {entry.name: entry.value for entry in metadata.entry_points(group=GROUP)}
        if spec not in entries:
            raise PluginError(_unknown_name(spec, sorted(entries), base_directory))
        where = entries[spec]
    module, attribute = _load_module_of(where, base_directory)
    descriptor = _attribute(module, attribute, where)
    return _checked(descriptor, where, module)


def load_half(descriptor: Simulation, role: Role, base_directory: Path) -> Callable[[], Any]:
    """
    Import one half of a simulation and return its class, made without arguments.

    Raises:
        PluginError: It cannot be found or lacks a method of its contract.
        MissingExtraError: It needs an optional dependency that is not installed.
    """
    where = descriptor.host if role == "host" else descriptor.agent
    if where is None:
        return IdleHost
    module, attribute = _load_module_of(where, base_directory)
    half = _attribute(module, attribute, where)
    faults = _contract_faults(half, role)
    if faults:
        raise PluginError(f"{_told(where, half)}: {'; '.join(faults)}")
    return half  # type: ignore[no-any-return]


def load_function(where: str, base_directory: Path) -> Callable[..., Any]:
    """
    Import a descriptor's `demand` or `check`.

    Raises:
        PluginError: It cannot be found or is no function.
        MissingExtraError: It needs an optional dependency that is not installed.
    """
    module, attribute = _load_module_of(where, base_directory)
    function = _attribute(module, attribute, where)
    if not callable(function):
        raise PluginError(f"{_told(where)}: expected a function, got {type(function).__name__}")
    return function  # type: ignore[no-any-return]


def part_faults(descriptor: Simulation, base_directory: Path) -> list[str]:
    """
    Import every part that a descriptor names, and say what is wrong with each.

    For a file that somebody is writing just now: a registered simulation's parts are loaded when
    they are needed, as its host may import a large library.
    """
    faults = []
    for role in ("agent", "host"):
        faults += _fault_of(lambda role=role: load_half(descriptor, role, base_directory))  # type: ignore[misc]
    for where in (descriptor.demand, descriptor.check):
        if where is not None:
            faults += _fault_of(lambda where=where: load_function(where, base_directory))  # type: ignore[misc]
    return faults


def is_file(spec: str) -> bool:
    """Tell whether a spec names a file beside the scenario, and no installed module."""
    place = spec.rpartition(":")[0]
    return place.endswith(".py") or "/" in place


def parse_parameters(descriptor: Simulation, mapping: Mapping[str, Any]) -> Any:
    """
    Build the simulation's parameters from a plain mapping that was validated where the file was read.

    Raises:
        ConfigurationError: A name is unknown or missing, or a value has another type.
    """
    return from_mapping(descriptor.parameters, mapping, "parameters")


def _unknown_name(spec: str, known: list[str], base_directory: Path) -> str:
    text = f"no simulation named {spec!r}"
    close = difflib.get_close_matches(spec, known, n=1)
    if close:
        text += f", did you mean {close[0]}?"
    if spec.endswith(".py") or (base_directory / f"{spec}.py").is_file():
        path = spec if spec.endswith(".py") else f"{spec}.py"
        path = path if path.startswith((".", "/")) else f"./{path}"
        text += f"; a file's simulation is written {path}:simulation"
    return f"{text}; installed are {', '.join(known) or 'none'}"


def _load_module_of(where: str, base_directory: Path) -> tuple[ModuleType, str]:
    place, _, attribute = where.rpartition(":")
    if not place or not attribute.isidentifier():
        raise PluginError(f"{where!r}: expected module:attribute or ./file.py:attribute")
    if is_file(where):
        return _load_file(base_directory / place, where), attribute
    if place.startswith(MODULE_PREFIX) and place in sys.modules:
        return sys.modules[place], attribute
    return _load_module(place, where), attribute


def _load_module(name: str, where: str) -> ModuleType:
    try:
        with talk_on_stderr():
            return importlib.import_module(name)
    except ImportError as error:
        raise _translated(error, where) from error
    except (Exception, SystemExit) as error:  # a plug-in may raise anything while it is imported
        raise PluginError(f"{where}: {_last_place(error, name)}{said(error)}") from error


def _load_file(path: Path, where: str) -> ModuleType:
    path = path.resolve()
    name = module_name(path)
    if name in sys.modules:
        return sys.modules[name]
    if not path.is_file():
        raise PluginError(f"{where}: no file {path}")
    specification = importlib.util.spec_from_file_location(name, path)
    if specification is None or specification.loader is None:
        raise PluginError(f"{where}: expected a Python file ending in .py, got {path.name}")
    module = importlib.util.module_from_spec(specification)
    sys.modules[name] = module  # before it runs: its dataclasses look their module up by name
    try:
        with talk_on_stderr(), _neighbours_importable(path.parent):
            specification.loader.exec_module(module)
    except BaseException as error:
        del sys.modules[name]
        if isinstance(error, ImportError):
            raise _translated(error, f"{path}{_line_in(error, path)}") from error
        if isinstance(error, Exception | SystemExit):
            raise PluginError(f"{path}{_line_in(error, path)}: {said(error)}") from error
        raise
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
    digest = hashlib.blake2b(str(path.resolve()).encode(), digest_size=8).hexdigest()
    return f"{MODULE_PREFIX}{re.sub(r'[^0-9A-Za-z_]', '_', path.stem)}_{digest}"


def _translated(error: ImportError, where: str) -> PluginError | MissingExtraError:
    return missing_extra(error) or PluginError(f"{where}: {error}")


def _fault_of(load: Callable[[], object]) -> list[str]:
    try:
        load()
    except (PluginError, MissingExtraError) as error:
        return [str(error)]
    return []


def _told(where: str, thing: Any = None) -> str:
    """Return *where* as its writer knows it: of a file's part, its file and line instead of the module's name."""
    place, _, attribute = where.rpartition(":")
    module = sys.modules.get(place)
    if not place.startswith(MODULE_PREFIX) or module is None:
        return where
    file = str(module.__file__)
    if getattr(thing, "__module__", None) == place:
        return f"{place_of(thing)}: {attribute}"
    return f"{file}{_line_naming(file, attribute)}: {attribute}"


def _line_naming(file: str, attribute: str) -> str:
    """Return :LINE of the line that names a part as the descriptor does."""
    with contextlib.suppress(OSError, UnicodeDecodeError):
        for number, line in enumerate(Path(file).read_text(encoding="utf-8").splitlines(), 1):
            if f':{attribute}"' in line or f":{attribute}'" in line:
                return f":{number}"
    return ""


def _line_in(error: BaseException, path: Path) -> str:
    """Return :LINE of the last line of *path* that took part in *error*."""
    if isinstance(error, SyntaxError) and error.filename == str(path):
        return f":{error.lineno}"
    lines = [
        frame.lineno
        for frame in traceback.extract_tb(error.__traceback__)
        if frame.filename == str(path)
    ]
    return f":{lines[-1]}" if lines else ""


def _last_place(error: BaseException, module: str) -> str:
    frames = traceback.extract_tb(error.__traceback__)
    if isinstance(error, SyntaxError):
        return f"{error.filename}:{error.lineno}: "
    outside = [f for f in frames if "importlib" not in f.filename and f.filename != __file__]
    return f"{outside[-1].filename}:{outside[-1].lineno}: " if outside else f"{module}: "


def _attribute(module: ModuleType, name: str, where: str) -> Any:
    try:
        return getattr(module, name)
    except AttributeError:
        public = [key for key in vars(module) if not key.startswith("_")]
        close = difflib.get_close_matches(name, public, n=1)
        hint = f", did you mean {close[0]}?" if close else ""
        if where.startswith(MODULE_PREFIX):
            raise PluginError(f"{_told(where)}: there is no {name!r}{hint}") from None
        file = getattr(module, "__file__", None) or module.__name__
        raise PluginError(f"{where}: {file} has no {name!r}{hint}") from None


def _checked(descriptor: Any, where: str, module: ModuleType) -> Simulation:
    """Return the descriptor with `:Class` written out in full, or say what is wrong with it."""
    if not isinstance(descriptor, Simulation):
        raise PluginError(
            f"{where}: expected a madns_runtime.plugin.api.Simulation, got {type(descriptor).__name__}"
        )
    faults = []
    parameters: Any = descriptor.parameters
    if not (isinstance(parameters, type) and dataclasses.is_dataclass(parameters)):
        faults.append("parameters: expected a dataclass (the class itself)")
    parts: dict[str, Any] = {}
    for part in ("agent", "host", "demand", "check"):
        value = getattr(descriptor, part)
        if value is None and part != "agent":
            continue
        text = str(value)
        if ":" not in text:
            faults.append(f"{part}: expected 'module:name' or ':name', got {value!r}")
        elif text.startswith(":"):
            parts[part] = f"{module.__name__}{text}"
    if faults:
        raise PluginError(f"{where}: {'; '.join(faults)}")
    return dataclasses.replace(descriptor, **parts)


def _contract_faults(half: Any, role: Role) -> list[str]:
    contract: type = HostSimulation if role == "host" else AgentSimulation
    methods = HOST_METHODS if role == "host" else AGENT_METHODS
    if not isinstance(half, type):
        return [f"expected a class, got {type(half).__name__}"]
    faults = [f"no method {name}()" for name in methods if not callable(getattr(half, name, None))]
    if faults:
        faults.append(f"subclass {contract.__name__} to inherit what is not needed")
    for name in methods:
        method = getattr(half, name, None)
        if callable(method):
            faults += _signature_faults(name, method, getattr(contract, name))
    faults += _constructor_faults(half)
    return faults


def _signature_faults(
    name: str, method: Callable[..., Any], agreed: Callable[..., Any]
) -> list[str]:
    wanted = list(inspect.signature(agreed).parameters)
    try:
        inspect.signature(method).bind(*wanted)
    except TypeError:
        return [f"{name}() must take ({', '.join(wanted)})"]
    except ValueError:  # a method written in C tells no signature
        return []
    return []


def _constructor_faults(half: type) -> list[str]:
    try:
        inspect.signature(half).bind()
    except TypeError:
        return ["it must be made without arguments; take what it needs in setup()"]
    except ValueError:
        return []
    return []
