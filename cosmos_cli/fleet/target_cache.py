"""
Targets of an inventory as it was read last: only how to reach its machines, for commands that need no more.

Reading an inventory takes as long as importing what validates it, 0.2 s, which is most of `cosmos ping`;
`exec` on 24 boards took 1.2 times as long without (median of 15 interleaved pairs).
So the targets of an inventory that was valid are kept under a hash of all that they depend on; whatever
changes there makes a new hash, and the inventory is read again. A folder of files that is too large, or a
cache that cannot be read or written, means reading as ever.
"""

from __future__ import annotations

import contextlib
import hashlib
import itertools
import json
import os
from collections.abc import Iterator, Sequence
from pathlib import Path

from cosmos_cli.cache import cache_folder
from cosmos_cli.fleet.target import Target
from cosmos_cli.models.inventory_arguments import Given, is_machine_list, sources_of
from cosmos_cli.models.limit_file import limit_files
from cosmos_cli.system.ownership import keep_small_file, read_own_file
from madns_runtime import __version__
from madns_runtime.bounded_files import read_regular_file

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
        kept = json.loads(read_own_file(cache_folder() / FOLDER / key, bytes_max=BYTES_MAX))
        return tuple(Target.from_mapping(mapping) for mapping in kept)
    except (OSError, ValueError, TypeError, RecursionError):
        return None


def remember(key: str | None, targets: Sequence[Target]) -> None:
    """Keep targets, whole or not at all, and forget the oldest beyond KEPT_MAX."""
    if key is None:
        return
    text = json.dumps([target.to_mapping() for target in targets])
    with contextlib.suppress(OSError):
        keep_small_file(cache_folder() / FOLDER, key, text, count_max=KEPT_MAX)


def key_of(given: Given, limit: str | None) -> str | None:
    """Return a hash of all that the targets of an inventory depend on; None when that is too much."""
    told = hashlib.sha256()
    size_bytes = 0
    try:
        sources = sources_of(given)
        files = [Path(name) for name in limit_files(limit)]
        for source in sources:
            if not is_machine_list(source):
                files += itertools.islice(_files(Path(source).absolute()), FILES_MAX + 1)
        where = (__version__, str(Path.cwd()), str(Path.home()))
        told.update(json.dumps([*where, sources, limit]).encode())
        for path in READERS.rglob("*.py"):
            status = path.stat()
            told.update(os.fsencode(f"{path} {status.st_mtime_ns} {status.st_size}\n"))
        for count, path in enumerate(files):
            if count >= FILES_MAX:
                return None
            # What is too large, or a pipe, whose content is gone for the next reader, is not remembered.
            data = read_regular_file(path, bytes_max=BYTES_MAX)
            size_bytes += len(data)
            if size_bytes > BYTES_MAX:
                return None
            told.update(os.fsencode(f"{path} {len(data)}\n"))
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
