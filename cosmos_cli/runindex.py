"""
Where this user's runs are, by name, so that one that goes on by itself is found from any shell.

It lies beside the register of processes. One small file a run; an entry whose directory is gone is removed when it is met. That the index cannot
be written is no reason to fail: a run is still found in its folder.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from madns_runtime.processes import state_directory

FILE_BYTES_MAX = 16_384
HASH_CHARACTERS = 8


@dataclass(frozen=True, slots=True, kw_only=True)
class IndexEntry:
    """One run and where it is."""

    name: str
    path: Path


def index_directory() -> Path:
    """Return the index's folder."""
    return state_directory().parent / "runs"


def remember_run(name: str, path: Path) -> None:
    """Enter a run; two of one name in two folders are two entries."""
    digest = hashlib.sha256(str(path).encode()).hexdigest()[:HASH_CHARACTERS]
    folder = index_directory()
    file = folder / f"{name}@{digest}.json"
    draft = file.with_suffix(".tmp")
    with contextlib.suppress(OSError):
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        draft.write_text(json.dumps({"name": name, "path": str(path)}), encoding="utf-8")
        draft.replace(file)


def remembered_runs() -> list[IndexEntry]:
    """Return every run that is still where it was, by name; others are forgotten."""
    return sorted(_entries(), key=lambda entry: (entry.name, entry.path))


def _entries() -> Iterator[IndexEntry]:
    try:
        files = [file for file in index_directory().iterdir() if file.suffix == ".json"]
    except OSError:
        return
    for file in files:
        entry = _read(file)
        if entry is None or not entry.path.is_dir():
            with contextlib.suppress(OSError):
                file.unlink(missing_ok=True)
        else:
            yield entry


def _read(file: Path) -> IndexEntry | None:
    try:
        with file.open("rb") as stream:
            values = json.loads(stream.read(FILE_BYTES_MAX))
        return IndexEntry(name=str(values["name"]), path=Path(values["path"]))
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return None
