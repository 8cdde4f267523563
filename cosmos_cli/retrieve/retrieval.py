"""All machines of a run: each is asked for its records, and nobody's failure hides another's result."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from types import TracebackType
from typing import Self, TypeVar

from cosmos_cli.counted import counted
from cosmos_cli.fleet.board import Board
from cosmos_cli.fleet.connection import Connection, ConnectOptions
from cosmos_cli.fleet.failure import FailureKind, MachineFailure
from cosmos_cli.fleet.outcome import Outcome
from cosmos_cli.fleet.pool import FORKS_DEFAULT, for_each
from cosmos_cli.fleet.silence import WatchedConnection
from cosmos_cli.fleet.target import Target
from cosmos_cli.problem import Problem
from cosmos_cli.retrieve.account import Account, Retrieved
from cosmos_cli.retrieve.claims import Claims
from cosmos_cli.retrieve.machine import MachineRetrieval
from cosmos_cli.retrieve.notes import read_note
from cosmos_cli.retrieve.sources import Source, Sources
from cosmos_cli.rundir import RunDirectory

PARTS = ("madns_runtime.processes", "living", "evidence")
ATTEMPTS_MAX = 5
"""So often a broken link is made anew, as long as every attempt brings something."""
PAUSE_S = 1.0
TOLD_INTERVAL_S = 0.1
BROKEN = (FailureKind.LOST, FailureKind.TIMEOUT)

Progress = Callable[[str, float], None]
"""Takes what is being done and how far it is, 0 to 1; called from the pool's threads, one at a time."""
T = TypeVar("T")


def retrieve(
    run: RunDirectory,
    *,
    options: ConnectOptions,
    forks: int = FORKS_DEFAULT,
    progress: Progress = lambda what, share: None,
    connections: Mapping[str, Connection] | None = None,
) -> list[Outcome[Retrieved]]:
    """
    Bring what a run's machines recorded into its directory, and release it there.

    May be repeated: what is here already is not fetched again, what was cut goes on where it ended.

    Args:
        run: The run; its plan.json says where its records lie. Nobody else collects it meanwhile (`alone`).
        options: How machines are connected to.
        forks: Machines at a time.
        progress: Called as data come.
        connections: By machine, what is open already; stays open.

    Returns:
        An outcome a machine, in the plan's order; none for a run that was on this computer alone.
    """
    with Retrieval(
        run, options=options, forks=forks, progress=progress, connections=connections
    ) as retrieval:
        return retrieval.fetch()


def problems_of(outcomes: Sequence[Outcome[Retrieved]]) -> tuple[Problem, ...]:
    """Return what the verdict is told of machines whose records have not all come."""
    return tuple(
        Problem(machine=outcome.machine, text=str(outcome.failure), step="collect")
        for outcome in outcomes
        if outcome.failure is not None
    )


class Retrieval:
    """
    One visit to the machines of a run. Use it as a context manager.

    Args:
        run: The run; nobody else collects it meanwhile (`alone`).
        options: How machines are connected to.
        forks: Machines at a time.
        progress: Called as data come.
        connections: By machine, what is open already; stays open.
    """

    def __init__(
        self,
        run: RunDirectory,
        *,
        options: ConnectOptions,
        forks: int = FORKS_DEFAULT,
        progress: Progress = lambda what, share: None,
        connections: Mapping[str, Connection] | None = None,
    ) -> None:
        self._run = run
        self._options = options
        self._forks = forks
        self._given = dict(connections or {})
        self._sources = Sources.read(run)
        self._tally = _Tally(progress, len(self.due))
        self._claims = Claims(run, self._sources)
        self._visits: dict[str, _Visit] = {}
        self._failures: dict[str, MachineFailure] = {}

    @property
    def due(self) -> tuple[Source, ...]:
        """The machines where something of the run may still lie."""
        notes = {each.machine: read_note(self._run, each.machine) for each in self._sources.remote}
        return tuple(
            each
            for each in self._sources.remote
            if (note := notes[each.machine]) is None or note.state != "released"
        )

    def find_living(self) -> dict[str, list[str]]:
        """Ask every machine what of the run lives there; one that does not answer is not in the result."""

        def ask(source: Source) -> list[str]:
            board = self._visit(source).board
            where = {"directory": source.directory, "state": source.state}
            return [str(words) for words in board.call("living", where).value]

        found: dict[str, list[str]] = {}
        for outcome in self._each(ask):
            if outcome.failure is not None:
                self._failures[outcome.machine] = outcome.failure
            elif outcome.value:
                found[outcome.machine] = outcome.value
        return found

    def fetch(self) -> list[Outcome[Retrieved]]:
        """Bring everything here that is not here yet; an outcome for every machine of the run."""
        fetched = {outcome.machine: outcome for outcome in self._each(self._fetch_from)}
        return [fetched.get(each.machine) or self._kept(each) for each in self._sources.remote]

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._tally.is_over = True
        for visit in list(self._visits.values()):
            visit.close(at_once=kind is not None)

    def _each(self, task: Callable[[Source], T]) -> list[Outcome[T]]:
        by_name = {source.machine: source for source in self.due}
        targets = [source.target for source in by_name.values()]
        return for_each(targets, lambda target: task(by_name[target.name]), forks=self._forks)

    def _kept(self, source: Source) -> Outcome[Retrieved]:
        note = read_note(self._run, source.machine)
        assert note is not None, "a machine that is not due has a note"
        return Outcome(machine=source.machine, value=Retrieved(files=note.files, bytes=note.bytes))

    def _fetch_from(self, source: Source) -> Retrieved:
        if source.machine in self._failures:
            raise self._failures[source.machine]
        account = Account(told=self._tally.of(source.machine))
        for attempt in range(1, ATTEMPTS_MAX + 1):
            before = account.fetched_bytes
            try:
                return self._attempt(source, account)
            except MachineFailure as failure:
                self._leave(source)
                is_hopeless = attempt == ATTEMPTS_MAX or account.fetched_bytes == before
                if failure.kind not in BROKEN or is_hopeless:
                    text = failure.text + account.so_far
                    raise MachineFailure(failure.kind, text, failure.advice) from failure
                time.sleep(PAUSE_S)
        raise AssertionError("the last attempt returns or raises")

    def _attempt(self, source: Source, account: Account) -> Retrieved:
        retrieval = MachineRetrieval(
            self._run,
            source,
            owner_of=lambda path: self._claims.claim(path, source.machine),
            account=account,
        )
        return retrieval.go_on(self._visit(source).board)

    def _visit(self, source: Source) -> _Visit:
        """Return the open visit to a machine, or begin one."""
        visit = self._visits.get(source.machine)
        if visit is None:
            given = self._given.pop(source.machine, None)
            is_given = given is not None and given.is_alive()
            connection = given if is_given and given else _connect(source.target, self._options)
            try:
                board = Board.start(WatchedConnection(connection), PARTS)
            except MachineFailure:
                if not is_given:
                    connection.close()
                raise
            visit = _Visit(connection, board, is_given=is_given)
            self._visits[source.machine] = visit
        return visit

    def _leave(self, source: Source) -> None:
        visit = self._visits.pop(source.machine, None)
        if visit is not None:
            visit.close()


class _Visit:
    """A connection and what works at its other end."""

    def __init__(self, connection: Connection, board: Board, *, is_given: bool) -> None:
        self.board = board
        self._connection = connection
        self._is_given = is_given

    def close(self, *, at_once: bool = False) -> None:
        """End it; *at_once* while a thread may still use it: the connection alone, which ends the rest."""
        if not at_once:
            self.board.close()
        if not self._is_given:
            self._connection.close()


class _Tally:
    """Adds up what all machines' accounts tell, and passes it on at a rate that eyes can follow."""

    def __init__(self, progress: Progress, machines: int) -> None:
        self.is_over = False
        self._progress = progress
        self._what = f"retrieving from {counted(machines, 'machine')}"
        self._lock = threading.Lock()
        self._bytes: dict[str, tuple[int, int]] = {}
        self._told_s = 0.0

    def of(self, machine: str) -> Callable[[int, int], None]:
        """Return what one machine's account tells."""

        def tell(here_bytes: int, total_bytes: int) -> None:
            if self.is_over:
                raise MachineFailure(FailureKind.LOST, "interrupted")
            with self._lock:
                self._bytes[machine] = (here_bytes, total_bytes)
                now_s = time.monotonic()
                if now_s - self._told_s >= TOLD_INTERVAL_S:
                    self._told_s = now_s
                    here, total = (
                        sum(values) for values in zip(*self._bytes.values(), strict=True)
                    )
                    self._progress(self._what, here / max(total, 1))

        return tell


def _connect(target: Target, options: ConnectOptions) -> Connection:
    # Imported late: a run on this computer alone needs no SSH.
    from cosmos_cli.fleet.connect import connect

    return connect(target, options)
