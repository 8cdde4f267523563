"""
Reads the log of a run where it lies: here, and on every machine whose records are not here yet.

One thread per machine asks and waits; the lines are put together in the caller's thread. A machine that fails is
named once, asked again while the run is followed, and holds nobody up. That of the host, which alone knows when the
run ends, is waited for a while, as for one that starts anew.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from queue import Empty, SimpleQueue
from typing import Any

from cosmos_cli.collect.machine_sources import RecordingMachine, RecordingMachines
from cosmos_cli.collect.retrieval_state import asked_sources, read_note
from cosmos_cli.errors import CosmosError
from cosmos_cli.evidence.run_directory import RunDirectory
from cosmos_cli.evidence.run_log import LogLine, LogReading
from cosmos_cli.fleet.connection import ConnectOptions
from cosmos_cli.fleet.failure import FailureKind, MachineFailure, unexpected
from cosmos_cli.fleet.helper import Helper
from cosmos_cli.fleet.liveness import SilenceWatch
from cosmos_cli.fleet.open_connection import connect
from madns_runtime.processes import list_processes

PARTS = ("madns_runtime.processes", "processes", "log_tail")
ASK_INTERVAL_S = 1.0
LOOK_INTERVAL_S = 0.5
AGAIN_S = 5.0
ANSWER_TIMEOUT_S = 60.0
ABSENCE_S = 60.0
"""Time without an answer of the host's machine after which its run is followed no more: a board has rebooted by then."""
PASSING = frozenset(
    {
        FailureKind.UNREACHABLE,
        FailureKind.REFUSED,
        FailureKind.FROZEN,
        FailureKind.LOST,
        FailureKind.TIMEOUT,
    }
)
"""Failures of a machine that may be well again."""

Told = Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class _Answered:
    """A machine's answer, or why there is none."""

    machine: str
    told: Told | None = None
    failure: MachineFailure | None = None
    error: CosmosError | None = None
    """Fault in the operator's own files, with which no machine can be asked."""


@dataclass(slots=True, kw_only=True)
class LogFollower:
    """
    Reads one run's log.

    Args:
        run: The run.
        sources: The machines that are asked.
        reading: What is wanted, and how far each file was read.
        options: How machines are connected to.
        on_failure: Called once for each machine that cannot be asked.
    """

    run: RunDirectory
    sources: Sequence[RecordingMachine]
    reading: LogReading
    options: ConnectOptions
    on_failure: Callable[[str, MachineFailure], None]
    failed: set[str] = field(default_factory=set)
    """Machines whose log is not read, or not all of it."""
    _living: dict[str, bool] = field(default_factory=dict)
    _awaited: str | None = None
    """The host's machine, while the run is followed; None if it is this computer."""
    _absent_since_s: float | None = None
    """When that gave no answer first since its last one, by the monotonic clock, s."""
    _answers: SimpleQueue[_Answered] = field(default_factory=SimpleQueue)
    _stop: threading.Event = field(default_factory=threading.Event)

    def lines(self, *, is_following: bool) -> Iterator[list[LogLine]]:
        """
        Yield what was said, in portions: what is there now, and while *is_following* what comes until the run ends.

        Raises:
            CosmosError: A fault in the operator's own files, such as the ssh configuration.
        """
        self._living = dict.fromkeys((source.machine for source in self.sources), True)
        self._awaited = RecordingMachines.read(self.run).host_machine if is_following else None
        for source in self.sources:
            threading.Thread(target=self._ask, args=(source, is_following), daemon=True).start()
        try:
            is_alive = True
            while is_alive:
                is_living = is_living_here(self.run)  # both before the last look
                is_alive = any(self._living.values()) or (is_following and is_living)
                yield from self.reading.read_here(self.run.path, is_ended=not is_living)
                yield from self._portions()
                if is_alive:  # until a machine answers, or it is time to look here again
                    yield from self._portions(LOOK_INTERVAL_S)
        finally:
            self._stop.set()

    def _portions(self, wait_s: float = 0.0) -> Iterator[list[LogLine]]:
        """Yield what machines have answered, in its order; where that is nothing yet, what comes within *wait_s*."""
        while True:
            try:
                answer = self._answers.get(block=wait_s > 0.0, timeout=wait_s)
            except Empty:
                return
            wait_s = 0.0
            if answer.error is not None:
                raise answer.error
            if answer.told is None:
                self._living[answer.machine] = self._may_return(answer)
                if answer.machine not in self.failed and answer.failure is not None:
                    self.failed.add(answer.machine)
                    self.on_failure(answer.machine, answer.failure)
                continue
            self.failed.discard(answer.machine)
            if answer.machine == self._awaited:
                self._absent_since_s = None
            self._living[answer.machine] = bool(answer.told["living"] or answer.told["more"])
            yield self.reading.take(answer.told["files"])

    def _may_return(self, answer: _Answered) -> bool:
        """Tell whether a machine that gave no answer is waited for: that of the host, for ABSENCE_S."""
        if answer.machine != self._awaited or answer.failure is None:
            return False
        now_s = time.monotonic()
        if self._absent_since_s is None:
            self._absent_since_s = now_s
        return answer.failure.kind in PASSING and now_s - self._absent_since_s < ABSENCE_S

    def _ask(self, source: RecordingMachine, is_following: bool) -> None:
        """Ask one machine until its part of the run has ended; in a thread of its own."""
        offsets = dict(self.reading.offsets)
        while not self._stop.is_set():
            try:
                self._ask_connected(source, offsets, is_following=is_following)
                return
            except MachineFailure as failure:
                self._answers.put(_Answered(source.machine, failure=failure))
            except CosmosError as error:
                self._answers.put(_Answered(source.machine, error=error))
                return
            except Exception as error:  # noqa: BLE001 - a thread that ends without a word is waited for for ever
                self._answers.put(_Answered(source.machine, failure=unexpected(error)))
            if not is_following:
                return
            self._stop.wait(AGAIN_S)

    def _ask_connected(
        self, source: RecordingMachine, offsets: dict[str, int], *, is_following: bool
    ) -> None:
        with (
            contextlib.closing(connect(source.target, self.options)) as connection,
            Helper.start(connection, PARTS, watch=SilenceWatch(connection)) as helper,
        ):
            is_more = True
            while not self._stop.is_set() and is_more:
                told = self._asked(helper, source, offsets)
                is_living = is_following and bool(told["living"])
                self._answers.put(_Answered(source.machine, told={**told, "living": is_living}))
                is_more = is_living or bool(told["more"])
                if not told["more"]:
                    self._stop.wait(ASK_INTERVAL_S if is_more else 0)

    def _asked(self, helper: Helper, source: RecordingMachine, offsets: dict[str, int]) -> Told:
        told: Told = helper.call(
            "tail", {**source.where, "offsets": offsets}, timeout_s=ANSWER_TIMEOUT_S
        ).value
        offsets |= {path: int(file["end"]) for path, file in told["files"].items()}
        return told


def is_living_here(run: RunDirectory) -> bool:
    """Tell whether anything of a run lives on this computer."""
    return any(entry.run_directory == str(run.path) for entry in list_processes())


def sources_elsewhere(run: RunDirectory) -> list[RecordingMachine]:
    """Return the machines whose records are not here yet, but for those that were forgotten."""
    notes = ((source, read_note(run, source.machine)) for source in asked_sources(run))
    return [source for source, note in notes if note is None or not note.is_complete]
