"""
The simulation's host half in a lockstep run: its calls are watched, and its jobs take no simulated time.

Jobs run on the executor, beside each other, while simulated time stands; their values are handed in
by the order in which they were submitted, whichever is done first.

The loop stands still while the half hangs in a call, so a thread of its own looks now and then and says in which.
Who hangs in a call that never lets other threads run is ended by the operator, which hears nothing more.
"""

from __future__ import annotations

import faulthandler
import os
import sys
import threading
from collections import deque
from collections.abc import Callable
from concurrent.futures import Executor, Future
from functools import partial
from typing import Any

from madns_runtime.config import Timeouts
from madns_runtime.faults.message_faults import MessageFaults
from madns_runtime.lockstep.barrier import STACK_HINT, Barrier
from madns_runtime.lockstep.result import EarlyEnd
from madns_runtime.lockstep.workers import WorkerProcess
from madns_runtime.plugin.api import HOST
from madns_runtime.plugin.context import JobContext
from madns_runtime.plugin.executor import JobRunner
from madns_runtime.plugin.half import REPEATS_MAX, HalfFailed, HostHalf
from madns_runtime.protocol.messages import Service
from madns_runtime.timing.granted_clock import GrantedLimit

LOOK_INTERVAL_S = 0.25
REPEATS_UNTIMED = 10
"""Calls of the timer behind the first at one simulated time that may each take as long as one alone; further ones share that time."""


class LockstepHalf:
    """
    Calls the host half.

    Args:
        half: The plug-in's.
        timeouts: How long its calls and jobs may take.
        barrier: Where jobs are waited for and faults end the run.
        executor: Who does the jobs.
        on_hang: Called, in another thread, with the reason when a call does not return; must not return.
    """

    def __init__(
        self,
        half: HostHalf,
        timeouts: Timeouts,
        *,
        barrier: Barrier,
        executor: Executor,
        on_hang: Callable[[str], None],
    ) -> None:
        self._half = half
        self._timeouts = timeouts
        self._barrier = barrier
        self._on_hang = on_hang
        self._faults: MessageFaults | None = None
        self._jobs = JobRunner(barrier.reactor, executor, self._job_done)
        self.close = self._jobs.close
        self._outstanding: deque[int] = deque()
        self._finished: dict[int, Future[Any]] = {}
        self._standing = GrantedLimit(timeouts.tick_s)
        self._under_way: tuple[str, float] | None = None  # a call, and how long it may take, s
        threading.Thread(target=self._watch_calls, name="call-watch", daemon=True).start()

    def submit(self, function: Callable[..., Any], *arguments: Any) -> int:
        """Start a job; see `plugin.api.HostContext.submit`."""
        job = self._jobs.submit(function, *arguments)
        self._outstanding.append(job)
        return job

    def call(self, name: str, *arguments: Any, limit_s: float | None = None) -> Any:
        """
        Call a method, and have done what it submits.

        Args:
            name: The method's.
            arguments: Its.
            limit_s: Wall time it may take; timeouts.tick_s if None.

        Raises:
            RunEnds: It raised, returned something else, or its job failed.
        """
        value = self._guard(name, partial(self._half.call, name, *arguments), limit_s)
        self._settle()
        return value

    def call_timer(self, t_s: float) -> None:
        """
        Call the timer at simulated time *t_s*, and have done what it submits.

        Raises:
            RunEnds: As `call`, or it never lets simulated time go on.
        """
        self._guard("timer", partial(self._half.call_timer, t_s))
        self._settle()
        half, limit_s = self._half, self._timeouts.tick_s
        if half.repeats == REPEATS_UNTIMED:
            self._standing = GrantedLimit(limit_s)
        elif half.repeats > REPEATS_UNTIMED and self._standing.is_over():
            asked = f"{half.name}.timer asked {half.repeats} times in a row for t = {t_s:g} s"
            why = f"for longer than {limit_s:g} s: simulated time stands (limit: timeouts.tick_s)"
            self._barrier.fail(HOST, f"{asked}, {why}")

    def finish(self) -> Any:
        """
        Return the half's summary; what it submits meanwhile comes too late.

        Raises:
            RunEnds: As `call`.
        """
        return self._guard("finish", partial(self._half.call, "finish"))

    def set_up(self, context: JobContext, limit_s: float) -> None:
        """
        Have it prepare, and have done what it submits; see `HostHalf.set_up`.

        Raises:
            RunEnds: As `call`.
        """
        self._guard("setup", partial(self._half.set_up, context), limit_s)
        self._settle()

    def take(self, agent: str, message: Any, service: Service) -> None:
        """
        Hand in what an agent sent, or show it to the faults in force; see `HostHalf.take`.

        Raises:
            RunEnds: As `call`.
        """
        if self._faults is not None:
            self._faults.take(agent, message, service)
        else:
            self.take_now(agent, message)

    def take_now(self, agent: str, message: Any) -> None:
        """
        Hand in what an agent sent, whatever faults are in force.

        Raises:
            RunEnds: As `call`.
        """
        self._guard("receive", partial(self._half.take_now, agent, message))
        self._settle()

    def intercept(self, faults: MessageFaults | None) -> None:
        """Show *faults* what agents send from now on, to the half and to each other; None: hand it in."""
        self._faults = self._half.carrier.faults = faults

    def _guard(self, name: str, call: Callable[[], Any], limit_s: float | None = None) -> Any:
        self._under_way = (name, limit_s or self._timeouts.tick_s)
        try:
            return call()
        except HalfFailed as failure:
            self._barrier.fail(HOST, str(failure))
        finally:
            self._under_way = None

    def _settle(self) -> None:
        """Hand in the values of all jobs, also of those that their values lead to."""
        settled = 0
        while self._outstanding:
            job = self._outstanding[0]
            limit_s = self._timeouts.host_setup_s
            self._barrier.wait(partial(self._finished.__contains__, job), limit_s, self._late)
            self._outstanding.popleft()
            future = self._finished.pop(job)
            self._guard("result", partial(self._half.take_job, job, future))
            settled += 1
            if settled > REPEATS_MAX:
                text = f"result submitted {REPEATS_MAX} jobs in a row: simulated time stands"
                self._barrier.fail(HOST, f"{self._half.name}.{text}")

    def _late(self, worker: WorkerProcess | None, limit_s: float) -> EarlyEnd:
        del worker  # none is awaited
        job = self._outstanding[0]
        reason = f"{self._half.name}: job {job} has not ended within {limit_s:g} s"
        return EarlyEnd(who=HOST, reason=f"{reason}{self._barrier.when()}")

    def _job_done(self, job: int, future: Future[Any]) -> None:
        self._finished[job] = future
        self._barrier.reactor.stop()

    def _watch_calls(self) -> None:
        watched, limit = None, GrantedLimit(0.0)
        while True:
            threading.Event().wait(LOOK_INTERVAL_S)
            present = self._under_way
            if present is not watched:
                # Its first part went unseen, and does not count.
                watched, limit = present, GrantedLimit(present[1] if present else 0.0)
            elif present is not None and limit.is_over():
                faulthandler.dump_traceback(file=sys.__stderr__ or 2)
                name, limit_s = present
                # Within a call others are made, such as the medium's.
                call = f"{self._half.name}.{self._half.doing or name}"
                when = self._barrier.when()
                self._on_hang(f"{call} has not returned within {limit_s:g} s{when}; {STACK_HINT}")
                os._exit(1)
