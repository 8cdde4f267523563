"""
The machines of a run while it lasts: one connection and one helper process each, and where things are there.

For the threads of `Background` and of the pool; the operator's loop never calls what waits.
"""

from __future__ import annotations

import dataclasses
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from cosmos_cli.errors import MachinesError
from cosmos_cli.fleet.board import Board
from cosmos_cli.fleet.connection import Connection, ConnectOptions, Stream
from cosmos_cli.fleet.failure import FailureKind, MachineFailure
from cosmos_cli.fleet.layout import Layout
from cosmos_cli.fleet.outcome import Outcome, raise_if_failed
from cosmos_cli.fleet.pool import for_each
from cosmos_cli.fleet.target import Target
from cosmos_cli.launch.places import expanded

PARTS = ("madns_runtime.processes", "processes")
ASK_TIMEOUT_S = 10.0
ALIVE_TIMEOUT_S = 1.5
RETURN_TIMEOUT_S = 5.0
"""To connect again to a machine that was lost: it answers, or the next try does better."""
OUT_OF_STEP = (FailureKind.LOST, FailureKind.TIMEOUT, FailureKind.DATA)
"""After these an answer may still come that belongs to no question."""

Connect = Callable[[Target, ConnectOptions], Connection]


class Prepared(Protocol):
    """What a machine needs of a run is there; see `cosmos_cli.provision.ready`."""

    @property
    def python(self) -> str:
        """The environment's interpreter."""

    @property
    def base_directory(self) -> str:
        """The scenario's folder there."""

    def variables(self) -> Mapping[str, str]:
        """Return the environment that programs of a run need, PYTHONPATH among it."""


Prepare = Callable[[Connection, Board], Prepared]


@dataclass(frozen=True, slots=True, kw_only=True)
class Paths:
    """Where things are on one machine, with ~ resolved."""

    root: str
    state: str
    python: str
    variables: Mapping[str, str]
    base_directory: str


class RemoteMachine:
    """
    A machine that is logged in at and has all that a run needs.

    Args:
        connection: Open; closed by `close`.
        board: The helper process there.
        prepared: What it said of its environment.
        options: How to connect again.
        connect: Opens a connection.
    """

    def __init__(
        self,
        connection: Connection,
        board: Board,
        prepared: Prepared,
        *,
        options: ConnectOptions,
        connect: Connect,
    ) -> None:
        home = str(board.greeting["home"])
        root = expanded(connection.target.root, home)
        self.target = connection.target
        self.connection = connection
        self.paths = Paths(
            root=root,
            state=Layout(root).state,
            python=expanded(prepared.python, home),
            variables=prepared.variables(),
            base_directory=expanded(prepared.base_directory, home),
        )
        self._options = dataclasses.replace(options, timeout_s=RETURN_TIMEOUT_S)
        self._connect = connect
        self._board: Board | None = board
        self._lock = threading.Lock()

    @property
    def name(self) -> str:
        """Its name in the inventory."""
        return self.target.name

    def directory_of(self, run: str, session_hex: str) -> str:
        """Return the run's directory there."""
        return Layout(self.paths.root).run(run, session_hex)

    def open(self, command: str) -> Stream:
        """
        Start a shell command there.

        Raises:
            MachineFailure: The connection is lost.
        """
        return self.connection.open(command)

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
            if self._board is None:
                self._board = Board.start(self.connection, PARTS, timeout_s=timeout_s)
            return self._board.call(verb, arguments, timeout_s=timeout_s).value
        except MachineFailure as failure:
            if failure.kind in OUT_OF_STEP and self._board is not None:
                board, self._board = self._board, None
                board.close()
            raise
        finally:
            self._lock.release()

    def is_alive(self, *, timeout_s: float = ALIVE_TIMEOUT_S) -> bool:
        """Ask for a sign of life of the machine itself."""
        return self.connection.is_alive(timeout_s=timeout_s)

    def return_to(self, directory: str, *, clean_s: float, forced_s: float) -> None:
        """
        Reach a machine that was lost, and end what still lives there of the run in *directory*.

        Raises:
            MachineFailure: It does not answer.
        """
        if not self.is_alive():
            self.connection.close()
            self.connection = self._connect(self.target, self._options)
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
            ending = self.ask(
                "end_run", arguments, timeout_s=timeout_s
            )  # the helper had gone with it
        if ending["left"]:
            pids = ", ".join(str(entry["pid"]) for entry in ending["left"])
            raise MachineFailure(FailureKind.STEP, f"even SIGKILL did not end {pids}")

    def close(self) -> None:
        """Let the helper end and close the connection."""
        if self._lock.acquire(timeout=ASK_TIMEOUT_S):
            board, self._board = self._board, None
            self._lock.release()
            if board is not None:
                board.close()
        self.connection.close()


def reach_machines(  # noqa: PLR0913 - how machines are reached and prepared; all by name
    targets: Sequence[Target],
    prepare_of: Callable[[Target], Prepare],
    *,
    parts: Sequence[str],
    options: ConnectOptions,
    connect: Connect,
    forks: int,
) -> dict[str, RemoteMachine]:
    """
    Connect to all machines and prepare each; whoever calls closes them.

    Raises:
        MachinesError: Some failed, each is named; the others are closed again.
    """

    def reach(target: Target) -> RemoteMachine:
        connection = connect(target, options)
        try:
            board = Board.start(connection, (*PARTS, *parts))
            try:
                prepared = prepare_of(target)(connection, board)
                return RemoteMachine(connection, board, prepared, options=options, connect=connect)
            except BaseException:
                board.close()
                raise
        except BaseException:
            connection.close()
            raise

    reached: dict[str, RemoteMachine] = {}

    def done(outcome: Outcome[RemoteMachine]) -> None:
        if outcome.value is not None:
            reached[outcome.machine] = outcome.value

    try:
        outcomes = for_each(targets, reach, forks=forks, on_done=done)
        raise_if_failed(outcomes, "the run was not started")
    except (KeyboardInterrupt, MachinesError):
        close_machines(tuple(reached.values()))
        raise
    return {target.name: reached[target.name] for target in targets}


def close_machines(machines: Sequence[RemoteMachine]) -> None:
    """Close all at once: a machine that does not answer must not hold up the rest."""
    threads = [threading.Thread(target=machine.close, daemon=True) for machine in machines]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(ASK_TIMEOUT_S)
