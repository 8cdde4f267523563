"""The options that every command which works on machines has."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cosmos_cli.errors import InputError
from cosmos_cli.fleet.fleet import Fleet, fleet_of
from cosmos_cli.fleet.pool import FORKS_DEFAULT

if TYPE_CHECKING:
    from cosmos_cli.models.inventory import Machine

__all__ = [
    "FORKS_DEFAULT",
    "TIMEOUT_S_MAX",
    "AcceptHostKeysOption",
    "Fleet",
    "ForksOption",
    "HostOption",
    "InventoryOption",
    "LimitOption",
    "SomeInventoryOption",
    "fleet_of",
    "some_machines",
]

TIMEOUT_S_MAX = 1e6
"""Of any --timeout, eleven days: the kernel's waits end at twenty-four."""

InventoryOption = Annotated[
    Path,
    typer.Option(
        "--inventory",
        "-i",
        metavar="FILE",
        envvar="COSMOS_INVENTORY",
        help="Inventory: the machines to work on.",
    ),
]
SomeInventoryOption = Annotated[
    Path | None,
    typer.Option(
        "--inventory",
        "-i",
        metavar="FILE",
        envvar="COSMOS_INVENTORY",
        help="Inventory: the machines to run on; default: this computer alone.",
    ),
]
HostOption = Annotated[
    str | None,
    typer.Option(
        "--host", metavar="MACHINE", help="Machine that runs the host; default: this computer."
    ),
]
LimitOption = Annotated[
    str | None,
    typer.Option(
        "--limit",
        "-l",
        metavar="PATTERN",
        envvar="COSMOS_LIMIT",
        help="Only these machines: names, groups, globs, as in tower:!chiefs.",
    ),
]
ForksOption = Annotated[
    int,
    typer.Option(
        "--forks", min=1, max=500, metavar="N", envvar="COSMOS_FORKS", help="Machines at a time."
    ),
]
AcceptHostKeysOption = Annotated[
    bool,
    typer.Option(
        "--accept-new-host-keys",
        envvar="COSMOS_ACCEPT_NEW_HOST_KEYS",
        help="Record unknown host keys in known_hosts; a changed one is always refused.",
    ),
]


def some_machines(
    inventory: Path | None, limit: str | None, host: str | None
) -> tuple[Machine, ...]:
    """
    Return the machines that a run would have: the inventory's, or this computer alone.

    Raises:
        InputError: Faults of the inventory or the pattern; or a host, and no inventory that it could be in.
    """
    # Imported late: most commands that have the options above never read an inventory's models.
    from cosmos_cli.models.inventory import load_machines
    from cosmos_cli.plan import LOOPBACK

    if inventory is not None:
        return load_machines(inventory, limit)
    if host is not None:
        raise InputError(
            f"--host {host}: there is no machine without an inventory; give one with -i"
        )
    return (LOOPBACK,)
