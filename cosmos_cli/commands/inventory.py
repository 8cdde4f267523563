"""`cosmos inventory`: show the machines that an inventory means."""

from __future__ import annotations

from cosmos_cli.commands.fleet_command import InventoryOption, LimitOption
from cosmos_cli.models.inventory import Machine, load_machines
from cosmos_cli.models.inventory.devices import device_label
from cosmos_cli.ui.console import Column, Console, JsonOption
from cosmos_cli.ui.plural import counted

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
    # The variables are those that Ansible sees.
    shown = [{"name": m.name, "groups": m.groups, "vars": dict(m.raw_variables)} for m in machines]
    console.print_json({"machines": shown})


def _row(machine: Machine) -> tuple[str, ...]:
    variables = machine.variables
    port = f":{variables.port}" if variables.port else ""
    return (
        machine.name,
        f"[{machine.address}]{port}" if port and ":" in machine.address else machine.address + port,
        machine.connection,
        variables.user or "",
        ", ".join(machine.groups),
        ", ".join(map(device_label, variables.cosmos_devices or ())),
    )
