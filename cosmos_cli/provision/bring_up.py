"""
`cosmos up` on one machine: facts, plan, steps, check. One connection; without a change, one question.

The first look takes no lock and changes nothing. Where something must change the lock is taken, and the
facts are asked for again, as another command may have worked there meanwhile.
"""

from __future__ import annotations

import dataclasses
import os
import socket
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from cosmos_cli.fleet.board import Board
from cosmos_cli.fleet.connection import Connection
from cosmos_cli.fleet.failure import FailureKind, MachineFailure
from cosmos_cli.models.inventory import Machine
from cosmos_cli.provision.apply import Applier, Done, Teller
from cosmos_cli.provision.facts import Facts, files_of
from cosmos_cli.provision.notes import notes_of, priority_notes
from cosmos_cli.provision.settings import setting_files
from cosmos_cli.provision.step import Kind, Step
from cosmos_cli.provision.steps import check_possible, installed_question, plan_steps
from cosmos_cli.provision.wanted import Content, Paths, Wanted, questions, wanted_of

LOOK_PARTS = ("files", "facts", "store", "trees", "environment")
WORK_PARTS = (*LOOK_PARTS, "system", "apt_words", "apt")
LOCK_PATIENCE_S = 60.0
"""Without a question for so long the machine's lock is given up: the operator is gone."""
LOOK_TIMEOUT_S = 150.0
"""For all facts, conditions of commands included."""
LOGIN_TIMEOUT_S = 10.0
CHECK_TITLE = "runtime starts, and UDP comes and goes"


@dataclass(frozen=True, slots=True, kw_only=True)
class Kit:
    """What machines are made ready with; one for all of them."""

    environments: Callable[[Machine, Mapping[str, Any], Teller], tuple[Any, ...]]
    """Builds what a machine needs, from its entry and what the helper there greeted with."""
    trees: tuple[Any, ...]
    """The runtime's first."""
    read_file: Callable[[Path], Content]
    echo: Callable[[Connection, Machine], Mapping[str, Any] | None]
    """How a machine asks this computer for a UDP answer; None to leave that out."""
    connect_again: Callable[[Connection], Connection]
    paths: Paths = Paths()


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
        brought.failure = failure
    return brought


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
        with Board.start(self.connection, LOOK_PARTS) as board:
            environments = self.kit.environments(self.machine, board.greeting, self.teller)
            wanted = dataclasses.replace(
                wanted_of(
                    self.machine,
                    home=str(board.greeting["home"]),
                    read_file=self.kit.read_file,
                    environments=environments,
                    trees=self.kit.trees,
                ),
                paths=self.kit.paths,
            )
            check = self._check_calls(wanted)
            refused = self._look(board, wanted, also=check)
            steps = self._plan(wanted)
            if not steps:
                _raise_first(refused)
                self._note(wanted)
                self._checked()
                return
            if self.options.is_check:
                if any(step.needs_root for step in steps):
                    self._look(board, wanted, is_sudo_asked=True)
                check_possible(self._facts, steps)
                self._note(wanted)
                self.brought.done = [Done(step=step, changed=True) for step in steps]
                return
        self._change(wanted, check)

    def _change(self, wanted: Wanted, check: Sequence[Mapping[str, Any]]) -> None:
        with Board.start(self.connection, WORK_PARTS) as board:
            self._lock(board, wanted)
            self._look(board, wanted, is_sudo_asked=True)
            steps = self._plan(wanted)
            check_possible(self._facts, steps)
            applier = Applier(board=board, layout=wanted.layout, teller=self.teller)
            self.brought.done = applier.done
            try:
                applier.apply(steps)
            finally:
                self.brought.notes += applier.notes
            self.teller.detail("checking")
            _raise_first(_several(board, check))
        self._note(wanted)
        self._checked()

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
        board.call("lock", arguments)

    def _look(
        self,
        board: Board,
        wanted: Wanted,
        *,
        is_sudo_asked: bool = False,
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
            {"verb": "installed", "arguments": installed_question(wanted)},
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

    def _check_calls(self, wanted: Wanted) -> list[Mapping[str, Any]]:
        """Return the questions that tell whether the runtime starts there and UDP comes and goes."""
        if not wanted.trees:
            return []
        layout, udp = wanted.layout, self.kit.echo(self.connection, self.machine)
        return [
            {
                "verb": "check_runtime",
                "arguments": {
                    "python": layout.python(environment.key),
                    "path": layout.tree(wanted.trees[0].hash),
                    "udp": udp if index == 0 else None,
                },
            }
            for index, environment in enumerate(wanted.environments)
        ]

    def _checked(self) -> None:
        if self.kit.trees:
            step = Step(kind=Kind.CHECK, title=CHECK_TITLE)
            self.brought.done = [*self.brought.done, Done(step=step, changed=False)]

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
