"""
The machines on which a command failed, kept in a file for `--limit @FILE`, as Ansible's retry files.

One file per command and inventory, beside the register of processes, for this user alone; the next failure of the
same command replaces it. That it cannot be written is no reason to fail.
"""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from cosmos_cli.fleet.target import Target
from cosmos_cli.system.ownership import keep_small_file
from cosmos_cli.ui import invocation
from cosmos_cli.ui.console import Console
from cosmos_cli.ui.name_ranges import compact
from cosmos_cli.ui.plural import counted
from madns_runtime.processes import state_directory

FOLDER = "failed"
ENDING = ".retry"
KEPT_MAX = 50
HASH_CHARACTERS = 6
STEM_CHARACTERS_MAX = 40


def offer_retry(
    console: Console,
    sources: Sequence[str],
    *,
    failed: Iterable[str],
    count: int,
    needed: str | None = None,
) -> dict[str, Any] | None:
    """
    Write the machines that failed to a file, and say with which command to repeat it for them alone.

    Args:
        console: Where it is said.
        sources: What -i named.
        failed: Machines, in the order of the inventory.
        count: Of all machines that the command worked on.
        needed: A machine without which the command cannot be repeated, such as a run's host.

    Returns:
        The value of "retry" for --json; None when none failed, or all did: then the command stays as it is.
    """
    names = list(dict.fromkeys(failed))
    if not names or len(names) >= count:
        return None
    retry = _write(sources, names, needed)
    if retry is None:
        return None
    console.say(
        f"{counted(len(names), 'machine')} of {count} failed ({compact(names)}); again for"
        f" {'it' if len(names) == 1 else 'them'} alone:\n  {retry['command']}"
    )
    return retry


def offer_retry_of(
    console: Console,
    sources: Sequence[str] | None,
    targets: Sequence[Target],
    failed: Iterable[str],
) -> dict[str, Any] | None:
    """
    Do so for a command that asks the machines of runs beside those of an inventory, which alone --limit can mean.

    Args:
        console: Where it is said.
        sources: The inventory, if one was given.
        targets: Its machines.
        failed: Names of machines, of the inventory or not.

    Returns:
        As `offer_retry`.
    """
    names = {target.name for target in targets}
    return offer_retry(
        console,
        sources or (),
        failed=[name for name in failed if name in names],
        count=len(names),
    )


def _write(
    sources: Sequence[str], names: Sequence[str], needed: str | None
) -> dict[str, Any] | None:
    """Return the file of the machines, and the command that works on them alone; None if it cannot be written."""
    current = invocation.current()
    told = "\0".join([os.getcwd(), *sources])
    digest = hashlib.sha256(told.encode(errors="surrogateescape")).hexdigest()[:HASH_CHARACTERS]
    stem = re.sub(r"[^A-Za-z0-9_.-]+", "-", Path(sources[0]).stem if sources else "")
    folder = state_directory().parent / FOLDER
    path = folder / f"{current.verb}-{stem[:STEM_CHARACTERS_MAX]}-{digest}{ENDING}"
    try:
        keep_small_file(
            folder, path.name, "".join(f"{name}\n" for name in names), count_max=KEPT_MAX
        )
    except OSError:
        return None
    pattern = _pattern(path, names) + (f",{needed}" if needed and needed not in names else "")
    return {"file": str(path), "command": current.with_limit(pattern)}


def _pattern(path: Path, names: Sequence[str]) -> str:
    """Return the --limit; a path that a pattern would be split in is put so that it is not, as far as possible."""
    text = str(path)
    if "," in text:
        return ",".join(names)
    return f"@{text}," if re.search(r"[\s:\[\]]", text) else f"@{text}"
