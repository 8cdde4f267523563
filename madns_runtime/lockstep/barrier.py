"""
The barrier of a lockstep run: its host waits there for its workers, and hears the operator meanwhile.

What ends a run before its time is noted here as its ending, wherever it was noticed; whatever waits
then raises RunEnds.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import partial
from operator import itemgetter
from time import monotonic
from typing import Any, NoReturn

from madns_runtime.config import HostLaunch
from madns_runtime.lockstep import frames
from madns_runtime.lockstep.clock import SimulatedClock
from madns_runtime.lockstep.frames import encode_frame
from madns_runtime.lockstep.result import LOST, EarlyEnd, RunAccount
from madns_runtime.lockstep.workers import WorkerPool, WorkerProcess
from madns_runtime.reactor.operator_link import OPERATOR_GONE, OperatorLink
from madns_runtime.reactor.reactor import Reactor
from madns_runtime.timing.granted_clock import GrantedLimit, is_stopped

PROGRESS_INTERVAL_S = 0.5
"""Time between two reports to the operator, and between two looks for a worker that is late."""
SERVE_INTERVAL_S = 0.2
"""A host that is busy with its own half hears the operator this often."""
SERVE_WAIT_S = 0.001
"""Length of such a hearing: a timer that is due at once would stop the loop before it has looked."""
STACK_HINT = "host/stderr.txt shows where it hung"


class RunEnds(Exception):
    """The run cannot go on; the barrier's `ending` says why."""


class Barrier:
    """
    The workers, the operator, and the loop in which both are heard.

    Args:
        launch: The run.
        pool: The workers.
        account: Where what they say is noted.
        clock: Simulated time.
        fds: Where the operator's commands come from and events go to.
        pending: What had already come behind the launch document.
    """

    def __init__(  # noqa: PLR0913 - the collaborators of a seam, most keyword-only
        self,
        launch: HostLaunch,
        pool: WorkerPool,
        *,
        account: RunAccount,
        clock: SimulatedClock,
        fds: tuple[int, int],
        pending: bytes,
    ) -> None:
        self._timeouts = launch.config.timeouts
        self._pool = pool
        self._account = account
        self._clock = clock
        self.reactor = Reactor()
        self.operator = OperatorLink(
            self.reactor,
            fds,
            on_command=self._command,
            on_gone=lambda: self.end("operator", OPERATOR_GONE, status="aborted"),
            pending=pending,
            is_detached=launch.is_detached,
        )
        pool.listen(self.reactor, on_frame=self._said, on_lost=self._worker_lost)
        self.goes_on = False
        """Whether the run goes on without an agent that is lost now."""
        self.is_open = True
        """Whether an ending is still noted; none is once the workers are told to stop."""
        self.ending: EarlyEnd | None = None
        """Why the run ends before its time, if it does."""
        self._late: tuple[GrantedLimit, Callable[[], EarlyEnd | None]] | None = None
        self._limit_s = 0.0
        self._served_s = monotonic()
        self._progress_timer = self.reactor.call_at(0.0, self._progress)

    # Endings --------------------------------------------------------------------------------------

    def end(self, who: str, reason: str, *, status: str = "failed") -> None:
        """End the run as soon as its script waits; the first cause stands."""
        self._note(EarlyEnd(who=who, reason=reason, status=status))

    def fail(self, who: str, reason: str) -> NoReturn:
        """
        End the run at once.

        Raises:
            RunEnds: Always.
        """
        self.end(who, reason)
        raise RunEnds

    def _note(self, ending: EarlyEnd) -> None:
        if self.is_open:
            self.ending = self.ending or ending
        self.reactor.stop()

    # Waiting --------------------------------------------------------------------------------------

    def exchange(self, order: tuple[float, ...], boxes: list[list[tuple[int, bytes]]]) -> None:
        """
        Give every worker *order* and what waits for its agents, and wait until all have answered.

        Raises:
            RunEnds: One of them cannot, or something else ends the run.
        """
        for worker, box in zip(self._pool.workers, boxes, strict=True):
            self.order(worker, *order, box)
            box.clear()
        self.await_all(self._timeouts.tick_s)

    def order(self, worker: WorkerProcess, *parts: Any) -> None:
        """
        Give one worker an order, without waiting for the answer.

        Raises:
            RunEnds: It does not read.
        """
        if worker.has_ended:
            return
        limit_s = self._timeouts.tick_s
        try:
            self._pool.order(worker, encode_frame(*parts), limit_s)
        except TimeoutError:
            ending = self._blame(worker, limit_s, "does not read", "tick_s")
            if ending is not None:
                self._note(ending)
                raise RunEnds from None

    def await_all(
        self, limit_s: float, late: str = "has not answered", setting: str = "tick_s"
    ) -> None:
        """
        Wait until every worker has answered; *late* says what one has not done, *setting* whose limit that is.

        Raises:
            RunEnds: One of them cannot, or something else ends the run.
        """
        blame = partial(self._blame, late=late, setting=setting)
        self.wait(lambda: self._pool.awaited is None, limit_s, blame)
        for answer in self._pool.answers():
            if answer[0] == frames.FAILED:
                self.fail(self._account.names[answer[1]], answer[2])
            for loss in answer[frames.LOSSES] if len(answer) > frames.LOSSES else ():
                self._account.note_loss(frames.Loss(*loss))

    def forget_answers(self) -> None:
        """Forget what the workers answered: those that are told nothing next have nothing to say."""
        for worker in self._pool.workers:
            worker.answer = None if worker.has_ended else [frames.DONE, (), ()]

    def await_ordered(self, late: str) -> None:
        """Wait for the answers of the workers that were given an order; see `await_all`."""
        self.await_all(self._timeouts.tick_s, late)

    def wait(
        self, is_done: Callable[[], bool], limit_s: float, late: Callable[..., EarlyEnd | None]
    ) -> None:
        """
        Wait in the loop.

        Args:
            is_done: Asked whenever something has happened.
            limit_s: How long; time spent waiting for a processor does not count.
            late: Called then with the first worker that is awaited (or None) and *limit_s*; where it
                returns None the wait goes on for as long again.

        Raises:
            RunEnds: The time is over, or something else ends the run.
        """
        self._late = (GrantedLimit(limit_s), lambda: late(self._pool.awaited, limit_s))
        self._limit_s = limit_s
        while self.ending is None and not is_done():
            self.reactor.run()
        self._late = None
        self._served_s = monotonic()
        if self.ending is not None:
            raise RunEnds

    def serve(self) -> None:
        """
        Hear the operator if that was long ago, and hardly wait.

        Raises:
            RunEnds: The run is to end.
        """
        if monotonic() - self._served_s < SERVE_INTERVAL_S:
            return
        self.reactor.call_at(monotonic() + SERVE_WAIT_S, self.reactor.stop)
        self.reactor.run()
        self._served_s = monotonic()
        if self.ending is not None:
            raise RunEnds

    def messages(self) -> Iterator[tuple[int, int, bytes]]:
        """Yield what the agents sent, in their order: whose it is, its class of service, its body."""
        sent = []
        for answer in self._pool.answers():
            self._account.note_values(answer[2])
            sent += answer[1]
        # A worker tells first what all its agents answered, then their steps; of one agent, as it sent them.
        yield from sorted(sent, key=itemgetter(0))

    def stop_workers(self, reason: str | None) -> tuple[str, ...]:
        """Have all close their records and end; return the agents of which there is no word that they did."""
        self.is_open, self.ending = False, None
        limit_s = self._timeouts.shutdown_s
        self._pool.stop(reason, limit_s)
        # Each agent's word gives the next as long again.
        self._late = (GrantedLimit(limit_s), lambda: EarlyEnd(who="", reason=""))
        while self._is_in_time() and not self._pool.have_all_ended:
            self.reactor.run()
        self._pool.end_left()
        agents = zip(self._account.names, self._account.agents, strict=True)
        settled = ("stopped", LOST) if self.goes_on else ("stopped",)
        return tuple(name for name, account in agents if account.state not in settled)

    def _is_in_time(self) -> bool:
        return self._late is not None

    # What is heard --------------------------------------------------------------------------------

    def _said(self, worker: WorkerProcess, frame: list[Any]) -> None:
        kind = frame[0]
        if kind == frames.CLOSED:
            account = self._account.agents[frame[1]]
            account.records = {**account.records, **frame[2]}
            if account.state != LOST:
                account.state = "stopped"
            if self._late is not None:
                self._late = (GrantedLimit(self._timeouts.shutdown_s), self._late[1])
            return
        if kind == frames.FAILED and worker.answer is not None:  # it was not asked
            self.end(self._account.names[frame[1]], frame[2])
        if worker.answer is None or worker.answer[0] != frames.FAILED:
            worker.answer = (
                frame  # a process that came back told its failure before the worker answered
            )
        if self._pool.awaited is None:
            self.reactor.stop()

    def _worker_lost(self, worker: WorkerProcess, how: str) -> None:
        self.reactor.stop()
        if not self.is_open:
            return
        number, method = worker.at
        where = f" in the agent's {method}" if method else ""
        reason = f"{self._process(worker)} {how}{where}{self.when()}"
        self._lose(worker, reason)
        if not self.goes_on:
            self.end(self._account.names[number], reason)

    def _command(self, command: Mapping[str, Any]) -> None:
        if command.get("command") == "stop":
            reason = str(command.get("reason", "stopped by the operator"))
            self.end("operator", reason, status=str(command.get("status", "interrupted")))
        else:
            self.operator.refuse(command)

    def _progress(self) -> None:
        now_s = monotonic()
        self._progress_timer = self.reactor.call_at(now_s + PROGRESS_INTERVAL_S, self._progress)
        self.operator.emit(self._account.progress(self._clock.t_s, now_s))
        if self._late is not None and self._late[0].is_over():
            late, self._late = self._late[1], None
            ending = late()
            if ending is None:
                self._late = (GrantedLimit(self._limit_s), late)
            else:
                self._note(ending)

    # Blame ----------------------------------------------------------------------------------------

    def _blame(
        self, worker: WorkerProcess | None, limit_s: float, late: str, setting: str
    ) -> EarlyEnd | None:
        """Return who of a worker that does not answer is to blame, if the run ends by it, and end the worker."""
        assert worker is not None, "somebody is awaited"
        number, method = worker.at
        what = f"the agent's {method} has not returned" if method else ""
        what = what or f"{self._process(worker)} {late}"
        stopped = " (it is stopped)" if is_stopped(worker.pid) else ""
        told = f"{what} within {limit_s:g} s{self.when()}{stopped}"
        reason = f"{told}; {STACK_HINT} (limit: timeouts.{setting})"
        self._pool.tell_stack(worker)
        self._lose(worker, reason)
        if self.goes_on:
            return None
        return EarlyEnd(who=self._account.names[number], reason=reason)

    def _lose(self, worker: WorkerProcess, reason: str) -> None:
        worker.answer = None
        for number in worker.agents:
            self._account.lose(number, reason, is_kept=self.goes_on)

    def _process(self, worker: WorkerProcess) -> str:
        names, agents = self._account.names, worker.agents
        first, last = names[agents[0]], names[agents[-1]]
        whose = first if len(agents) == 1 else f"{first} to {last}"
        return f"the process of {whose} (pid {worker.pid})"

    def when(self) -> str:
        """Return words for the simulated time, if it has begun."""
        return "" if self._account.began_s is None else f", at t = {self._clock.t_s:g} s"
