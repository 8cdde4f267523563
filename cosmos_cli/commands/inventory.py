"""`cosmos inventory`: show the machines that an inventory means."""

from __future__ import annotations

from cosmos_cli.commands.fleet_options import InventoryOption, LimitOption
from cosmos_cli.console import Column, Console, JsonOption
from cosmos_cli.counted import counted
from cosmos_cli.models.inventory import Machine, load_machines

COLUMNS = (
    Column("machine"),
    Column("address"),
    Column("connection"),
    Column("user"),
    Column("groups"),
    Column("devices"),
)


def inventory(
    inventory: InventoryOption,
    limit: LimitOption = None,
    json: JsonOption = False,
) -> None:
    """Show the machines of an inventory, their addresses and their groups."""
    console = Console(json=json)
    machines = load_machines(inventory, limit)
    console.table(COLUMNS, [_row(machine) for machine in machines])
    console.data(counted(len(machines), "machine"))
    console.print_json({"machines": [_shown(machine) for machine in machines]})


def _row(machine: Machine) -> tuple[str, ...]:
    port = f":{machine.port}" if machine.port else ""
    return (
        machine.name,
        f"[{machine.address}]{port}" if port and ":" in machine.address else machine.address + port,
        machine.connection,
        machine.user or "",
        ", ".join(machine.groups),
        ", ".join(machine.devices),
    )


def _shown(machine: Machine) -> dict[str, object]:
    """Return what --json promises: the variables are those that Ansible sees."""
    return {
        "name": machine.name,
        "groups": list(machine.groups),
        "vars": dict(machine.variables),
    }
