"""All machines of a run: each is asked for its records, and nobody's failure hides another's result."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from types import TracebackType
from typing import Self, TypeVar

from cosmos_cli.collect.machine_retrieval import (
    MachineRetrieval,
    RecordsKept,
    Retrieved,
    TransferAccount,
)
from cosmos_cli.collect.machine_sources import RecordingMachine, RecordingMachines
from cosmos_cli.collect.retrieval_state import asked_sources, read_note, retrieved_paths
from cosmos_cli.collect.size_bound import recordable_bytes
from cosmos_cli.evidence.run_directory import RunDirectory
from cosmos_cli.evidence.run_documents import Problem
from cosmos_cli.fleet.connection import Connection, ConnectOptions
from cosmos_cli.fleet.failure import FailureKind, MachineFailure
from cosmos_cli.fleet.helper import Helper
from cosmos_cli.fleet.liveness import NAMED_S, SilenceWatch, SilentMachine
from cosmos_cli.fleet.outcome import Outcome
from cosmos_cli.fleet.pool import FORKS_DEFAULT, for_each
from cosmos_cli.fleet.target import Target
from cosmos_cli.system.import_turn import IMPORT_TURN
from cosmos_cli.ui.plural import counted

PARTS = ("madns_runtime.processes", "processes", "records")
ATTEMPTS_MAX = 5
"""Attempts at most: a broken link is made anew as long as they bring something."""
BARREN_MAX = 2
"""Attempts in a row that may bring nothing, such as those that broke while the link was opened."""
PAUSE_S = 1.0
TOLD_INTERVAL_S = 0.1
BROKEN = (FailureKind.LOST, FailureKind.TIMEOUT)

Say = Callable[[str], None]
"""Takes a sentence; called from the pool's threads."""
Progress = Callable[[str, float], None]
"""Takes what is being done and how far it is, 0 to 1; called from the pool's threads, one at a time."""
T = TypeVar("T")


def problems_of(outcomes: Sequence[Outcome[Retrieved]]) -> tuple[Problem, ...]:
    """Return what the verdict is told of machines whose records have not all come."""
    return tuple(
        Problem(
            machine=outcome.machine,
            text=str(outcome.failure),
            step="collect",
            is_of_data=isinstance(outcome.failure, RecordsKept),
        )
        for outcome in outcomes
        if outcome.failure is not None
    )


def kept_copies(outcomes: Sequence[Outcome[Retrieved]]) -> list[str]:
    """Say of each machine that brought everything and could not let go of its copy, why, as on a card that turned read-only."""
    return [
        f"{outcome.machine}: its records are here, but the copy stays: {outcome.value.remark}"
        for outcome in outcomes
        if outcome.value is not None and outcome.value.remark
    ]


class Retrieval:
    """
    One visit to the machines of a run. Use it as a context manager.

    Args:
        run: The run; nobody else collects it meanwhile (`alone`).
        options: How machines are connected to.
        forks: Machines at a time.
        progress: Called as data come.
        connections: By machine, what is open already; stays open.
        say: Takes what should be known meanwhile, such as which machine is silent.
        bytes_max: The most that a machine may have of the run; None for what its plan allows.
    """

    def __init__(  # noqa: PLR0913 - what a visit may be told, by name; all but two are optional
        self,
        run: RunDirectory,
        *,
        options: ConnectOptions,
        forks: int = FORKS_DEFAULT,
        progress: Progress = lambda what, share: None,
        connections: Mapping[str, Connection] | None = None,
        say: Say = lambda text: None,
        bytes_max: int | None = None,
    ) -> None:
        self._run = run
        self._say = say
        self._bytes_max = bytes_max
        self._options = options
        self._forks = forks
        self._given = dict(connections or {})
        self._sources = RecordingMachines.read(run)
        self._config = run.read_config()
        self._tally = _Tally(progress, len(self.due))
        self._claims = _PathOwners(run, self._sources)
        self._visits: dict[str, _Visit] = {}
        self._failures: dict[str, MachineFailure] = {}

    @property
    def due(self) -> tuple[RecordingMachine, ...]:
        """The machines where something of the run may still lie."""
        notes = ((each, read_note(self._run, each.machine)) for each in self._sources.remote)
        return tuple(each for each, note in notes if note is None or note.state == "verified")

    def find_living(self) -> dict[str, list[str]]:
        """Ask every machine what of the run lives there; one that does not answer is not in the result."""

        def ask(source: RecordingMachine) -> list[str]:
            return self._persist(source, TransferAccount(), lambda: self._ask_living(source))

        found: dict[str, list[str]] = {}
        for outcome in self._each(ask):
            if outcome.failure is not None:
                self._failures[outcome.machine] = outcome.failure
            elif outcome.value:
                found[outcome.machine] = outcome.value
        return found

    def fetch(self) -> list[Outcome[Retrieved]]:
        """
        Bring here what the machines recorded, and release it there; may be repeated.

        What is here already is not fetched again, what was cut goes on where it ended.

        Returns:
            An outcome for every machine of the run but forgotten ones, in the plan's order; none for a run that
            was on this computer alone.
        """
        fetched = {outcome.machine: outcome for outcome in self._each(self._fetch_from)}
        return [fetched.get(each.machine) or self._kept(each) for each in asked_sources(self._run)]

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

    def _each(self, task: Callable[[RecordingMachine], T]) -> list[Outcome[T]]:
        by_name = {source.machine: source for source in self.due}
        return for_each(
            [source.target for source in by_name.values()],
            lambda target: task(by_name[target.name]),
            forks=self._forks,
        )

    def _kept(self, source: RecordingMachine) -> Outcome[Retrieved]:
        note = read_note(self._run, source.machine)
        assert note is not None, "a machine that is not due has a note"
        return Outcome(machine=source.machine, value=Retrieved(files=note.files, bytes=note.bytes))

    def _fetch_from(self, source: RecordingMachine) -> Retrieved:
        if source.machine in self._failures:
            raise self._failures[source.machine]
        account = TransferAccount(told=self._tally.of(source.machine))
        return self._persist(source, account, lambda: self._attempt(source, account))

    def _persist(
        self, source: RecordingMachine, account: TransferAccount, attempt: Callable[[], T]
    ) -> T:
        """Do *attempt*, and again when the link breaks: also one that breaks while it is opened."""
        barren = 0
        for number in range(1, ATTEMPTS_MAX + 1):
            before = account.fetched_bytes
            try:
                return attempt()
            except MachineFailure as failure:
                if (visit := self._visits.pop(source.machine, None)) is not None:
                    visit.close()
                barren = barren + 1 if account.fetched_bytes == before else 0
                if not _is_worth_another(failure, barren) or number == ATTEMPTS_MAX:
                    text = failure.text + account.so_far
                    told = RecordsKept if isinstance(failure, RecordsKept) else MachineFailure
                    raise told(failure.kind, text, failure.advice) from failure
                time.sleep(PAUSE_S)
        raise AssertionError("the last attempt returns or raises")

    def _ask_living(self, source: RecordingMachine) -> list[str]:
        return [
            str(words) for words in self._visit(source).helper.call("living", source.where).value
        ]

    def _attempt(self, source: RecordingMachine, account: TransferAccount) -> Retrieved:
        retrieval = MachineRetrieval(
            self._run,
            source,
            owner_of=lambda path: self._claims.claim(path, source.machine),
            account=account,
            bytes_max=self._bound_of(source),
        )
        return retrieval.go_on(self._visit(source).helper)

    def _bound_of(self, source: RecordingMachine) -> int:
        if self._bytes_max is not None:
            return self._bytes_max
        agents = sum(
            machine == source.machine for machine in self._sources.machine_of_agent.values()
        )
        return recordable_bytes(
            self._config, agents, is_host=self._sources.host_machine == source.machine
        )

    def _visit(self, source: RecordingMachine) -> _Visit:
        """Return the open visit to a machine, or begin one."""
        visit = self._visits.get(source.machine)
        if visit is None:
            given = self._given.pop(source.machine, None)
            is_given = given is not None and given.is_alive()
            connection = given if is_given and given else self._open(source)
            watch = SilenceWatch(connection, lambda s: self._name_silent(source, s))
            try:
                helper = Helper.start(connection, PARTS, watch=watch)
            except MachineFailure:
                if not is_given:
                    connection.close()
                raise
            visit = _Visit(connection, helper, is_given=is_given)
            self._visits[source.machine] = visit
        return visit

    def _open(self, source: RecordingMachine) -> Connection:
        """Connect to a machine; its silence is told long before it is given up."""
        timer = threading.Timer(NAMED_S, self._name_silent, (source, NAMED_S))
        timer.daemon = True
        timer.start()
        try:
            return _connect(source.target, self._options)
        finally:
            timer.cancel()

    def _name_silent(self, source: RecordingMachine, silent_s: float) -> None:
        if not self._tally.is_over:
            self._say(f"{source.machine}: no sign of life for {silent_s:g} s; waiting for it")


def _is_worth_another(failure: MachineFailure, barren: int) -> bool:
    """Tell whether a link is made anew: one that breaks, unless that leads nowhere; silence only if it brought something."""
    if failure.kind is FailureKind.LOST and not isinstance(failure, SilentMachine):
        return barren <= BARREN_MAX
    return failure.kind in BROKEN and barren == 0


class _Visit:
    """A connection and the helper at its other end."""

    def __init__(self, connection: Connection, helper: Helper, *, is_given: bool) -> None:
        self.helper = helper
        self._connection = connection
        self._is_given = is_given

    def close(self, *, at_once: bool = False) -> None:
        """End the visit; *at_once*, while a thread may still use it, closes the connection alone, which ends the rest."""
        if not at_once:
            self.helper.close()
        if not self._is_given:
            self._connection.close()


class _PathOwners:
    """
    Owners of the paths in a run directory: what one machine brought, no other may replace. For many threads.

    They stand in the plan; what no plan names is of whoever brought it first.

    Args:
        run: What came earlier is in its notes.
        sources: What the plan says.
    """

    def __init__(self, run: RunDirectory, sources: RecordingMachines) -> None:
        self._sources = sources
        self._owners = dict(retrieved_paths(run))
        self._lock = threading.Lock()

    def claim(self, path: str, machine: str) -> str:
        """Return whose *path* is; *machine*'s if it was nobody's."""
        planned = self._sources.owner_of(path)
        if planned is not None:
            return planned
        with self._lock:
            return self._owners.setdefault(path, machine)


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
    with IMPORT_TURN:
        from cosmos_cli.fleet.open_connection import connect

    return connect(target, options)
