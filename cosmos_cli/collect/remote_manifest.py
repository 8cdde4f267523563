"""
A machine's manifest of its records, checked as the input that it is. Pure.

Nothing that it says leads out of the run directory, over a file of the operator, or into what is
another machine's. A file that may not come is named; it stays where it is, and so does its directory.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from cosmos_cli.collect.machine_sources import MACHINES
from cosmos_cli.evidence.run_directory import RESERVE_NAME

PATH_CHARACTERS_MAX = 1000
NAME_BYTES_MAX = 255
FILE_BYTES_MAX = 1 << 50
INCOMING = ".incoming"
"""Folder of the run directory where files are until they are whole."""
RETRIEVED_NAME, MANIFEST_NAME = "retrieved.json", "manifest.json"
"""Files about a machine, kept here in machines/<machine>/."""
RESERVED = frozenset(
    [
        "run.json",
        "plan.json",
        "result.json",
        "manifest.json",
        "report.html",
        "scenario.yaml",
        "inventory.yaml",
        "tables",
    ]
) | {RESERVE_NAME, INCOMING}
SHA256 = re.compile(r"[0-9a-f]{64}")


@dataclass(frozen=True, slots=True, kw_only=True)
class OfferedFile:
    """One file that may come."""

    path: str
    """Below the run directory, there and here."""
    size_bytes: int
    sha256: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Offer:
    """A machine's manifest."""

    files: tuple[OfferedFile, ...]
    faults: tuple[str, ...]
    """One line per file or folder that may not come or cannot be read there, each starting with its path."""

    @property
    def size_bytes(self) -> int:
        """Bytes of all files."""
        return sum(file.size_bytes for file in self.files)


def check_offer(
    entries: Iterable[object], machine: str, owner_of: Callable[[str], str | None]
) -> Offer:
    """
    Sort a manifest's entries into files that may come and faults.

    Args:
        entries: As the machine sent them.
        machine: Its name.
        owner_of: Tells whose a path is; None for one that is nobody's yet.
    """
    files: dict[str, OfferedFile] = {}
    faults: list[str] = []
    for entry in entries:
        mapping = entry if isinstance(entry, Mapping) else {}
        path = mapping.get("path")
        if not isinstance(path, str):
            faults.append(f"{shown(str(entry))}: no entry of a manifest")
        elif path in files:
            faults.append(f"{shown(path)}: listed twice")
        elif "error" in mapping:
            faults.append(f"{shown(path)}: cannot be read there: {shown(str(mapping['error']))}")
        elif reason := _fault_of_path(path, machine, owner_of) or _fault_of_file(mapping):
            faults.append(f"{shown(path)}: {reason}")
        elif "kind" not in mapping:
            # Links, pipes and sockets hold no records; the manifest names them.
            files[path] = OfferedFile(
                path=path, size_bytes=mapping["bytes"], sha256=mapping["sha256"]
            )
    return Offer(files=tuple(files.values()), faults=tuple(faults))


def shown(path: str) -> str:
    """Return a name from a machine as it may be shown: short, and nothing a terminal would obey."""
    return path if path.isprintable() and len(path) < 200 else ascii(path)[:200]


def _fault_of_path(path: str, machine: str, owner_of: Callable[[str], str | None]) -> str | None:
    parts = path.split("/")
    if any(part in ("", ".", "..") for part in parts):  # an absolute path begins with an empty part
        return "leads out of the run directory"
    if not path.isprintable() or len(path) > PATH_CHARACTERS_MAX:
        return "expected a printable name of moderate length"
    if any(len(part.encode()) > NAME_BYTES_MAX for part in parts):
        return f"expected names of at most {NAME_BYTES_MAX} bytes"
    own_notes = (f"{MACHINES}/{machine}/{name}" for name in (RETRIEVED_NAME, MANIFEST_NAME))
    if parts[0] in RESERVED or path in own_notes:
        return "this name is the operator's"
    owner = owner_of(path)
    if owner is not None and owner != machine:
        return f"{machine} offers it, but it is of {owner}"
    return None


def _fault_of_file(entry: Mapping[str, Any]) -> str | None:
    if "kind" in entry:
        return None
    size, digest = entry.get("bytes"), entry.get("sha256")
    if not isinstance(size, int) or isinstance(size, bool) or not 0 <= size <= FILE_BYTES_MAX:
        return f"expected its size, got {shown(str(size))}"
    if not isinstance(digest, str) or not SHA256.fullmatch(digest):
        return f"expected its SHA-256, got {shown(str(digest))}"
    return None
