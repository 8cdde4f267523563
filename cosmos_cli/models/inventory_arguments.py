"""
Arguments of -i: files, folders, and lists of machines, in the order given. Light: they are read before all else.

As in Ansible, a source with a comma that is no path is a list of machines (`pi01,pi02,`), and the
variable of the environment names several sources with commas between them.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from cosmos_cli.errors import InputError

SOURCES_MAX = 100
Given = str | Path | Sequence[str | Path]
"""One source or several."""


def sources_of(given: Given) -> tuple[str, ...]:
    """Return the sources as texts."""
    if isinstance(given, str | Path):
        return (str(given),)
    return tuple(str(source) for source in given)


def is_machine_list(source: str) -> bool:
    """Whether a source is a list of machines, not the path of a file or a folder."""
    return "," in source and not os.path.exists(source)


def split_variable(value: str) -> list[str]:
    """
    Return the sources that COSMOS_INVENTORY names: paths with commas between them, as in ANSIBLE_INVENTORY.

    A path that exists as a whole is one source, and what ends in a comma is a list of machines, as after -i.
    """
    if not value or os.path.exists(value) or value.rstrip().endswith(","):
        return [value] if value else []
    return [part.strip() for part in value.split(",") if part.strip()]


def folder_of(source: str) -> Path:
    """Return the folder beside which group_vars and host_vars are looked for."""
    path = Path(source)
    return path if os.path.isdir(path) else path.parent


def refuse_stray_limit(limit: str | None) -> None:
    """
    Refuse a pattern where no inventory is given.

    Raises:
        InputError: There is one: nothing is there that it could mean.
    """
    if limit is not None:
        raise InputError(
            f"--limit {limit}: there are no machines without an inventory; give one with -i"
            " (or leave out --limit and COSMOS_LIMIT)"
        )
