"""
Makes a machine ready for a run within a moment: its environment is checked, an edited file is sent.

What takes long, the environment, is `cosmos up`'s work and only looked at here; code and scenario files are
sent when they are not there yet, so that an edit of flight software needs no `up`.
"""

from __future__ import annotations

import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

from cosmos_cli.fleet.failure import FailureKind, MachineFailure
from cosmos_cli.fleet.helper import Helper
from cosmos_cli.fleet.layout import Layout, at_home
from cosmos_cli.fleet.target import Target
from cosmos_cli.models.device_needs import NO_NEEDS, MachineNeeds, needs_of_machines
from cosmos_cli.models.inventory import Machine, Variables
from cosmos_cli.models.loading import ScenarioFile
from cosmos_cli.provision.driver_files import DriverFiles, drivers_by_machine
from cosmos_cli.provision.environment import ask_installed, installed_request
from cosmos_cli.provision.trees import Tree, runtime_tree, scenario_tree, send_tree
from cosmos_cli.provision.wheelhouse import EnvironmentNeed, environment_key
from cosmos_cli.provision.wheels import with_own_wheels
from cosmos_cli.ui import invocation

BASE_VARIABLE = "COSMOS_BASE_DIRECTORY"
DRIVERS_VARIABLE = "COSMOS_DRIVER_DIRECTORY"


@dataclass(frozen=True, slots=True, kw_only=True)
class Ready:
    """Paths that a run's programs are started with on a machine; absolute ones there."""

    python: str
    python_path: str
    """PYTHONPATH: the runtime."""
    base_directory: str
    """Folder of the scenario's files."""
    driver_directory: str = ""
    """Folder from which drivers beside the inventory are found; "" if the machine has none of them."""

    def variables(self) -> dict[str, str]:
        """
        Return the environment variables that the programs of a run must be started with.

        COSMOS_BASE_DIRECTORY and COSMOS_DRIVER_DIRECTORY tell everybody there that these files are in use, so
        that no `cosmos up` removes them under a run.
        """
        found = {
            "PYTHONPATH": self.python_path,
            "PYTHONNOUSERSITE": "1",
            BASE_VARIABLE: self.base_directory,
        }
        return found | ({DRIVERS_VARIABLE: self.driver_directory} if self.driver_directory else {})


@dataclass(frozen=True, slots=True, kw_only=True)
class Cargo:
    """Everything that each machine of a run is to have; made once for all of them by `cargo_of`."""

    scenario_path: str
    requirements: tuple[str, ...]
    runtime: Tree
    scenario: Tree
    needs: Mapping[str, MachineNeeds] = field(default_factory=dict)
    """Needs of the devices, by machine."""
    drivers: Mapping[str, DriverFiles] = field(default_factory=dict)
    """Files of devices' drivers beside the inventory, by machine."""

    def trees(self, machine: str) -> tuple[Tree, ...]:
        """Return all that a machine is sent."""
        own = (self.drivers[machine].tree,) if machine in self.drivers else ()
        return (self.runtime, self.scenario, *own)


def cargo_of(
    scenario_file: ScenarioFile,
    machines: Sequence[Machine] = (),
    say: Callable[[str], None] = lambda text: None,
) -> Cargo:
    """
    Return what the machines of a run must have.

    Args:
        scenario_file: What is run.
        machines: Where.
        say: Told what takes long on this computer.

    Raises:
        InputError: The scenario's folder is too large, has a link that leads outside, or no wheel can be had
            of what it requires by path.
    """
    needs = needs_of_machines(machines, scenario_file)
    return Cargo(
        needs=needs,
        drivers=drivers_by_machine(machines, needs.__getitem__, [scenario_file.base_directory]),
        scenario_path=str(scenario_file.path),
        requirements=with_own_wheels(
            scenario_file.scenario.requirements, scenario_file.base_directory, say
        ),
        runtime=runtime_tree(),
        scenario=scenario_tree(scenario_file),
    )


def make_ready(
    helper: Helper,
    target: Target,
    cargo: Cargo,
    *,
    machine: Machine | None = None,
    is_host: bool = False,
) -> Ready:
    """
    See that a machine has what a run needs, and send what is quick to send.

    Args:
        helper: Started on it with `cosmos_cli.provision.STORE_PARTS`.
        target: The machine.
        cargo: What is run.
        machine: Its entry in the inventory, for its own requirements.
        is_host: Whether the host runs there.

    Raises:
        MachineFailure: Its environment is not there or damaged, the advice is the command that makes it; or as `send_tree`.
    """
    layout = Layout(at_home(target.root, str(helper.greeting["home"])))
    key = environment_key_of(helper, cargo, machine, is_host=is_host)
    trees = cargo.trees(target.name)
    found = ask_installed(
        helper,
        installed_request(
            layout,
            trees=[tree.hash for tree in trees],
            environments=[key],
            touch=True,
        ),
    )
    machines = invocation.current().machine_options
    as_host = f" --host {target.name}" if is_host else ""
    up = f"`cosmos up{machines}{as_host} {shlex.quote(cargo.scenario_path)}`"
    if not found.environments[key]:
        raise MachineFailure(
            FailureKind.STEP,
            "the Python packages that the run needs are not installed there, or no longer whole",
            f"run {up} first",
        )
    for tree in trees:
        if not found.trees[tree.hash]:
            _send(helper, layout, tree, up)
    drivers = cargo.drivers.get(target.name)
    return Ready(
        python=layout.python(key),
        python_path=layout.tree(cargo.runtime.hash),
        base_directory=layout.tree(cargo.scenario.hash),
        driver_directory=drivers.directory(layout.tree(drivers.tree.hash)) if drivers else "",
    )


def _send(helper: Helper, layout: Layout, tree: Tree, up: str) -> None:
    """Send a tree; where no room is left for it, the advice is the command that makes some."""
    try:
        send_tree(helper, layout, tree)
    except MachineFailure as failure:
        if failure.kind is not FailureKind.DISK_FULL:
            raise
        advice = f"run {up}, which removes code of earlier runs there, or make room"
        raise MachineFailure(failure.kind, f"{tree.label}: {failure.text}", advice) from None


def environment_key_of(
    helper: Helper, cargo: Cargo, machine: Machine | None, *, is_host: bool
) -> str:
    """Return the key of the environment that a machine must have for a run."""
    variables = machine.variables if machine is not None else Variables()
    needs = cargo.needs.get(machine.name, NO_NEEDS) if machine is not None else NO_NEEDS
    return environment_key(
        EnvironmentNeed.of_machine(
            helper.greeting, variables, cargo.requirements, is_host=is_host, needs=needs
        )
    )
