"""Devices of a machine, as `cosmos_devices` of an inventory lists them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Final

from annotated_types import Ge, Gt, Le

from cosmos_cli.errors import Fault
from cosmos_cli.models.device_kinds import DeviceQuestion, ask_kinds
from cosmos_cli.models.document import Document
from cosmos_cli.models.document import Path as ValuePath
from cosmos_cli.models.text_forms import DeviceName, NonBlank
from madns_runtime.config import RATE_HZ_MAX
from madns_runtime.hardware.kind_registry import registered_kinds
from madns_runtime.plain_values import FORBID_EXTRA

DEVICES: Final = "cosmos_devices"


@dataclass(frozen=True, slots=True, kw_only=True)
class MachineDevice:
    """One device that hangs on a machine; a bare name stands for a device of the kind of that name, or is a label."""

    __pydantic_config__ = FORBID_EXTRA

    name: DeviceName
    """Name by which scenarios know it, such as imu."""
    kind: NonBlank
    """Registered kind (`cosmos devices` lists them), module:NAME, or ./file.py:NAME beside the inventory."""
    rate_hz: Annotated[float, Gt(0), Le(RATE_HZ_MAX)] | None = None
    """Rate at which it is read, Hz; the kind's own if not given."""
    serial: str = ""
    """Identity that it must have, as `cosmos devices test` shows it: another device in its place is a fault."""
    outputs: bool = False
    """Whether a scenario that is armed may move its outputs."""
    hang_s: Annotated[float, Ge(0.1), Le(3600)] = 15.0
    """A device that says nothing for so long is given up: its process is killed and started anew."""
    frozen_s: dict[str, Annotated[float, Gt(0)]] = field(default_factory=dict)
    """By input: one that has not changed, or not come, for so many seconds is frozen."""
    parameters: dict[str, Any] = field(default_factory=dict)
    """The kind's own."""


def driven_devices(listed: Iterable[str | MachineDevice]) -> dict[str, MachineDevice]:
    """Return the devices that can be driven, by name: those with a kind, and bare names that are one."""
    kinds = registered_kinds()
    found = [
        MachineDevice(name=each, kind=each) if isinstance(each, str) and each in kinds else each
        for each in listed
    ]
    return {each.name: each for each in found if isinstance(each, MachineDevice)}


def device_words(listed: Iterable[str | MachineDevice]) -> set[str]:
    """Return all by which a rule finds a machine's devices: names, kinds and labels."""
    words = set()
    for each in listed:
        words |= {each} if isinstance(each, str) else {each.name, each.kind}
    return words


def device_label(device: str | MachineDevice) -> str:
    """Return how a device is listed: a label, or its name with its kind."""
    if isinstance(device, str) or device.name == device.kind:
        return device if isinstance(device, str) else device.name
    return f"{device.name} ({device.kind})"


def device_kind_faults(
    document: Document, path: ValuePath, listed: Any, folder: Path
) -> list[Fault]:
    """
    Return what kinds find wrong with the devices of `cosmos_devices`, and names that are listed twice.

    Args:
        document: The inventory.
        path: Of the list.
        listed: As it is written, and of the right form; None where there is none.
        folder: The inventory's, from which files are found.
    """
    faults = []
    seen: dict[str, bool] = {}
    """Whether a mapping has said what the device is, by name: labels alone may come again."""
    questions = []
    for index, each in enumerate(listed or ()):
        is_label = isinstance(each, str)
        name = each if is_label else each["name"]
        if name in seen and (seen[name] or not is_label):
            faults.append(document.fault((*path, index), f"{name} is listed already"))
        seen[name] = seen.get(name, False) or not is_label
        if not is_label:
            parameters = each.get("parameters") or {}
            questions.append(
                DeviceQuestion(
                    path=(*path, index),
                    kind=each["kind"],
                    parameters=parameters,
                    base_directory=folder.absolute(),
                )
            )
    # Files of parameters may be the machine's own: channels are asked for when a run is planned.
    answers = ask_kinds(questions, document, is_whole=False)
    return faults + [fault for answer in answers for fault in answer.faults]
