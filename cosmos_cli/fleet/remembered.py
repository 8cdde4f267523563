"""
What an inventory meant the last time it was read: only how to reach its machines, for commands that need no more.

Reading an inventory takes as long as importing what validates it, 0.2 s, which is most of `cosmos ping`.
So the targets of an inventory that was valid are kept under a hash of all that they depend on; whatever
changes there makes a new hash, and the inventory is read again. A folder of files that is too large, or a
cache that cannot be read or written, means reading as ever.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

from cosmos_cli.cache import cache_folder
from cosmos_cli.fleet.target import Target
from madns_runtime import __version__

FOLDER = "targets"
FILES_MAX = 500
BYTES_MAX = 8 * 1024 * 1024
KEPT_MAX = 64
VARIABLE_FOLDERS = ("group_vars", "host_vars")
READERS = Path(__file__).parent.parent / "models"
"""Code that reads inventories; editing it must not leave old readings behind."""


def recall(key: str | None) -> tuple[Target, ...] | None:
    """Return the targets that are kept under a key of `key_of`; None if there are none."""
    if key is None:
        return None
    try:
        kept = json.loads((cache_folder() / FOLDER / key).read_bytes())
        return tuple(Target.from_mapping(mapping) for mapping in kept)
    except (OSError, ValueError, TypeError):
        return None


def remember(key: str | None, targets: Sequence[Target]) -> None:
    """Keep targets, whole or not at all, and forget the oldest beyond KEPT_MAX."""
    if key is None:
        return
    with contextlib.suppress(OSError):
        folder = cache_folder() / FOLDER
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        text = json.dumps([target.to_mapping() for target in targets])
        with tempfile.NamedTemporaryFile("w", dir=folder, delete=False, encoding="utf-8") as file:
            file.write(text)
        os.replace(file.name, folder / key)
        kept = sorted(folder.iterdir(), key=lambda path: path.stat().st_mtime, reverse=True)
        for old in kept[KEPT_MAX:]:
            old.unlink()


def key_of(inventory: Path, limit: str | None) -> str | None:
    """Return a hash of all that the targets of an inventory depend on; None when that is too much."""
    told = hashlib.sha256()
    size_bytes = 0
    try:
        where = (__version__, str(Path(inventory).absolute()), str(Path.cwd()), str(Path.home()))
        told.update(json.dumps([*where, limit]).encode())
        for path in READERS.rglob("*.py"):
            status = path.stat()
            told.update(f"{path} {status.st_mtime_ns} {status.st_size}\n".encode())
        for count, path in enumerate(_files(inventory)):
            if not path.is_file():  # a pipe would be empty for who reads it next
                return None
            data = path.read_bytes()
            size_bytes += len(data)
            if count >= FILES_MAX or size_bytes > BYTES_MAX:
                return None
            told.update(f"{path} {len(data)}\n".encode())
            told.update(data)
    except (OSError, RuntimeError):  # also: a folder that is gone, nobody's home
        return None
    return told.hexdigest()


def _files(inventory: Path) -> Iterator[Path]:
    """Return every file that an inventory may be read from: itself, or all in its folder, and the variables."""
    if inventory.is_dir():
        yield from _below(inventory)
        return
    yield inventory
    for name in VARIABLE_FOLDERS:
        if (folder := inventory.parent / name).is_dir():
            yield from _below(folder)


def _below(folder: Path) -> Iterator[Path]:
    for root, folders, names in os.walk(folder, followlinks=True):
        folders.sort()
        yield from (Path(root, name) for name in sorted(names))
