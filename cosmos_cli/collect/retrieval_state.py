"""
State of each machine's retrieval: its manifest as it was verified, and whether its copy there is gone.

    machines/<machine>/manifest.json    every file it had, with size and hash; also what is no file
    machines/<machine>/retrieved.json   verified: all of it is here and on the disk; released: it is gone there;
                                        forgotten: nobody asks any more

They are written before anything is deleted, so that after any interruption they tell the truth.

A board that is gone for good must not be looked for for ever. What a forgotten machine had of the run is given up,
which is told in run.json and in every verdict; the run stays incomplete. It can be taken back, for the machine's
own copy is not touched.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeGuard, get_args

from cosmos_cli.collect.disk import hash_of, local_disk
from cosmos_cli.collect.machine_sources import MACHINES, RecordingMachine, RecordingMachines
from cosmos_cli.collect.remote_manifest import MANIFEST_NAME, RETRIEVED_NAME, shown
from cosmos_cli.errors import InputError
from cosmos_cli.evidence.run_directory import SCHEMA, RunDirectory, utc_now, write_json
from cosmos_cli.evidence.run_documents import Problem
from madns_runtime.recording.records import WHOLE_MAX

EVERY, NONE = "all", "none"
"""Words beside the names of machines: all that were not released yet; those that were forgotten are asked again."""
State = Literal["verified", "released", "forgotten"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Note:
    """One machine's retrieved.json."""

    state: State
    directory: str
    """The run's, there."""
    manifest_sha256: str
    """Empty while not all of it is here."""
    files: int
    bytes: int
    utc: str = ""
    """Time of the note."""

    @property
    def is_complete(self) -> bool:
        """Whether all that the machine had is here."""
        return bool(self.manifest_sha256)

    def in_state(self, state: State) -> Note:
        """Return it in another state."""
        return dataclasses.replace(self, state=state)


def note_path(run: RunDirectory, machine: str) -> Path:
    """Return the file of a machine's note."""
    return run.path / MACHINES / machine / RETRIEVED_NAME


def read_note(run: RunDirectory, machine: str) -> Note | None:
    """Return what was noted of a machine; None if not all of its data have come, or the note is damaged."""
    values = run.read_json(note_path(run, machine)) or {}
    directory = values.get("directory")
    state = next((each for each in get_args(State) if each == values.get("state")), None)
    manifest_sha256, utc = values.get("manifest_sha256"), values.get("utc")
    files, size_bytes = values.get("files"), values.get("bytes")
    if state is None or not isinstance(directory, str):
        return None
    if not isinstance(manifest_sha256, str) or not (_is_count(files) and _is_count(size_bytes)):
        return None
    return Note(
        state=state,
        directory=directory,
        manifest_sha256=manifest_sha256,
        files=files,
        bytes=size_bytes,
        utc=utc if isinstance(utc, str) else "",
    )


def _is_count(value: object) -> TypeGuard[int]:
    return isinstance(value, int) and not isinstance(value, bool) and value >= 0


def write_note(run: RunDirectory, machine: str, note: Note) -> None:
    """
    Note how far a machine is, for good.

    Raises:
        MachineFailure: The disk here fails.
    """
    _write(
        run, note_path(run, machine), dataclasses.asdict(dataclasses.replace(note, utc=utc_now()))
    )


def write_manifest(
    run: RunDirectory, machine: str, entries: Sequence[Mapping[str, Any]], manifest_sha256: str
) -> None:
    """
    Keep a machine's manifest as evidence of what it had.

    Raises:
        MachineFailure: The disk here fails.
    """
    files = {str(entry["path"]): _kept(entry) for entry in entries}
    _write(
        run,
        note_path(run, machine).with_name(MANIFEST_NAME),
        {"sha256": manifest_sha256, "files": files},
    )


def _kept(entry: Mapping[str, Any]) -> dict[str, Any]:
    """Return what is kept of a file's entry that was checked: no more than is known to be fit for a file of JSON."""
    kept: dict[str, Any] = {}
    for name in ("bytes", "mtime_s"):
        number = entry.get(name)
        if isinstance(number, int) and not isinstance(number, bool) and abs(number) <= WHOLE_MAX:
            kept[name] = number
    if "kind" not in entry:
        return {**kept, "sha256": entry["sha256"]}
    kind = entry["kind"]
    return {**kept, "kind": shown(kind) if isinstance(kind, str) else "no file"}


def _write(run: RunDirectory, path: Path, values: Mapping[str, Any]) -> None:
    with local_disk(run.path):
        path.parent.mkdir(parents=True, exist_ok=True)
        write_json(path, {"schema": SCHEMA, "machine": path.parent.name, **values})


def retrieved_files(run: RunDirectory) -> Iterator[tuple[str, Mapping[str, Any]]]:
    """Yield path and entry of every file that came from a machine and was verified then."""
    for _, files in _manifests(run):
        yield from files


def is_all_here(run: RunDirectory, machine: str) -> bool:
    """Tell whether every file that a machine's kept manifest lists is here, with that content."""
    manifests = dict(_manifests(run))
    return machine in manifests and all(
        _is_count(entry.get("bytes"))
        and hash_of(run.path / path, entry["bytes"]) == entry["sha256"]
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


def forget(run: RunDirectory, names: Sequence[str]) -> list[str]:
    """
    Note that machines are not asked any more, or with NONE that all are again.

    Args:
        run: The run; nobody else collects it meanwhile (`alone`).
        names: Of its machines; or EVERY, or NONE.

    Returns:
        Whose note has changed.

    Raises:
        InputError: A name is no machine's from which something may still come.
        MachineFailure: The disk here fails.
    """
    sources = {each.machine: each for each in RecordingMachines.read(run).remote}
    if NONE in names:
        if len(names) > 1:
            raise InputError(f"--forget {NONE} asks all machines again; give no other name with it")
        return [name for name in sources if _remember(run, name)]
    notes = {name: read_note(run, name) for name in sources}
    open_ = [name for name, note in notes.items() if note is None or note.state == "verified"]
    wanted = open_ if EVERY in names else list(dict.fromkeys(names))
    forgotten = {name for name, note in notes.items() if note and note.state == "forgotten"}
    unknown = [name for name in wanted if name not in open_ and name not in forgotten]
    if unknown or not open_:
        known = ", ".join(open_) or "none; there is nothing to forget"
        raise InputError(
            f"--forget {', '.join(names)}: machines from which something may still come: {known}"
        )
    changed = [name for name in wanted if name in open_]
    for name in changed:
        nothing = Note(
            state="forgotten",
            directory=sources[name].directory,
            manifest_sha256="",
            files=0,
            bytes=0,
        )
        write_note(run, name, (notes[name] or nothing).in_state("forgotten"))
    return changed


def asked_sources(run: RunDirectory) -> tuple[RecordingMachine, ...]:
    """Return the machines of a run that are asked about it: all but those that were forgotten."""
    notes = ((each, read_note(run, each.machine)) for each in RecordingMachines.read(run).remote)
    return tuple(each for each, note in notes if note is None or note.state != "forgotten")


def problem_of(machine: str, note: Note) -> Problem | None:
    """Return what the verdict is told of a forgotten machine; None if all that it had is here."""
    if note.state != "forgotten" or note.is_complete:
        return None
    when = f" on {note.utc[:10]}" if note.utc else ""
    return Problem(
        machine=machine,
        text=f"given up{when}: what it still had of the run is not here",
        step="forgotten",
    )


def forgotten_problems(run: RunDirectory) -> tuple[Problem, ...]:
    """Return what the verdict is told of all forgotten machines."""
    notes = (
        (each.machine, read_note(run, each.machine)) for each in RecordingMachines.read(run).remote
    )
    found = (problem_of(machine, note) for machine, note in notes if note is not None)
    return tuple(problem for problem in found if problem is not None)


def _remember(run: RunDirectory, machine: str) -> bool:
    note = read_note(run, machine)
    if note is None or note.state != "forgotten":
        return False
    if note.is_complete:
        write_note(run, machine, note.in_state("verified"))
    else:
        note_path(run, machine).unlink()
    return True
