"""
Places of this user's runs by name, so that one that goes on by itself is found from any shell.

It lies beside the register of processes. One small file per run; an entry whose directory is gone is removed when it is met. That the index cannot
be written is no reason to fail: a run is still found in its folder.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import stat
from collections.abc import Iterator
from pathlib import Path

from cosmos_cli.system.ownership import read_own_file
from madns_runtime.partial_file import write_whole
from madns_runtime.processes import state_directory

FILE_BYTES_MAX = 16_384
HASH_CHARACTERS = 8


def index_directory() -> Path:
    """Return the index's folder."""
    return state_directory().parent / "runs"


def remember_run(name: str, path: Path) -> None:
    """Enter a run; two of one name in two folders are two entries."""
    digest = hashlib.sha256(str(path).encode()).hexdigest()[:HASH_CHARACTERS]
    folder = index_directory()
    file = folder / f"{name}@{digest}.json"
    with contextlib.suppress(OSError):
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        text = json.dumps({"name": name, "path": str(path)})
        write_whole(file, text.encode(), mode=0o600, is_durable=False)


def remembered_runs() -> list[Path]:
    """Return the directory of every run that is still where it was, by name; others are forgotten, unless nobody can tell."""
    return sorted(_places(), key=lambda path: (path.name, path))


def _places() -> Iterator[Path]:
    try:
        files = [file for file in index_directory().iterdir() if file.suffix == ".json"]
    except OSError:
        return
    for file in files:
        path = _read(file)
        is_there = False if path is None else _is_folder(path)
        if path is not None and is_there:
            yield path
        elif is_there is not None:
            with contextlib.suppress(OSError):
                file.unlink(missing_ok=True)


def _is_folder(path: Path) -> bool | None:
    """Tell whether a folder is there; None where it cannot be looked at, as on a disk of the network that is away."""
    try:
        return stat.S_ISDIR(path.stat().st_mode)
    except (FileNotFoundError, NotADirectoryError, ValueError):
        return False
    except OSError:
        return None


def _read(file: Path) -> Path | None:
    try:
        return Path(json.loads(read_own_file(file, bytes_max=FILE_BYTES_MAX))["path"])
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return None
