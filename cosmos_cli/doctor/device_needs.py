"""Needs of a machine's devices that are missing there: the questions to it, and the meaning of its answers. Pure."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from cosmos_cli.models.device_needs import DeviceNeeds, MachineNeeds
from cosmos_cli.models.machine_facts import condition_key
from cosmos_cli.onboard.content_store import MARK
from cosmos_cli.onboard.dpkg import names_asked
from cosmos_cli.provision.device_steps import membership

UP = "`cosmos up -i INVENTORY`"
FIND_FILE = "import glob, sys; sys.exit(not glob.glob(sys.argv[1]))"
FIND_MODULE = "import importlib.util, sys; sys.exit(importlib.util.find_spec(sys.argv[1]) is None)"

Condition = Mapping[str, Any]


@dataclass(frozen=True, slots=True, kw_only=True)
class NeedQuestion:
    """One thing that a device needs, how a machine is asked for it, and what to tell where it is missing."""

    device: str
    conditions: tuple[Condition, ...]
    """Any of them will do."""
    found: str
    cure: str


def need_questions(
    machine: str,
    needs: MachineNeeds,
    *,
    greeting: Mapping[str, Any],
    environments: tuple[str, ...],
) -> tuple[NeedQuestion, ...]:
    """
    Return all that a machine is to be asked.

    Args:
        machine: Its name.
        needs: Of its devices.
        greeting: First words of its helper.
        environments: Folders there, of which one has the devices' Python packages; empty if none was ever prepared.
    """
    return tuple(
        NeedQuestion(
            device=f"{machine}/{each.device}", conditions=conditions, found=found, cure=cure
        )
        for each in needs.devices
        for conditions, found, cure in _items(each, greeting, environments)
    )


def _items(
    device: DeviceNeeds, greeting: Mapping[str, Any], environments: tuple[str, ...]
) -> Iterator[tuple[tuple[Condition, ...], str, str]]:
    needs, python = device.needs, str(greeting["executable"])
    for package in needs.packages:
        names = shlex.join(names_asked([package]))
        test = f"dpkg-query -W -f='${{db:Status-Status}}\\n' {names} | grep -qx installed"
        yield (_unless(test),), f"no package {package}", UP
    for group in needs.groups if greeting["uid"] else ():
        yield (membership(group),), f"who logs in is not in the group {group}", UP
    for pattern in needs.files:
        lines = ", ".join(needs.boot_lines)
        cure = f"{UP} writes {lines} into config.txt, then `cosmos reboot`" if lines else ""
        yield (
            (_python(python, FIND_FILE, pattern),),
            f"no file {pattern}",
            cure or "is it connected?",
        )
    for module in needs.system_modules:
        name = module.partition(".")[0]
        yield (_python(python, FIND_MODULE, name),), f"no Python module {module}", UP
    if needs.requirements:
        found = f"no environment with {', '.join(needs.requirements)}"
        marks = tuple({"creates": f"{path}/{MARK}"} for path in environments)
        yield marks, found, UP


def _unless(test: str) -> Condition:
    return {"unless": test, "root": False}


def _python(python: str, code: str, word: str) -> Condition:
    return _unless(shlex.join([python, "-c", code, word]))


def conditions_of(asked: tuple[NeedQuestion, ...]) -> dict[str, Condition]:
    """Return all conditions, each once, by its key."""
    return {condition_key(each): each for question in asked for each in question.conditions}


def missing_of(
    machine: str,
    needs: MachineNeeds,
    asked: tuple[NeedQuestion, ...],
    answers: Mapping[str, bool | None],
) -> list[dict[str, Any]]:
    """Return what the checks read: each device with what is missing, and its cure."""
    found: dict[str, list[dict[str, str]]] = {
        f"{machine}/{each.device}": (
            [{"found": each.fault, "cure": "mend it in the inventory or the scenario"}]
            if each.fault
            else []
        )
        for each in needs.devices
    }
    for question in asked:
        if not any(answers.get(condition_key(each)) for each in question.conditions):
            found[question.device].append({"found": question.found, "cure": question.cure})
    return [{"device": device, "missing": missing} for device, missing in found.items()]
