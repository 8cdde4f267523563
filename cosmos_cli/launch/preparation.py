"""Preparation of a run on several machines: they are reached, and each is told its own."""

from __future__ import annotations

import dataclasses
import ipaddress
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from cosmos_cli.errors import InputError
from cosmos_cli.evidence.run_directory import RunDirectory
from cosmos_cli.fleet.connection import Connection, ConnectOptions, address_here
from cosmos_cli.fleet.failure import MachineFailure
from cosmos_cli.fleet.helper import Helper
from cosmos_cli.fleet.ssh.link_local import address_from
from cosmos_cli.fleet.target import Target, target_of
from cosmos_cli.launch.machines import Connect, Prepared, RemoteMachine, reach_machines
from cosmos_cli.launch.plan import LaunchPlan
from cosmos_cli.launch.request import MachineConfig
from cosmos_cli.models.inventory import Machine
from cosmos_cli.models.loading import ScenarioFile
from cosmos_cli.models.yaml_source import yaml_text
from cosmos_cli.provision import STORE_PARTS
from cosmos_cli.system.import_turn import IMPORT_TURN
from cosmos_cli.ui.plural import counted
from madns_runtime.config import RunConfig

ANY_ADDRESSES = ("0.0.0.0", "::", "")
LOOPBACK = "127.0.0.1"
KEPT_PREFIXES = ("ansible_", "cosmos_")
LEFT_OUT = ("cosmos_provision", "cosmos_devices")
"""May hold the content of files, which is nobody's business in a run directory, or name files beside the inventory."""
INVENTORY_HEAD = "# The machines of this run, with what was said of them where they were listed.\n"


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
    if not plan.elsewhere:
        return {}
    # Imported late: a run on this computer alone needs none of it.
    with IMPORT_TURN:
        from cosmos_cli.fleet.open_connection import connect
        from cosmos_cli.provision.before_run import cargo_of, make_ready

    cargo = cargo_of(scenario, plan.elsewhere, say)
    host = plan.host.name if plan.host else None

    def prepare(target: Target, board: Helper) -> Prepared:
        return make_ready(
            board,
            target,
            cargo,
            machine=plan.involved[target.name],
            is_host=target.name == host,
        )

    say(f"reaching {counted(len(plan.elsewhere), 'machine')}")
    return reach_machines(
        [target_of(machine) for machine in plan.elsewhere],
        prepare,
        parts=STORE_PARTS,
        options=options,
        connect=with_address(connect, plan, scenario.run_config("")),
        forks=forks,
        say=say,
    )


def with_address(connect: Connect, plan: LaunchPlan, config: RunConfig) -> Connect:
    """Return what connects as *connect* does, and fails where it is not known how a machine reaches a host here."""

    def connect_and_see(target: Target, options: ConnectOptions) -> Connection:
        connection = connect(target, options)
        try:
            address_here(connection, plan.involved[target.name].variables.cosmos_host_address)
        except MachineFailure:
            connection.close()
            raise
        return connection

    return connect if plan.host is not None or says_address(config) else connect_and_see


def places_of(
    plan: LaunchPlan,
    remote: Mapping[str, RemoteMachine],
    config: RunConfig,
    *,
    run: RunDirectory,
    session_hex: str,
) -> dict[str, MachineConfig]:
    """
    Return what each machine is told differently, by name.

    Raises:
        InputError: It is not known how one of them reaches the host.
    """
    host = remote.get(plan.host.name) if plan.host else None
    return {
        name: MachineConfig(
            directory=(
                remote[name].directory_of(run.name, session_hex)
                if name in remote
                else str(run.path)
            ),
            base_directory=remote[name].paths.base_directory if name in remote else None,
            driver_directory=remote[name].paths.driver_directory if name in remote else "",
            cpu_affinity=machine.variables.cosmos_cpu_affinity or (),
            host_address=(
                _host_address(machine, remote.get(name), host, config) if remote else None
            ),
        )
        for name, machine in plan.involved.items()
    }


def _host_address(
    machine: Machine, here: RemoteMachine | None, host: RemoteMachine | None, config: RunConfig
) -> str:
    """
    Return how a machine reaches the host: as its inventory says, else as the connections show.

    Raises:
        InputError: They show an address of the host that means nothing on the machine.
    """
    if machine.variables.cosmos_host_address is not None:
        return machine.variables.cosmos_host_address
    if says_address(config):
        return config.network.address
    if here is host:  # both on that machine, or both on this computer
        return LOOPBACK
    if host is not None:
        peer = host.connection.peer_address
        if here is None:
            return peer
        own, at = here.connection.own_address, here.connection.peer_address
        if (address := address_from(peer, own=own, at=at)) is None:
            raise InputError(
                f"{host.name}, which runs the host, is reached here by a link-local address, {peer}, and it is not known"
                f" by which interface {machine.name} does: set cosmos_host_address of {machine.name}, or have"
                f" ansible_host of {host.name} name an address of IPv4"
            )
        return address
    assert here is not None
    return here.connection.own_address


def host_config(config: RunConfig, places: Mapping[str, MachineConfig]) -> RunConfig:
    """Return the run's configuration with an address that all of *places* can reach."""
    addresses = [place.host_address for place in places.values() if place.host_address]
    return listening_config(config, addresses) if addresses else config


def listening_config(config: RunConfig, reached_by: Iterable[str]) -> RunConfig:
    """
    Return the configuration of a host that other machines must reach.

    A scenario that names an address means it. One that does not, or names the loopback, which no other
    machine could reach, has the host listen on all.

    Args:
        config: The run's.
        reached_by: Addresses by which agents will reach the host.
    """
    if says_address(config):
        return config
    is_six = any(":" in address for address in reached_by)
    network = dataclasses.replace(config.network, address="::" if is_six else "0.0.0.0")
    return dataclasses.replace(config, network=network)


def says_address(config: RunConfig) -> bool:
    """Tell whether the scenario names an address that other machines can be told."""
    address = config.network.address
    if address in ANY_ADDRESSES:
        return False
    try:
        return not ipaddress.ip_address(address).is_loopback
    except ValueError:
        return address != "localhost"


def plan_mapping(
    plan: LaunchPlan, places: Mapping[str, MachineConfig], session_hex: str, *, is_detached: bool
) -> dict[str, Any]:
    """Return plan.json but for the configuration: enough to find every machine's part of the run again."""
    mapping = plan.to_mapping()
    for planned in plan.elsewhere:
        directory = {"directory": places[planned.name].directory}
        if planned.name in mapping["machines"]:
            mapping["machines"][planned.name] |= directory
        if plan.host is not None and planned.name == plan.host.name:
            mapping["host"] |= directory
    return {**mapping, "session": session_hex, "is_detached": is_detached}


def inventory_text(plan: LaunchPlan) -> str:
    """Return the machines of a run as an inventory of their own, groups resolved."""
    hosts = {name: _kept(machine.raw_variables) for name, machine in plan.involved.items()}
    text = yaml_text({"all": {"hosts": hosts}})
    return INVENTORY_HEAD + text


def _kept(variables: Mapping[str, Any]) -> dict[str, Any]:
    return {
        name: value
        for name, value in variables.items()
        if name.startswith(KEPT_PREFIXES) and name not in LEFT_OUT
    }
