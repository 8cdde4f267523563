"""
Files of a run on this computer that are not read: larger than the run can have recorded, without a name in text, or denied.

A file with holes, such as a core dump, may say to be larger than any disk, and would be hashed and packed
without end. A file without holes is bounded by the disk, and is read however large.
"""

from __future__ import annotations

import errno
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from cosmos_cli.collect.previous_manifest import Earlier
from cosmos_cli.collect.size_bound import recordable_bytes
from cosmos_cli.evidence.manifest import run_files, unreadable_places
from cosmos_cli.evidence.run_directory import RunDirectory
from cosmos_cli.ui.sizes import size_words

BLOCK_BYTES = 512
"""Unit of `st_blocks` on every file system, bytes."""


def find_unread(
    run: RunDirectory, earlier: Earlier | None = None, bytes_max: int | None = None
) -> dict[Path, str]:
    """
    Return the files that are not read, and of each why: the largest, until the rest can have been recorded.

    Args:
        run: The run.
        earlier: What was read before and has the same size is read again.
        bytes_max: The most that files with holes may hold; None for what the run's plan allows.
    """
    if bytes_max is None:
        config = run.read_config()
        bytes_max = recordable_bytes(config, config.agents.count if config else 0, is_host=True)
    sizes = _sizes_with_holes(run, (earlier or Earlier.read(run)).entries)
    total = sum(sizes.values())
    found: dict[Path, str] = {
        path: f"not read: its name is no UTF-8; rename it, then repeat with: cosmos collect {run.shell_path}"
        for path in run_files(run)
        if not _is_text(str(path))
    }
    found |= {path: f"not read: {error.strerror}" for path, error in unreadable_places(run).items()}
    denied = f"not read: {os.strerror(errno.EACCES)}"
    found |= {path: denied for path in run_files(run) if not _may_read(path)}
    for path in sorted(sizes, key=lambda path: (-sizes[path], path)):
        if total <= bytes_max:
            break
        total -= sizes[path]
        found[path] = (
            f"not read: it is {size_words(sizes[path])}, with holes, and the run can have recorded at"
            f" most {size_words(bytes_max)}; delete it, or if it is right, repeat with:"
            f" cosmos collect --size-max SIZE {run.shell_path}"
        )
    return found


def _sizes_with_holes(run: RunDirectory, known: Mapping[str, Mapping[str, Any]]) -> dict[Path, int]:
    sizes: dict[Path, int] = {}
    for path in run_files(run):
        try:
            found = path.lstat()
        except OSError:
            continue
        has_holes = found.st_blocks * BLOCK_BYTES < found.st_size
        entry = known.get(path.relative_to(run.path).as_posix(), {})
        if has_holes and entry.get("bytes") != found.st_size:
            sizes[path] = found.st_size
    return sizes


def _may_read(path: Path) -> bool:
    return os.access(path, os.R_OK, effective_ids=os.access in os.supports_effective_ids)


def _is_text(name: str) -> bool:
    try:
        name.encode()
    except UnicodeEncodeError:
        return False
    return True


def told_unread(run: RunDirectory, unread: Mapping[Path, str]) -> dict[str, str]:
    """Return the same by the name within the run; bytes that are no text are escaped."""
    return {
        os.fsencode(path.relative_to(run.path)).decode(errors="backslashreplace"): why
        for path, why in unread.items()
    }
