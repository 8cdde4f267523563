"""
Steps for a machine's devices, in the terms of `cosmos_provision`: groups, and lines of the boot configuration. Pure.

System packages and Python requirements of devices go with everybody else's.
"""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Sequence
from typing import Any

from cosmos_cli.models.device_needs import MachineNeeds, line_pattern
from cosmos_cli.models.machine_facts import MachineFacts, SystemPaths
from cosmos_cli.models.provision_steps import LineInFile, ProvisionStep, ShellCommand
from cosmos_cli.provision.inventory_steps import DeclaredStep
from cosmos_cli.provision.step import Done
from cosmos_cli.ui import invocation


def membership(group: str) -> dict[str, Any]:
    """
    Return the condition that who logs in is a member of a group, by the machine's own list: a login may be older.

    It is asked again beside the step, by root then, whom sudo tells who became it.
    """
    return {
        "unless": f'id -nG "${{SUDO_USER:-$(id -un)}}" | tr " " "\\n" | grep -qxF -- {shlex.quote(group)}',
        "root": False,
    }


def device_steps(
    facts: MachineFacts, needs: MachineNeeds, paths: SystemPaths
) -> Iterator[DeclaredStep]:
    """
    Yield what a machine's devices need of its groups and its boot configuration, done or not.

    Root needs no group; a machine without a config.txt is no Raspberry Pi (`boot_notes` tells).
    """
    for group, devices in needs.groups.items() if facts.uid != 0 else ():
        condition = membership(group)
        run = f"usermod -aG {shlex.quote(group)} {shlex.quote(facts.user)}"
        command = ShellCommand(run=run, unless=condition["unless"])
        step = ProvisionStep(name=_for(devices), command=command)
        yield DeclaredStep(step=step, condition=condition)
    path = _configuration(facts, paths)
    for line, devices in needs.boot_lines.items() if path else ():
        edit = LineInFile(path=path, line=line, regexp=line_pattern(line))
        yield DeclaredStep(step=ProvisionStep(name=_for(devices), line=edit), path=path)


def boot_notes(facts: MachineFacts, needs: MachineNeeds, paths: SystemPaths) -> Iterator[str]:
    """Yield a note where lines of a boot configuration are wanted, and there is none."""
    if needs.boot_lines and not _configuration(facts, paths):
        devices = dict.fromkeys(name for names in needs.boot_lines.values() for name in names)
        lines = ", ".join(needs.boot_lines)
        yield (
            f"{', '.join(devices)}: on a Raspberry Pi config.txt would say {lines}; there is none in"
            f" {paths.boot}: see to it in this system's own way"
        )


def reboot_notes(done: Sequence[Done], paths: SystemPaths) -> Iterator[str]:
    """Yield a note if a machine's boot configuration was changed; the same for all machines of a command."""
    machines = invocation.current().machine_options
    for path in paths.boot_configurations:
        if any(
            each.changed and each.step.change and each.step.change.path == path for each in done
        ):
            yield f"{path} was changed, which counts from its next start on: `cosmos reboot{machines}`"


def _configuration(facts: MachineFacts, paths: SystemPaths) -> str:
    """Return the machine's config.txt; "" if there is none."""
    found = (each for each in paths.boot_configurations if facts.file(each).kind != "missing")
    return next(found, "")


def _for(devices: Sequence[str]) -> str:
    return f"for the device {', '.join(devices)}"
