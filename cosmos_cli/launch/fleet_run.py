"""What a run on several machines needs before it starts: they are reached, and each is told its own."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import yaml

from cosmos_cli.counted import counted
from cosmos_cli.fleet.connection import ConnectOptions
from cosmos_cli.fleet.target import Target, target_of
from cosmos_cli.launch.machines import Prepare, RemoteMachine, reach_machines
from cosmos_cli.launch.places import LOOPBACK, Place, listening_config, says_address
from cosmos_cli.models.inventory import Machine
from cosmos_cli.models.loading import ScenarioFile
from cosmos_cli.plan import LaunchPlan
from madns_runtime.config import RunConfig

if TYPE_CHECKING:
    from cosmos_cli.rundir import RunDirectory

KEPT_PREFIXES = ("ansible_", "cosmos_")
LEFT_OUT = ("cosmos_provision",)
"""May hold the content of files, which is nobody's business in a run directory."""
INVENTORY_HEAD = "# The machines of this run, with what was said of them where they were listed.\n"


def remote_machines(plan: LaunchPlan) -> tuple[Machine, ...]:
    """Return the machines of a plan that are other computers, the host's among them."""
    machines = {planned.name: planned.machine for planned in plan.machines}
    if plan.host is not None:
        machines.setdefault(plan.host.name, plan.host)
    return tuple(machine for machine in machines.values() if machine.connection != "local")


def reach(
    plan: LaunchPlan,
    scenario: ScenarioFile,
    *,
    options: ConnectOptions,
    forks: int,
    say: Callable[[str], None],
) -> dict[str, RemoteMachine]:
    """
    Connect to every other computer of a plan, and see that it has what the run needs.

    Raises:
        MachinesError: Some failed, each is named; nothing was started.
        InputError: The scenario's folder cannot be sent.
    """
    machines = remote_machines(plan)
    if not machines:
        return {}
    # Imported late: a run on this computer alone needs none of it.
    from cosmos_cli.fleet.connect import connect
    from cosmos_cli.provision.environment import PARTS
    from cosmos_cli.provision.ready import cargo_of, make_ready

    cargo = cargo_of(scenario)
    by_name = {machine.name: machine for machine in machines}
    host = plan.host.name if plan.host else None

    def prepare_of(target: Target) -> Prepare:
        return lambda connection, board: make_ready(
            connection,
            board,
            target,
            cargo,
            machine=by_name[target.name],
            is_host=target.name == host,
        )

    say(f"reaching {counted(len(machines), 'machine')}")
    return reach_machines(
        [target_of(machine) for machine in machines],
        prepare_of,
        parts=PARTS,
        options=options,
        connect=connect,
        forks=forks,
    )


def places_of(
    plan: LaunchPlan,
    remote: Mapping[str, RemoteMachine],
    config: RunConfig,
    *,
    run: RunDirectory,
    session_hex: str,
) -> dict[str, Place]:
    """Return what each machine is told differently, by name."""
    machines = {planned.name: planned.machine for planned in plan.machines}
    if plan.host is not None:
        machines.setdefault(plan.host.name, plan.host)
    host = remote.get(plan.host.name) if plan.host else None
    return {
        name: Place(
            directory=(
                remote[name].directory_of(run.name, session_hex)
                if name in remote
                else str(run.path)
            ),
            base_directory=remote[name].paths.base_directory if name in remote else None,
            cpu_affinity=machine.cpu_affinity,
            host_address=(
                _host_address(machine, remote.get(name), host, config) if remote else None
            ),
        )
        for name, machine in machines.items()
    }


def _host_address(
    machine: Machine, here: RemoteMachine | None, host: RemoteMachine | None, config: RunConfig
) -> str:
    """Return how a machine reaches the host: as its inventory says, else as the connections show."""
    if machine.host_address is not None:
        return machine.host_address
    if says_address(config):
        return config.network.address
    if here is host:  # both on that machine, or both on this computer
        return LOOPBACK
    if host is not None:
        return host.connection.peer_address
    assert here is not None
    return here.connection.own_address


def host_config(config: RunConfig, places: Mapping[str, Place]) -> RunConfig:
    """Return the run's configuration with an address that all of *places* can reach."""
    addresses = [place.host_address for place in places.values() if place.host_address]
    return listening_config(config, addresses) if addresses else config


def plan_mapping(
    plan: LaunchPlan, places: Mapping[str, Place], session_hex: str, *, is_detached: bool
) -> dict[str, Any]:
    """Return plan.json but for the configuration: enough to find every machine's part of the run again."""
    mapping = plan.to_mapping()
    for planned in remote_machines(plan):
        directory = {"directory": places[planned.name].directory}
        if planned.name in mapping["machines"]:
            mapping["machines"][planned.name] |= directory
        if plan.host is not None and planned.name == plan.host.name:
            mapping["host"] |= directory
    return {**mapping, "session": session_hex, "is_detached": is_detached}


def inventory_text(plan: LaunchPlan) -> str:
    """Return the machines of a run as an inventory of their own, groups resolved."""
    machines = {planned.name: planned.machine for planned in plan.machines}
    if plan.host is not None:
        machines.setdefault(plan.host.name, plan.host)
    hosts = {name: _kept(machine.variables) for name, machine in machines.items()}
    text = yaml.safe_dump({"all": {"hosts": hosts}}, sort_keys=False, allow_unicode=True)
    return INVENTORY_HEAD + text


def _kept(variables: Mapping[str, Any]) -> dict[str, Any]:
    return {
        name: value
        for name, value in variables.items()
        if name.startswith(KEPT_PREFIXES) and name not in LEFT_OUT
    }
