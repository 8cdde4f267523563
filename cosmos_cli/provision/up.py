"""
`cosmos up`: gathers facts of a machine, plans steps, carries them out and checks the result; for a fleet, on all machines.

One connection per machine, and where nothing is to change, one question. The first look takes no lock and changes
nothing. Where something must change the lock is taken, and the facts are asked for again: another command may have
worked there meanwhile.
"""

from __future__ import annotations

import contextlib
import dataclasses
import os
import socket
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cosmos_cli.errors import InputError
from cosmos_cli.fleet.connection import SMALL_BYTES_MAX, Connection
from cosmos_cli.fleet.failure import FailureKind, MachineFailure
from cosmos_cli.fleet.fleet import Fleet
from cosmos_cli.fleet.helper import Helper
from cosmos_cli.models.inventory import Machine, no_machine_words
from cosmos_cli.models.machine_facts import MachineFacts
from cosmos_cli.provision.apply import REPEAT, Applier
from cosmos_cli.provision.desired import DesiredState, desired_state
from cosmos_cli.provision.device_steps import reboot_notes
from cosmos_cli.provision.environment import pack_wheels
from cosmos_cli.provision.full_checks import machine_kind
from cosmos_cli.provision.gather_facts import (
    Answer,
    Call,
    fact_calls,
    gather_facts,
    raise_first,
    realtime_priority_of,
    several,
)
from cosmos_cli.provision.resources import UpResources
from cosmos_cli.provision.step import Done, Kind, Step, StepRequest
from cosmos_cli.provision.steps import check_possible, notes_of, plan_steps
from cosmos_cli.provision.udp_echo import Echo
from cosmos_cli.provision.unchecked import needs_check, note_unchecked, strike_out
from cosmos_cli.provision.up_table import MachineResult
from cosmos_cli.provision.up_view import MachineTeller, UpView
from cosmos_cli.system.import_turn import IMPORT_TURN

if TYPE_CHECKING:
    from cosmos_cli.models.loading import ScenarioFile

LOCK_WAIT_S = 10.0
"""Wait for another command to end there: one that was cut off gives the lock up within moments."""
LOCK_RETRY_S = 0.5
LOGIN_TIMEOUT_S = 10.0
CHECK_TITLE = "runtime starts, and UDP comes and goes"


@dataclass(frozen=True, slots=True, kw_only=True)
class UpOptions:
    """Options of `cosmos up`."""

    is_check: bool = False
    """Whether the plan is shown and nothing changed."""
    has_texts: bool = False
    """Whether contents of files are wanted, for --diff."""
    host: str | None = None
    """The machine that will run the host's half; None for this computer."""


@dataclass(slots=True, kw_only=True)
class MachineUp:
    """
    The work on one machine; `run` does it.

    Args:
        connection: To the machine.
        helper: Started there with `cosmos_cli.provision.HELPER_PARTS`.
        machine: Its entry in the inventory.
        resources: What it is made ready with.
        options: What was asked for.
        teller: Told what is being done there.
        result: Filled with what becomes of it.
    """

    connection: Connection
    helper: Helper
    machine: Machine
    resources: UpResources
    options: UpOptions
    teller: MachineTeller
    result: MachineResult

    def run(self) -> MachineResult:
        """Make the machine ready, or plan it; its failure is in the result."""
        try:
            self._work()
        except MachineFailure as failure:
            self.result.failure = failure
            if failure.kind is FailureKind.TIMEOUT and not self.connection.is_alive():  # not slow
                text = f"it stopped answering: {failure.text}"
                self.result.failure = MachineFailure(FailureKind.LOST, text, REPEAT)
        return self.result

    def _work(self) -> None:
        self.teller.detail("looking")
        desired = self._desired()
        udp = self.resources.udp_question(self.connection, self.machine)
        checks = self._look(desired, also=self.resources.checks(desired, udp, depth="look"))
        steps = self._plan(desired)
        is_doubtful = needs_check(self._facts, desired)
        if steps and self.options.is_check:
            self._foresee(desired, steps)
        elif steps or (is_doubtful and not self.options.is_check):
            self._change(desired)
        else:
            check_possible(self._facts, steps)
            self._raise_first(checks, udp)
            if is_doubtful:
                self._check(desired)
        self._note(desired)
        if not (steps and self.options.is_check) and desired.trees:
            check = Done(step=Step(kind=Kind.CHECK, title=CHECK_TITLE), changed=False)
            self.result.done = [*self.result.done, check]

    def _desired(self) -> DesiredState:
        greeting = self.helper.greeting
        desired = desired_state(
            self.machine.variables,
            home=str(greeting["home"]),
            read_file=self.resources.read_file,
            environments=self.resources.environments(self.machine, greeting, self.teller),
            trees=self.resources.trees(self.machine),
        )
        needs = self.resources.needs(self.machine)
        return dataclasses.replace(desired, paths=self.resources.paths, needs=needs)

    def _foresee(self, desired: DesiredState, steps: tuple[Step, ...]) -> None:
        """Say what would be done, or that it cannot be done."""
        if any(step.needs_root for step in steps):
            self._look(desired, is_sudo_asked=True)
        check_possible(self._facts, steps)
        self.result.done = [Done(step=step, changed=True) for step in steps]

    def _change(self, desired: DesiredState) -> None:
        applier = Applier(helper=self.helper, layout=desired.layout, teller=self.teller)
        self.result.done = applier.done
        try:
            self._apply(desired, applier)
        finally:
            self.result.notes += applier.notes
        self._check(desired)
        self._ask(strike_out(self._facts, desired))

    def _check(self, desired: DesiredState) -> None:
        """See that what is wanted works there, in full on the first machine of its kind."""
        self.teller.detail("checking")
        udp = self.resources.udp_question(self.connection, self.machine)
        kind = machine_kind(self._facts, desired)
        with self.resources.full_checks.turn(kind) as is_full:
            checks = self.resources.checks(desired, udp, depth="full" if is_full else "start")
            self._raise_first(several(self.helper, checks), udp)

    def _apply(self, desired: DesiredState, applier: Applier) -> None:
        """Make the folders, for the lock is in one of them; lock; look again; do the rest."""
        self._look(desired, is_sudo_asked=True)
        steps = self._plan(desired)
        check_possible(self._facts, steps)
        folders = tuple(step for step in steps if step.kind is Kind.DIRECTORY)
        applier.apply(folders)
        for step in steps:
            if step.kind is Kind.ENVIRONMENT:
                self.teller.detail("packing what is sent")
                pack_wheels(step.subject)
        self._lock(desired)
        can_become_root = self._facts.can_become_root
        self._look(desired, touch=True)
        self.result.facts = dataclasses.replace(self._facts, can_become_root=can_become_root)
        steps = self._plan(desired)
        check_possible(self._facts, steps)
        self.result.planned = (*folders, *steps)
        if steps:
            self._ask(note_unchecked(self._facts, desired))
        applier.apply(steps)

    def _ask(self, request: StepRequest) -> None:
        self.helper.call(request.verb, request.arguments, body=request.body)

    @property
    def _facts(self) -> MachineFacts:
        assert self.result.facts is not None
        return self.result.facts

    def _plan(self, desired: DesiredState) -> tuple[Step, ...]:
        self.result.planned = plan_steps(self._facts, desired)
        return self.result.planned

    def _lock(self, desired: DesiredState) -> None:
        holder = f"cosmos up on {socket.gethostname()}, pid {os.getpid()}"
        arguments = {"path": desired.layout.lock, "holder": holder}
        until_s = time.monotonic() + LOCK_WAIT_S
        while True:
            try:
                self.helper.call("lock", arguments)
                return
            except MachineFailure as failure:
                if failure.kind is not FailureKind.BUSY or time.monotonic() > until_s:
                    raise
                self.teller.detail(f"waiting: {failure.text}")
                time.sleep(LOCK_RETRY_S)

    def _look(
        self,
        desired: DesiredState,
        *,
        is_sudo_asked: bool = False,
        touch: bool = False,
        also: Sequence[Call] = (),
    ) -> list[Answer]:
        """Ask for all facts at once, and for *also*, whose answers are returned."""
        known = self._facts.conditions if is_sudo_asked else {}
        calls = fact_calls(
            desired,
            has_texts=self.options.has_texts,
            is_sudo_asked=is_sudo_asked,
            touch=touch,
        )
        facts, others = gather_facts(
            self.helper, [*calls, *also], may_become_root=desired.variables.may_become_root
        )
        self.result.facts = dataclasses.replace(facts, conditions={**known, **facts.conditions})
        return others

    def _raise_first(self, answers: Sequence[Answer], udp: dict[str, Any]) -> None:
        """Raise for a check that failed; where datagrams came from there and the answers did not arrive, say so."""
        try:
            raise_first(answers)
        except MachineFailure as failure:
            if "no UDP" not in failure.text or not self.resources.udp_heard(udp):
                raise
            text = "UDP from there comes here, but the answers do not come back"
            advice = "is a firewall closing it, on the machine or on the way?"
            raise MachineFailure(failure.kind, text, advice) from None

    def _note(self, desired: DesiredState) -> None:
        facts, priority = self._facts, desired.variables.cosmos_realtime_priority
        has_new_limit = any(step.subject == "realtime_priority" for step in self.result.planned)
        if priority is not None and has_new_limit:
            # In a check nobody was granted it yet.
            granted = None if self.options.is_check else self._granted_to_new_login()
            facts = dataclasses.replace(facts, realtime_priority_max=granted)
        self.result.notes += notes_of(facts, desired)
        if not self.options.is_check:
            self.result.notes += reboot_notes(self.result.done, desired.paths)

    def _granted_to_new_login(self) -> int | None:
        """Return the real-time priority that a login of now is granted; None for no limit, and where it is not known."""
        try:
            with contextlib.closing(self.resources.connect_again(self.connection)) as connection:
                said = connection.run(
                    "cat /proc/self/limits",
                    timeout_s=LOGIN_TIMEOUT_S,
                    said_bytes_max=SMALL_BYTES_MAX,
                ).stdout
        except MachineFailure as failure:
            self.result.notes.append(f"what a new login is granted is not known: {failure.text}")
            return None
        return realtime_priority_of(said.decode(errors="replace"))


class FleetUp:
    """
    Makes the machines of a fleet ready, or plans it; used by many threads.

    Args:
        fleet: The machines.
        scenarios: What they are made ready for; none for the runtime alone.
        options: What was asked for.
        echo: Answers datagrams here.
        view: Shows what is done.

    Raises:
        InputError: Faults of the inventory or a scenario, or no such host.
    """

    def __init__(
        self,
        fleet: Fleet,
        scenarios: Sequence[Path],
        options: UpOptions,
        *,
        echo: Echo,
        view: UpView,
    ) -> None:
        self._machines = {machine.name: machine for machine in fleet.machines}
        if options.host is not None and options.host not in self._machines:
            words = no_machine_words(fleet.machines, options.host)
            raise InputError(f"--host {options.host}: {words}")
        self._options = options
        self._view = view
        self.scenarios = tuple(_load(scenarios, view))
        self._resources = UpResources(
            self.scenarios,
            fleet,
            host=options.host,
            echo=echo,
            say=view.say,
        )

    def warn(self, remark: str) -> None:
        """Show a warning before any machine is worked on."""
        self._view.say(f"warning: {remark}")

    def bring(self, connection: Connection, helper: Helper) -> MachineResult:
        """Make one machine ready; *helper* is started there with HELPER_PARTS."""
        name = connection.target.name
        return MachineUp(
            connection=connection,
            helper=helper,
            machine=self._machines[name],
            resources=self._resources,
            options=self._options,
            teller=self._view.teller(name),
            result=MachineResult(machine=name),
        ).run()


def _load(paths: Sequence[Path], view: UpView) -> list[ScenarioFile]:
    if not paths:
        return []
    with IMPORT_TURN:
        from cosmos_cli.models.loading import load_scenario  # not needed for the runtime alone

    def warn(remark: str) -> None:
        view.say(f"warning: {remark}")

    return [load_scenario(path, warn=warn) for path in paths]
