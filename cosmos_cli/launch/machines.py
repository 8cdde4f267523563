"""
The machines of a run while it lasts: one connection and one helper process each, and where things are there.

For the threads of `Background` and of the pool; the operator's loop never calls what waits.
"""

from __future__ import annotations

import contextlib
import dataclasses
import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from cosmos_cli.errors import InputError, MachinesError
from cosmos_cli.fleet.connection import Connection, ConnectOptions
from cosmos_cli.fleet.failure import FailureKind, MachineFailure
from cosmos_cli.fleet.helper import Helper
from cosmos_cli.fleet.layout import Layout
from cosmos_cli.fleet.outcome import Outcome, failure_teller, raise_if_failed
from cosmos_cli.fleet.pool import for_each
from cosmos_cli.fleet.target import Target
from cosmos_cli.onboard.request_loop import BOOT_ID_FILE

PARTS = ("madns_runtime.processes", "processes")
ASK_TIMEOUT_S = 10.0
ALIVE_TIMEOUT_S = 1.5
RETURN_TIMEOUT_S = 5.0
"""To connect again to a machine that was lost: it answers, or the next try does better."""
OUT_OF_STEP = (FailureKind.LOST, FailureKind.TIMEOUT, FailureKind.DATA)
"""After these an answer may still come that belongs to no question."""

Connect = Callable[[Target, ConnectOptions], Connection]


class Prepared(Protocol):
    """Everything that a machine needs of a run is there; see `cosmos_cli.provision.before_run`."""

    @property
    def python(self) -> str:
        """The environment's interpreter."""

    @property
    def base_directory(self) -> str:
        """The scenario's folder there."""

    @property
    def driver_directory(self) -> str:
        """The folder of drivers beside the inventory; "" for none."""

    def variables(self) -> Mapping[str, str]:
        """Return the environment that programs of a run need, PYTHONPATH among it."""


Prepare = Callable[[Target, Helper], Prepared]
Identity = tuple[str, str, str]
"""Boot, name that a machine has for itself, and folder of COSMoS there."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MachinePaths:
    """Paths on one machine, with ~ resolved."""

    root: str
    state: str
    python: str
    variables: Mapping[str, str]
    base_directory: str
    driver_directory: str = ""


class RemoteMachine:
    """
    A machine that is logged in at and has all that a run needs.

    Args:
        connection: Open; closed by `close`.
        helper: The helper process there.
        prepared: What it said of its environment.
        options: How to connect again.
        connect: Opens a connection.
    """

    def __init__(
        self,
        connection: Connection,
        helper: Helper,
        prepared: Prepared,
        *,
        options: ConnectOptions,
        connect: Connect,
    ) -> None:
        home = str(helper.greeting["home"])
        root = expanded(connection.target.root, home)
        self.target = connection.target
        self.connection = connection
        self.paths = MachinePaths(
            root=root,
            state=Layout(root).state,
            python=expanded(prepared.python, home),
            variables=prepared.variables(),
            base_directory=expanded(prepared.base_directory, home),
            driver_directory=expanded(prepared.driver_directory, home),
        )
        self._options = dataclasses.replace(options, timeout_s=RETURN_TIMEOUT_S)
        self._connect = connect
        self._helper: Helper | None = helper
        self._lock = threading.Lock()
        self._connecting = threading.Lock()
        self.identity = identity_of(helper.greeting, connection.target.root)

    @property
    def name(self) -> str:
        """Its name in the inventory."""
        return self.target.name

    def directory_of(self, run: str, session_hex: str) -> str:
        """Return the run's directory there."""
        return Layout(self.paths.root).run(run, session_hex)

    def ask(
        self, verb: str, arguments: Mapping[str, Any], *, timeout_s: float = ASK_TIMEOUT_S
    ) -> Any:
        """
        Ask the helper process, one question at a time; one that has ended is started again.

        Raises:
            MachineFailure: It was refused, or the machine does not answer.
        """
        if not self._lock.acquire(timeout=timeout_s):
            raise MachineFailure(FailureKind.TIMEOUT, f"another question took over {timeout_s:g} s")
        try:
            if self._helper is None:
                self._helper = Helper.start(self.connection, PARTS, timeout_s=timeout_s)
            return self._helper.call(verb, arguments, timeout_s=timeout_s).value
        except MachineFailure as failure:
            if failure.kind in OUT_OF_STEP and self._helper is not None:
                helper, self._helper = self._helper, None
                helper.close()
            raise
        finally:
            self._lock.release()

    def is_alive(self, *, timeout_s: float = ALIVE_TIMEOUT_S) -> bool:
        """Ask for a sign of life of the machine itself."""
        return self.connection.is_alive(timeout_s=timeout_s)

    def has_started_anew(self) -> bool:
        """
        Tell whether it is another boot that answers than the one that was reached first.

        Raises:
            MachineFailure: It does not answer.
        """
        asked = self.connection.run(f"cat {BOOT_ID_FILE}", timeout_s=ASK_TIMEOUT_S)
        is_told = asked.exit_status == 0  # a machine without memory starts no program either
        return is_told and asked.stdout.decode(errors="replace").strip() != self.identity[0]

    def connect_again(self) -> None:
        """
        Make another connection if the present one is broken.

        Raises:
            MachineFailure: It does not answer.
        """
        with self._connecting:  # several programs there may miss it at the same time
            if self.is_alive():
                return
            self.connection.close()
            self.connection = self._connect(self.target, self._options)
            self._drop_helper()  # it has gone with the old one

    def return_to(self, directory: str, *, clean_s: float, forced_s: float) -> None:
        """
        Reach a machine that was lost, and end what still lives there of the run in *directory*.

        Raises:
            MachineFailure: It does not answer.
        """
        self.connect_again()
        arguments = {
            "state": self.paths.state,
            "directory": directory,
            "clean_s": clean_s,
            "forced_s": forced_s,
        }
        timeout_s = clean_s + 2 * forced_s + ASK_TIMEOUT_S
        try:
            ending = self.ask("end_run", arguments, timeout_s=timeout_s)
        except MachineFailure as failure:
            if failure.kind not in OUT_OF_STEP or not self.is_alive():
                raise
            # The helper had gone with it.
            ending = self.ask("end_run", arguments, timeout_s=timeout_s)
        if ending["left"]:
            pids = ", ".join(str(entry["pid"]) for entry in ending["left"])
            raise MachineFailure(FailureKind.STEP, f"even SIGKILL did not end {pids}")

    def close(self) -> None:
        """Let the helper end and close the connection."""
        self._drop_helper()
        self.connection.close()

    def _drop_helper(self) -> None:
        if self._lock.acquire(timeout=ASK_TIMEOUT_S):
            helper, self._helper = self._helper, None
            self._lock.release()
            if helper is not None:
                helper.close()


def reach_machines(  # noqa: PLR0913 - how machines are reached and prepared; all by name
    targets: Sequence[Target],
    prepare: Prepare,
    *,
    parts: Sequence[str],
    options: ConnectOptions,
    connect: Connect,
    forks: int,
    say: Callable[[str], None] = lambda text: None,
) -> dict[str, RemoteMachine]:
    """
    Connect to all machines and prepare each; whoever calls closes them. *say* is told each failure at once.

    Raises:
        MachinesError: Some failed, each is named; the others are closed again.
        InputError: Two are one.
    """

    def reach(target: Target) -> RemoteMachine:
        with contextlib.ExitStack() as opened:
            connection = opened.enter_context(contextlib.closing(connect(target, options)))
            helper = opened.enter_context(Helper.start(connection, (*PARTS, *parts)))
            machine = RemoteMachine(
                connection, helper, prepare(target, helper), options=options, connect=connect
            )
            opened.pop_all()  # whoever has the machine closes them
            return machine

    reached: dict[str, RemoteMachine] = {}
    tell_failure = failure_teller(say)

    def done(outcome: Outcome[RemoteMachine]) -> None:
        if outcome.value is not None:
            reached[outcome.machine] = outcome.value
        tell_failure(outcome)

    try:
        raise_if_failed(
            for_each(targets, reach, forks=forks, on_done=done), "the run was not started"
        )
        refuse_twins((target, reached[target.name].identity) for target in targets)
    except (KeyboardInterrupt, MachinesError, InputError):
        close_machines(tuple(reached.values()))
        raise
    return {target.name: reached[target.name] for target in targets}


def identity_of(greeting: Mapping[str, Any], root: str) -> Identity:
    """Return what two names of one machine with one folder have in common; containers of one boot differ in node."""
    return (
        str(greeting["boot_id"]),
        str(greeting["node"]),
        expanded(root, str(greeting["home"])),
    )


def refuse_twins(machines: Iterable[tuple[Target, Identity]]) -> None:
    """
    Refuse machines that are one, by whatever addresses they were reached: each would offer the other's records.

    Raises:
        InputError: Two are one.
    """
    known: dict[Identity, Target] = {}
    for target, identity in machines:
        boot_id, node, root = identity
        other = known.setdefault(identity, target)
        if other is not target and boot_id:  # of no boot: not known
            raise InputError(
                f"{other.label} and {target.label} are one machine, which calls itself {node}, with one"
                f" cosmos_root, {root}: correct ansible_host, leave one of them out (--limit), or give each a"
                " cosmos_root of its own"
            )


def close_machines(machines: Sequence[RemoteMachine]) -> None:
    """Close all at once: a machine that does not answer must not hold up the rest."""
    threads = [threading.Thread(target=machine.close, daemon=True) for machine in machines]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(ASK_TIMEOUT_S)


def expanded(path: str, home: str) -> str:
    """Return a path of a machine with ~ resolved, as that machine's shell would."""
    is_at_home = path == "~" or path.startswith("~/")
    return home.rstrip("/") + path[1:] if is_at_home else path
