"""`cosmos inventory`: show the machines that an inventory means."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cosmos_cli.console import Column, Console, JsonOption
from cosmos_cli.models.inventory import load_inventory

COLUMNS = (
    Column("machine"),
    Column("address"),
    Column("connection"),
    Column("user"),
    Column("groups"),
)


def inventory(
    file: Annotated[
        Path,
        typer.Option(
            "--inventory", "-i", metavar="FILE", envvar="COSMOS_INVENTORY", help="Inventory file."
        ),
    ],
    json: JsonOption = False,
) -> None:
    """Show the machines of an inventory, their addresses and their groups."""
    console = Console(json=json)
    machines = load_inventory(file)
    rows = [
        (
            machine.name,
            machine.address,
            machine.connection,
            str(machine.variables.get("ansible_user", "")),
            ", ".join(machine.groups),
        )
        for machine in machines
    ]
    console.table(COLUMNS, rows)
    console.data(f"{len(machines)} machine{'s' if len(machines) > 1 else ''}")
    console.print_json({"machines": [machine.to_mapping() for machine in machines]})
