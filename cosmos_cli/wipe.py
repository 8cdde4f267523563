"""
Old runs on machines: what lies there, whether it was collected here, and its deletion.

What was collected is deleted only when it is, byte for byte, what lies here; what was not stays, unless
that is asked for by name.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from cosmos_cli.fleet.board import Board
from cosmos_cli.fleet.connection import Connection
from cosmos_cli.fleet.failure import FailureKind, MachineFailure
from cosmos_cli.fleet.layout import Layout
from cosmos_cli.fleet.onboard.evidence import RELEASED_PREFIX, entry_line
from cosmos_cli.fleet.target import Target
from cosmos_cli.retrieve.notes import is_all_here, read_note, write_note
from cosmos_cli.rundir import RunDirectory, list_runs
from cosmos_cli.runindex import remembered_runs

PARTS = ("madns_runtime.processes", "living", "evidence", "wiping")
ASK_TIMEOUT_S = 60.0
DELETE_TIMEOUT_S = 300.0
PIECE_TIMEOUT_S = 30.0

State = Literal["collected", "not collected", "running", "left over"]
"""Left over: its copy was verified long ago, and its deletion was cut."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RunThere:
    """One run's directory on a machine."""

    name: str
    """Of the directory: the run's name and the begin of its session."""
    state: State
    files: int
    bytes: int
    newest_s: int
    """Its newest change, s since 1970."""
    living: tuple[str, ...] = ()
    here: str | None = None
    """Where its copy is here."""

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
    """What lies on one machine."""

    runs: tuple[RunThere, ...]
    installed_bytes: Mapping[str, int] = field(default_factory=dict)
    """Of environments, trees and wheels; only when all of it is to go."""
    others: tuple[str, ...] = ()
    """What is in COSMoS's folder and is not COSMoS's."""
    living: tuple[str, ...] = ()
    """Of any run; only when all of it is to go."""
    has_root: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class Order:
    """What is to be deleted of a machine's findings."""

    runs: tuple[RunThere, ...] = ()
    kept: tuple[RunThere, ...] = ()
    is_root: bool = False
    installed_bytes: int = 0
    """Of environments, trees and wheels, if they go."""

    @property
    def is_empty(self) -> bool:
        """Whether there is nothing to do."""
        return not self.runs and not self.is_root

    @property
    def bytes(self) -> int:
        """Of all that goes."""
        return sum(run.bytes for run in self.runs) + self.installed_bytes


@dataclass(frozen=True, slots=True, kw_only=True)
class Wiped:
    """What was deleted on a machine."""

    runs: tuple[str, ...] = ()
    bytes: int = 0
    is_root_gone: bool = False
    left: tuple[str, ...] = ()
    """What stays in COSMoS's folder although all of it was to go."""


def make_order(findings: Findings, *, is_all: bool, with_uncollected: bool) -> Order:
    """
    Decide what goes. Pure.

    Raises:
        MachineFailure: All of it is to go, and something lives there or is not COSMoS's.
    """
    wanted: tuple[State, ...] = ("collected", "left over")
    if with_uncollected:
        wanted = (*wanted, "not collected")
    runs = tuple(run for run in findings.runs if run.state in wanted)
    kept = tuple(run for run in findings.runs if run.state not in wanted)
    if is_all and findings.living:
        told = ", ".join(findings.living[:5])
        raise MachineFailure(
            FailureKind.BUSY, f"still running there: {told}", "end it with: cosmos down"
        )
    if is_all and findings.others:
        told = ", ".join(findings.others[:5])
        raise MachineFailure(
            FailureKind.DATA,
            f"COSMoS's folder there holds what is not COSMoS's: {told}",
            "move that away first; single runs go without --all",
        )
    is_root = is_all and findings.has_root
    installed = sum(findings.installed_bytes.values()) if is_root else 0
    return Order(runs=runs, kept=kept, is_root=is_root, installed_bytes=installed)


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
    with Board.start(connection, PARTS) as board:
        where = {"runs": layout.runs, "state": layout.state}
        listed = board.call("inventory_runs", where, timeout_s=ASK_TIMEOUT_S).value
        runs = tuple(_run_there(board, target, entry, known) for entry in listed)
        if not is_all:
            return Findings(runs=runs)
        root = {"root": layout.root, "state": layout.state}
        content = board.call("root_content", root, timeout_s=ASK_TIMEOUT_S).value
    return Findings(
        runs=runs,
        installed_bytes=content["bytes"],
        others=tuple(content["others"]),
        living=tuple(content["living"]),
        has_root=content["is_there"],
    )


def carry_out(connection: Connection, order: Order, holder: str) -> Wiped:
    """
    Delete on a machine what was decided, each thing only if it is still what it was.

    Args:
        connection: To the machine.
        order: What goes.
        holder: Who takes the machine's lock meanwhile.

    Raises:
        MachineFailure: Something changed, lives, or could not be deleted; what went is gone.
    """
    target = connection.target
    layout = Layout(target.root)
    with Board.start(connection, PARTS) as board:
        board.call("lock", {"path": layout.lock, "holder": holder})
        for run in order.runs:
            _delete(board, target, run)
        if not order.is_root:
            return Wiped(runs=tuple(run.name for run in order.runs), bytes=order.bytes)
        root = {"root": layout.root, "state": layout.state}
        left = tuple(board.call("remove_root", root, timeout_s=DELETE_TIMEOUT_S).value)
    return Wiped(
        runs=tuple(run.name for run in order.runs),
        bytes=order.bytes,
        is_root_gone=not left,
        left=left,
    )


def runs_here(root: Path) -> dict[str, RunDirectory]:
    """Return the runs of a folder, and those of this user elsewhere, by the name of their directory on machines."""
    remembered = (RunDirectory(entry.path) for entry in remembered_runs())
    found: dict[str, RunDirectory] = {}
    for run in (*remembered, *list_runs(root)):
        session = (run.read_json(run.plan_json) or {}).get("session")
        if isinstance(session, str) and session:
            found[Path(Layout("").run(run.name, session)).name] = run
    return found


def _run_there(
    board: Board, target: Target, entry: Mapping[str, Any], known: Mapping[str, RunDirectory]
) -> RunThere:
    name = str(entry["name"])
    run = known.get(name)
    state: State = "not collected"
    if entry["living"]:
        state = "running"
    elif name.startswith(RELEASED_PREFIX):
        state = "left over"
    elif run is not None and _is_here(board, target, name, run):
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


def _is_here(board: Board, target: Target, name: str, run: RunDirectory) -> bool:
    """Tell whether all that a machine has of a run is, unchanged, what was verified here and is here still."""
    note = read_note(run, target.name)
    is_known = note is not None and note.manifest_sha256 == _listed(board, target, name)
    return is_known and is_all_here(run, target.name)


def _listed(board: Board, target: Target, name: str) -> str | None:
    """Have a run's directory listed there, and return the hash of its manifest."""
    digest, told = hashlib.sha256(), None
    for answer in board.parts("manifest", _where(target, name), timeout_s=PIECE_TIMEOUT_S):
        for entry in answer.value.get("files", ()):
            digest.update(entry_line(entry))
        told = answer.value.get("sha256", told)
    return told if told == digest.hexdigest() else None


def _delete(board: Board, target: Target, run: RunThere) -> None:
    where = _where(target, run.name)
    if run.state != "collected":
        shown = {"bytes": run.bytes, "files": run.files, "newest_s": run.newest_s}
        board.call("discard", {**where, "shown": shown}, timeout_s=DELETE_TIMEOUT_S)
        return
    here = RunDirectory(Path(str(run.here)))
    if not _is_here(board, target, run.name, here):
        text = f"{run.name} is not what was collected any more"
        raise MachineFailure(FailureKind.DATA, text, "repeat the command")
    note = read_note(here, target.name)
    assert note is not None, "_is_here read it"
    digest = {"manifest_sha256": note.manifest_sha256}
    board.call("release", {**where, **digest}, timeout_s=DELETE_TIMEOUT_S)
    write_note(here, target.name, note.as_released())


def _where(target: Target, name: str) -> dict[str, str]:
    layout = Layout(target.root)
    return {"directory": f"{layout.runs}/{name}", "state": layout.state}
