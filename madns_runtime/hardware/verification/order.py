"""Orders to verify a driver, and what came of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

from madns_runtime.errors import PluginError
from madns_runtime.hardware.contract import Device, DeviceKind
from madns_runtime.hardware.kind_registry import DeviceProgram, prepare
from madns_runtime.plugin.registry import load_object

STAND_IN: Final = "pty"
"""Of the parameter `port`: a pseudo-terminal stands in for the line, and sends frames, garbage, and nothing."""
PORT: Final = "port"
MEMORY_BYTES_MAX: Final = 4 << 20
SAFE_S_MAX: Final = 1.0
STEPS: Final = ("opening", "samples", "outputs", "process", "line")
STEP_S_MAX: Final = 60.0
"""For one process of the verification."""


@dataclass(frozen=True, slots=True, kw_only=True)
class VerificationOrder:
    """A driver to verify, and how."""

    kind: str
    """Registered kind, module:NAME, ./file.py:NAME, or ./file.py that holds one Device class."""
    parameters: Mapping[str, Any] = field(default_factory=dict)
    directory: str = "."
    """Folder from which files are found."""
    rate_hz: float | None = None
    """None for the kind's own."""
    may_write: bool = False
    """Whether outputs may move; those of kinds that need no hardware, and of stand-ins, always do."""
    cycles: int = 100
    sampling_s: float = 2.0
    """For so long samples are looked at."""
    steps: tuple[str, ...] = STEPS
    """Parts that are looked at, beside the declaration."""


@dataclass(frozen=True, slots=True, kw_only=True)
class VerificationFinding:
    """One row of the table."""

    name: str
    passed: bool | None
    """None: not looked at; `got` says why."""
    got: str
    limit: str = ""


Findings = list[VerificationFinding]


def finding(name: str, passed: bool | None, got: str, limit: str = "") -> VerificationFinding:
    """Return one row of the table."""
    return VerificationFinding(name=name, passed=passed, got=got, limit=limit)


def spec_of(kind: str, directory: Path) -> str:
    """
    Return a kind as it is named everywhere else: a file alone with the name of its one Device class.

    Raises:
        PluginError: The file does not load, or holds none or several.
    """
    if ":" in kind or not kind.endswith(".py"):
        return kind
    module, _ = load_object(f"{kind}:__name__", directory)
    names = [
        name
        for name, found in vars(module).items()
        if isinstance(found, type)
        and issubclass(found, Device)
        and found.__module__ == module.__name__
        and isinstance(getattr(found, "kind", None), DeviceKind)
    ]
    if len(names) != 1:
        told = f"it has {', '.join(names)}: say which, as {kind}:NAME" if names else "it has none"
        raise PluginError(f"{kind}: expected one Device class with a kind; {told}")
    return f"{kind}:{names[0]}"


def has_stand_in(order: VerificationOrder) -> bool:
    """Tell whether a pseudo-terminal stands in for the device's line."""
    return order.parameters.get(PORT) == STAND_IN


def may_write(order: VerificationOrder, kind: DeviceKind) -> bool:
    """Tell whether outputs may move."""
    return order.may_write or not kind.needs_hardware or has_stand_in(order)


def make_program(order: VerificationOrder, port: str | None) -> DeviceProgram:
    """
    Return the driver that is to be verified, on *port* if there is one; what it makes knows whether its outputs may move.

    Raises:
        MadnsError: The kind cannot be found, or its parameters are wrong.
    """
    parameters = dict(order.parameters) if port is None else {**order.parameters, PORT: port}
    program = prepare(order.kind, parameters, Path(order.directory))

    def make() -> Device:
        device = program.make()
        device.may_move = may_write(order, program.kind)
        return device

    return replace(program, make=make)
