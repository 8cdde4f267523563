"""
`cosmos up` on one machine: facts, plan, steps, check. One connection; without a change, one question.

The first look takes no lock and changes nothing. Where something must change the lock is taken, and the
facts are asked for again, as another command may have worked there meanwhile.
"""

from __future__ import annotations

import dataclasses
import os
import socket
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Protocol

from cosmos_cli.fleet.board import Board
from cosmos_cli.fleet.connection import Connection
from cosmos_cli.fleet.failure import FailureKind, MachineFailure
from cosmos_cli.fleet.silence import WatchedConnection
from cosmos_cli.models.inventory import Machine
from cosmos_cli.provision.apply import REPEAT, Applier, Done, Teller
from cosmos_cli.provision.environment import PARTS
from cosmos_cli.provision.facts import Facts, files_of
from cosmos_cli.provision.notes import notes_of, priority_notes
from cosmos_cli.provision.settings import setting_files
from cosmos_cli.provision.step import Kind, Step
from cosmos_cli.provision.steps import check_possible, installed_question, plan_steps
from cosmos_cli.provision.wanted import Content, Paths, Wanted, questions, wanted_of

HELPER_PARTS = ("files", "facts", *PARTS, "system", "apt_words", "apt")
"""Each is loaded there when it is first needed."""
LOCK_PATIENCE_S = 60.0
"""Without a question for so long the machine's lock is given up: the operator is gone."""
LOCK_WAIT_S = 10.0
"""For another command to end there: one that was cut off gives the lock up within moments."""
LOCK_RETRY_S = 0.5
LOOK_TIMEOUT_S = 150.0
"""For all facts, conditions of commands included."""
LOGIN_TIMEOUT_S = 10.0
CHECK_TITLE = "runtime starts, and UDP comes and goes"


class Kit(Protocol):
    """What machines are made ready with; one for all of them, used by many threads."""

    @property
    def trees(self) -> tuple[Any, ...]:
        """Return the trees that every machine gets, the runtime's first."""

    @property
    def paths(self) -> Paths:
        """Return where a machine's system keeps its settings."""

    def environments(
        self, machine: Machine, greeting: Mapping[str, Any], teller: Teller
    ) -> tuple[Any, ...]:
        """Return what a machine needs, built for what its helper greeted with."""

    def read_file(self, path: Path) -> Content:
        """Return a file of this computer."""

    def udp_question(self, connection: Connection, machine: Machine) -> dict[str, Any]:
        """Return where a machine is to send a datagram that comes back."""

    def udp_heard(self, question: dict[str, Any]) -> int:
        """Return how many datagrams of a question came here."""

    def checks(
        self, wanted: Wanted, udp: Mapping[str, Any], *, is_full: bool
    ) -> list[dict[str, Any]]:
        """Return the arguments of the questions whether the runtime starts there."""

    def connect_again(self, connection: Connection) -> Connection:
        """Return a second connection to the same machine: a new login."""


@dataclass(frozen=True, slots=True, kw_only=True)
class UpOptions:
    """What `cosmos up` was asked for."""

    is_check: bool = False
    """Show the plan and change nothing."""
    has_texts: bool = False
    """Contents of files are wanted, for --diff."""


@dataclass(slots=True, kw_only=True)
class Brought:
    """What became of one machine; filled while it is worked on, so that a failure hides nothing."""

    facts: Facts | None = None
    planned: tuple[Step, ...] = ()
    done: Sequence[Done] = ()
    notes: list[str] = dataclasses.field(default_factory=list)
    failure: MachineFailure | None = None
    is_local: bool = False

    @property
    def changed_count(self) -> int:
        """How many steps changed something, or would."""
        return sum(done.changed for done in self.done)


def bring_up(
    connection: Connection, machine: Machine, kit: Kit, options: UpOptions, teller: Teller
) -> Brought:
    """
    Make a machine ready, or plan it.

    Args:
        connection: To the machine.
        machine: Its entry in the inventory.
        kit: What it is made ready with.
        options: What was asked for.
        teller: Told what is being done there.

    Returns:
        What became of it; its failure is in there.
    """
    brought = Brought()
    try:
        _Work(connection, machine, kit, options, teller, brought).do()
    except MachineFailure as failure:
        brought.failure = _explained(connection, failure)
    return brought


def _explained(connection: Connection, failure: MachineFailure) -> MachineFailure:
    """Tell a machine that is gone from one that is slow."""
    if failure.kind is not FailureKind.TIMEOUT or connection.is_alive():
        return failure
    return MachineFailure(FailureKind.LOST, f"it stopped answering: {failure.text}", REPEAT)


@dataclass(slots=True)
class _Work:
    connection: Connection
    machine: Machine
    kit: Kit
    options: UpOptions
    teller: Teller
    brought: Brought

    def do(self) -> None:
        self.teller.detail("looking")
        with Board.start(WatchedConnection(self.connection), HELPER_PARTS) as board:
            wanted = self._wanted(board.greeting)
            udp = self.kit.udp_question(self.connection, self.machine)
            checks = self._look(board, wanted, also=self._checks(wanted, udp, is_full=False))
            steps = self._plan(wanted)
            if not steps:
                self._raise_first(checks, udp)
            elif self.options.is_check:
                self._foresee(board, wanted, steps)
            else:
                self._change(board, wanted)
        self._note(wanted)
        if not (steps and self.options.is_check) and self.kit.trees:
            step = Step(kind=Kind.CHECK, title=CHECK_TITLE)
            self.brought.done = [*self.brought.done, Done(step=step, changed=False)]

    def _wanted(self, greeting: Mapping[str, Any]) -> Wanted:
        environments = self.kit.environments(self.machine, greeting, self.teller)
        wanted = wanted_of(
            self.machine,
            home=str(greeting["home"]),
            read_file=self.kit.read_file,
            environments=environments,
            trees=self.kit.trees,
        )
        return dataclasses.replace(wanted, paths=self.kit.paths)

    def _foresee(self, board: Board, wanted: Wanted, steps: tuple[Step, ...]) -> None:
        """Say what would be done, or that it cannot be done."""
        if any(step.needs_root for step in steps):
            self._look(board, wanted, is_sudo_asked=True)
        check_possible(self._facts, steps)
        self.brought.done = [Done(step=step, changed=True) for step in steps]

    def _change(self, board: Board, wanted: Wanted) -> None:
        applier = Applier(board=board, layout=wanted.layout, teller=self.teller)
        self.brought.done = applier.done
        try:
            self._apply(board, wanted, applier)
        finally:
            self.brought.notes += applier.notes
        self.teller.detail("checking")
        udp = self.kit.udp_question(self.connection, self.machine)
        self._raise_first(_several(board, self._checks(wanted, udp, is_full=True)), udp)

    def _apply(self, board: Board, wanted: Wanted, applier: Applier) -> None:
        """Make the folders, for the lock is in one of them; lock; look again; do the rest."""
        self._look(board, wanted, is_sudo_asked=True)
        steps = self._plan(wanted)
        check_possible(self._facts, steps)
        folders = tuple(step for step in steps if step.kind is Kind.DIRECTORY)
        applier.apply(folders)
        self._lock(board, wanted)
        can_become_root = self._facts.can_become_root
        self._look(board, wanted, touch=True)
        self.brought.facts = dataclasses.replace(self._facts, can_become_root=can_become_root)
        steps = self._plan(wanted)
        check_possible(self._facts, steps)
        self.brought.planned = (*folders, *steps)
        applier.apply(steps)

    @property
    def _facts(self) -> Facts:
        assert self.brought.facts is not None
        return self.brought.facts

    def _plan(self, wanted: Wanted) -> tuple[Step, ...]:
        self.brought.planned = plan_steps(self._facts, wanted)
        return self.brought.planned

    def _lock(self, board: Board, wanted: Wanted) -> None:
        holder = f"cosmos up on {socket.gethostname()}, pid {os.getpid()}"
        arguments = {
            "path": wanted.layout.lock,
            "holder": holder,
            "patience_s": LOCK_PATIENCE_S,
        }
        until_s = time.monotonic() + LOCK_WAIT_S
        while True:
            try:
                board.call("lock", arguments)
                return
            except MachineFailure as failure:
                if failure.kind is not FailureKind.BUSY or time.monotonic() > until_s:
                    raise
                self.teller.detail(f"waiting: {failure.text}")
                time.sleep(LOCK_RETRY_S)

    def _look(
        self,
        board: Board,
        wanted: Wanted,
        *,
        is_sudo_asked: bool = False,
        touch: bool = False,
        also: Sequence[Mapping[str, Any]] = (),
    ) -> list[Mapping[str, Any]]:
        """Ask for all facts at once, and for *also*, whose answers are returned."""
        home = str(board.greeting["home"])
        asked = questions(
            wanted,
            home=home,
            setting_files=setting_files(wanted.paths),
            has_texts=self.options.has_texts,
        )
        is_sudo_asked = is_sudo_asked and wanted.may_become_root
        calls = [
            {"verb": "facts", "arguments": {**asked, "sudo": is_sudo_asked}},
            {"verb": "installed", "arguments": installed_question(wanted, touch=touch)},
            *also,
        ]
        asked_utc_s = _utc_s()
        told, installed, *others = _several(board, calls)
        _raise_first([told, installed])
        facts = Facts.from_mapping(told["value"], asked_utc_s=asked_utc_s, answered_utc_s=_utc_s())
        facts = _with_installed(facts, installed["value"])
        if wanted.may_become_root:
            facts = _as_root(board, facts, asked)
        else:
            facts = dataclasses.replace(facts, can_become_root=False)
        self.brought.facts = facts
        return others

    def _checks(
        self, wanted: Wanted, udp: dict[str, Any], *, is_full: bool
    ) -> list[Mapping[str, Any]]:
        asked = self.kit.checks(wanted, udp, is_full=is_full)
        return [{"verb": "check_runtime", "arguments": arguments} for arguments in asked]

    def _raise_first(self, answers: Sequence[Mapping[str, Any]], udp: dict[str, Any]) -> None:
        """Raise for a check that failed; say of datagrams that came but were not answered there, that it is so."""
        try:
            _raise_first(answers)
        except MachineFailure as failure:
            if "no UDP" not in failure.text or not self.kit.udp_heard(udp):
                raise
            text = "UDP from there comes here, but the answers do not come back"
            advice = "is a firewall closing it, on the machine or on the way?"
            raise MachineFailure(failure.kind, text, advice) from None

    def _note(self, wanted: Wanted) -> None:
        facts, priority = self._facts, wanted.settings.realtime_priority
        has_new_limit = any(step.subject == "realtime_priority" for step in self.brought.planned)
        if priority is None or not has_new_limit or self.options.is_check:
            self.brought.notes += notes_of(facts, wanted)
            return
        granted = self._granted_to_new_login()
        spared = dataclasses.replace(facts, realtime_priority_max=None)
        self.brought.notes += notes_of(spared, wanted)
        self.brought.notes += priority_notes(facts, priority, granted)

    def _granted_to_new_login(self) -> int | None:
        """Return the real-time priority that a login of now is granted; None for no limit."""
        connection = self.kit.connect_again(self.connection)
        try:
            said = connection.run("cat /proc/self/limits", timeout_s=LOGIN_TIMEOUT_S).stdout
        finally:
            connection.close()
        for line in said.decode(errors="replace").splitlines():
            if line.startswith("Max realtime priority"):
                hard = line.split()[4]
                return int(hard) if hard.isdecimal() else None
        return None


def _several(board: Board, calls: Sequence[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    answers: list[Mapping[str, Any]] = board.call(
        "several", {"calls": list(calls)}, timeout_s=LOOK_TIMEOUT_S
    ).value
    return answers


def _raise_first(answers: Sequence[Mapping[str, Any]]) -> None:
    for answer in answers:
        if not answer["ok"]:
            error = answer["error"]
            raise MachineFailure(FailureKind(error["kind"]), error["text"], error["advice"])


def _with_installed(facts: Facts, told: Mapping[str, Any]) -> Facts:
    prunable = told.get("prunable") or {}
    return dataclasses.replace(
        facts,
        trees=frozenset(name for name, is_whole in told["trees"].items() if is_whole),
        environments=frozenset(key for key, is_whole in told["environments"].items() if is_whole),
        prunable=tuple(f"{kind}/{name}" for kind, names in prunable.items() for name in names),
    )


def _as_root(board: Board, facts: Facts, asked: Mapping[str, Any]) -> Facts:
    """Ask root about what the user is not shown; where nobody becomes root it stays unknown."""
    files = {
        path: asked["files"][path] for path, fact in facts.files.items() if fact.kind == "denied"
    }
    conditions = {
        key: asked["conditions"][key]
        for key, is_done in facts.conditions.items()
        if is_done is None
    }
    if not files and not conditions:
        return facts
    try:
        told = board.call(
            "look",
            {"files": files, "conditions": conditions},
            as_root=True,
            timeout_s=LOOK_TIMEOUT_S,
        ).value
    except MachineFailure as failure:
        if failure.kind is not FailureKind.NO_SUDO:
            raise
        return facts
    return dataclasses.replace(
        facts,
        files={**facts.files, **files_of(told)},
        conditions={**facts.conditions, **told["conditions"]},
    )


def _utc_s() -> float:
    return datetime.now(UTC).timestamp()
