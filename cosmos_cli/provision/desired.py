"""Desired state of a machine: from its entry in the inventory, the scenarios, and what was built for it. Pure."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from cosmos_cli.fleet.layout import Layout, at_home
from cosmos_cli.models.device_needs import NO_NEEDS, MachineNeeds
from cosmos_cli.models.inventory import Variables
from cosmos_cli.models.inventory.settings import setting_files
from cosmos_cli.models.machine_facts import SystemPaths, condition_key
from cosmos_cli.provision.device_steps import membership
from cosmos_cli.provision.inventory_steps import Content, DeclaredStep, declared_step, unit_of
from cosmos_cli.provision.trees import Tree
from cosmos_cli.provision.wheelhouse import Environment

MEMORY_FILE = "settings.json"
UNCHECKED_FILE = "unchecked"


@dataclass(frozen=True, slots=True, kw_only=True)
class DesiredState:
    """All that a machine should have and be."""

    layout: Layout
    """Its root has no ~ any more."""
    paths: SystemPaths = field(default_factory=SystemPaths)
    variables: Variables = field(default_factory=Variables)
    """Of the inventory: the settings, and whether anybody may become root."""
    needs: MachineNeeds = NO_NEEDS
    """Of its devices."""
    declared: tuple[DeclaredStep, ...] = ()
    environments: tuple[Environment, ...] = ()
    """One for each scenario, or one for the runtime alone."""
    trees: tuple[Tree, ...] = ()

    @property
    def packages(self) -> tuple[str, ...]:
        """System packages: the inventory's, those of its devices, then those of the environments."""
        distributed = (name for built in self.environments for name in built.distribution_packages)
        own = self.variables.cosmos_packages or ()
        return tuple(dict.fromkeys((*own, *self.needs.packages, *distributed)))

    @property
    def directories(self) -> tuple[str, ...]:
        """Folders that are to be there."""
        layout = self.layout
        return (
            layout.root,
            layout.state,
            layout.trees,
            layout.environments,
            layout.wheels,
            layout.runs,
        )

    @property
    def memory_path(self) -> str:
        """The file there that remembers what settings were before."""
        return f"{self.layout.state}/{MEMORY_FILE}"

    @property
    def unchecked_path(self) -> str:
        """The file there that names what was installed and not yet seen to work."""
        return f"{self.layout.state}/{UNCHECKED_FILE}"

    @property
    def distinct_environments(self) -> tuple[Environment, ...]:
        """Each environment once; most scenarios share one."""
        return tuple({each.key: each for each in self.environments}.values())

    @property
    def all_packages(self) -> tuple[str, ...]:
        """Every system package that any part of it names."""
        declared = (name for each in self.declared for name in each.step.packages or ())
        return tuple(dict.fromkeys((*self.packages, *declared)))


def desired_state(
    variables: Variables,
    *,
    home: str,
    read_file: Callable[[Path], Content],
    environments: tuple[Environment, ...],
    trees: tuple[Tree, ...],
) -> DesiredState:
    """
    Return what a machine should be like.

    Args:
        variables: Its own, of the inventory.
        home: Of who logs in there.
        read_file: Gives the content of a file here.
        environments: Built for it.
        trees: Code and scenarios.
    """
    return DesiredState(
        layout=Layout(at_home(variables.root, home)),
        variables=variables,
        declared=tuple(
            declared_step(step, variables, home, read_file)
            for step in variables.cosmos_provision or ()
        ),
        environments=environments,
        trees=trees,
    )


def questions(desired: DesiredState, *, has_texts: bool = False) -> dict[str, Any]:
    """
    Return the arguments of the verb "facts": what the plan needs to know.

    Args:
        desired: What the machine should be like.
        has_texts: Whether contents of files are wanted too, for --diff.
    """
    paths = desired.paths
    return {
        "root": desired.layout.root,
        "etc": paths.etc,
        "sys": paths.sys,
        "proc": paths.proc,
        "files": _files(desired, has_texts),
        "is_pam_asked": desired.variables.cosmos_realtime_priority is not None,
        "packages": list(desired.all_packages),
        "services": sorted(
            {d.step.service.name for d in desired.declared if d.step.service is not None}
        ),
        "units": sorted({unit for d in desired.declared if (unit := unit_of(d.path))}),
        "conditions": {
            condition_key(condition): condition
            for condition in (
                *(membership(group) for group in desired.needs.groups),
                *(d.condition for d in desired.declared if d.condition is not None),
            )
        },
    }


def _files(desired: DesiredState, has_texts: bool) -> dict[str, str]:
    """Return what must be known of each file, by path; of one that two ask about, what the later says."""
    declared = [each for each in desired.declared if each.path is not None]
    how = "text" if has_texts else "hash"
    boot = desired.paths.boot_configurations if desired.needs.boot_lines else ()
    return {
        **dict.fromkeys(desired.directories, "look"),
        **dict.fromkeys((*setting_files(desired.paths), desired.memory_path), "text"),
        desired.unchecked_path: "text",
        **{str(each.path): how for each in declared if each.content is not None},
        **{str(each.path): "text" for each in declared if each.content is None},
        **dict.fromkeys(boot, "text"),
    }
