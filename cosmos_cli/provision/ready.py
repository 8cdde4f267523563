"""
Makes a machine ready for a run within a moment: its environment is checked, an edited file is sent.

What takes long, the environment, is `cosmos up`'s work and only looked at here; code and scenario files are
sent when they are not there yet, so that an edit of flight software needs no `up`.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import PurePosixPath

from cosmos_cli.fleet.board import Board
from cosmos_cli.fleet.connection import Connection
from cosmos_cli.fleet.failure import FailureKind, MachineFailure
from cosmos_cli.fleet.layout import Layout
from cosmos_cli.fleet.target import Target
from cosmos_cli.models.inventory import Machine
from cosmos_cli.models.loading import ScenarioFile
from cosmos_cli.provision.environment import ask_installed, installed_request
from cosmos_cli.provision.platform import greeted_platform
from cosmos_cli.provision.trees import Tree, runtime_tree, scenario_tree, send_tree
from cosmos_cli.provision.wheelhouse import environment_key, sees_system_packages

BASE_VARIABLE = "COSMOS_BASE_DIRECTORY"


@dataclass(frozen=True, slots=True, kw_only=True)
class Ready:
    """What a run's programs are started with on a machine; absolute paths there."""

    python: str
    python_path: str
    """PYTHONPATH: the runtime."""
    base_directory: str
    """Where the scenario's files are."""

    def variables(self) -> dict[str, str]:
        """
        Return the environment variables that the programs of a run must be started with.

        COSMOS_BASE_DIRECTORY tells everybody there that the scenario's files are in use, so that no `cosmos up`
        removes them under a run.
        """
        return {
            "PYTHONPATH": self.python_path,
            "PYTHONNOUSERSITE": "1",
            BASE_VARIABLE: self.base_directory,
        }


@dataclass(frozen=True, slots=True, kw_only=True)
class Cargo:
    """What every machine of a run is to have; made once for all of them by `cargo_of`."""

    scenario_path: str
    requirements: tuple[str, ...]
    runtime: Tree
    scenario: Tree


def cargo_of(scenario_file: ScenarioFile) -> Cargo:
    """
    Return what the machines of a run must have.

    Raises:
        InputError: The scenario's folder is too large, or has a link that leads outside.
    """
    return Cargo(
        scenario_path=str(scenario_file.path),
        requirements=tuple(scenario_file.scenario.requirements),
        runtime=runtime_tree(),
        scenario=scenario_tree(scenario_file),
    )


def make_ready(  # noqa: PLR0913 - which machine, and what of; all but the first four by name
    connection: Connection,
    board: Board,
    target: Target,
    scenario: ScenarioFile | Cargo,
    *,
    machine: Machine | None = None,
    is_host: bool = False,
) -> Ready:
    """
    See that a machine has what a run needs, and send what is quick to send.

    Args:
        connection: To the machine.
        board: Started on it with `cosmos_cli.provision.environment.PARTS`.
        target: The machine.
        scenario: What is run; a `Cargo` saves reading the files once a machine.
        machine: Its entry in the inventory, for its own requirements.
        is_host: Whether the host runs there.

    Raises:
        MachineFailure: Its environment is not there or damaged; the advice is the command that makes it.
    """
    if target.connection == "local" and isinstance(scenario, ScenarioFile):
        return Ready(
            python=sys.executable, python_path="", base_directory=str(scenario.base_directory)
        )
    cargo = scenario if isinstance(scenario, Cargo) else cargo_of(scenario)
    layout = Layout(_absolute_root(target.root, board.greeting))
    key = _environment_key(board, cargo, machine, is_host=is_host)
    trees = (cargo.runtime, cargo.scenario)
    found = ask_installed(
        board,
        installed_request(
            layout,
            trees=[tree.hash for tree in trees],
            environments=[key],
            touch=True,
        ),
    )
    if not found.environments[key]:
        as_host = f" --host {target.name}" if is_host else ""
        raise MachineFailure(
            FailureKind.STEP,
            "the Python packages that the run needs are not installed there, or no longer whole",
            f"run `cosmos up -i INVENTORY{as_host} {cargo.scenario_path}` first",
        )
    for tree in trees:
        if not found.trees[tree.hash]:
            send_tree(board, layout, tree)
    return Ready(
        python=layout.python(key),
        python_path=layout.tree(cargo.runtime.hash),
        base_directory=layout.tree(cargo.scenario.hash),
    )


def _environment_key(board: Board, cargo: Cargo, machine: Machine | None, *, is_host: bool) -> str:
    own = machine.requirements if machine is not None else ()
    packages = machine.packages if machine is not None else ()
    return environment_key(
        greeted_platform(board.greeting),
        (*own, *cargo.requirements),
        is_host=is_host,
        sees_system=sees_system_packages(packages),
    )


def _absolute_root(root: str, greeting: Mapping[str, object]) -> str:
    """Return the folder of COSMoS there with ~ replaced: variables and plans know no ~."""
    home = str(greeting["home"])
    path = PurePosixPath(root)
    return str(PurePosixPath(home, *path.parts[1:])) if path.parts[:1] == ("~",) else str(path)
