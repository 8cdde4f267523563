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
from pathlib import Path
from typing import Any, Protocol

from cosmos_cli.fleet.board import Board
from cosmos_cli.fleet.connection import Connection
from cosmos_cli.fleet.failure import FailureKind, MachineFailure
from cosmos_cli.models.inventory import Machine
from cosmos_cli.provision.apply import REPEAT, Applier, Done, Teller
from cosmos_cli.provision.brought import Brought, UpOptions
from cosmos_cli.provision.facts import Facts
from cosmos_cli.provision.look import Question, look, raise_first, realtime_priority_of, several
from cosmos_cli.provision.notes import notes_of
from cosmos_cli.provision.step import Kind, Step
from cosmos_cli.provision.steps import check_possible, plan_steps
from cosmos_cli.provision.wanted import Content, Paths, Wanted, wanted_of

LOCK_WAIT_S = 10.0
"""For another command to end there: one that was cut off gives the lock up within moments."""
LOCK_RETRY_S = 0.5
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
class Site:
    """One machine at which work goes on."""

    connection: Connection
    board: Board
    """Started there with `cosmos_cli.provision.parts.HELPER_PARTS`."""
    machine: Machine
    """Its entry in the inventory."""


def bring_up(site: Site, kit: Kit, options: UpOptions, teller: Teller) -> Brought:
    """
    Make a machine ready, or plan it.

    Args:
        site: The machine.
        kit: What it is made ready with.
        options: What was asked for.
        teller: Told what is being done there.

    Returns:
        What became of it; its failure is in there.
    """
    brought = Brought()
    try:
        _Work(site, kit, options, teller, brought).do()
    except MachineFailure as failure:
        brought.failure = _explained(site.connection, failure)
    return brought


def _explained(connection: Connection, failure: MachineFailure) -> MachineFailure:
    """Tell a machine that is gone from one that is slow."""
    if failure.kind is not FailureKind.TIMEOUT or connection.is_alive():
        return failure
    return MachineFailure(FailureKind.LOST, f"it stopped answering: {failure.text}", REPEAT)


@dataclass(slots=True)
class _Work:
    site: Site
    kit: Kit
    options: UpOptions
    teller: Teller
    brought: Brought

    def do(self) -> None:
        self.teller.detail("looking")
        wanted = self._wanted()
        udp = self._udp_question()
        checks = self._look(wanted, also=self._checks(wanted, udp, is_full=False))
        steps = self._plan(wanted)
        if not steps:
            self._raise_first(checks, udp)
        elif self.options.is_check:
            self._foresee(wanted, steps)
        else:
            self._change(wanted)
        self._note(wanted)
        if not (steps and self.options.is_check) and self.kit.trees:
            step = Step(kind=Kind.CHECK, title=CHECK_TITLE)
            self.brought.done = [*self.brought.done, Done(step=step, changed=False)]

    def _wanted(self) -> Wanted:
        machine, greeting = self.site.machine, self.site.board.greeting
        environments = self.kit.environments(machine, greeting, self.teller)
        wanted = wanted_of(
            machine,
            home=str(greeting["home"]),
            read_file=self.kit.read_file,
            environments=environments,
            trees=self.kit.trees,
        )
        return dataclasses.replace(wanted, paths=self.kit.paths)

    def _udp_question(self) -> dict[str, Any]:
        return self.kit.udp_question(self.site.connection, self.site.machine)

    def _foresee(self, wanted: Wanted, steps: tuple[Step, ...]) -> None:
        """Say what would be done, or that it cannot be done."""
        if any(step.needs_root for step in steps):
            self._look(wanted, is_sudo_asked=True)
        check_possible(self._facts, steps)
        self.brought.done = [Done(step=step, changed=True) for step in steps]

    def _change(self, wanted: Wanted) -> None:
        board = self.site.board
        applier = Applier(board=board, layout=wanted.layout, teller=self.teller)
        self.brought.done = applier.done
        try:
            self._apply(wanted, applier)
        finally:
            self.brought.notes += applier.notes
        self.teller.detail("checking")
        udp = self._udp_question()
        self._raise_first(several(board, self._checks(wanted, udp, is_full=True)), udp)

    def _apply(self, wanted: Wanted, applier: Applier) -> None:
        """Make the folders, for the lock is in one of them; lock; look again; do the rest."""
        self._look(wanted, is_sudo_asked=True)
        steps = self._plan(wanted)
        check_possible(self._facts, steps)
        folders = tuple(step for step in steps if step.kind is Kind.DIRECTORY)
        applier.apply(folders)
        self._lock(wanted)
        can_become_root = self._facts.can_become_root
        self._look(wanted, touch=True)
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

    def _lock(self, wanted: Wanted) -> None:
        holder = f"cosmos up on {socket.gethostname()}, pid {os.getpid()}"
        arguments = {"path": wanted.layout.lock, "holder": holder}
        until_s = time.monotonic() + LOCK_WAIT_S
        while True:
            try:
                self.site.board.call("lock", arguments)
                return
            except MachineFailure as failure:
                if failure.kind is not FailureKind.BUSY or time.monotonic() > until_s:
                    raise
                self.teller.detail(f"waiting: {failure.text}")
                time.sleep(LOCK_RETRY_S)

    def _look(
        self,
        wanted: Wanted,
        *,
        is_sudo_asked: bool = False,
        touch: bool = False,
        also: Sequence[Mapping[str, Any]] = (),
    ) -> list[Mapping[str, Any]]:
        """Ask for all facts at once, and for *also*, whose answers are returned."""
        question = Question(
            wanted=wanted,
            has_texts=self.options.has_texts,
            is_sudo_asked=is_sudo_asked,
            touch=touch,
        )
        self.brought.facts, others = look(self.site.board, question, also)
        return others

    def _checks(
        self, wanted: Wanted, udp: dict[str, Any], *, is_full: bool
    ) -> list[Mapping[str, Any]]:
        asked = self.kit.checks(wanted, udp, is_full=is_full)
        return [{"verb": "check_runtime", "arguments": arguments} for arguments in asked]

    def _raise_first(self, answers: Sequence[Mapping[str, Any]], udp: dict[str, Any]) -> None:
        """Raise for a check that failed; say of datagrams that came but were not answered there, that it is so."""
        try:
            raise_first(answers)
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
        try:
            granted = self._granted_to_new_login()
        except MachineFailure as failure:
            self.brought.notes.append(f"what a new login is granted is not known: {failure.text}")
            granted = None
        facts = dataclasses.replace(facts, realtime_priority_max=granted)
        self.brought.notes += notes_of(facts, wanted)

    def _granted_to_new_login(self) -> int | None:
        """Return the real-time priority that a login of now is granted; None for no limit."""
        connection = self.kit.connect_again(self.site.connection)
        try:
            said = connection.run("cat /proc/self/limits", timeout_s=LOGIN_TIMEOUT_S).stdout
        finally:
            connection.close()
        return realtime_priority_of(said.decode(errors="replace"))
