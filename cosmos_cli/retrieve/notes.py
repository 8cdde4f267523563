"""
What is noted here of each machine: its manifest as it was verified, and whether its copy there is gone.

    machines/<machine>/manifest.json    every file it had, with size and hash; also what is no file
    machines/<machine>/retrieved.json   verified: all of it is here and on the disk; released: it is gone there

They are written before anything is deleted, so that after any interruption they tell the truth.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from cosmos_cli.retrieve.disk import hash_of, local_disk
from cosmos_cli.retrieve.offer import MANIFEST_NAME, RETRIEVED_NAME
from cosmos_cli.retrieve.sources import MACHINES
from cosmos_cli.rundir import SCHEMA, RunDirectory, utc_now, write_json

State = Literal["verified", "released"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Note:
    """One machine's retrieved.json."""

    state: State
    directory: str
    """The run's, there."""
    manifest_sha256: str
    files: int
    bytes: int

    def as_released(self) -> Note:
        """Return it once the copy there is gone."""
        return dataclasses.replace(self, state="released")


def folder_of(run: RunDirectory, machine: str) -> Path:
    """Return where a machine's notes are."""
    return run.path / MACHINES / machine


def read_note(run: RunDirectory, machine: str) -> Note | None:
    """Return what was noted of a machine; None if not all of its data have come."""
    values = run.read_json(folder_of(run, machine) / RETRIEVED_NAME) or {}
    state, directory = values.get("state"), values.get("directory")
    if state not in ("verified", "released") or not isinstance(directory, str):
        return None
    return Note(
        state=state,
        directory=directory,
        manifest_sha256=str(values.get("manifest_sha256")),
        files=int(values.get("files") or 0),
        bytes=int(values.get("bytes") or 0),
    )


def write_note(run: RunDirectory, machine: str, note: Note) -> None:
    """
    Note how far a machine is, for good.

    Raises:
        MachineFailure: The disk here fails.
    """
    with local_disk(run.path):
        folder = folder_of(run, machine)
        folder.mkdir(parents=True, exist_ok=True)
        write_json(
            folder / RETRIEVED_NAME,
            {
                "schema": SCHEMA,
                "machine": machine,
                "state": note.state,
                "directory": note.directory,
                "manifest_sha256": note.manifest_sha256,
                "files": note.files,
                "bytes": note.bytes,
                "utc": utc_now(),
            },
        )


def write_manifest(
    run: RunDirectory, machine: str, entries: Sequence[Mapping[str, Any]], manifest_sha256: str
) -> None:
    """
    Keep a machine's manifest as evidence of what it had.

    Raises:
        MachineFailure: The disk here fails.
    """
    with local_disk(run.path):
        folder = folder_of(run, machine)
        folder.mkdir(parents=True, exist_ok=True)
        files = {str(e["path"]): {k: v for k, v in e.items() if k != "path"} for e in entries}
        write_json(
            folder / MANIFEST_NAME,
            {"schema": SCHEMA, "machine": machine, "sha256": manifest_sha256, "files": files},
        )


def retrieved_files(run: RunDirectory) -> Iterator[tuple[str, Mapping[str, Any]]]:
    """Yield path and entry of every file that came from a machine and was verified then."""
    for _, files in _manifests(run):
        yield from files


def is_all_here(run: RunDirectory, machine: str) -> bool:
    """Tell whether every file that a machine's kept manifest lists is here, with that content."""
    manifests = dict(_manifests(run))
    return machine in manifests and all(
        hash_of(run.path / path, int(entry.get("bytes", -1))) == entry["sha256"]
        for path, entry in manifests[machine]
    )


def retrieved_paths(run: RunDirectory) -> Iterator[tuple[str, str]]:
    """Yield the path of every file that came from a machine, and the machine."""
    for machine, files in _manifests(run):
        for path, _ in files:
            yield path, machine


def _manifests(run: RunDirectory) -> Iterator[tuple[str, list[tuple[str, Mapping[str, Any]]]]]:
    for path in sorted((run.path / MACHINES).glob(f"*/{MANIFEST_NAME}")):
        files = (run.read_json(path) or {}).get("files")
        items = files.items() if isinstance(files, Mapping) else ()
        yield (
            path.parent.name,
            [
                (name, entry)
                for name, entry in items
                if isinstance(entry, Mapping) and isinstance(entry.get("sha256"), str)
            ],
        )
