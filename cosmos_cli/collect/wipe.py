"""
Old runs on machines: what lies there, whether it was collected here, and its deletion.

What was collected is deleted only when it is, byte for byte, what lies here; what was not stays, unless
that is asked for by name.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from cosmos_cli.collect.retrieval_state import Note, is_all_here, read_note, write_note
from cosmos_cli.collect.size_bound import hash_deadline_s
from cosmos_cli.evidence.run_directory import RunDirectory, list_runs
from cosmos_cli.evidence.run_index import remembered_runs
from cosmos_cli.fleet.connection import Connection
from cosmos_cli.fleet.failure import FailureKind, MachineFailure
from cosmos_cli.fleet.helper import Helper
from cosmos_cli.fleet.layout import Layout
from cosmos_cli.fleet.target import Target
from cosmos_cli.onboard.records import RELEASED_PREFIX, entry_line

PARTS = ("madns_runtime.processes", "processes", "records", "deletion")
ASK_TIMEOUT_S = 60.0
DELETE_TIMEOUT_S = 300.0
PIECE_TIMEOUT_S = 30.0

State = Literal["collected", "not collected", "running", "left over"]
"""Left over: its copy was verified long ago, and its deletion was cut."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RunThere:
    """One run's directory on a machine."""

    name: str
    """Name of the directory: the run's name and the beginning of its session."""
    state: State
    files: int
    bytes: int
    newest_s: int
    """Time of the newest change, s since 1970."""
    living: tuple[str, ...] = ()
    here: str | None = None
    """Place of its copy here."""

    def to_mapping(self) -> dict[str, Any]:
        """Return plain values for --json."""
        return {
            "run": self.name,
            "state": self.state,
            "files": self.files,
            "bytes": self.bytes,
            "living": list(self.living),
            "here": self.here,
        }


@dataclass(frozen=True, slots=True, kw_only=True)
class Findings:
    """Runs found on one machine."""

    runs: tuple[RunThere, ...]
    installed_bytes: Mapping[str, int] = field(default_factory=dict)
    """Bytes of environments, trees and wheels; only when all of it is to go."""
    others: tuple[str, ...] = ()
    """Files in COSMoS's folder that are not COSMoS's."""
    living: tuple[str, ...] = ()
    """Processes of any run that live there; only when all of it is to go."""
    has_root: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class Order:
    """Findings of a machine that are to be deleted."""

    runs: tuple[RunThere, ...] = ()
    kept: tuple[RunThere, ...] = ()
    is_root: bool = False
    installed_bytes: int = 0
    """Bytes of environments, trees and wheels, if they go."""

    @property
    def is_empty(self) -> bool:
        """Whether there is nothing to do."""
        return not self.runs and not self.is_root

    @property
    def bytes(self) -> int:
        """Bytes of all that goes."""
        return sum(run.bytes for run in self.runs) + self.installed_bytes


@dataclass(frozen=True, slots=True, kw_only=True)
class Wiped:
    """Account of a deletion on one machine."""

    runs: tuple[str, ...] = ()
    bytes: int = 0
    is_root_gone: bool = False
    left: tuple[str, ...] = ()
    """Files that stay in COSMoS's folder although all of it was to go."""


def make_order(findings: Findings, *, is_all: bool, with_uncollected: bool) -> Order:
    """
    Decide what goes. Pure.

    Raises:
        MachineFailure: All of it is to go, and something lives there or is not COSMoS's.
    """
    wanted = {"collected", "left over"} | ({"not collected"} if with_uncollected else set())
    runs = tuple(run for run in findings.runs if run.state in wanted)
    kept = tuple(run for run in findings.runs if run.state not in wanted)
    if is_all and findings.living:
        raise MachineFailure(
            FailureKind.BUSY,
            f"still running there: {', '.join(findings.living[:5])}",
            "end it with: cosmos down",
        )
    if is_all and findings.others:
        raise MachineFailure(
            FailureKind.DATA,
            f"COSMoS's folder there holds what is not COSMoS's: {', '.join(findings.others[:5])}",
            "move that away first; single runs go without --all",
        )
    is_root = is_all and findings.has_root
    return Order(
        runs=runs,
        kept=kept,
        is_root=is_root,
        installed_bytes=sum(findings.installed_bytes.values()) if is_root else 0,
    )


def look(connection: Connection, known: Mapping[str, RunDirectory], *, is_all: bool) -> Findings:
    """
    Ask a machine what lies there; nothing is changed.

    Args:
        connection: To the machine.
        known: Runs here by the name of their directory on machines; see `runs_here`.
        is_all: Whether all of COSMoS's folder is meant.

    Raises:
        MachineFailure: It does not answer.
    """
    target = connection.target
    layout = Layout(target.root)
    with Helper.start(connection, PARTS) as helper:
        where = {"runs": layout.runs, "state": layout.state}
        listed = helper.call("inventory_runs", where, timeout_s=ASK_TIMEOUT_S).value
        runs = tuple(_run_there(helper, target, entry, known) for entry in listed)
        if not is_all:
            return Findings(runs=runs)
        root = {"root": layout.root, "state": layout.state}
        content = helper.call("root_content", root, timeout_s=ASK_TIMEOUT_S).value
    return Findings(
        runs=runs,
        installed_bytes=content["bytes"],
        others=tuple(content["others"]),
        living=tuple(content["living"]),
        has_root=content["is_there"],
    )


def carry_out(
    connection: Connection,
    order: Order,
    holder: str,
    gone: Callable[[RunThere], None] = lambda run: None,
) -> Wiped:
    """
    Delete on a machine what was decided, each thing only if it is still what it was.

    Args:
        connection: To the machine.
        order: What goes.
        holder: Who takes the machine's lock meanwhile.
        gone: Told each run as it has been deleted.

    Raises:
        MachineFailure: Something changed, lives, or could not be deleted; what went is gone.
    """
    target = connection.target
    layout = Layout(target.root)
    with Helper.start(connection, PARTS) as helper:
        helper.call("lock", {"path": layout.lock, "holder": holder})
        for run in order.runs:
            _delete(helper, target, run)
            gone(run)
        left: tuple[str, ...] = ()
        if order.is_root:
            root = {"root": layout.root, "state": layout.state}
            left = tuple(helper.call("remove_root", root, timeout_s=DELETE_TIMEOUT_S).value)
    return Wiped(
        runs=tuple(run.name for run in order.runs),
        bytes=order.bytes,
        is_root_gone=order.is_root and not left,
        left=left,
    )


def runs_here(root: Path) -> dict[str, RunDirectory]:
    """Return the runs of a folder, and those of this user elsewhere, by the name of their directory on machines."""
    remembered = map(RunDirectory, remembered_runs())
    found: dict[str, RunDirectory] = {}
    for run in (*remembered, *list_runs(root)):
        session = (run.read_json(run.plan_json) or {}).get("session")
        if isinstance(session, str) and session:
            found[Path(Layout("").run(run.name, session)).name] = run
    return found


def _run_there(
    helper: Helper, target: Target, entry: Mapping[str, Any], known: Mapping[str, RunDirectory]
) -> RunThere:
    name = str(entry["name"])
    run = known.get(name)
    state: State = "not collected"
    if entry["living"]:
        state = "running"
    elif name.startswith(RELEASED_PREFIX):
        state = "left over"
    elif run is not None and _is_here(helper, target, name, run):
        state = "collected"
    return RunThere(
        name=name,
        state=state,
        files=int(entry["files"]),
        bytes=int(entry["bytes"]),
        newest_s=int(entry["newest_s"]),
        living=tuple(map(str, entry["living"])),
        here=str(run.path) if run is not None else None,
    )


def _is_here(helper: Helper, target: Target, name: str, run: RunDirectory) -> bool:
    """Tell whether all that a machine has of a run is, unchanged, what was verified here and is here still."""
    note = read_note(run, target.name)
    is_known = note is not None and note.manifest_sha256 == _listed(helper, target, name, note)
    return is_known and is_all_here(run, target.name)


def _listed(helper: Helper, target: Target, name: str, note: Note) -> str | None:
    """Have a run's directory listed there, and return the hash of its manifest; None if it holds more than was noted."""
    try:
        return _manifest_sha256(helper, _where(target, name), note)
    except MachineFailure as failure:
        if failure.kind is FailureKind.DATA:
            return None
        raise


def _manifest_sha256(helper: Helper, where: Mapping[str, str], note: Note) -> str | None:
    digest, told = hashlib.sha256(), None
    arguments = {**where, "bytes_max": note.bytes}
    whole_s = hash_deadline_s(note.files, note.bytes)
    for answer in helper.pieces("manifest", arguments, timeout_s=PIECE_TIMEOUT_S, whole_s=whole_s):
        for entry in answer.value.get("files", ()):
            digest.update(entry_line(entry))
        told = answer.value.get("sha256", told)
    return told if told == digest.hexdigest() else None


def _delete(helper: Helper, target: Target, run: RunThere) -> None:
    where = _where(target, run.name)
    if run.state != "collected":
        shown = {"bytes": run.bytes, "files": run.files, "newest_s": run.newest_s}
        helper.call("discard", {**where, "shown": shown}, timeout_s=DELETE_TIMEOUT_S)
        return
    here = RunDirectory(Path(str(run.here)))
    if not _is_here(helper, target, run.name, here):
        raise MachineFailure(
            FailureKind.DATA, f"{run.name} is not what was collected any more", "repeat the command"
        )
    note = read_note(here, target.name)
    assert note is not None, "_is_here read it"
    copy = {**where, "manifest_sha256": note.manifest_sha256}
    helper.call("release", copy, timeout_s=DELETE_TIMEOUT_S)
    write_note(here, target.name, note.in_state("released"))


def _where(target: Target, name: str) -> dict[str, str]:
    layout = Layout(target.root)
    return {"directory": f"{layout.runs}/{name}", "state": layout.state}
