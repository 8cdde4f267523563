"""The options that every command which works on machines has."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cosmos_cli.fleet.fleet import Fleet, fleet_of
from cosmos_cli.fleet.pool import FORKS_DEFAULT

__all__ = [
    "FORKS_DEFAULT",
    "AcceptHostKeysOption",
    "Fleet",
    "ForksOption",
    "InventoryOption",
    "LimitOption",
    "fleet_of",
]

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
